"""The machine that the program runs on: free memory, and the ranks that mpirun started.

MPI is loaded only if environment variables of a launcher are set: other processes don't need it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from modeharvest.util.errors import InputError

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUP = Path("/proc/self/cgroup")
_LITTLE = 1e6
"""Amounts below this are not checked [bytes]: less than an import takes."""
_UNITS = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")


def available_bytes() -> float:
    """Memory that this process may still take [bytes]: the machine's, or its container's."""
    import psutil  # here: it is a tenth of the command line's start time

    return min(float(psutil.virtual_memory().available), *map(_left_in, _own_cgroups()))


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Raise InputError before work that would allocate more memory than is available.

    ``needed``: a rough estimate [bytes]; infinity and NaN are refused. ``what`` needs it, such as
    "an image of 9000 x 9000 px"; ``remedy``: advice to the user.
    """
    if needed < _LITTLE:
        return
    there = available_bytes()
    if not needed <= there:
        raise InputError(
            f"expected {what} to fit into the memory that is free, {_readable(there)}, got one "
            f"that needs about {_readable(needed)}; {remedy}"
        )


def _own_cgroups() -> list[Path]:
    """The folders of the control groups that this process is in; Linux only.

    A limit counts wherever it is set between the process's own group and the root.
    """
    folders = [_CGROUPS, _CGROUPS / "memory"]
    with suppress(OSError):
        for line in _OWN_CGROUP.read_text("utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                own = _CGROUPS / controllers / path.lstrip("/")
                folders += [own, *(p for p in own.parents if _CGROUPS in p.parents)]
    return folders


def _left_in(folder: Path) -> float:
    """Memory left to a control group [bytes]; its cached files count as free memory."""
    v2, v1 = ("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for limit, usage in (v2, v1):
        with suppress(OSError, ValueError):
            left = float((folder / limit).read_text()) - float((folder / usage).read_text())
            return left + _cached_in(folder)
    return float("inf")


def _cached_in(folder: Path) -> float:
    with suppress(OSError, ValueError):
        entries = (line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return float(next((value for name, value in entries if name == "inactive_file"), 0))
    return 0.0


def _readable(count: float) -> str:
    """1.2e10 as "12 GB"."""
    power = next((k for k in range(6) if count < 1000.0 ** (k + 1)), 6)
    return f"{count / 1000.0**power:.3g} {_UNITS[power]}"


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
    """Whether this is rank 0, which alone writes files and messages."""
    world = _world()
    return world is None or world.rank == 0


def on_first(work: Callable[[], T]) -> T:
    """Do work on rank 0 only; all ranks wait, then return its result or raise its exception."""
    world = _world()
    if world is None:
        return work()
    done: tuple[Any, Exception | None] = (None, None)
    if world.rank == 0:
        try:
            done = work(), None
        except Exception as error:  # of any type: the other ranks would wait for ever
            done = None, error
    value, failure = world.bcast(done)
    if failure is not None:
        raise failure
    return cast(T, value)
