"""Unit cells of infinite lattices as T6 meshes that fit exactly onto their own copies.

Each is made of one small block that gmsh meshes and numpy reflects, rotates and places, so
that partner nodes agree to rounding and the mesh has the lattice's symmetries.

The paper shows a chiral metamaterial without its dimensions. The geometry here is this project's
choice: that of Prall & Lakes (1997), doi 10.1016/S0020-7403(96)00025-2, with six ligaments or four:

- Rings (annuli) sit on a hexagonal or square lattice. Each is joined to all nearest neighbours by
  straight ligaments of constant thickness.
- A ligament's outer edge is tangent to the outer edge of the ring at both ends, on opposite sides
  of the line between the centres. So a ring rotates when its ligaments are compressed.
- No fillets: at the notch where a ligament's inner edge meets a ring, strains are singular, so
  energies and eigenvalues converge more slowly with the mesh than those of round holes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.periodicity import Periodicity, find_periodicity
from modeharvest.fem.lattice.symmetry import CellSymmetry, find_symmetry
from modeharvest.fem.meshing import (
    SIGNS,
    MeshBlock,
    divisions_of,
    join,
    mesh_block,
    quarter_cell,
    require_size,
)
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError


@dataclass(frozen=True, eq=False)
class UnitCell:
    """A piece of a lattice whose copies, translated by the lattice vectors, tile the plane.

    InputError for a mesh that is not periodic; the message names the nodes without a partner.
    """

    mesh: Mesh
    """T6 mesh [mm]."""
    lattice: FloatArray
    """(2, 2) lattice vectors a1 and a2 as rows [mm]."""
    origin: IntArray | None = None
    """(n,) number of each node in its file, see ``files``; -1 for nodes that are not in it."""
    notes: tuple[str, ...] = ()
    """Texts on the mesh that a reader of results should know."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "lattice", np.array(self.lattice, dtype=np.float64))
        _ = self.periodicity  # or an InputError

    @cached_property
    def periodicity(self) -> Periodicity:
        """The nodes as translates of independent nodes."""
        return find_periodicity(self.mesh, self.lattice)

    @cached_property
    def symmetry(self) -> CellSymmetry:
        """Symmetry of the lattice's geometry, whether or not the mesh has it."""
        return find_symmetry(self.mesh, self.periodicity)

    @property
    def area(self) -> float:
        """Area of the cell, including holes [mm^2]."""
        return float(abs(np.linalg.det(self.lattice)))

    def enlarged(self, m: int, n: int) -> UnitCell:
        """The cell of m x n copies along a1 and a2, at least one along each."""
        if m < 1 or n < 1:
            raise InputError(f"enlarged cell: expected at least 1 x 1 copies, got {m} x {n}")
        if m == n == 1:
            return self
        # First make partners' positions agree to rounding, so that all of them are joined.
        _, first = np.unique(self.periodicity.master, return_index=True)
        nodes = self.mesh.nodes[first[self.periodicity.master]]
        nodes = nodes + self.periodicity.shift @ self.lattice
        blocks = [
            MeshBlock(nodes + np.array([i, j]) @ self.lattice, self.mesh.cells)
            for i, j in product(range(m), range(n))
        ]
        shortest = float(np.linalg.norm(self.lattice, axis=1).min())
        return UnitCell(join(blocks, 1e-7 * shortest), self.lattice * [[m], [n]])


_HEXAGONAL = [[1.0, 0.0], [0.5, 0.5 * math.sqrt(3.0)]]
"""Hexagonal lattice vectors as rows, of length 1."""


def square(pitch: float, diameter: float, size: float) -> UnitCell:
    """The primitive cell of circular holes in square stacking, a hole's centre at the origin.

    Distance l of the holes' centres, diameter d with 0 < d < l, edge length of the elements [mm].
    """
    _check(pitch, diameter, size)
    quarter = quarter_cell(pitch, diameter, size)
    mesh = join([quarter.placed(s, (0.0, 0.0)) for s in SIGNS], 1e-7 * pitch)
    return UnitCell(mesh, pitch * np.eye(2))


