"""Boundaries to draw: of a mesh, of a mask, of a piece of an infinite lattice."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.lattice.periodicity import find_periodicity
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class MeshBoundary:
    """The edges that belong to one element only, in closed loops."""

    nodes: FloatArray
    """(n, 2) node positions of the mesh [mm]."""
    loops: tuple[IntArray, ...]
    """For each loop (m, 3) node numbers: first corner, mid-side, second corner of each edge,
    material on the left. Without mid-side nodes, the second column repeats the first."""

    @classmethod
    def of(cls, mesh: Mesh) -> MeshBoundary:
        """Find the boundary of a mesh."""
        edges = boundary_sides(mesh)
        following = {int(a): k for k, a in enumerate(edges[:, 0])}
        loops, visited = [], np.zeros(len(edges), dtype=bool)
        for first in range(len(edges)):
            loop, k = [], first
            while not visited[k]:
                visited[k] = True
                loop.append(k)
                k = following.get(int(edges[k, 2]), first)
            if loop:
                loops.append(edges[loop])
        return cls(mesh.nodes, tuple(loops))

    def path(self, displacement: FloatArray | None = None) -> Path:
        """Path of the boundary, displaced by nodal values (n, 2) [mm]; holes aren't filled.

        A quadratic edge is a parabola, which a Bezier curve of second order draws exactly.
        """
        nodes = self.nodes if displacement is None else self.nodes + displacement
        vertices: list[FloatArray] = [np.empty((0, 2))]
        codes: list[np.uint8] = []
        for loop in self.loops:
            a, middle, b = (np.asarray(nodes[loop[:, k]]) for k in range(3))
            curved = loop[:, 1] != loop[:, 0]
            if curved.any():
                control = np.where(curved[:, None], 2.0 * middle - 0.5 * (a + b), 0.5 * (a + b))
                points: FloatArray = np.stack([control, b], axis=1).reshape(-1, 2)
                codes += [Path.MOVETO, *[Path.CURVE3] * len(points), Path.CLOSEPOLY]
            else:
                points = a[1:]
                codes += [Path.MOVETO, *[Path.LINETO] * len(points), Path.CLOSEPOLY]
            vertices += [a[:1], points, a[:1]]
        return Path(np.vstack(vertices), codes)


CELLS = 900
"""Approximate limit on the cells along a mask's longer side, for tracing its boundary."""
_TOLERANCE = 0.3  # largest deviation of the simplified polygon from the traced contour [cells]


def mask_boundary(mask: BoolArray, grid: PixelGrid, least: float = 0.0) -> MeshBoundary:
    """Trace the boundary of a mask.

    ``mask``: (rows, cols) True on material. ``grid``: its pixels. ``least``: holes and islands of
    at most this area [mm²] are left out. The boundary deviates from the mask's edge by at most
    about a third of a cell, and is empty for an empty mask.
    """
    from skimage.measure import approximate_polygon, find_contours  # a second to load

    factor = max(1, round(max(grid.shape) / CELLS))
    cells = grid.binned(factor)
    # Padding closes the contours of material that touches the image's edge.
    cover = np.pad(block_means(mask, factor), 1)
    nodes: list[FloatArray] = [np.empty((0, 2))]
    loops, count = [], 0
    for contour in find_contours(cover, 0.5):  # type: ignore[no-untyped-call]
        rounded = approximate_polygon(contour, _TOLERANCE)  # type: ignore[no-untyped-call]
        corners = rounded[:-1] - 1.0
        x, y = cells.to_mm(corners[:, 0], corners[:, 1])
        area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
        if len(corners) < 3 or area <= least:
            continue
        first = count + np.arange(len(corners))
        loops.append(np.stack([first, first, np.roll(first, -1)], axis=1))
        nodes.append(np.stack([x, y], axis=1))
        count += len(corners)
    return MeshBoundary(np.vstack(nodes), tuple(loops))


