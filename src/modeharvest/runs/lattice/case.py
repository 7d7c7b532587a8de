"""Case of an infinite lattice: a TOML file, or a few lines of Python, validated before the run.

::

    title = "..."
    [lattice]      # kind = "square", "hexagonal", "tetrachiral", "hexachiral" or "file"
    [material]     # kind = "ogden" or "two-term-I1", and its constants
    [loading]      # kind = "uniaxial", "uniaxial-strain", "equibiaxial", "shear", "prescribed"
    [search]       # largest load, resolution
    [dispersion]   # loads, points, bands
    [modes]        # which modes, which branches
    [study]        # optional: how the pattern depends on d/l, l, material and loading

In Python: ``LatticeCase(lattice=SquareLattice(1.9, 1.5), loading=Loading("equibiaxial"))``.
gmsh is needed only when the cell is meshed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from pydantic import model_validator

from modeharvest.fem.bloch.dispersion import ZONES
from modeharvest.fem.lattice import options
from modeharvest.fem.lattice.options import CriticalSearch, Wave
from modeharvest.fem.materials import MATERIALS, Material, Ogden
from modeharvest.runs.case import CaseModel, of_kind, with_kind
from modeharvest.runs.lattice.loads import Loading
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.lattice import (
    LatticeModeStudy,
    StudiedLattice,
    StudyPlan,
    run_lattice_study,
)

if TYPE_CHECKING:
    from modeharvest.fem.lattice.cells import UnitCell


@runtime_checkable
class LatticeSpec(Protocol):
    """Interface of lattices: their primitive cell can be meshed."""

    @property
    def pitch(self) -> float:
        """Unit cell size l [mm], the unit of wave lengths in spectra."""

    @property
    def symmetry(self) -> str:
        """Symmetry without load: "square", "hexagonal" (60 deg from a1 to a2) or "oblique"."""

    def cell(self) -> UnitCell:
        """The primitive cell, meshed; InputError if no such lattice exists."""


def _require_holes(lattice: SquareLattice | HexagonalLattice) -> None:
    """Raise InputError unless lengths are positive and holes don't touch."""
    require_within("expected mesh_size [mm]", lattice.mesh_size, 0.0, above=True)
    if not 0 < lattice.diameter < lattice.pitch < math.inf:
        got = f"{lattice.diameter} and {lattice.pitch}"
        raise InputError(f"expected 0 < diameter < pitch [mm], got {got}; holes must not touch")


@dataclass(frozen=True)
class SquareLattice:
    """Holes in square stacking: pitch l, diameter d, edge length of the elements [mm]."""

    pitch: float = 1.9
    diameter: float = 1.5
    mesh_size: float = 0.15
    symmetry = "square"

    def __post_init__(self) -> None:
        _require_holes(self)

    def cell(self) -> UnitCell:
        """The primitive cell, with one hole."""
        from modeharvest.fem.lattice.cells import square

        return square(self.pitch, self.diameter, self.mesh_size)


@dataclass(frozen=True)
class HexagonalLattice:
    """Holes in hexagonal stacking: distance of centres l, diameter d, element edge length [mm]."""

    pitch: float = 1.386
    diameter: float = 1.28
    mesh_size: float = 0.1
    symmetry = "hexagonal"

    def __post_init__(self) -> None:
        _require_holes(self)

    def cell(self) -> UnitCell:
        """The primitive cell, with one hole."""
        from modeharvest.fem.lattice.cells import hexagonal

        return hexagonal(self.pitch, self.diameter, self.mesh_size)


@dataclass(frozen=True)
class ChiralLattice:
    """Rings joined by ligaments that touch them tangentially: ``fem.lattice.cells.chiral``."""

    pitch: float = 1.9
    """Distance between the centres of neighbouring rings [mm]."""
    mesh_size: float = 0.1
    """Edge length of the elements [mm]."""
    ring_radius: float | None = None
    ring_thickness: float | None = None
    ligament_thickness: float | None = None
    """Dimensions [mm]; by default those of ``fem.lattice.cells.chiral``."""
    handedness: Literal["clockwise", "counterclockwise"] = "clockwise"
    """Either "clockwise" or "counterclockwise"."""
    ligaments = 4
    symmetry = "square"

    def __post_init__(self) -> None:
        for name in ("pitch", "mesh_size", "ring_radius", "ring_thickness", "ligament_thickness"):
            if (value := getattr(self, name)) is not None:
                require_within(f"expected {name} [mm]", value, 0.0, above=True)

    def cell(self) -> UnitCell:
        """The primitive cell: one ring."""
        from modeharvest.fem.lattice.cells import chiral

        walls = (self.ring_radius, self.ring_thickness, self.ligament_thickness)
        return chiral(self.pitch, self.mesh_size, self.ligaments, *walls, self.handedness)


