"""A whole image in one pass over its rows: inverse mapping, pattern, grey level.

A thread takes a band of rows at a time, whose mapping fits into its cache; of the whole image
nothing is kept but grey levels and the mask.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.elements import polynomials
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.isoparametric import in_turn
from modeharvest.imaging.jacobian import require_positive_jacobian
from modeharvest.imaging.layout import Elements, Pixels, bands, lay
from modeharvest.imaging.periodic_spline import BLOCK, PeriodicSpline, Table, desk, sample
from modeharvest.imaging.rasterise import fill

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_BAND = 16  # rows


def paint(
    mesh: Mesh,
    displacement: FloatArray,
    grid: PixelGrid,
    pattern: PeriodicSpline,
    background: float,
    where: str = "deformed mesh",
) -> tuple[NDArray[np.float32], BoolArray, int]:
    """Show the deformed specimen.

    Parameters
    ----------
    mesh, displacement
        The undeformed mesh and its nodal displacements (n, 2) [mm].
    grid
        The pixels; the pattern's whole pixels are the grid's.
    pattern, background
        Intensity of the material and around it.
    where
        What to call the state in an error.

    Returns
    -------
    image, mask, twice
        (rows, cols) float32 intensity; (rows, cols) True where there is material; how many of
        its pixels lie inside more than one element.

    Raises
    ------
    InputError
        If the displacement turns an element inside out.
    """
    nodes = mesh.nodes + displacement
    require_positive_jacobian(nodes, mesh.cells, mesh.element, where)
    elements = lay(nodes, mesh.cells, mesh.element, grid)
    start, visits = bands(elements.row_from, elements.row_to, grid.rows, _BAND)
    home = np.stack(grid.to_px(mesh.nodes[:, 0], mesh.nodes[:, 1]), axis=1)
    image, mask = np.empty(grid.shape, dtype=np.float32), np.empty(grid.shape, dtype=np.bool_)
    twice = _paint(
        elements, polynomials(mesh.element, mesh.cells, home), pattern.table, float(background),
        start, visits, in_turn(start.size - 1), image, mask,
    )  # fmt: skip
    return image, mask, int(twice)


@compiled(parallel=True)
def _paint(
    elements: Elements,
    home: FloatArray,
    pattern: Table,
    background: float,
    start: IntArray,
    visits: IntArray,
    order: IntArray,
    image: NDArray[np.float32],
    mask: BoolArray,
) -> int:
    """``home`` (m, 2, 9): where in the pattern, (row, col) [px], the elements' points are."""
    twice = 0
    for i in prange(order.size):
        visited = visits[start[order[i]] : start[order[i] + 1]]
        twice += _paint_band(elements, home, pattern, background, visited, order[i], image, mask)
    return twice


@compiled()
def _paint_band(
    elements: Elements,
    home: FloatArray,
    pattern: Table,
    background: float,
    visited: IntArray,
    band: int,
    image: NDArray[np.float32],
    mask: BoolArray,
) -> int:
    rows, cols = image.shape
    top, bottom = band * _BAND, min((band + 1) * _BAND, rows)
    size = (bottom - top) * cols
    pixels = Pixels(
        np.empty(size, dtype=np.int32), np.empty((2, size)), np.empty(0, dtype=np.float32),
        top, cols, 0.0, 0.0, 1.0,
    )  # fmt: skip
    everywhere = np.empty(0, dtype=np.bool_)
    twice = fill(elements, home, pixels, everywhere, visited, top, bottom)
    grey, covered = image[top:bottom].ravel(), mask[top:bottom].ravel()
    where, at = np.empty(BLOCK, dtype=np.int64), np.empty((2, BLOCK))
    shown, room = np.empty(BLOCK), desk()
    count = 0
    for k in range(size):
        covered[k] = pixels.element[k] >= 0
        grey[k] = background
        if covered[k]:
            where[count], at[0, count], at[1, count] = k, pixels.values[0, k], pixels.values[1, k]
            count += 1
        if count == BLOCK or (k == size - 1 and count > 0):
            sample(pattern, at[0, :count], at[1, :count], shown[:count], room)
            for n in range(count):
                grey[where[n]] = shown[n]
            count = 0
    return twice
