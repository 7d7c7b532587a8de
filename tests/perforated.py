"""Periodic cells with a hole as isoparametric meshes, made by a formula: shared, pip alone."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh

FloatArray = NDArray[np.float64]

PITCH = 1.9
SQUARE = PITCH * np.eye(2)
OBLIQUE = PITCH * np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])  # hexagonal stacking


def holed_cell(
    lattice: FloatArray,
    divisions: int,
    copies: tuple[int, int] = (1, 1),
    element: str = "T6",
    radius: float = 0.35 * PITCH,
    centre: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """Copies of a parallelogram with a round hole in the middle.

    Parameters
    ----------
    lattice
        (2, 2) of one hole, as rows [mm].
    divisions
        Elements along each side, and half as many from the hole to the side.
    copies
        Along the two vectors.
    element
        "T6" or "Q9".
    radius, centre
        Of the hole at the origin of the lattice [mm].
    """
    half_lattice, around, outward = 0.5 * lattice, 8 * divisions, divisions + 1
    corners = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]]) @ half_lattice
    t = np.arange(around) / (2.0 * divisions)
    side = t.astype(int)
    boundary = corners[side] + (t - side)[:, None] * (corners[side + 1] - corners[side])
    hole = radius * boundary / np.linalg.norm(boundary, axis=1)[:, None]
    s = np.arange(outward)[:, None, None] / (outward - 1.0)
    nodes = ((1.0 - s) * hole + s * boundary).reshape(-1, 2)
    cells = np.array(
        [
            cell
            for i, j in product(range(0, outward - 1, 2), range(0, around, 2))
            for cell in _element(element, i, j, around)
        ]
    )
    shifts = [np.array(copy) @ lattice for copy in product(range(copies[0]), range(copies[1]))]
    every = np.vstack([nodes + shift + np.array(centre) for shift in shifts])
    numbers = np.vstack([cells + k * len(nodes) for k in range(len(shifts))])
    return Mesh(every, numbers, element)


def _element(element: str, i: int, j: int, around: int) -> list[list[int]]:
    """Node numbers of the quadrilateral, or its two triangles, from row i and column j on."""

    def at(row: int, column: int) -> int:
        return (i + row) * around + (j + column) % around

    if element == "Q9":
        order = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1), (1, 1)]
        return [[at(*node) for node in order]]
    lower = [(0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)]
    upper = [(0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)]
    return [[at(*node) for node in order] for order in (lower, upper)]