def hexagonal(pitch: float, diameter: float, size: float) -> UnitCell:
    """The primitive cell of circular holes in hexagonal stacking: a hexagon about one hole.

    a1 points along x, a2 at 60 degrees to it. ``hexagonal(...).enlarged(2, 2)`` is the 4-hole cell,
    which has the period of the modes of all three M points. Lengths as in :func:`square`.
    """
    _check(pitch, diameter, size)
    half, radius, angle = 0.5 * pitch, 0.5 * diameter, math.pi / 6
    rise, long = half * math.tan(angle), half / math.cos(angle)
    # A twelfth of the hexagon, from the centre of a ligament to a junction.
    corners = [(radius, 0.0), (half, 0.0), (half, rise), _polar(radius, angle)]
    lengths = [half - radius, rise, long - radius, angle * radius]
    wedge = mesh_block(corners, [divisions_of(length, size) for length in lengths], arcs=[3])
    halves = [wedge.placed((1.0, sign), (0.0, 0.0)) for sign in (1.0, -1.0)]
    mesh = join([block.turned(k * math.pi / 3) for k in range(6) for block in halves], 1e-7 * pitch)
    return UnitCell(mesh, pitch * np.array(_HEXAGONAL))


def _check(pitch: float, diameter: float, size: float) -> None:
    if not 0 < diameter < pitch < math.inf:
        raise InputError(
            "unit cell: expected 0 < diameter < pitch (holes must not touch), got "
            f"diameter = {diameter} mm, pitch = {pitch} mm"
        )
    require_size(size, pitch**2)


HANDEDNESS = ("clockwise", "counterclockwise")

# Relative to the pitch. Ligaments are then 18 times as long as thick, so that they bend rather
# than shorten, and still thick enough for elements of pitch / 20. Rings of twice that thickness
# rotate rather than deform; their deformation keeps Poisson's ratio above -1.
RING_RADIUS, RING_THICKNESS, LIGAMENT_THICKNESS = 0.25, 0.1, 0.05


def chiral(
    pitch: float,
    size: float,
    ligaments: int = 6,
    ring_radius: float | None = None,
    ring_thickness: float | None = None,
    ligament_thickness: float | None = None,
    handedness: str = "clockwise",
) -> UnitCell:
    """The primitive cell of a ring-and-ligament lattice, a ring's centre at the origin.

    a1 points along x; a2 at 90 degrees (tetrachiral) or 60 degrees (hexachiral) to it.
    ``enlarged(2, 2)`` has the period of modes that change sign from ring to ring. InputError for
    rings that touch, and for ligaments so thick that they touch at a ring or have no free length.

    pitch, size : distance of neighbouring rings' centres; edge length of the elements, at most a
        wall's thickness [mm]. Half of that thickness is a good choice.
    ligaments : number per ring: 4 (tetrachiral, square lattice) or 6 (hexachiral, hexagonal).
    ring_radius, ring_thickness, ligament_thickness : outer radius, by default 0.25 pitch;
        thicknesses of ring and ligaments, by default 0.1 and 0.05 pitch [mm].
    handedness : sense of rotation, "clockwise" or "counterclockwise", in which a ligament, followed
        outwards, leaves its ring. One lattice is the mirror image of the other.
    """
    radius = RING_RADIUS * pitch if ring_radius is None else ring_radius
    wall = RING_THICKNESS * pitch if ring_thickness is None else ring_thickness
    ligament = LIGAMENT_THICKNESS * pitch if ligament_thickness is None else ligament_thickness
    shape = _RingAndLigaments(pitch, radius, wall, ligament, ligaments)
    require_size(size, pitch**2)
    if handedness not in HANDEDNESS:
        known = " or ".join(map(repr, HANDEDNESS))
        raise InputError(f"chiral cell: expected handedness {known}, got {handedness!r}")
    sector = shape.sector(min(size, shape.ring_thickness, shape.ligament_thickness))
    if handedness == "counterclockwise":
        sector = sector.placed((1.0, -1.0), (0.0, 0.0))
    angle = 2 * math.pi / ligaments
    mesh = join([sector.turned(k * angle) for k in range(ligaments)], 1e-7 * pitch)
    return UnitCell(mesh, pitch * np.array(np.eye(2) if ligaments == 4 else _HEXAGONAL))


