"""Meshes to image: the paper's specimen after buckling, and elements distorted but valid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.case import shipped_solution

FloatArray = NDArray[np.float64]

STRAIN = 0.128
ELEMENTS = ("T3", "T6", "Q4", "Q8", "Q9")
_QUAD = ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1), (1, 1))
"""Nodes of a Q9 on a lattice of half its edge."""


@dataclass(frozen=True, eq=False)
class MeshView:
    """A mesh in two states, and the pixels of an image of the second.

    Parameters
    ----------
    name
        Name in tables.
    mesh
        The undeformed mesh.
    deformed
        (n, 2) positions of its nodes in the image [mm].
    grid
        The pixels of both images.
    """

    name: str
    mesh: Mesh
    deformed: FloatArray
    grid: PixelGrid


def specimen(rows: int) -> MeshView:
    """The shipped solution after buckling in the paper's format (2751 x 2207 px, upright)."""
    path = shipped_solution("paper-virtual")
    solution = Solution.read(path)
    cols = round(rows * 2207 / 2751)
    grid = PixelGrid.centred(rows, cols, 21.8 / rows)
    deformed = solution.mesh.nodes + solution.at(STRAIN).displacement
    return MeshView("paper's specimen", solution.mesh, deformed, grid)


def bulged(element: str, rows: int, count: int = 20, seed: int = 0) -> MeshView:
    """Fill an image with ``count`` x ``count`` quadrilaterals, skewed and with bulged edges.

    Corners are moved by up to 0.16 of an edge along x and y, other nodes by up to 0.07 from the
    middle between corners; triangles are halves of the quadrilaterals.
    """
    lattice = _lattice(count)
    rng = np.random.default_rng(seed)
    deformed = lattice + rng.uniform(-0.32, 0.32, lattice.shape)
    even, odd = slice(0, None, 2), slice(1, None, 2)
    corners = deformed[even, even]
    deformed[odd, even] = 0.5 * (corners[1:] + corners[:-1])
    deformed[even, odd] = 0.5 * (corners[:, 1:] + corners[:, :-1])
    deformed[odd, odd] = 0.25 * (corners[1:, 1:] + corners[1:, :-1] + corners[:-1, 1:]
                                 + corners[:-1, :-1])  # fmt: skip
    bulge = rng.uniform(-0.14, 0.14, lattice.shape)
    bulge[even, even] = 0.0
    deformed += bulge
    grid = PixelGrid.centred(rows, rows, 2.2 * count / rows)
    return _view("bulged, skewed", element, lattice, deformed, grid)


def aligned(element: str, rows: int) -> MeshView:
    """Fill an image with squares, or halves of them, whose edges run through pixel centres.

    All positions are multiples of 1/8, so that nothing is rounded: pixels on an edge are exactly on
    it, and only a rule decides to which element they belong.
    """
    count = (rows - 40) // 16
    lattice = _lattice(count)
    grid = PixelGrid.centred(rows | 1, rows | 1, 0.125)
    return _view("edges through pixel centres", element, lattice, lattice, grid)


def _view(
    name: str, element: str, lattice: FloatArray, deformed: FloatArray, grid: PixelGrid
) -> MeshView:
    """View of a mesh with the nodes of this type of element."""
    cells = _cells(element, len(lattice) // 2)
    used, cells = np.unique(cells, return_inverse=True)
    mesh = Mesh(lattice.reshape(-1, 2)[used], cells.reshape(-1, _nodes(element)), element)
    return MeshView(name, mesh, deformed.reshape(-1, 2)[used], grid)


def _lattice(count: int) -> FloatArray:
    """(2 count + 1, 2 count + 1, 2) whole numbers around zero: [i, j] is at x = i, y = j."""
    axis = np.arange(-count, count + 1.0)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)


def _nodes(element: str) -> int:
    return int(element[1:])


def _cells(element: str, count: int) -> NDArray[np.int64]:
    """(m, k) cells on the lattice."""
    corner = 2 * np.stack(np.meshgrid(*[np.arange(count)] * 2, indexing="ij"), -1).reshape(-1, 1, 2)
    lattice = corner + np.array(_QUAD)
    quads = lattice[..., 0] * (2 * count + 1) + lattice[..., 1]
    if element.startswith("Q"):
        return np.asarray(quads[:, : _nodes(element)])
    halves = np.concatenate([quads[:, [0, 1, 2, 4, 5, 8]], quads[:, [0, 2, 3, 8, 6, 7]]])
    return np.asarray(halves[:, : _nodes(element)])