def block_means(field: NDArray[Any], side: int) -> FloatArray:
    """Means over blocks of ``side`` x ``side`` pixels; incomplete blocks are dropped."""
    rows, cols = (size // side for size in field.shape)
    # Summing over rows first is several times faster.
    whole = field[: rows * side].reshape(rows, side, -1).sum(axis=1, dtype=np.float64)
    return np.asarray(whole[:, : cols * side].reshape(rows, cols, side).sum(axis=2) / side**2)


_SPARE = 0.15  # margin of copies around a window, over its size: a deformation moves some into it


@dataclass(frozen=True, eq=False)
class LatticePatch:
    """Copies of a unit cell, joined at common nodes."""

    mesh: Mesh
    """Undeformed mesh of all copies [mm]."""
    boundary: MeshBoundary
    """Boundary of the holes, and the outer boundary, which is outside the window."""
    lattice: FloatArray
    """(2, 2) lattice vectors of the cell as rows [mm]."""
    node: IntArray
    copy: IntArray
    """(N,) index of each node in the cell, and (N, 2) lattice indices of its copy of the cell."""
    centre: FloatArray
    """(2,) middle of the cell and of the window [mm]."""
    window: FloatArray
    """(2,) width and height of the window [mm]."""

    @classmethod
    def of(cls, mesh: Mesh, lattice: FloatArray, window: tuple[float, float]) -> LatticePatch:
        """Fill a window (width, height) [mm] around a periodic cell's middle with its copies."""
        lattice, size = np.asarray(lattice, dtype=np.float64), np.asarray(window)
        found = find_periodicity(mesh, lattice)
        copies = _cells_in_window(mesh, lattice, size)
        # A node of the lattice is identified by its master and the master's copy of the cell.
        shifts = (copies[:, None] + found.shift).reshape(-1, 2)
        names = np.column_stack([shifts, np.tile(found.master, len(copies))])
        _, first, number = np.unique(names, axis=0, return_index=True, return_inverse=True)
        node, copy = first % len(mesh.nodes), copies[first // len(mesh.nodes)]
        numbers = number.reshape(len(copies), -1)
        cells = numbers[:, mesh.cells].reshape(-1, 6)
        joined = Mesh(mesh.nodes[node] + copy @ lattice, cells, "T6")
        middle = np.asarray(0.5 * (mesh.nodes.min(axis=0) + mesh.nodes.max(axis=0)))
        return cls(joined, MeshBoundary.of(joined), lattice, node, copy, middle, size)

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the window [mm]."""
        (left, bottom), (right, top) = self.centre - self.window / 2, self.centre + self.window / 2
        return (left, right, bottom, top)

    @property
    def cell_corners(self) -> FloatArray:
        """(4, 2) corners of the lattice vectors' parallelogram around the middle [mm]."""
        a1, a2 = self.lattice
        return np.array([self.centre + 0.5 * (s * a1 + t * a2)
                         for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])  # fmt: skip

    def moved(self, values: FloatArray, gradient: FloatArray | None = None) -> FloatArray:
        """(N, 2) displacement of all copies [mm]; its affine part is zero at the window's middle.

        ``values``: (n, 2) displacement of the cell's nodes [mm], periodic except for its affine
        part. ``gradient``: (2, 2) F̄ of the affine part [-]; None for a periodic displacement.
        """
        if gradient is None:
            return np.asarray(values[self.node])
        stretch = np.asarray(gradient) - np.eye(2)
        offsets = self.copy @ self.lattice - self.centre
        return np.asarray(values[self.node] + offsets @ stretch.T)


def _cells_in_window(mesh: Mesh, lattice: FloatArray, window: FloatArray) -> IntArray:
    """(c, 2) lattice indices of copies whose bounding box meets the window with its margin."""
    half = 0.5 * (window + np.ptp(mesh.nodes, axis=0)) + _SPARE * window
    inverse = np.linalg.inv(lattice)
    corners = np.array([[s, t] for s, t in product((-1, 1), repeat=2)]) * half @ inverse
    far = np.ceil(np.abs(corners).max(axis=0)).astype(int)
    every = np.array(list(product(*(range(-n, n + 1) for n in far))), dtype=np.int64)
    return np.asarray(every[np.all(np.abs(every @ lattice) <= half, axis=1)])
