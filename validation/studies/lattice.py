"""Study of lattice modes: parameters that affect the pattern of a square lattice.

The paper says that modes are independent of the size l of the unit cell, of d/l for moderate
variations, and of the material (Section "Graded Microstructures and Size Independence of the
Modes"). This study quantifies it by the normalised overlap of a lattice's numerical mode at (π, π)
with Eq. (6).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import MacroLoading, equibiaxial, uniaxial, uniaxial_strain
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.idic.modes import square_family
from modeharvest.idic.spectra.lattice_spectrum import MeshQuadrature
from modeharvest.idic.spectra.mode_family import best_amplitude, mode_family, overlap, wave_sum
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.files import reading, write_csv
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.typed import headings, nearest, quantity

if TYPE_CHECKING:
    from modeharvest.fem.bloch.critical import LatticeCritical
    from modeharvest.fem.lattice.cell import CellPath

Key = tuple[str, str, float, float, int]


@dataclass(frozen=True)
class ModeRow:
    """The pattern of one lattice under one loading; labels and units are the table's headings."""

    material: str = quantity("material")
    loading: str = quantity("loading")
    pitch: float = quantity("l", "mm")
    ratio: float = quantity("d/l", "-")
    divisions: int = quantity("elements per l", "-")
    found: bool = quantity("critical point found")
    first: float = quantity("first critical or largest strain", "-")
    kind: str = quantity("first critical waves")
    """First critical waves: "pattern" for (π, π) alone, "long waves", "other waves"; "none" if
    nothing is critical up to the largest load; "path ends" if no further equilibrium was found."""
    pattern: float = quantity("critical strain of (pi, pi)", "-")
    """First load at which (π, π) is critical, alone or not; NaN if none in the range."""
    state: float = quantity("strain of the mode's state", "-")
    """Load of the state at which the mode is computed: the first critical one, else the last."""
    eigenvalue: float = quantity("eigenvalue at (pi, pi)", "N/mm^4")
    overlap: float = quantity("overlap with Eq. (6)", "-")
    """|<numerical, analytic>| of the lowest mode at (π, π) with Eq. (6), both of unit norm over
    the material."""
    captured: float = quantity("energy captured by the automatic family", "-")
    """Share of the mode's energy captured by the automatically found mode family."""
    waves: int = quantity("its waves", "-")
    likeness: float = quantity("overlap with the reference's mode", "-", default=math.nan)
    """|<mode, mode of the reference>|, both of unit norm, on the same mesh up to its size; NaN if
    not compared."""

    @property
    def key(self) -> Key:
        """The parameters of the computation, without its results."""
        return (self.material, self.loading, self.pitch, self.ratio, self.divisions)

    @property
    def is_first(self) -> bool:
        """Whether the pattern is the first mode to buckle."""
        return self.kind == "pattern"


_HEADS = headings(ModeRow)
_ROWS = TypeAdapter(tuple[ModeRow, ...])


def write_rows(path: Path, rows: Iterable[ModeRow]) -> None:
    """Write the table atomically, with all digits."""
    write_csv(path, _HEADS.values(), ([getattr(row, name) for name in _HEADS] for row in rows))


def read_rows(path: Path) -> tuple[ModeRow, ...]:
    """Read a file of :func:`write_rows`; empty without a file, InputError for another format."""
    if not path.exists():
        return ()
    heads, remedy = list(_HEADS.values()), "remove it to begin anew"
    with (
        reading(path, "a table of the mode study", remedy),
        path.open(newline="", encoding="utf-8") as file,
    ):
        first, *rows = csv.reader(file)
        if first != heads:
            raise InputError(f"expected the columns of this version, got {first}; {remedy}")
        return _ROWS.validate_python([dict(zip(_HEADS, row, strict=True)) for row in rows])


PATTERN = (math.pi, math.pi)
"""The wave of the paper's pattern, as phase differences from cell to cell [rad]."""
EQ_MODE = square_family("hole")
"""The analytic mode, Eq. (6) of the paper; a hole's centre is the origin."""
_STEP, _CLOSE = 0.02, 0.002  # step of the load [-]
_NARROW = 0.005  # width of the bracket of d/l at which the first mode changes [-]
LOADINGS: dict[str, MacroLoading] = {
    "uniaxial": uniaxial(), "uniaxial-strain": uniaxial_strain(), "equibiaxial": equibiaxial()
}  # fmt: skip


def ogden(exponent: float, poisson: float, shear: float = 0.6) -> Ogden:
    """One Ogden term with a Poisson's ratio [-] and a shear modulus [MPa]."""
    kappa = round(2.0 * poisson * shear / (1.0 - 2.0 * poisson), 9)
    return Ogden((2.0 * shear,), (exponent,), kappa)