@dataclass(frozen=True)
class TetrachiralLattice(ChiralLattice):
    """Four ligaments at each ring, rings on a square lattice."""


@dataclass(frozen=True)
class HexachiralLattice(ChiralLattice):
    """Six ligaments at each ring, rings on a hexagonal lattice."""

    ligaments = 6
    symmetry = "hexagonal"


@dataclass(frozen=True)
class FileLattice:
    """A cell read from a file, a mesh or a geometry: ``fem.lattice.files.read_cell``."""

    path: str
    """Path of the mesh or geometry; in a case file, relative to that file's folder."""
    pitch: float
    """Unit cell size l [mm], the unit of wave lengths in spectra."""
    vectors: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Lattice vectors a1 and a2, as rows [mm]; None: the bounding rectangle along x and y."""
    mesh_size: float | None = None
    """Largest edge length of elements, for a geometry that is meshed [mm]; None for a mesh."""
    unit: str | None = None
    """Unit of lengths in the file, such as "m" or "um"; None: mm, refused if that is unlikely."""
    primitive: bool = True
    """Whether a supercell is reduced to its primitive cell, to which waves and modes refer."""
    symmetry = "oblique"

    def __post_init__(self) -> None:
        require_within("expected pitch [mm]", self.pitch, 0.0, above=True)
        if self.mesh_size is not None:
            require_within("expected mesh_size [mm]", self.mesh_size, 0.0, above=True)

    def cell(self) -> UnitCell:
        """The cell in the file, or its primitive cell."""
        from modeharvest.fem.lattice.files import read_cell
        from modeharvest.fem.lattice.primitive import primitive_cell

        cell = read_cell(self.path, self.vectors, self.mesh_size, self.unit)
        shortest = float(np.linalg.norm(cell.lattice, axis=1).min())
        if not 0.01 < self.pitch / shortest < 100:
            raise InputError(
                f"{self.path}: expected the pitch l in mm, about the distance of the holes in a "
                f"cell whose shorter vector is {shortest:.4g} mm long, got {self.pitch}"
            )
        return primitive_cell(cell, self.primitive)


LATTICES: dict[str, type[Any]] = {
    "square": SquareLattice, "hexagonal": HexagonalLattice, "tetrachiral": TetrachiralLattice,
    "hexachiral": HexachiralLattice, "file": FileLattice,
}  # fmt: skip


@dataclass(frozen=True)
class DispersionPlan:
    """Where the lowest eigenvalues are computed."""

    loads: tuple[float, ...] = ()
    """Loads e [-]; by default 0, half the critical load, and the critical load."""
    points: int = 60
    """Number of wave vectors along the path; 0: no dispersion."""
    bands: int = 3
    """Number of lowest eigenvalues at each wave vector."""
    map_divisions: int = 24
    """Divisions of each axis of the Brillouin zone's map; even, 0 for no map."""
    corners: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Names and phases [π rad] of the path's corners, such as [["Γ", [0, 0]], ["M", [1, 1]]]; by
    default a path that suits the symmetry of lattice and load."""

    def __post_init__(self) -> None:
        _check_loads("dispersion", self.loads)
        tour = self._own_tour()
        if not self.points:
            return
        if tour and not 2 <= len(tour) <= self.points:
            raise InputError(
                "dispersion: expected two corners or more, and no fewer points, got "
                f"{len(tour)} corners and {self.points} points"
            )
        require_within("dispersion: expected points", self.points, 8, 10_000)
        require_within("dispersion: expected bands", self.bands, 1, 100)
        require_within("dispersion: expected map_divisions", self.map_divisions, 0, 1000)
        if self.map_divisions % 2:
            raise InputError(
                f"dispersion: expected an even number of map divisions, got {self.map_divisions}"
            )

    def tour(self, lattice: LatticeSpec, loading: Loading) -> tuple[tuple[str, Wave], ...]:
        """Names and phases [rad] of the path's corners."""
        if self.corners:
            return self._own_tour()
        if loading.is_isotropic or lattice.symmetry == "oblique":
            return ZONES[lattice.symmetry]
        return ZONES["rhombic" if lattice.symmetry == "hexagonal" else "oblique"]

    def _own_tour(self) -> tuple[tuple[str, Wave], ...]:
        return tuple((name, options.phases_in_rad(wave)) for name, wave in self.corners)


