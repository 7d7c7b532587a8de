"""How much memory there is, and one line instead of work that would need more."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import psutil

from modeharvest.errors import InputError

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUP = Path("/proc/self/cgroup")
_UNITS = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")


def available_bytes() -> float:
    """Memory that this process may still take [bytes]: the machine's, or its container's."""
    return min(float(psutil.virtual_memory().available), *map(_left_in, _own_cgroups()))


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Refuse work before it begins to allocate.

    Parameters
    ----------
    needed
        A rough estimate [bytes]; infinite or NaN is too much.
    what
        Needs it: "an image of 9000 x 9000 px".
    remedy
        What to change.

    Raises
    ------
    InputError
        If there is less.
    """
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
    """What a control group may still take [bytes]; files it has cached don't count as taken."""
    for limit, usage in (
        ("memory.max", "memory.current"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
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
    for unit in _UNITS:
        if count < 1000.0 or unit == _UNITS[-1]:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:g}"