STUDIED_MATERIALS: dict[str, Material] = {
    "two-term-I1": TwoTermI1(),
    **{f"Ogden m={m:g}, nu={nu:.2f}": ogden(m, nu)
       for m, nu in ((3, 0.45), (2, 0.45), (4, 0.45), (6, 0.45), (-2, 0.45), (3, 0.40), (3, 0.49))},
}  # fmt: skip
"""By name. The first is the reference; exponents and Poisson's ratios vary about (3, 0.45)."""


@dataclass(frozen=True)
class StudiedLattice:
    """One lattice of the study: all parameters on which its pattern may depend."""

    ratio: float = 0.7895
    """Hole diameter over cell size d/l [-]."""
    loading: MacroLoading = LOADINGS["uniaxial"]
    material: Material = STUDIED_MATERIALS["two-term-I1"]
    pitch: float = 1.9
    """Unit cell size l [mm]."""
    divisions: int = 13
    """Elements along l."""
    largest: float = 0.28
    """Load up to which to look for critical points [-]."""

    def __post_init__(self) -> None:
        if not (0 < self.ratio < 1 and self.pitch > 0 and self.divisions > 0 and self.largest > 0):
            wanted = "0 < d/l < 1 and a positive pitch, number of elements and load"
            raise InputError(f"mode study: expected {wanted}, got {self}")

    @property
    def key(self) -> Key:
        """The same as :attr:`ModeRow.key`."""
        names = name_of(self.material, STUDIED_MATERIALS), name_of(self.loading, LOADINGS)
        return (*names, self.pitch, self.ratio, self.divisions)


@dataclass(frozen=True, eq=False)
class PatternMode:
    """The numerical pattern of a lattice and the analytic one."""

    row: ModeRow
    mesh: Mesh
    """Mesh of the primitive cell around a hole, a quarter of the pattern's cell [mm]."""
    shape: FloatArray
    analytic: FloatArray
    """(n, 2) numerical and analytic mode at the nodes [-]; the mean of their squared length over
    the material is 1, their scalar product is positive."""


def name_of(thing: object, names: Mapping[str, object]) -> str:
    """The name of ``thing`` in ``names``; its repr if it has none."""
    return next((name for name, known in names.items() if known == thing), repr(thing))


def overlap_of_fields(mesh: Mesh, first: FloatArray, second: FloatArray) -> float:
    """Normalised overlap of two nodal fields (n, 2) over the material [-]."""
    rule = MeshQuadrature(mesh)
    return math.sqrt(best_amplitude(rule, rule.values(first), rule.values(second))[1])


def mode_likeness(reference: PatternMode, other: PatternMode) -> float:
    """Overlap of two lattices' modes [-]; InputError unless the meshes differ by a factor only."""
    nodes = other.mesh.nodes / other.row.pitch, reference.mesh.nodes / reference.row.pitch
    if nodes[0].shape != nodes[1].shape or not np.allclose(*nodes, rtol=0, atol=1e-9):
        raise InputError(
            "mode study: expected two lattices of the same d/l and divisions, got "
            f"{reference.row.key} and {other.row.key}"
        )
    return overlap_of_fields(reference.mesh, reference.shape, other.shape)


def pattern_row(lattice: StudiedLattice) -> ModeRow:
    """Find a lattice's first critical point and compare its lowest mode at (π, π).

    The mode is computed at the first critical state, or, without one, at the last state reached.
    If (π, π) is not critical there, its eigenvalue shows how far it is from critical.
    """
    from modeharvest.fem.bloch.critical import critical_at, first_critical
    from modeharvest.fem.bloch.real_modes import real_modes
    from modeharvest.fem.lattice.options import CriticalSearch

    path, search = _path(lattice), CriticalSearch(largest=lattice.largest)
    found = first_critical(path, search)
    if not found.found and found.load < lattice.largest:
        # The path ends within the next step, perhaps after a critical point: use small steps.
        search = CriticalSearch(largest=lattice.largest, largest_step=_CLOSE)
        found = first_critical(path, search)
    kind = kind_of(found, lattice.largest)
    alone = found if kind == "pattern" else critical_at(path, PATTERN, search)
    modes = real_modes(path.cell, found.state, (PATTERN,))
    pitch, shape = lattice.pitch, modes.shapes[0]
    automatic = mode_family(modes.mesh, modes.lattice, shape, pitch)
    return ModeRow(
        *lattice.key, found.found, found.load, kind, alone.load if alone.found else math.nan,
        found.load, float(modes.eigenvalues[0]), overlap(modes.mesh, shape, EQ_MODE, pitch),
        automatic.captured, automatic.family.wave_count,
    )  # fmt: skip