@dataclass(frozen=True)
class ModesPlan:
    """Options of the modes to compute and the buckled branches to follow."""

    waves: tuple[tuple[float, ...], ...] = ()
    """Phases of the modes' waves [π rad], such as [[1, 1]]; by default the critical waves."""
    load: float = 0.0
    """Load at which the tangent is evaluated [-]; 0: the critical load, or the largest reached.
    Branches are followed only for modes at the critical load."""
    combinations: tuple[tuple[float, ...], ...] = ()
    """One row for each branch to follow, with one coefficient per mode, in the order of their waves
    (critical waves by phases, the largest first). By default all combinations that are not
    equivalent by symmetry, ``fem.bloch.degenerate.distinct_combinations``."""
    branch_loads: tuple[float, ...] = ()
    """Loads at which states of the branches are stored [-]; by default 1.02, 1.1, 1.25 and 1.5
    times the critical load."""

    def __post_init__(self) -> None:
        _ = self.phases
        _check_loads("modes", (self.load, *self.branch_loads))
        for row in self.combinations:
            if not any(row) or not all(math.isfinite(c) for c in row):
                raise InputError(f"modes: expected finite combinations, not all 0, got {row}")

    @property
    def phases(self) -> tuple[Wave, ...]:
        """Phases of the waves [rad]."""
        return tuple(options.phases_in_rad(wave) for wave in self.waves)


def _check_loads(where: str, loads: Sequence[float]) -> None:
    if not all(0 <= load < 1 for load in loads):
        raise InputError(f"{where}: expected loads of 0 or more and below 1, got {tuple(loads)}")


class LatticeCase(CaseModel):
    """An infinite lattice under load, with the options of its analysis."""

    table = "lattice"

    lattice: Annotated[LatticeSpec, of_kind(LATTICES, "lattice")] = SquareLattice()
    material: Annotated[Material, of_kind(MATERIALS, "material")] = Ogden()
    loading: Loading = Loading()
    search: CriticalSearch = CriticalSearch()
    dispersion: DispersionPlan = DispersionPlan()
    modes: ModesPlan = ModesPlan()
    study: StudyPlan | None = None

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as for any kind; a lattice's path is relative to the folder of its file."""
        case = super().read(name)
        if not isinstance(case.lattice, FileLattice):
            return case
        file = str(Path(name).parent / case.lattice.path)
        return case.model_copy(update={"lattice": replace(case.lattice, path=file)})

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values; lattice and material have their ``kind``."""
        lattice, material = with_kind(self.lattice, LATTICES), with_kind(self.material, MATERIALS)
        return {**super().plain(), "lattice": lattice, "material": material}

    @model_validator(mode="after")
    def _can_be_searched_and_studied(self) -> Self:
        if self.search.largest >= 1:
            raise InputError(f"search: expected 0 < largest < 1, got {self.search.largest}")
        if self.study is not None and not isinstance(self.lattice, SquareLattice):
            raise InputError(
                "expected a square lattice for a [study], got another kind; leave [study] out"
            )
        return self

    def run_study(self, table: Path, progress: Progress = silent) -> LatticeModeStudy | None:
        """Run the study, continuing from the rows in ``table``; None without [study]."""
        plan, lattice = self.study, self.lattice
        if plan is None or not isinstance(lattice, SquareLattice):
            return None
        ratio, loading = lattice.diameter / lattice.pitch, self.loading.macro()
        base = StudiedLattice(ratio, loading, self.material, lattice.pitch)
        return run_lattice_study(base, plan, table, progress)
