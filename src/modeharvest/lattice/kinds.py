"""The kinds of lattices a case can name, none of which needs gmsh before its cell is meshed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:  # it needs gmsh
    from modeharvest.fem.lattices import UnitCell


@runtime_checkable
class Lattice(Protocol):
    """A lattice of which one primitive cell can be meshed."""

    @property
    def pitch(self) -> float:
        """Unit cell size l [mm], the unit of wave lengths in spectra."""

    @property
    def symmetry(self) -> str:
        """Without load: "square", "hexagonal" (60 degrees from a1 to a2) or "oblique"."""

    def cell(self) -> UnitCell:
        """The primitive cell, meshed; an InputError if there is no such lattice."""


@dataclass(frozen=True)
class SquareLattice:
    """Circular holes in square stacking: ``fem.lattices.square``.

    Parameters
    ----------
    pitch, diameter
        l and d [mm].
    mesh_size
        Edge length of the elements [mm].
    """

    pitch: float = 1.9
    diameter: float = 1.5
    mesh_size: float = 0.15
    symmetry = "square"

    def cell(self) -> UnitCell:
        """The primitive cell."""
        from modeharvest.fem.lattices import square

        return square(self.pitch, self.diameter, self.mesh_size)


@dataclass(frozen=True)
class HexagonalLattice:
    """Circular holes in hexagonal stacking: ``fem.lattices.hexagonal``.

    Parameters
    ----------
    pitch, diameter
        Distance of the holes' centres and their diameter [mm].
    mesh_size
        Edge length of the elements [mm].
    """

    pitch: float = 1.386
    diameter: float = 1.28
    mesh_size: float = 0.1
    symmetry = "hexagonal"

    def cell(self) -> UnitCell:
        """The primitive cell: one hole."""
        from modeharvest.fem.lattices import hexagonal

        return hexagonal(self.pitch, self.diameter, self.mesh_size)


@dataclass(frozen=True)
class ChiralLattice:
    """Rings joined by ligaments that touch them tangentially: ``fem.chiral.chiral``.

    Parameters
    ----------
    pitch
        Distance of neighbouring rings' centres [mm].
    mesh_size
        Edge length of the elements [mm].
    ring_radius, ring_thickness, ligament_thickness
        [mm]; shares of the pitch that ``fem.chiral`` states unless given.
    handedness
        "clockwise" or "counterclockwise".
    """

    pitch: float = 1.9
    mesh_size: float = 0.1
    ring_radius: float | None = None
    ring_thickness: float | None = None
    ligament_thickness: float | None = None
    handedness: str = "clockwise"
    ligaments = 4
    symmetry = "square"

    def cell(self) -> UnitCell:
        """The primitive cell: one ring."""
        from modeharvest.fem.chiral import chiral

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
    """A cell of one's own, a mesh or a geometry: ``fem.cell_files.read_cell``.

    Parameters
    ----------
    path
        The file [mm]; in a case file, relative to that file's folder.
    pitch
        Unit cell size l [mm], the unit of wave lengths in spectra.
    vectors
        a1 and a2 as rows [mm]; None: a rectangle along x and y, as large as the material.
    mesh_size
        Largest edge length [mm] where a geometry is meshed; None for a mesh.
    """

    path: str
    pitch: float
    vectors: tuple[tuple[float, float], tuple[float, float]] | None = None
    mesh_size: float | None = None
    symmetry = "oblique"

    def cell(self) -> UnitCell:
        """The cell as the file has it."""
        from modeharvest.fem.cell_files import read_cell

        return read_cell(self.path, self.vectors, self.mesh_size)


LATTICES: dict[str, type[Any]] = {
    "square": SquareLattice,
    "hexagonal": HexagonalLattice,
    "tetrachiral": TetrachiralLattice,
    "hexachiral": HexachiralLattice,
    "file": FileLattice,
}
