"""Who this process is among those that mpirun started; alone without it.

MPI is asked only where a launcher has left its marks, so that nothing else has to load it.
"""

from __future__ import annotations

import os
from functools import cache
from typing import Any

_MARKS = ("OMPI_COMM_WORLD_SIZE", "PMIX_RANK", "PMI_SIZE", "PMI_RANK")


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


def agreed(value: bool) -> bool:
    """Rank 0's value, on every rank; the others wait for it."""
    world = _world()
    return value if world is None else bool(world.bcast(value))
