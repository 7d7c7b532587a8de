"""Grey levels of a whole image in one pass over its rows: inverse mapping, pattern, grey level.

A thread takes a band of rows at a time, whose mapping fits into its cache; of the whole image
nothing is kept but grey levels and the mask.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.element_table import ElementTable, Pixels, bands, tabulate_elements
from modeharvest.imaging.mapping.elements import polynomials, require_positive_jacobian
from modeharvest.imaging.mapping.isoparametric import in_turn
from modeharvest.imaging.mapping.rasterise import fill
from modeharvest.imaging.speckle.periodic_spline import (
    BLOCK,
    PeriodicSpline,
    SplineTable,
    sample,
    workspace,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled

_BAND = 16  # rows


def render_rows(
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
    elements = tabulate_elements(nodes, mesh.cells, mesh.element, grid)
    start, visits = bands(elements.row_from, elements.row_to, grid.rows, _BAND)
    home = np.stack(grid.to_px(mesh.nodes[:, 0], mesh.nodes[:, 1]), axis=1)
    image, mask = np.empty(grid.shape, dtype=np.float32), np.empty(grid.shape, dtype=np.bool_)
    twice = _render_bands(
        elements, polynomials(mesh.element, mesh.cells, home), pattern.table, float(background),
        start, visits, in_turn(start.size - 1), image, mask,
    )  # fmt: skip
    return image, mask, int(twice)


@compiled(parallel=True)
def _render_bands(
    elements: ElementTable,
    home: FloatArray,
    pattern: SplineTable,
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
        twice += _render_band(elements, home, pattern, background, visited, order[i], image, mask)
    return twice


@compiled()
def _render_band(
    elements: ElementTable,
    home: FloatArray,
    pattern: SplineTable,
    background: float,
    visited: IntArray,
    band: int,
    image: NDArray[np.float32],
    mask: BoolArray,
) -> int:
    rows, cols = image.shape
    top, bottom = band * _BAND, min((band + 1) * _BAND, rows)
    everywhere = np.empty(0, dtype=np.bool_)
    element, grey, twice = _render_pixels(
        elements, home, pattern, background, everywhere, visited, top, bottom, cols
    )
    shown, covered = image[top:bottom].ravel(), mask[top:bottom].ravel()
    for k in range(grey.size):
        shown[k], covered[k] = grey[k], element[k] >= 0
    return twice


@compiled()
def _render_pixels(
    elements: ElementTable,
    home: FloatArray,
    pattern: SplineTable,
    background: float,
    wanted: BoolArray,
    visited: IntArray,
    top: int,
    bottom: int,
    cols: int,
) -> tuple[NDArray[np.int32], FloatArray, int]:
    """(element, grey level) of the pixels of some rows, and how many are covered twice."""
    size = (bottom - top) * cols
    element, at, grey = np.empty(size, dtype=np.int32), np.empty((2, size)), np.empty(size)
    pixels = Pixels(element, at, np.empty(0, dtype=np.float32), top, cols, 0.0, 0.0, 1.0)
    twice = fill(elements, home, pixels, wanted, visited, top, bottom)
    where, row, col = np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK), np.empty(BLOCK)
    shown, room = np.empty(BLOCK), workspace()
    grey[:] = background
    count = 0
    for k in range(size):
        if element[k] >= 0:
            where[count], row[count], col[count] = k, at[0, k], at[1, k]
            count += 1
        if count == BLOCK or (k == size - 1 and count > 0):
            sample(pattern, row[:count], col[:count], shown[:count], room)
            for n in range(count):
                grey[where[n]] = shown[n]
            count = 0
    return element, grey, twice


def render_rows_average(
    mesh: Mesh,
    nodes: FloatArray,
    grid: PixelGrid,
    pattern: PeriodicSpline,
    background: float,
    wanted: BoolArray,
    offsets: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """(rows, cols) weighted sum of grey levels at pixels moved by offsets; wrong if not wanted.

    Parameters
    ----------
    mesh, nodes
        The undeformed mesh, whose Jacobians are proved positive in the state with the node
        positions ``nodes`` (n, 2) [mm].
    grid, pattern, background
        As for :func:`paint`.
    wanted
        (rows, cols) True where to sum.
    offsets, weights
        (k, 2) (row, col) [px] and (k,).
    """
    total = np.zeros(grid.shape)
    home = np.stack(grid.to_px(mesh.nodes[:, 0], mesh.nodes[:, 1]), axis=1)
    fields, h = polynomials(mesh.element, mesh.cells, home), grid.pixel_size
    for (down, right), weight in zip(offsets, weights, strict=True):
        moved = PixelGrid(*grid.shape, h, float(grid.x0 + h * right), float(grid.y0 - h * down))
        elements = tabulate_elements(nodes, mesh.cells, mesh.element, moved)
        start, visits = bands(elements.row_from, elements.row_to, grid.rows, _BAND)
        order = in_turn(start.size - 1)
        _add(elements, fields, pattern.table, background, start, visits, order,
             float(weight), np.ascontiguousarray(wanted), total)  # fmt: skip
    return total


@compiled(parallel=True)
def _add(
    elements: ElementTable,
    home: FloatArray,
    pattern: SplineTable,
    background: float,
    start: IntArray,
    visits: IntArray,
    order: IntArray,
    weight: float,
    wanted: BoolArray,
    total: FloatArray,
) -> None:
    for i in prange(order.size):
        visited = visits[start[order[i]] : start[order[i] + 1]]
        _add_band(elements, home, pattern, background, visited, order[i], weight, wanted, total)


@compiled()
def _add_band(
    elements: ElementTable,
    home: FloatArray,
    pattern: SplineTable,
    background: float,
    visited: IntArray,
    band: int,
    weight: float,
    wanted: BoolArray,
    total: FloatArray,
) -> None:
    rows, cols = total.shape
    top, bottom = band * _BAND, min((band + 1) * _BAND, rows)
    sums = total[top:bottom].ravel()
    if not wanted[top:bottom].any():
        return
    grey = _render_pixels(
        elements, home, pattern, background, wanted.ravel(), visited, top, bottom, cols
    )[1]
    for k in range(grey.size):  # of others, too: what they get is not looked at
        sums[k] += weight * grey[k]
