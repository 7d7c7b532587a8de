"""Compiled kernels: the element that covers each pixel, and fields there.

The image is divided into bands of rows. Each band visits, in ascending order, the elements that
reach into it, and writes only its own pixels: there are no races, and the result is the same for
any number of threads. Within an element, a row's pixels lie between the row's two intersections
with the (possibly curved) sides. They are collected over the rows and inverted together.

Coordinates are (row, col) in px relative to the element's centre, a whole number of pixels, so
that rounding errors scale with the element's size and not with the image's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.mapping.element_table import (
    CLEAR_OF_EDGES,
    EDGE,
    EXCLUDED,
    INSIDE,
    OVERLAPPING,
    UNASSIGNED,
    ElementTable,
    Pixels,
    proved_reach,
)
from modeharvest.imaging.mapping.inversion import (
    ACCEPTED_PX,
    ON_EDGE,
    coefficients,
    distance_px,
    ends,
    invert,
    outside,
    search,
    start_cubic,
    straight_ends,
    value,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled

BAND = 32  # rows
_BATCH = 1024  # pixels inverted together; their work arrays fit into the fastest cache
_MARGIN_PX = 1e-3  # margin beyond a row's ends, whose error is much smaller


class Batch(NamedTuple):
    """Work arrays, of equal length, for pixels of one element."""

    row: FloatArray
    col: FloatArray
    """Position relative to the element's centre [px]."""
    s: FloatArray
    t: FloatArray
    """Local coordinates."""
    off: FloatArray
    """Squared residual, from ``ElementTable.polynomials`` [px^2]."""
    residual: FloatArray
    """Residual, from ``ElementTable.absolute``: node coordinates in mm [px]."""
    where: IntArray
    """Index into the arrays of ``Pixels``."""


@compiled()
def rasterise(
    elements: ElementTable, fields: FloatArray, pixels: Pixels, start: IntArray, visits: IntArray,
    overlapping: IntArray, thread: int, threads: int,
) -> None:  # fmt: skip
    """Fill ``pixels``, a whole image, and count those that lie inside more than one element.

    ``fields`` (m, c, 9) are polynomials over the elements; without any (c = 0) the values are
    the local coordinates. The elements of band b are ``visits[start[b]:start[b + 1]]``; the
    count of band b is ``overlapping[b]``. Each thread's bands are spread over the image.
    """
    rows = pixels.element.size // pixels.cols
    everywhere = np.empty(0, dtype=np.bool_)
    for band in range(thread, overlapping.size, threads):
        top = band * BAND
        bottom, visited = min(top + BAND, rows), visits[start[band] : start[band + 1]]
        overlapping[band] = fill(elements, fields, pixels, everywhere, visited, top, bottom)


@compiled(inner=True)
def fill(
    elements: ElementTable, fields: FloatArray, pixels: Pixels, selected: BoolArray,
    visited: IntArray, top: int, bottom: int,
) -> int:  # fmt: skip
    """Fill the image rows ``top`` ... ``bottom`` - 1; return how many pixels lie in two elements.

    They are only counted if residuals are computed. ``selected`` (n,): which pixels of the whole
    image to fill; all if it is empty.
    """
    begin, end = (top - pixels.first_row) * pixels.cols, (bottom - pixels.first_row) * pixels.cols
    state = np.zeros(end - begin, dtype=np.uint8)
    pixels.element[begin:end] = -1
    if selected.size:
        for k, is_selected in enumerate(selected[top * pixels.cols : bottom * pixels.cols]):
            state[k] = UNASSIGNED if is_selected else EXCLUDED
    real = np.empty((6, _BATCH))
    batch = Batch(real[0], real[1], real[2], real[3], real[4], real[5],
                  np.empty(_BATCH, dtype=np.int64))  # fmt: skip
    rows_, cols_, s, t, where = batch.row, batch.col, batch.s, batch.t, batch.where
    cols, first_row, corners = pixels.cols, pixels.first_row, elements.corners
    # Inlined here: a separate kernel would count references to all arrays at each call.
    for e in visited:
        centre_row, centre_col = int(elements.centres[e, 0]), int(elements.centres[e, 1])
        polynomial, sides, affine = elements.polynomials[e], elements.sides[e], elements.affine[e]
        count = 0
        for image_row in range(max(top, elements.row_from[e]), min(bottom, elements.row_to[e])):
            row = float(image_row - centre_row)
            low, high = straight_ends(sides, row) if affine else ends(sides, corners, row)
            if not low[0] <= high[0] + _MARGIN_PX:
                continue
            col = max(0, int(np.ceil(low[0] - _MARGIN_PX)) + centre_col)
            past = min(cols, int(np.floor(high[0] + _MARGIN_PX)) + centre_col + 1)
            at = (image_row - first_row) * cols
            while col < past and state[at + col - begin] == EXCLUDED:
                col += 1
            while col < past and state[at + past - 1 - begin] == EXCLUDED:
                past -= 1
            while col < past:
                if count == _BATCH:
                    _assign(elements, fields, pixels, e, state, begin, batch, count)
                    count = 0
                stop = min(past, col + _BATCH - count)
                n, col_from = stop - col, float(col - centre_col)
                for k in range(count, count + n):
                    rows_[k], cols_[k], where[k] = row, col_from + (k - count), at + col + k - count
                    s[k] = t[k] = 0.0  # for an affine map one Newton step from here is exact
                if not affine:
                    start_cubic(polynomial, not elements.triangular, low, high, col_from,
                                s[count : count + n], t[count : count + n])  # fmt: skip
                count, col = count + n, stop
        _assign(elements, fields, pixels, e, state, begin, batch, count)
    overlapping = 0
    if pixels.residual.size:  # else the caller handles pixels outside the mesh
        for k in range(state.size):
            overlapping += state[k] == OVERLAPPING
            if pixels.element[begin + k] < 0:
                pixels.residual[begin + k] = np.nan
                pixels.values[:, begin + k] = np.nan
    return overlapping


