"""The first critical point of a lattice's case, and ``critical.json``, which keeps it.

That holds ``point``, the fields of :class:`modeharvest.validation.lattice.run.CriticalPoint`, and
``history``: for each load looked at the least stable wave (see ``fem.zone.LeastStable``).
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from modeharvest.files import read_json, write_json
from modeharvest.lattice.options import Search
from modeharvest.progress import Progress, named, silent
from modeharvest.reading import reading
from modeharvest.validation.lattice.run import CriticalPoint

if TYPE_CHECKING:  # their modules need dolfinx
    from modeharvest.fem.bloch_critical import LatticeCritical
    from modeharvest.fem.cell import CellPath


def find_critical(path: CellPath, search: Search, progress: Progress = silent) -> LatticeCritical:
    """Look for the first critical point over all wave vectors.

    Raises
    ------
    InputError
        If the lattice is a mechanism.
    """
    from modeharvest.fem.bloch_critical import CriticalSearch, first_critical

    how = CriticalSearch(**asdict(search))
    return first_critical(path, how, named(progress, "first critical load"))


def write_critical(path: Path, loading: str, found: LatticeCritical) -> None:
    """Write ``critical.json``."""
    point = _in_order(CriticalPoint.of(loading, found))
    history = [asdict(least) for least in found.history]
    write_json(path, {"point": asdict(point), "history": history})


def read_critical(path: Path) -> CriticalPoint:
    """Read the point in ``critical.json``; InputError if it is damaged."""
    with reading(path, "a critical point", "remove it"):
        content = read_json(path)["point"]
        waves = {name: tuple(map(tuple, content[name])) for name in ("waves", "earlier")}
        signs = {name: tuple(content[name]) for name in ("below", "above")}
        return CriticalPoint(**{**content, **waves, **signs})


def _in_order(point: CriticalPoint) -> CriticalPoint:
    """The same with its waves by phases, the largest first: rounding must not number the modes."""
    every = zip(point.waves, point.below, point.above, strict=True)
    ordered = sorted(every, key=lambda one: [-round(phase, 3) for phase in one[0]])
    waves, below, above = zip(*ordered, strict=True) if ordered else ((), (), ())
    return replace(point, waves=waves, below=below, above=above)
