"""Pixels of a mask, sorted by the elements of a mesh that contain them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.masks import large_parts

_BEYOND_PX = 2
"""Largest distance of a mask's edge from the mesh, along rows and columns."""
SLIVERS = 1e-3
"""Share of a mask that its own mesh may leave out: tips of slivers, which no element fills."""

_FLAT, _MOST_FLAT, _SPECKLES = 0.01, 0.2, 2.0
"""Largest difference of neighbours, over the speckle's standard deviation, where all is one grey
level; largest share of the material, and least size of such a place [squares of a speckle]."""


class ElementPixels(NamedTuple):
    """The pixels that count, element by element."""

    start: NDArray[Any]
    """(m + 1,): those of element e are start[e] ... start[e + 1] - 1."""
    row: NDArray[Any]
    col: NDArray[Any]
    """(p,) int32 position [px]."""
    xi: NDArray[Any]
    """(2, p) float32 local coordinates [-]."""
    grey: NDArray[Any]
    """(p,) float32 grey level of f there."""
    slope: NDArray[Any]
    """(2, p) float32 gradient of f there, along x and y [grey levels/mm]; or (2, 0)."""

    def only(self, keep: BoolArray) -> ElementPixels:
        """Select pixels: (p,) True for those that count."""
        start = np.concatenate([[0], np.cumsum(keep)])[self.start]
        return ElementPixels(start, *(p[..., keep] if p.shape[-1] else p for p in self[1:]))

    def completed(self, chosen: BoolArray) -> BoolArray:
        """(p,) the chosen pixels (p,), and all of the elements of which most are chosen."""
        count = np.diff(self.start)
        many = np.diff(np.concatenate([[0], np.cumsum(chosen)])[self.start]) > 0.5 * count
        return chosen | np.repeat(many, count)


class MeshPixels:
    """Pixels of masks sorted by the elements of a T6 mesh; the sorting of a mask is kept."""

    def __init__(self, mesh: Mesh, beyond: float = 0.0) -> None:
        self.mesh, self.beyond = mesh, beyond  # largest share of a mask beyond the mesh [-]
        self._kept: dict[tuple[PixelGrid, int], tuple[BoolArray, ElementPixels]] = {}

    def on(self, grid: PixelGrid, mask: BoolArray, image: NDArray[Any]) -> ElementPixels:
        """Pixels of a mask (rows, cols) that are in the mesh, with f (rows, cols) there.

        InputError if more of the mask than may be lies over 2 px away from pixels in elements.
        """
        key = grid, int(mask.sum())
        kept = self._kept.get(key)
        if kept is None or not np.array_equal(kept[0], mask):
            kept = self._kept[key] = mask, self._sorted(grid, mask)
        pixels = kept[1]
        return pixels._replace(grey=np.asarray(image, np.float32)[pixels.row, pixels.col])

    def _sorted(self, grid: PixelGrid, mask: BoolArray) -> ElementPixels:
        mesh = self.mesh
        located = locate(mesh.nodes, mesh.cells, mesh.element, grid, "mesh of the material")
        _require_cover(located.mask, mask, self.beyond)
        places = np.flatnonzero(mask & located.mask)
        where, ones = (located.element.ravel()[places], places), np.ones(places.size, np.int8)
        by_element = csr_array((ones, where), shape=(len(mesh.cells), mask.size))
        row, col = np.divmod(by_element.indices, grid.cols)
        xi = located.values.reshape(2, -1)[:, by_element.indices].astype(np.float32)
        none, start = np.empty((2, 0), np.float32), by_element.indptr.astype(np.int64)
        return ElementPixels(start, row.astype(np.int32), col.astype(np.int32), xi, none[0], none)


def flat(image: FloatImage, mask: BoolArray, speckle_px: float) -> BoolArray:
    """(rows, cols) True where a mask's material has one grey level over many speckles.

    Such are reflections of lamps, which don't move with the material. None are found where much of
    the pattern has few grey levels, as black and white ones have.
    """
    same, least = mask.copy(), _SPECKLES * speckle_px**2
    largest = _FLAT * float(image[mask].std() if mask.any() else 0.0)
    for of, step in ((same, np.diff(image, axis=0)), (same.T, np.diff(image, axis=1).T)):
        alike = np.abs(step) <= largest
        of[1:] &= alike
        of[:-1] &= alike
    is_some = least <= same.sum() <= _MOST_FLAT * mask.sum()
    return large_parts(same, least) if is_some else np.zeros_like(mask)


def _require_cover(covered: BoolArray, mask: BoolArray, beyond: float) -> None:
    far = mask & eroded(~covered, _BEYOND_PX)
    if far.sum() > beyond * mask.sum():
        row, col = np.argwhere(far)[0]
        raise InputError(
            f"expected a mesh that covers the mask, got one that leaves out {int(far.sum())} of "
            f"{int(mask.sum())} px, the first at row {row}, column {col}; give the mesh of the "
            "whole body, or a mask of what it covers"
        )