@compiled(inline=True)
def _assign(
    elements: ElementTable, fields: FloatArray, pixels: Pixels, e: int, state: NDArray[np.uint8],
    begin: int, batch: Batch, count: int,
) -> None:  # fmt: skip
    """Invert a batch; assign its pixels that are inside the element and not assigned yet."""
    polynomial, triangular = elements.polynomials[e], elements.triangular
    row, col, s, t, off, residual, where = batch
    element, residuals = pixels.element, pixels.residual
    invert(polynomial, triangular, elements.affine[e], row, col, s, t, count)
    _check(elements, pixels, e, row, col, s, t, off, residual, count)
    reach = np.inf if elements.affine[e] else np.nan  # NaN: not computed yet
    assigned = 0
    for k in range(count):
        depth = -outside(triangular, s[k], t[k])
        if depth < -ON_EDGE and np.isnan(reach):
            reach = proved_reach(polynomial, elements.slopes, elements.middle)
        if off[k] > ACCEPTED_PX**2 or (depth < -ON_EDGE and depth <= -reach):
            # A root outside is the only one where the map is proved one to one. Beyond that
            # region there may be another root inside.
            found, s[k], t[k] = search(
                polynomial, elements.bezier, elements.quarters, triangular, row[k], col[k]
            )
            if not found:
                continue
            depth = -outside(triangular, s[k], t[k])
            _check(elements, pixels, e, row[k:], col[k:], s[k:], t[k:], off[k:], residual[k:], 1)
        if depth < -ON_EDGE:
            continue
        at = where[k]
        if state[at - begin] == UNASSIGNED:
            state[at - begin] = INSIDE if depth > CLEAR_OF_EDGES else EDGE
            element[at] = e
            if residuals.size:
                residuals[at] = residual[k]
            where[assigned], s[assigned], t[assigned] = at, s[k], t[k]
            assigned += 1
        elif depth > CLEAR_OF_EDGES and state[at - begin] == INSIDE:
            state[at - begin] = OVERLAPPING
    _write(fields, pixels.values, e, triangular, where, s, t, assigned)


@compiled(inline=True, relaxed=True)
def _check(
    elements: ElementTable, pixels: Pixels, e: int, row: FloatArray, col: FloatArray, s: FloatArray,
    t: FloatArray, off: FloatArray, residual: FloatArray, count: int,
) -> None:  # fmt: skip
    """Compute ``off`` and ``residual`` of the first ``count`` pixels, see Batch."""
    curved = not elements.triangular
    a = coefficients(elements.polynomials[e, 0])
    b = coefficients(elements.polynomials[e, 1])
    for k in range(count):
        p = value(a, curved, s[k], t[k]) - row[k]
        q = value(b, curved, s[k], t[k]) - col[k]
        off[k] = p * p + q * q
    if not pixels.residual.size:
        return
    x, y = coefficients(elements.absolute[e, 0]), coefficients(elements.absolute[e, 1])
    h = pixels.pixel_size
    y0, x0 = pixels.y0 - h * elements.centres[e, 0], pixels.x0 + h * elements.centres[e, 1]
    for k in range(count):
        at = x0 + h * col[k], y0 - h * row[k], h
        residual[k] = distance_px(x, y, curved, s[k], t[k], at)


@compiled(inline=True, relaxed=True)
def _write(
    fields: FloatArray, values: FloatArray, e: int, triangular: bool, where: IntArray,
    s: FloatArray, t: FloatArray, count: int,
) -> None:  # fmt: skip
    """Write the fields, or the local coordinates, at the first ``count`` pixels of a batch."""
    if fields.shape[1] == 0:
        for k in range(count):
            values[0, where[k]] = s[k]
            values[1, where[k]] = t[k]
    for field in range(fields.shape[1]):
        a, out = coefficients(fields[e, field]), values[field]
        for k in range(count):
            out[where[k]] = value(a, not triangular, s[k], t[k])


@compiled(relaxed=True)
def evaluate(
    polynomials: FloatArray, curved: bool, element: NDArray[np.int32], xi: FloatArray,
    out: FloatArray, thread: int, threads: int,
) -> None:  # fmt: skip
    """Write a field's polynomials (m, c, 9) at located pixels to ``out`` (c, rows, cols).

    ``xi`` (rows, cols, 2) may have any memory layout.
    """
    cols = element.shape[1]
    for row in range(thread, element.shape[0], threads):
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
