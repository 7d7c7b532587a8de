"""The inverse isoparametric mapping: which element covers a pixel, and where in it.

For each pixel centre x of an image, find the element e and the local coordinates xi with
sum_a N_a(xi) x_a = x, where x_a are the element's node positions in the state the image shows.
The paper inverts the same mapping to make its virtual images (section "Virtual Experiments").
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping import rasterise
from modeharvest.imaging.mapping.element_table import Pixels, bands, tabulate_elements
from modeharvest.imaging.mapping.elements import (
    polynomials,
    reference_element,
    require_positive_jacobian,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError


@dataclass(frozen=True, eq=False)
class Located:
    """Every pixel of an image in terms of a mesh."""

    element: NDArray[np.int32]
    """(rows, cols) int32 number of the element that covers the pixel centre, -1 where none does. A
    pixel on a shared edge or node belongs to the element of the lowest number."""
    values: FloatArray
    """(c, rows, cols) nodal fields at the pixel centres, or the two local coordinates (xi, eta)
    there [-]; NaN where no element is."""
    residual_px: NDArray[np.float32]
    """(rows, cols) float32 distance of the mapped (xi, eta) from the pixel [px], or NaN."""
    doubly_covered: int = 0
    """How many pixels lie inside more than one element: the mesh overlaps there."""

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True where there is material."""
        return np.asarray(self.element >= 0)

    @property
    def xi(self) -> FloatArray:
        """(rows, cols, 2) local coordinates, where these were asked for."""
        return np.moveaxis(self.values, 0, -1)

    @property
    def max_residual_px(self) -> float:
        """The largest residual of the inverse mapping [px]; 0 if no pixel is covered."""
        mask = self.mask
        return float(self.residual_px[mask].max()) if mask.any() else 0.0


def locate(
    nodes: FloatArray,
    cells: IntArray,
    element: str,
    grid: PixelGrid,
    where: str = "mesh",
    nodal: FloatArray | None = None,
) -> Located:
    """Find element and local coordinates, or fields, at every pixel centre of a grid.

    InputError if a Jacobian isn't positive everywhere in some element.

    nodes : (n, 2) node positions in the state to look at: undeformed X or deformed X + u [mm].
    cells, element : (m, k) node numbers of each element; T3, T6, Q4, Q8 or Q9.
    grid : the pixels.
    where : what to call the mesh in an error.
    nodal : (n, c) fields at the nodes to evaluate instead of the local coordinates: faster than
        :func:`interpolate` later, and without the memory for those.
    """
    require_positive_jacobian(nodes, cells, element, where)
    elements = tabulate_elements(nodes, cells, element, grid)
    start, visits = bands(elements, grid.rows, rasterise.BAND)
    fields = polynomials(element, cells, np.empty((len(nodes), 0)) if nodal is None else nodal)
    size = grid.rows * grid.cols
    pixels = Pixels(
        np.empty(size, dtype=np.int32), np.empty((fields.shape[1] or 2, size)),
        np.empty(size, dtype=np.float32), 0, grid.cols, float(grid.x0), float(grid.y0),
        float(grid.pixel_size),
    )  # fmt: skip
    order = in_turn(start.size - 1)
    overlapping = rasterise.rasterise(elements, fields, pixels, start, visits, order)
    return Located(
        pixels.element.reshape(grid.shape), pixels.values.reshape(-1, *grid.shape),
        pixels.residual.reshape(grid.shape), int(overlapping),
    )  # fmt: skip


def in_turn(bands: int) -> IntArray:
    """Order of the bands that gives each thread as many from every part of the image."""
    threads = numba.get_num_threads()
    return np.concatenate([np.arange(k, bands, threads) for k in range(threads)])


def interpolate(located: Located, cells: IntArray, element: str, nodal: FloatArray) -> FloatArray:
    """(c, rows, cols) values of a nodal field (n, c) at located pixels, NaN off the material.

    ``located`` is from :func:`locate` with the same cells. InputError unless the field is (n, c).
    """
    if nodal.ndim != 2:
        raise InputError(f"expected a nodal field of shape (n, c), got {nodal.shape}")
    coefficients = polynomials(element, cells, np.asarray(nodal, dtype=np.float64))
    out = np.empty((coefficients.shape[1], *located.element.shape))
    curved = not reference_element(element).triangular
    rasterise.evaluate(coefficients, curved, located.element, located.xi, out)
    return out