def pattern_mode(lattice: StudiedLattice, row: ModeRow | None = None) -> PatternMode:
    """The mode described by a lattice's row; without a row, the row is computed first.

    InputError if there is no equilibrium at the row's state: the row is another lattice's.
    """
    from modeharvest.fem.bloch.real_modes import real_modes

    row, path = row or pattern_row(lattice), _path(lattice)
    for load in np.linspace(0.0, row.state, 2 + int(row.state / _STEP)):
        state = path.at(float(load))
    if state is None:
        raise InputError(
            f"mode study: expected an equilibrium at the load {row.state} of {lattice}, got none; "
            "remove the table that this row is from"
        )
    modes, mesh = real_modes(path.cell, state, (PATTERN,)), path.cell.cell.mesh
    quarter = cKDTree(modes.mesh.nodes).query(mesh.nodes)[1]
    shape, rule = modes.shapes[0][quarter], MeshQuadrature(mesh)
    analytic = wave_sum(EQ_MODE.waves(EQ_MODE.start), mesh.nodes, lattice.pitch)
    a, b = rule.values(shape), rule.values(analytic)
    sizes = [math.sqrt(rule.product(v, v) / rule.area) for v in (a, b)]
    sign = math.copysign(1.0, rule.product(a, b))
    return PatternMode(row, mesh, sign / sizes[0] * shape, np.asarray(analytic / sizes[1]))


def _path(lattice: StudiedLattice) -> CellPath:
    from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
    from modeharvest.fem.lattice.cells import UnitCell, square

    # Meshed for l = 1 mm and scaled: gmsh's tolerances are lengths, so its meshes depend on l.
    one = square(1.0, lattice.ratio, 1.0 / lattice.divisions)
    mesh = Mesh(lattice.pitch * one.mesh.nodes, one.mesh.cells, one.mesh.element)
    unit = UnitCell(mesh, lattice.pitch * one.lattice)
    return CellPath(PeriodicCell(unit, lattice.material), lattice.loading)


def kind_of(found: LatticeCritical, largest: float) -> str:
    """The first critical waves up to the largest load, as :attr:`ModeRow.kind`."""
    from modeharvest.fem.bloch.degenerate import is_same

    if not found.found:
        return "none" if found.load >= largest else "path ends"
    if found.least_stable.angle is not None:
        return "long waves"
    alone = len(found.waves) == 1 and is_same(found.waves[0], PATTERN)
    return "pattern" if alone else "other waves"


Work = Callable[[StudiedLattice], ModeRow]


@dataclass(frozen=True)
class FirstModeLimit:
    """Interval of d/l in which the pattern stops being the first mode under one loading."""

    loading: str
    without: float
    with_: float
    """The largest d/l found at which another mode is first, and the smallest at which the pattern
    is first [-]."""
    instead: str
    """The first critical waves below, as :attr:`ModeRow.kind`."""


@dataclass(frozen=True, eq=False)
class LatticeModeStudy:
    """Results of a study of lattice modes."""

    ratios: tuple[ModeRow, ...] = ()
    """Rows for every hole size under every loading."""
    scales: tuple[ModeRow, ...] = ()
    materials: tuple[ModeRow, ...] = ()
    """Rows of the reference lattice with other l and with other materials; each ``likeness`` is the
    overlap with the reference's mode."""
    limits: tuple[FirstModeLimit, ...] = ()
    """d/l at which the pattern stops being the first mode, for each loading with such a limit."""
    overlays: tuple[PatternMode, ...] = ()
    """Modes to be drawn over the analytic one."""


class ModeTable:
    """A CSV of rows, extended as they are computed; existing rows aren't computed again.

    ``path``: the file; None to keep the rows in memory.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self.known = {row.key: row for row in (() if path is None else read_rows(path))}

    def row(self, lattice: StudiedLattice, work: Work) -> ModeRow:
        """The row of a lattice, from the table or computed by ``work``."""
        if lattice.key not in self.known:
            self.known[lattice.key] = work(lattice)
            if self.path is not None:
                write_rows(self.path, self.known.values())
        return self.known[lattice.key]

    def rows(
        self, lattices: Sequence[StudiedLattice], work: Work, progress: Progress = silent
    ) -> tuple[ModeRow, ...]:
        """The rows of some lattices, in their order."""
        return tuple(self.row(it, work) for it in counted(lattices, progress, "mode study"))


def study_likeness(
    reference: StudiedLattice,
    others: Sequence[StudiedLattice],
    table: ModeTable,
    progress: Progress = silent,
) -> tuple[ModeRow, ...]:
    """The rows of lattices with the reference's d/l, their modes compared with its mode."""

    @cache
    def own() -> PatternMode:
        return pattern_mode(reference, table.row(reference, pattern_row))

    def work(lattice: StudiedLattice) -> ModeRow:
        compared = own(), pattern_mode(lattice)
        return replace(compared[1].row, likeness=mode_likeness(*compared))

    return table.rows(others, work, progress)


