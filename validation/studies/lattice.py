"""Study of lattice modes: on what the pattern of a square lattice depends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.lattice_pattern import (
    LOADINGS,
    RATIOS,
    STUDIED_MATERIALS,
    ModeRow,
    PatternMode,
    StudiedLattice,
    mode_likeness,
    pattern_mode,
    pattern_row,
    ratio_lattices,
    read_rows,
    write_rows,
)

SHOWN = (0.95, 0.7895, 0.25)
"""Of d/l in the paper's Fig. "graded", from left to right."""
Work = Callable[[StudiedLattice], ModeRow]


@dataclass(frozen=True)
class FirstModeLimit:
    """Between which d/l the pattern stops being what buckles first under one loading.

    ``without``, ``with_``: the largest d/l found at which something else comes first, and the
    smallest at which the pattern does [-]; ``instead``: what comes first below, as in
    :class:`ModeRow`.
    """

    loading: str
    without: float
    with_: float
    instead: str


@dataclass(frozen=True, eq=False)
class LatticeModeStudy:
    """What came out of a study.

    ``ratios``: every hole size under every loading. ``scales``, ``materials``: the reference at
    other l, and of other materials; each ``likeness`` is the overlap with the reference's own mode.
    ``limits``: where the pattern stops being the first mode, for each loading where it does.
    ``overlays``: modes to be laid over the analytic one.
    """

    ratios: tuple[ModeRow, ...] = ()
    scales: tuple[ModeRow, ...] = ()
    materials: tuple[ModeRow, ...] = ()
    limits: tuple[FirstModeLimit, ...] = ()
    overlays: tuple[PatternMode, ...] = ()


class ModeTable:
    """A CSV of rows that grows as they are computed; what it has isn't computed again.

    ``path``: the file; None to keep the rows in memory.
    """

    def __init__(self, path: Path | str | None = None) -> None:
        self.path = path
        rows = () if path is None else read_rows(path)
        self.known: dict[object, ModeRow] = {row.key: row for row in rows}

    def row(self, lattice: StudiedLattice, work: Work) -> ModeRow:
        """The row of a lattice, from the table or by ``work``."""
        if lattice.key not in self.known:
            self.known[lattice.key] = work(lattice)
            if self.path is not None:
                write_rows(self.path, self.known.values())
        return self.known[lattice.key]

    def rows(
        self, lattices: Sequence[StudiedLattice], work: Work, progress: Progress = silent
    ) -> tuple[ModeRow, ...]:
        """The rows of some lattices, in their order."""
        found = []
        for n, lattice in enumerate(lattices):
            progress(n, len(lattices), "mode study")
            found.append(self.row(lattice, work))
        progress(1, 1, "mode study")
        return tuple(found)


def study_likeness(
    reference: StudiedLattice,
    others: Sequence[StudiedLattice],
    table: ModeTable,
    progress: Progress = silent,
) -> tuple[ModeRow, ...]:
    """The rows of lattices of the reference's d/l, their modes compared with its mode."""

    @cache
    def own() -> PatternMode:
        return pattern_mode(reference, table.row(reference, pattern_row))

    def work(lattice: StudiedLattice) -> ModeRow:
        compared = own(), pattern_mode(lattice)
        return replace(compared[1].row, likeness=mode_likeness(*compared))

    return table.rows(others, work, progress)


def first_mode_limit(
    base: StudiedLattice,
    loading: str,
    rows: Sequence[ModeRow],
    tolerance: float = 0.005,
    table: ModeTable | None = None,
) -> FirstModeLimit | None:
    """Bisect d/l to where the pattern stops being the first mode of a loading.

    ``base``: all else about the lattice; ``rows``: known ones, to begin with; ``tolerance``: of
    d/l [-], an InputError if it is not positive. None if among the rows there is none with the
    pattern first and one below with something else.
    """
    if not tolerance > 0:
        raise InputError(f"mode study: expected a positive tolerance of d/l, got {tolerance}")
    table = table or ModeTable()
    known = sorted((row for row in rows if row.loading == loading), key=lambda row: row.ratio)
    below = [row for row in known if not row.is_first]
    above = [row for row in known if row.is_first and (not below or row.ratio > below[-1].ratio)]
    if not below or not above:
        return None
    low, high = below[-1], above[0]
    if low.kind == "path ends":
        return None
    while high.ratio - low.ratio > tolerance:
        ratio = round(0.5 * (low.ratio + high.ratio), 6)
        middle = table.row(replace(base, ratio=ratio, loading=LOADINGS[loading]), pattern_row)
        low, high = (low, middle) if middle.is_first else (middle, high)
    return FirstModeLimit(loading, low.ratio, high.ratio, low.kind)


def run_lattice_study(
    base: StudiedLattice,
    table: Path | str | None = None,
    *,
    ratios: Sequence[float] = RATIOS,
    loadings: Sequence[str] = tuple(LOADINGS),
    pitches: Sequence[float] = (),
    materials: Sequence[str] = (),
    shown: Sequence[float] = SHOWN,
    progress: Progress = silent,
) -> LatticeModeStudy:
    """The whole study about one lattice: hole sizes, scales, materials, limits, overlays.

    ``table``: CSV that keeps the rows, and that a study which was broken off goes on from;
    ``ratios``, ``loadings``: d/l [-] and names of loadings, every combination; ``pitches``: other l
    [mm], the mesh is scaled, too; ``materials``: names of other materials, among
    ``STUDIED_MATERIALS``; ``shown``: d/l of the overlays [-], under the reference's loading.
    """
    kept = ModeTable(table)
    rows = kept.rows(ratio_lattices(ratios, loadings, base), pattern_row, progress)
    limits = [first_mode_limit(base, name, rows, table=kept) for name in loadings]
    scaled = [replace(base, pitch=pitch) for pitch in pitches]
    others = [replace(base, material=STUDIED_MATERIALS[name]) for name in materials]
    overlaid = [replace(base, ratio=ratio) for ratio in shown]
    return LatticeModeStudy(
        rows,
        study_likeness(base, scaled, kept, progress),
        study_likeness(base, others, kept, progress),
        tuple(limit for limit in limits if limit is not None),
        tuple(pattern_mode(it, kept.row(it, pattern_row)) for it in overlaid),
    )