@dataclass(frozen=True)
class _RingAndLigaments:
    """Dimensions of the boundary of rings and ligaments [mm].

    In the ligament's local frame, the ring is centred at the origin and the ligament runs along x
    between y = ring_radius - ligament_thickness and y = ring_radius, up to its middle.
    """

    pitch: float
    ring_radius: float
    ring_thickness: float
    ligament_thickness: float
    ligaments: int

    def __post_init__(self) -> None:
        radius, wall, ligament = self.ring_radius, self.ring_thickness, self.ligament_thickness
        most = radius * (1.0 - math.cos(2 * math.pi / max(self.ligaments, 1)))
        if self.ligaments not in (4, 6):
            fault = f"4 (tetrachiral) or 6 (hexachiral) ligaments, got {self.ligaments}"
        elif not 0 < 2 * radius < self.pitch < math.inf:
            got = f"ring_radius = {radius} mm, pitch = {self.pitch} mm"
            fault = f"0 < 2 ring_radius < pitch (rings must not touch), got {got}"
        elif not 0 < wall < radius:
            got = f"ring_thickness = {wall} mm, ring_radius = {radius} mm"
            fault = f"0 < ring_thickness < ring_radius, got {got}"
        elif not 0 < ligament < most:
            fault = f"0 < ligament_thickness < {most:.4g} mm (the ligaments of a ring must not "
            fault += f"touch), got {ligament} mm; make ligaments thinner or rings larger"
        elif not self.middle > self.foot:
            apart = self.pitch - 2 * radius
            fault = f"ligaments with a free length, got rings {apart:.4g} mm apart with ligaments "
            fault += f"{ligament} mm thick; make rings smaller or ligaments thinner"
        else:
            return
        raise InputError(f"chiral cell: expected {fault}")

    @property
    def middle(self) -> float:
        """x of the ligament's middle: half its length between the tangent points."""
        across = self.ring_radius - 0.5 * self.ligament_thickness
        return math.sqrt((0.5 * self.pitch) ** 2 - across**2)

    @property
    def foot(self) -> float:
        """x at which the ligament's inner edge leaves the ring."""
        return math.sqrt((2 * self.ring_radius - self.ligament_thickness) * self.ligament_thickness)

    def sector(self, size: float) -> MeshBlock:
        """Half a ligament with its part of the ring; the ligament's middle is at (pitch / 2, 0).

        The ring is cut halfway between the feet of two ligaments, the ligament across its middle.
        Uniform divisions of the latter cut are mapped onto themselves by a rotation by 180 degrees.
        """
        outer, inner = self.ring_radius, self.ring_radius - self.ring_thickness
        y = outer - self.ligament_thickness
        leaves, touches = math.atan2(y, self.foot), 0.5 * math.pi
        free = 2 * math.pi / self.ligaments - (touches - leaves)
        low, high = leaves - 0.5 * free, touches + 0.5 * free
        sides = [  # first corner and length of each side
            (_polar(inner, low), self.ring_thickness),
            (_polar(outer, low), 0.5 * free * outer),
            ((self.foot, y), self.middle - self.foot),
            ((self.middle, y), self.ligament_thickness),
            ((self.middle, outer), self.middle),
            ((0.0, outer), 0.5 * free * outer),
            (_polar(outer, high), self.ring_thickness),
            (_polar(inner, high), 2 * math.pi / self.ligaments * inner),
        ]
        divisions = [divisions_of(length, size) for _, length in sides]
        block = mesh_block([corner for corner, _ in sides], divisions, arcs=[1, 5, 7])
        return block.turned(-math.atan2(outer - 0.5 * self.ligament_thickness, self.middle))


def _polar(radius: float, angle: float) -> tuple[float, float]:
    return radius * math.cos(angle), radius * math.sin(angle)
