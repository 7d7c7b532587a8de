"""Unit cells of infinite lattices as T6 meshes that fit exactly onto their own copies.

Each is made of one small block that gmsh meshes and numpy reflects, turns and places, so
that partner nodes agree to rounding and the mesh has the lattice's own symmetries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import (
    Block,
    divisions_of,
    join,
    mesh_block,
    quarter_cell,
    require_size,
)
from modeharvest.fem.periodicity import Periodicity, find_periodicity

FloatArray = NDArray[np.float64]

_MIRRORED = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))

# Corners of irreducible zones as phases (k . a1, k . a2) [rad].
SQUARE_ZONE = (
    ("Γ", (0.0, 0.0)),
    ("X", (math.pi, 0.0)),
    ("M", (math.pi, math.pi)),
    ("Y", (0.0, math.pi)),
    ("Γ", (0.0, 0.0)),
)
"""Of a square lattice loaded along its axes (a quarter of the zone: x and y may differ)."""

HEXAGONAL_ZONE = (
    ("Γ", (0.0, 0.0)),
    ("M", (math.pi, 0.0)),
    ("K", (4 * math.pi / 3, 2 * math.pi / 3)),
    ("Γ", (0.0, 0.0)),
)
"""Of a hexagonal lattice that keeps its sixfold symmetry (equibiaxial loading)."""


@dataclass(frozen=True, eq=False)
class UnitCell:
    """A piece of a lattice whose copies, moved by the lattice vectors, make up all of it.

    Parameters
    ----------
    mesh
        T6 mesh [mm].
    lattice
        (2, 2) lattice vectors a1 and a2 as rows [mm].

    Raises
    ------
    InputError
        If the mesh is not periodic; the message names the nodes without a partner.
    """

    mesh: Mesh
    lattice: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "lattice", np.array(self.lattice, dtype=np.float64))
        _ = self.periodicity  # finds out, and says, what is wrong with the mesh

    @cached_property
    def periodicity(self) -> Periodicity:
        """Which nodes are translates of which."""
        return find_periodicity(self.mesh, self.lattice)

    @property
    def area(self) -> float:
        """Area of the cell, holes included [mm^2]."""
        return float(abs(np.linalg.det(self.lattice)))

    def enlarged(self, m: int, n: int) -> UnitCell:
        """The cell of m x n copies along a1 and a2.

        Raises
        ------
        InputError
            If there is less than one copy along either.
        """
        if m < 1 or n < 1:
            raise InputError(f"enlarged cell: expected at least 1 x 1 copies, got {m} x {n}")
        blocks = [
            Block(self.mesh.nodes + np.array([i, j]) @ self.lattice, self.mesh.cells)
            for i, j in product(range(m), range(n))
        ]
        shortest = float(np.linalg.norm(self.lattice, axis=1).min())
        return UnitCell(join(blocks, 1e-7 * shortest), self.lattice * [[m], [n]])


def square(pitch: float, diameter: float, size: float) -> UnitCell:
    """The primitive cell of circular holes in square stacking, a hole's centre at the origin.

    Parameters
    ----------
    pitch, diameter
        Distance of the holes' centres l and diameter d [mm]; 0 < d < l.
    size
        Target edge length of the elements [mm].
    """
    _check(pitch, diameter, size)
    quarter = quarter_cell(pitch, diameter, size)
    mesh = join([quarter.placed(s, (0.0, 0.0)) for s in _MIRRORED], 1e-7 * pitch)
    return UnitCell(mesh, pitch * np.eye(2))


def hexagonal(pitch: float, diameter: float, size: float) -> UnitCell:
    """The primitive cell of circular holes in hexagonal stacking: a hexagon about one hole.

    a1 points along x, a2 stands 60 degrees from it. ``hexagonal(...).enlarged(2, 2)`` is the
    4-hole cell, which has room for the modes of all three M points.

    Parameters
    ----------
    pitch, diameter
        Distance of the holes' centres and their diameter [mm]; 0 < d < pitch.
    size
        Target edge length of the elements [mm].
    """
    _check(pitch, diameter, size)
    wedge = _wedge(pitch, diameter, size)
    blocks = []
    for k in range(6):
        for sign in (1.0, -1.0):
            blocks.append(wedge.placed((1.0, sign), (0.0, 0.0)).turned(k * math.pi / 3))
    a2 = [0.5, 0.5 * math.sqrt(3.0)]
    return UnitCell(join(blocks, 1e-7 * pitch), pitch * np.array([[1.0, 0.0], a2]))


def _wedge(pitch: float, diameter: float, size: float) -> Block:
    """A twelfth of the hexagon, from the middle of a ligament up to a junction."""
    half, radius, angle = 0.5 * pitch, 0.5 * diameter, math.pi / 6
    long = half / math.cos(angle)
    arc_end = (radius * math.cos(angle), radius * math.sin(angle))
    corners = [(radius, 0.0), (half, 0.0), (half, half * math.tan(angle)), arc_end]
    lengths = [half - radius, half * math.tan(angle), long - radius, angle * radius]
    return mesh_block(corners, [divisions_of(length, size) for length in lengths], arcs=[3])


def _check(pitch: float, diameter: float, size: float) -> None:
    if not 0 < diameter < pitch < math.inf:
        raise InputError(
            "unit cell: expected 0 < diameter < pitch (holes must not touch), got "
            f"diameter = {diameter} mm, pitch = {pitch} mm"
        )
    require_size(size, pitch**2)
