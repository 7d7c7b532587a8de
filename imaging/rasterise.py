"""Compiled kernels: which element covers a pixel, and fields there.

The image is cut into bands of rows. A band visits, in ascending order, the elements that reach
into it, and writes its own pixels only: no races, and the same result for any number of
threads. Within an element, a row's pixels are limited to those between its two ends on the
element's sides, however curved. They are collected over the rows and inverted together.

Coordinates are (row, col) in px relative to the element's centre, a whole number of pixels, so
rounding is that of the element's size and not of the image's.
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
from modeharvest.imaging.layout import Elements, proved_reach
from modeharvest.imaging.scanline import ends, start_affine, start_cubic

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

BAND = 32  # rows
_BATCH = 1024  # pixels that are inverted together; their work fits into the fastest cache
_CLEAR_OF_EDGES = 1e-6  # in xi, eta; pixels on an edge come out within some 1e-9
_MARGIN_PX = 1e-3  # beyond a row's ends; these are found much more closely

_NOBODYS, _ON_EDGE, _INSIDE, _TWICE, _NOT_WANTED = 0, 1, 2, 3, 4


class Pixels(NamedTuple):
    """What is found, over some rows of an image, pixels in the order of memory.

    element : (n,) int32 element, -1 where none is.
    values : (c, n) fields at the pixels, NaN where no element is.
    residual : (n,) float32 [px], NaN where no element is; (0,) if it isn't wanted.
    first_row : of these pixels in the image.
    cols : pixels a row.
    x0, y0, pixel_size : of the image's grid [mm].
    """

    element: NDArray[np.int32]
    values: FloatArray
    residual: NDArray[np.float32]
    first_row: int
    cols: int
    x0: float
    y0: float
    pixel_size: float


class Batch(NamedTuple):
    """Pixels of one element on their way through the kernels: arrays of equal length.

    row, col : relative to the element's centre [px].
    s, t : local coordinates.
    off : squared residual in the kernels' own coordinates [px^2].
    residual : distance in the physical plane, by the nodes' own coordinates [px].
    where : place among the pixels.
    """

    row: FloatArray
    col: FloatArray
    s: FloatArray
    t: FloatArray
    off: FloatArray
    residual: FloatArray
    where: IntArray


@compiled(parallel=True)
def rasterise(
    elements: Elements,
    fields: FloatArray,
    pixels: Pixels,
    wanted: BoolArray,
    start: IntArray,
    visits: IntArray,
    order: IntArray,
) -> int:
    """Fill ``pixels``, a whole image, and count those that lie inside more than one element.

    ``fields`` (m, c, 9) are polynomials over the elements; without any (c = 0) the values are
    the local coordinates. ``wanted`` (n,) tells where to look, everywhere if it is empty. The
    elements of band b are ``visits[start[b]:start[b + 1]]``; ``order`` is that of the bands.
    """
    rows = pixels.element.size // pixels.cols
    twice = 0
    for i in prange(order.size):
        top = order[i] * BAND
        visited = visits[start[order[i]] : start[order[i] + 1]]
        twice += fill(elements, fields, pixels, wanted, visited, top, min(top + BAND, rows))
    return twice


@compiled()
def fill(
    elements: Elements,
    fields: FloatArray,
    pixels: Pixels,
    wanted: BoolArray,
    visited: IntArray,
    top: int,
    bottom: int,
) -> int:
    """Fill the image rows ``top`` ... ``bottom`` - 1 of ``pixels``; how many are covered twice."""
    begin, end = (top - pixels.first_row) * pixels.cols, (bottom - pixels.first_row) * pixels.cols
    state = np.zeros(end - begin, dtype=np.uint8)
    if wanted.size:
        for k in range(end - begin):
            if not wanted[top * pixels.cols + k]:
                state[k] = _NOT_WANTED
    real = np.empty((6, _BATCH))
    batch = Batch(real[0], real[1], real[2], real[3], real[4], real[5],
                  np.empty(_BATCH, dtype=np.int64))  # fmt: skip
    for e in visited:
        first, last = max(top, elements.row_from[e]), min(bottom, elements.row_to[e])
        _fill_element(
            elements, fields, pixels, e, first, last, wanted.size > 0, state, begin, batch
        )
    twice = 0
    for k in range(end - begin):
        if state[k] == _NOBODYS or state[k] == _NOT_WANTED:
            pixels.element[begin + k] = -1
            for field in range(pixels.values.shape[0]):
                pixels.values[field, begin + k] = np.nan
            if pixels.residual.size:
                pixels.residual[begin + k] = np.nan
        elif state[k] == _TWICE:
            twice += 1
    return twice


@compiled()
def _fill_element(
    elements: Elements,
    fields: FloatArray,
    pixels: Pixels,
    e: int,
    first: int,
    last: int,
    picky: bool,
    state: NDArray[np.uint8],
    begin: int,
    batch: Batch,
) -> None:
    """Claim the element's pixels in image rows ``first`` ... ``last`` - 1, batch by batch."""
    centre_row, centre_col = int(elements.centres[e, 0]), int(elements.centres[e, 1])
    polynomial, sides, corners = elements.polynomials[e], elements.sides[e], elements.corners
    affine, curved = elements.affine[e], not elements.triangular
    count = 0
    for image_row in range(first, last):
        row = float(image_row - centre_row)
        low, high = ends(sides, corners, row)
        if not low[0] <= high[0]:
            continue
        col = max(0, int(np.ceil(low[0] - _MARGIN_PX)) + centre_col)
        past = min(pixels.cols, int(np.floor(high[0] + _MARGIN_PX)) + centre_col + 1)
        row_begin = (image_row - pixels.first_row) * pixels.cols
        while col < past:
            if count == _BATCH:
                _claim(elements, fields, pixels, e, state, begin, batch, count)
                count = 0
            stop = min(past, col + _BATCH - count)
            if picky:
                while col < stop and state[row_begin + col - begin] == _NOT_WANTED:
                    col += 1
                until = col
                while until < stop and state[row_begin + until - begin] != _NOT_WANTED:
                    until += 1
                stop = until
            n, col_from = stop - col, float(col - centre_col)
            if affine:
                start_affine(polynomial, row, col_from, batch.s, batch.t, count, count + n)
            else:
                start_cubic(
                    polynomial, curved, low, high, col_from, batch.s, batch.t, count, count + n
                )
            for k in range(n):
                batch.row[count + k] = row
                batch.col[count + k] = col_from + k
                batch.where[count + k] = row_begin + col + k
            count += n
            col = stop
    _claim(elements, fields, pixels, e, state, begin, batch, count)


