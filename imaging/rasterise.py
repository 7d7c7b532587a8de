"""Compiled kernels: which element covers a pixel, and a field at located pixels.

The image is cut into bands of rows. A band visits, in ascending order, the elements that reach
into it, and writes its own pixels only: no races, and the same result for any number of
threads. Within an element, a row's pixels are limited to the convex hull of the Bézier control
points, which holds the whole element however curved it is. They are collected over the rows and
inverted together.

Coordinates are (row, col) in px relative to the element's ``centre``, a whole number of pixels,
so rounding is that of the element's size and not of the image's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.inversion import (
    ACCEPTED_PX,
    ON_EDGE,
    coefficients,
    invert,
    outside,
    search,
    value,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

BAND = 32  # rows
_BATCH = 1024  # pixels that are inverted together; their work fits into the fastest cache
_CLEAR_OF_EDGES = 1e-6  # in xi, eta; pixels on an edge come out within some 1e-9
_NOT_WANTED = 2**31 - 1


class Elements(NamedTuple):
    """A mesh as the kernels see it: m elements.

    polynomials : (m, 2, 9) (row, col) relative to the centre [px].
    absolute : (m, 2, 9) (x, y) [mm]; only the residual is from them, which makes it a check.
    hulls : (m, p, 2) Bézier control points (row, col) relative to the centre [px].
    centres : (m, 2) whole pixels (row, col).
    reach : (m,) how far beyond the element's edges its map is one to one, in (xi, eta).
    row_from, row_to : (m,) the image rows row_from ... row_to - 1 may hold pixels of it.
    bezier : (p, 9) from polynomials to control points.
    quarters : (4, 3) sub-elements.
    triangular : triangles or quadrilaterals.
    """

    polynomials: FloatArray
    absolute: FloatArray
    hulls: FloatArray
    centres: FloatArray
    reach: FloatArray
    row_from: IntArray
    row_to: IntArray
    bezier: FloatArray
    quarters: FloatArray
    triangular: bool


class Pixels(NamedTuple):
    """What is found, over the pixels in the order of memory.

    element : (rows * cols,) int32 element, -1 where none is.
    xi : (rows * cols, 2) local coordinates, NaN where no element is.
    residual : (rows * cols,) float32 [px], NaN where no element is.
    cols : how many a row.
    x0, y0, pixel_size : of the grid [mm].
    """

    element: NDArray[np.int32]
    xi: FloatArray
    residual: NDArray[np.float32]
    cols: int
    x0: float
    y0: float
    pixel_size: float


@compiled(parallel=True)
def rasterise(
    elements: Elements,
    pixels: Pixels,
    wanted: BoolArray,
    visit_start: IntArray,
    visits: IntArray,
    order: IntArray,
) -> int:
    """Fill ``pixels``, and count those that lie inside more than one element.

    ``wanted`` (rows * cols,) tells where to look, everywhere if it is empty.
    ``visits[visit_start[b]:visit_start[b + 1]]`` are the elements of band b, ascending;
    ``order`` is that of the bands.
    """
    twice = 0
    for i in prange(order.size):
        band = order[i]
        twice += _fill_band(
            elements, pixels, wanted, visits[visit_start[band] : visit_start[band + 1]], band
        )
    return twice


@compiled()
def _fill_band(
    elements: Elements, pixels: Pixels, wanted: BoolArray, visits: IntArray, band: int
) -> int:
    cols = pixels.cols
    rows = pixels.element.size // cols
    top, bottom = band * BAND, min((band + 1) * BAND, rows)
    for at in range(top * cols, bottom * cols):
        pixels.element[at] = -1 if wanted.size == 0 or wanted[at] else _NOT_WANTED
    again = np.zeros((bottom - top) * cols, dtype=np.bool_)
    work, where = np.empty((6, _BATCH)), np.empty(_BATCH, dtype=np.int64)
    for e in visits:
        first, last = max(top, elements.row_from[e]), min(bottom, elements.row_to[e])
        _fill_element(elements, pixels, e, first, last, again, top * cols, work, where)
    for at in range(top * cols, bottom * cols):
        if pixels.element[at] == _NOT_WANTED:
            pixels.element[at] = -1
        if pixels.element[at] < 0:
            pixels.xi[at, 0] = pixels.xi[at, 1] = np.nan
            pixels.residual[at] = np.nan
    return np.count_nonzero(again)


@compiled()
def _fill_element(
    elements: Elements,
    pixels: Pixels,
    e: int,
    first: int,
    last: int,
    again: BoolArray,
    band_start: int,
    work: FloatArray,
    where: IntArray,
) -> None:
    """Claim the element's pixels in image rows ``first`` ... ``last`` - 1, batch by batch."""
    cols = pixels.cols
    hull = elements.hulls[e]
    centre_row, centre_col = elements.centres[e]
    row, col = work[0], work[1]
    count = 0
    for image_row in range(first, last):
        low, high = _row_range(hull, image_row - centre_row)
        if low > high:
            continue
        from_col = max(0, int(np.ceil(low - 1e-9 + centre_col)))
        to_col = min(cols - 1, int(np.floor(high + 1e-9 + centre_col)))
        for image_col in range(from_col, to_col + 1):
            at = image_row * cols + image_col
            if pixels.element[at] == _NOT_WANTED:
                continue
            if count == _BATCH:
                _claim(elements, pixels, e, again, band_start, work, where, count)
                count = 0
            row[count], col[count] = image_row - centre_row, image_col - centre_col
            where[count] = at
            count += 1
    _claim(elements, pixels, e, again, band_start, work, where, count)