def first_mode_limit(
    base: StudiedLattice, loading: str, rows: Sequence[ModeRow], table: ModeTable
) -> FirstModeLimit | None:
    """Find by bisection the d/l at which the pattern stops being the first mode under a loading.

    ``base``: the other parameters of the lattice; ``rows``: known rows, as initial bracket. None
    unless they include one with the pattern first, and one with smaller d/l and another mode first.
    """
    known = sorted((row for row in rows if row.loading == loading), key=lambda row: row.ratio)
    below = [row for row in known if not row.is_first]
    above = [row for row in known if row.is_first and (not below or row.ratio > below[-1].ratio)]
    if not below or not above or below[-1].kind == "path ends":
        return None
    low, high = below[-1], above[0]
    while high.ratio - low.ratio > _NARROW:
        ratio = round(0.5 * (low.ratio + high.ratio), 6)
        middle = table.row(replace(base, ratio=ratio, loading=LOADINGS[loading]), pattern_row)
        low, high = (low, middle) if middle.is_first else (middle, high)
    return FirstModeLimit(loading, low.ratio, high.ratio, low.kind)


@dataclass(frozen=True)
class StudyPlan:
    """Parameters that a study varies about one lattice.

    Every ratio under every loading, and the limit below which the pattern isn't the first mode;
    other unit cell sizes and materials at the lattice's own d/l and loading.
    """

    ratios: tuple[float, ...] = (0.25, 0.35, 0.45, 0.55, 0.6, 0.65, 0.7, 0.7895, 0.8696, 0.95)
    """d/l [-]: 0.7895 is the paper's; for 0.8696 and 0.95 independent results exist, too."""
    loadings: tuple[str, ...] = tuple(LOADINGS)
    """Loadings, among "uniaxial", "uniaxial-strain" and "equibiaxial"."""
    pitches: tuple[float, ...] = ()
    """Other l [mm], with which the mesh is scaled."""
    materials: tuple[str, ...] = ()
    """Names among ``STUDIED_MATERIALS``."""
    overlays: tuple[float, ...] = (0.95, 0.7895, 0.25)
    """d/l of the pictures of numerical over analytic mode [-]; as in Fig. 8 of the paper."""
    divisions: int = 13
    """Elements along l."""
    largest: float = 0.28
    """Load up to which to look for critical points [-]."""

    def __post_init__(self) -> None:
        for names, known in ((self.loadings, LOADINGS), (self.materials, STUDIED_MATERIALS)):
            for name in names:
                if name not in known:
                    raise InputError(f"unknown name {name!r}{nearest(name, list(known))}")
        if not self.loadings or not self.ratios:
            raise InputError("study: expected a ratio and a loading or more, got none")
        require_within("study: expected divisions", self.divisions, 4, 200)
        if not 0 < self.largest < 1:
            raise InputError(f"study: expected 0 < largest < 1, got {self.largest}")
        for pitch in self.pitches:
            require_within("study: expected pitches [mm]", pitch, 0, above=True)
        if not all(0 < ratio < 1 for ratio in (*self.ratios, *self.overlays)):
            raise InputError(f"study: expected 0 < d/l < 1, got {self.ratios}, {self.overlays}")


def run_lattice_study(
    base: StudiedLattice, plan: StudyPlan, table: Path | None = None, progress: Progress = silent
) -> LatticeModeStudy:
    """The whole study about one lattice: hole sizes, scales, materials, limits, overlays.

    ``base``: the lattice, with the plan's divisions and largest load; ``table``: CSV that stores
    the rows, and from which an interrupted study continues.
    """
    kept = ModeTable(table)
    base = replace(base, divisions=plan.divisions, largest=plan.largest)
    lattices = [replace(base, ratio=r, loading=LOADINGS[name])
                for name, r in product(plan.loadings, plan.ratios)]  # fmt: skip
    rows = kept.rows(lattices, pattern_row, progress)
    limits = [first_mode_limit(base, name, rows, kept) for name in plan.loadings]
    scaled = [replace(base, pitch=pitch) for pitch in plan.pitches]
    others = [replace(base, material=STUDIED_MATERIALS[name]) for name in plan.materials]
    overlaid = [replace(base, ratio=ratio) for ratio in plan.overlays]
    scales, other = (study_likeness(base, some, kept, progress) for some in (scaled, others))
    overlays = tuple(pattern_mode(it, kept.row(it, pattern_row)) for it in overlaid)
    known = tuple(limit for limit in limits if limit is not None)
    return LatticeModeStudy(rows, scales, other, known, overlays)