@compiled()
def _claim(
    elements: Elements,
    fields: FloatArray,
    pixels: Pixels,
    e: int,
    state: NDArray[np.uint8],
    begin: int,
    batch: Batch,
    count: int,
) -> None:
    """Invert a batch; claim those of its pixels that are inside and nobody's yet."""
    if not elements.affine[e]:
        invert(elements.polynomials[e], elements.triangular, batch.row, batch.col, batch.s, batch.t,
               count)  # fmt: skip
    _check(elements, pixels, e, batch, 0, count)
    reach = np.inf if elements.affine[e] else np.nan  # it is proved when first needed
    claimed = 0
    for k in range(count):
        depth = -outside(elements.triangular, batch.s[k], batch.t[k])
        if depth < -ON_EDGE and np.isnan(reach):
            reach = proved_reach(elements.polynomials[e], elements.slopes, elements.middle)
        if batch.off[k] > ACCEPTED_PX**2 or (depth < -ON_EDGE and depth <= -reach):
            # A root found outside, where the map is still one to one, is the only one; here
            # there may be another inside.
            found, batch.s[k], batch.t[k] = search(
                elements.polynomials[e], elements.bezier, elements.quarters, elements.triangular,
                batch.row[k], batch.col[k],
            )  # fmt: skip
            if not found:
                continue
            depth = -outside(elements.triangular, batch.s[k], batch.t[k])
            _check(elements, pixels, e, batch, k, k + 1)
        if depth < -ON_EDGE:
            continue
        at = batch.where[k]
        if state[at - begin] == _NOBODYS:
            state[at - begin] = _INSIDE if depth > _CLEAR_OF_EDGES else _ON_EDGE
            pixels.element[at] = e
            if pixels.residual.size:
                pixels.residual[at] = batch.residual[k]
            batch.where[claimed], batch.s[claimed], batch.t[claimed] = at, batch.s[k], batch.t[k]
            claimed += 1
        elif depth > _CLEAR_OF_EDGES and state[at - begin] == _INSIDE:
            state[at - begin] = _TWICE
    _write(elements, fields, pixels, e, batch, claimed)


@compiled(relaxed=True)
def _check(elements: Elements, pixels: Pixels, e: int, batch: Batch, first: int, last: int) -> None:
    """Compute the residuals of the pixels ``first`` ... ``last`` - 1 of a batch, two ways."""
    curved = not elements.triangular
    a = coefficients(elements.polynomials[e, 0])
    b = coefficients(elements.polynomials[e, 1])
    for k in range(first, last):
        p = value(a, curved, batch.s[k], batch.t[k]) - batch.row[k]
        q = value(b, curved, batch.s[k], batch.t[k]) - batch.col[k]
        batch.off[k] = p * p + q * q
    if not pixels.residual.size:
        return
    x, y = coefficients(elements.absolute[e, 0]), coefficients(elements.absolute[e, 1])
    h = pixels.pixel_size
    y0, x0 = pixels.y0 - h * elements.centres[e, 0], pixels.x0 + h * elements.centres[e, 1]
    for k in range(first, last):
        down = y0 - h * batch.row[k] - value(y, curved, batch.s[k], batch.t[k])
        right = x0 + h * batch.col[k] - value(x, curved, batch.s[k], batch.t[k])
        batch.residual[k] = np.sqrt(down * down + right * right) / h


@compiled(relaxed=True)
def _write(
    elements: Elements, fields: FloatArray, pixels: Pixels, e: int, batch: Batch, count: int
) -> None:
    """Write the fields, or the local coordinates, at the first ``count`` pixels of a batch."""
    if fields.shape[1] == 0:
        for k in range(count):
            pixels.values[0, batch.where[k]] = batch.s[k]
            pixels.values[1, batch.where[k]] = batch.t[k]
        return
    curved = not elements.triangular
    for field in range(fields.shape[1]):
        a = coefficients(fields[e, field])
        for k in range(count):
            pixels.values[field, batch.where[k]] = value(a, curved, batch.s[k], batch.t[k])


@compiled(parallel=True, relaxed=True)
def evaluate(
    polynomials: FloatArray,
    curved: bool,
    element: NDArray[np.int32],
    xi: FloatArray,
    out: FloatArray,
) -> None:
    """Write a field's polynomials (m, c, 9) at located pixels to ``out`` (c, rows, cols).

    ``xi`` (rows, cols, 2) may lie in memory in any order.
    """
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