@compiled()
def _claim(
    elements: Elements,
    pixels: Pixels,
    e: int,
    again: BoolArray,
    band_start: int,
    work: FloatArray,
    where: IntArray,
    count: int,
) -> None:
    """Invert a batch; claim those of its pixels that are inside and nobody's yet."""
    triangular = elements.triangular
    row, col, s, t, off, residual = work[0], work[1], work[2], work[3], work[4], work[5]
    polynomial, absolute = elements.polynomials[e], elements.absolute[e]
    invert(polynomial, triangular, row, col, s, t, count)
    centre_row, centre_col = elements.centres[e]
    h = pixels.pixel_size
    start = (pixels.y0 - h * centre_row, pixels.x0 + h * centre_col, h)
    _check(polynomial, absolute, not triangular, row, col, s, t, start, off, residual, count)
    for k in range(count):
        at = where[k]
        depth = -outside(triangular, s[k], t[k])
        converged = off[k] <= ACCEPTED_PX**2
        if not converged or (depth < -ON_EDGE and depth <= -elements.reach[e]):
            # A root found outside, where the map is still one to one, is the only one; here
            # there may be another inside.
            found, s[k], t[k] = search(
                polynomial, elements.bezier, elements.quarters, triangular, row[k], col[k]
            )
            if not found:
                continue
            depth = -outside(triangular, s[k], t[k])
            _check(polynomial, absolute, not triangular, row[k:], col[k:], s[k:], t[k:], start,
                   off[k:], residual[k:], 1)  # fmt: skip
        if depth < -ON_EDGE:
            continue
        if pixels.element[at] < 0:
            pixels.element[at] = e
            pixels.xi[at, 0] = s[k]
            pixels.xi[at, 1] = t[k]
            pixels.residual[at] = residual[k]
        elif depth > _CLEAR_OF_EDGES:
            owner_depth = -outside(triangular, pixels.xi[at, 0], pixels.xi[at, 1])
            again[at - band_start] |= owner_depth > _CLEAR_OF_EDGES


@compiled(relaxed=True)
def _check(
    polynomial: FloatArray,
    absolute: FloatArray,
    curved: bool,
    row: FloatArray,
    col: FloatArray,
    s: FloatArray,
    t: FloatArray,
    start: tuple[float, float, float],
    off: FloatArray,
    residual: FloatArray,
    count: int,
) -> None:
    """Compute the residuals of the first ``count`` pixels, two ways.

    ``off`` is squared, by the kernel's own coordinates [px^2]; ``residual`` is the distance in
    the physical plane, by the nodes' own [px].
    """
    a, b = coefficients(polynomial[0]), coefficients(polynomial[1])
    x, y = coefficients(absolute[0]), coefficients(absolute[1])
    y0, x0, h = start
    for k in range(count):
        p = value(a, curved, s[k], t[k]) - row[k]
        q = value(b, curved, s[k], t[k]) - col[k]
        off[k] = p * p + q * q
        down = y0 - h * row[k] - value(y, curved, s[k], t[k])
        right = x0 + h * col[k] - value(x, curved, s[k], t[k])
        residual[k] = np.sqrt(down * down + right * right) / h


@compiled()
def _row_range(hull: FloatArray, row: float) -> tuple[float, float]:
    """Find the least and greatest column of the control points' hull on an image row."""
    low, high = np.inf, -np.inf
    for i in range(hull.shape[0]):
        if abs(hull[i, 0] - row) < 1e-9:
            low, high = min(low, hull[i, 1]), max(high, hull[i, 1])
        for j in range(i):
            if (hull[i, 0] - row) * (hull[j, 0] - row) < 0.0:
                part = (row - hull[i, 0]) / (hull[j, 0] - hull[i, 0])
                col = hull[i, 1] + part * (hull[j, 1] - hull[i, 1])
                low, high = min(low, col), max(high, col)
    return low, high


@compiled(parallel=True, relaxed=True)
def evaluate(
    polynomials: FloatArray,
    curved: bool,
    element: NDArray[np.int32],
    xi: FloatArray,
    out: FloatArray,
) -> None:
    """Write a field's polynomials (m, c, 9) at located pixels to ``out`` (c, rows, cols)."""
    cols = element.shape[1]
    for row in prange(element.shape[0]):
        begin = 0
        while begin < cols:
            e = element[row, begin]
            end = begin + 1
            while end < cols and element[row, end] == e:
                end += 1
            for k in range(out.shape[0]):
                if e < 0:
                    out[k, row, begin:end] = np.nan
                else:
                    a = coefficients(polynomials[e, k])
                    for col in range(begin, end):
                        out[k, row, col] = value(a, curved, xi[row, col, 0], xi[row, col, 1])
            begin = end


@compiled()
def bands(row_from: IntArray, row_to: IntArray, rows: int) -> tuple[IntArray, IntArray]:
    """(visit_start, visits): for each band of rows the elements that reach into it."""
    count = (rows + BAND - 1) // BAND
    start = np.zeros(count + 1, dtype=np.int64)
    for e in range(row_from.size):
        if row_to[e] > row_from[e]:
            for b in range(row_from[e] // BAND, (row_to[e] - 1) // BAND + 1):
                start[b + 1] += 1
    for b in range(count):
        start[b + 1] += start[b]
    visits = np.empty(start[-1], dtype=np.int64)
    cursor = start[:-1].copy()
    for e in range(row_from.size):
        if row_to[e] > row_from[e]:
            for b in range(row_from[e] // BAND, (row_to[e] - 1) // BAND + 1):
                visits[cursor[b]] = e
                cursor[b] += 1
    return start, visits
