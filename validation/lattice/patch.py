"""A piece of an infinite lattice, large enough to fill a window, in one outline."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.fem.periodicity import find_periodicity
from modeharvest.validation.outline import Outline

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SPARE = 0.15  # of the window: how much further the copies reach, for what a deformation brings in


@dataclass(frozen=True, eq=False)
class Patch:
    """Copies of a cell, joined where they touch.

    Parameters
    ----------
    mesh
        Of all copies together, undeformed [mm].
    outline
        Its outline: holes and the ragged outer edge, which the window cuts off.
    lattice
        (2, 2) lattice vectors of the cell as rows [mm].
    node, copy
        (N,) which node of the cell each node is, and (N, 2) in which copy.
    centre
        (2,) middle of the cell and of the window [mm].
    window
        (2,) width and height [mm].
    """

    mesh: Mesh
    outline: Outline
    lattice: FloatArray
    node: IntArray
    copy: IntArray
    centre: FloatArray
    window: FloatArray

    @classmethod
    def of(cls, mesh: Mesh, lattice: FloatArray, window: tuple[float, float]) -> Patch:
        """Fill a window [mm] about the middle of a periodic cell with copies of it."""
        lattice, size = np.asarray(lattice, dtype=np.float64), np.asarray(window)
        found = find_periodicity(mesh, lattice)
        copies = _copies(mesh, lattice, size)
        # A node of the lattice: its master's number, and the copy the master would be in.
        shifts = (copies[:, None] + found.shift).reshape(-1, 2)
        names = np.column_stack([shifts, np.tile(found.master, len(copies))])
        _, first, number = np.unique(names, axis=0, return_index=True, return_inverse=True)
        node, copy = first % len(mesh.nodes), copies[first // len(mesh.nodes)]
        numbers = number.reshape(len(copies), -1)
        cells = numbers[:, mesh.cells].reshape(-1, 6)
        joined = Mesh(mesh.nodes[node] + copy @ lattice, cells, "T6")
        return cls(joined, Outline.of(joined), lattice, node, copy, _middle(mesh), size)

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the window [mm]."""
        (left, bottom), (right, top) = self.centre - self.window / 2, self.centre + self.window / 2
        return (left, right, bottom, top)

    @property
    def cell_corners(self) -> FloatArray:
        """(4, 2) corners of the parallelogram of the lattice vectors about the middle [mm]."""
        a1, a2 = self.lattice
        return np.array([self.centre + 0.5 * (s * a1 + t * a2)
                         for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])  # fmt: skip

    def moved(self, values: FloatArray, gradient: FloatArray | None = None) -> FloatArray:
        """(N, 2) displacement of all copies from the cell's, the window's middle staying.

        Parameters
        ----------
        values
            (n, 2) displacement of the cell's nodes [mm]: periodic but for the affine part.
        gradient
            (2, 2) F̄ of the affine part [-]; None for a periodic field.
        """
        if gradient is None:
            return np.asarray(values[self.node])
        stretch = np.asarray(gradient) - np.eye(2)
        offsets = self.copy @ self.lattice - self.centre
        return np.asarray(values[self.node] + offsets @ stretch.T)


def _middle(mesh: Mesh) -> FloatArray:
    return np.asarray(0.5 * (mesh.nodes.min(axis=0) + mesh.nodes.max(axis=0)))


def _copies(mesh: Mesh, lattice: FloatArray, window: FloatArray) -> IntArray:
    """(c, 2) the copies whose bounding box meets the window, with some to spare."""
    half = 0.5 * (window + np.ptp(mesh.nodes, axis=0)) + _SPARE * window
    inverse = np.linalg.inv(lattice)
    corners = np.array([[s, t] for s, t in product((-1, 1), repeat=2)]) * half @ inverse
    far = np.ceil(np.abs(corners).max(axis=0)).astype(int)
    every = np.array(list(product(*(range(-n, n + 1) for n in far))), dtype=np.int64)
    return np.asarray(every[np.all(np.abs(every @ lattice) <= half, axis=1)])
