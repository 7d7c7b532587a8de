"""Who this process is among those that mpirun started; alone without it.

MPI is asked only where a launcher has left its marks, so that nothing else has to load it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

_MARKS = ("OMPI_COMM_WORLD_SIZE", "PMIX_RANK", "PMI_SIZE", "PMI_RANK")

T = TypeVar("T")


@cache
def _world() -> Any:
    if not any(mark in os.environ for mark in _MARKS):
        return None
    try:
        from mpi4py import MPI
    except ImportError:
        return None
    return MPI.COMM_WORLD


def is_alone() -> bool:
    """Whether no launcher of MPI started this process."""
    return _world() is None


def is_first() -> bool:
    """Whether this is rank 0, the one that writes and talks."""
    world = _world()
    return world is None or world.rank == 0


def on_first(work: Callable[[], T]) -> T:
    """Do work on rank 0 alone; every rank waits for it, and returns or raises what it did."""
    world = _world()
    if world is None:
        return work()
    done: tuple[Any, Exception | None] = (None, None)
    if world.rank == 0:
        try:
            done = work(), None
        except Exception as error:  # of any kind: the others would wait for ever
            done = None, error
    value, failure = world.bcast(done)
    if failure is not None:
        raise failure
    found: T = value
    return found
