"""Cells as strangers make them: gmsh meshes each copy of a hole anew, so no symmetry is exact."""

from __future__ import annotations

from functools import cache

import gmsh
import numpy as np

from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.files import cell_from_gmsh


@cache
def foreign(
    vectors: tuple[tuple[float, float], tuple[float, float]],
    holes: tuple[tuple[float, float], ...],
    diameter: float,
    size: float,
) -> UnitCell:
    """A parallelogram from (0, 0) with round holes at shares of its vectors, as gmsh meshes it."""
    a, b = np.array(vectors)
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        occ = gmsh.model.occ
        corners = [occ.addPoint(*p, 0.0) for p in (0 * a, a, a + b, b)]
        lines = [occ.addLine(p, q) for p, q in zip(corners, corners[1:] + corners[:1], strict=True)]
        plate = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        disks = [occ.addDisk(*(s * a + t * b), 0.0, diameter / 2, diameter / 2) for s, t in holes]
        occ.cut([(2, plate)], [(2, disk) for disk in disks])
        occ.synchronize()
        return cell_from_gmsh(vectors, size)
    finally:
        gmsh.finalize()


def many(m: int, n: int) -> tuple[tuple[float, float], ...]:
    """Centres of m x n holes in a cell."""
    return tuple(((i + 0.5) / m, (j + 0.5) / n) for i in range(m) for j in range(n))


def corners(m: int, n: int) -> tuple[tuple[float, float], ...]:
    """The same with a hole in each corner, cut by the boundary."""
    return tuple((i / m, j / n) for i in range(m + 1) for j in range(n + 1))


ROOT3 = float(np.sqrt(3.0))


def square_four(size: float = 0.15) -> UnitCell:
    """2 x 2 holes in square stacking, d/l = 0.87, l = 1 mm."""
    return foreign(((2.0, 0.0), (0.0, 2.0)), many(2, 2), 0.87, size)


def hexagonal_four(size: float = 0.1) -> UnitCell:
    """2 x 2 holes in hexagonal stacking, d/l = 0.9, l = 1 mm."""
    return foreign(((2.0, 0.0), (1.0, ROOT3)), corners(2, 2), 0.9, size)


def hexagonal_two(size: float = 0.1) -> UnitCell:
    """A rectangle with two holes in hexagonal stacking: neither 2 x 1 nor 1 x 2 primitive cells."""
    return foreign(((1.0, 0.0), (0.0, ROOT3)), (*corners(1, 1), (0.5, 0.5)), 0.9, size)


def hexagonal_one(size: float = 0.1) -> UnitCell:
    """One hole in a rhombus, meshed without the lattice's symmetry."""
    return foreign(((1.0, 0.0), (0.5, ROOT3 / 2)), corners(1, 1), 0.9, size)
