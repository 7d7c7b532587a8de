"""Grey levels averaged over pixels in passes over an image's rows: mapping, pattern, grey level.

A thread takes a band of rows at a time, whose mapping fits into its cache; of the whole image
nothing is kept but grey levels.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.element_table import ElementTable, Pixels, bands, tabulate_elements
from modeharvest.imaging.mapping.elements import polynomials
from modeharvest.imaging.mapping.rasterise import fill
from modeharvest.imaging.speckle.periodic_spline import (
    BLOCK,
    PeriodicSpline,
    SplineTable,
    sample,
    workspace,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel

_BAND = 16  # rows


def render_rows_average(
    mesh: Mesh,
    nodes: FloatArray,
    grid: PixelGrid,
    pattern: PeriodicSpline,
    background: float,
    selected: BoolArray,
    offsets: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """(rows, cols) weighted sum of grey levels at selected pixels moved by offsets; else wrong.

    mesh, nodes : the undeformed mesh, whose Jacobians are proved positive in the state with the
        node positions ``nodes`` (n, 2) [mm].
    grid, pattern, background : the pixels, also the pattern's; intensity of material and around.
    selected, offsets, weights : (rows, cols) True where to sum; (k, 2) (row, col) [px] and (k,).
    """
    total = np.zeros(grid.shape)
    position = np.stack(grid.to_px(mesh.nodes[:, 0], mesh.nodes[:, 1]), axis=1)
    place, h = polynomials(mesh.element, mesh.cells, position), grid.pixel_size
    for (down, right), weight in zip(offsets, weights, strict=True):
        moved = PixelGrid(*grid.shape, h, float(grid.x0 + h * right), float(grid.y0 - h * down))
        elements = tabulate_elements(nodes, mesh.cells, mesh.element, moved)
        start, visits = bands(elements, grid.rows, _BAND)
        in_parallel(_add, elements, place, pattern.table, background, start, visits,
                    float(weight), np.ascontiguousarray(selected), total)  # fmt: skip
    return total


@compiled()
def _add(
    elements: ElementTable,
    place: FloatArray,
    pattern: SplineTable,
    background: float,
    start: IntArray,
    visits: IntArray,
    weight: float,
    selected: BoolArray,
    total: FloatArray,
    thread: int,
    threads: int,
) -> None:
    """``place`` (m, 2, 9): where in the pattern, (row, col) [px], the elements' points are."""
    for band in range(thread, start.size - 1, threads):
        visited = visits[start[band] : start[band + 1]]
        _add_band(elements, place, pattern, background, visited, band, weight, selected, total)


@compiled()
def _add_band(
    elements: ElementTable,
    place: FloatArray,
    pattern: SplineTable,
    background: float,
    visited: IntArray,
    band: int,
    weight: float,
    selected: BoolArray,
    total: FloatArray,
) -> None:
    rows, cols = total.shape
    top, bottom = band * _BAND, min((band + 1) * _BAND, rows)
    sums = total[top:bottom].ravel()
    if not selected[top:bottom].any():
        return
    grey = _render_pixels(
        elements, place, pattern, background, selected.ravel(), visited, top, bottom, cols
    )
    for k in range(grey.size):  # of others, too: what they get is not looked at
        sums[k] += weight * grey[k]


@compiled()
def _render_pixels(
    elements: ElementTable,
    place: FloatArray,
    pattern: SplineTable,
    background: float,
    selected: BoolArray,
    visited: IntArray,
    top: int,
    bottom: int,
    cols: int,
) -> FloatArray:
    """Grey levels of the pixels of some rows."""
    size = (bottom - top) * cols
    element, at, grey = np.empty(size, dtype=np.int32), np.empty((2, size)), np.empty(size)
    pixels = Pixels(element, at, np.empty(0, dtype=np.float32), top, cols, 0.0, 0.0, 1.0)
    fill(elements, place, pixels, selected, visited, top, bottom)
    where, row, col = np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK), np.empty(BLOCK)
    shown, work = np.empty(BLOCK), workspace()
    grey[:] = background
    count = 0
    for k in range(size):
        if element[k] >= 0:
            where[count], row[count], col[count] = k, at[0, k], at[1, k]
            count += 1
        if count == BLOCK or (k == size - 1 and count > 0):
            sample(pattern, row[:count], col[:count], shown[:count], work)
            for n in range(count):
                grey[where[n]] = shown[n]
            count = 0
    return grey
