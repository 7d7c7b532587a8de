"""Compiled kernels: which element covers a pixel, and a field at located pixels.

The image is cut into bands of rows. A band visits, in ascending order, the elements that reach
into it, and writes its own pixels only: no races, and the same result for any number of
threads. Within an element, a row's pixels are limited to the convex hull of the Bézier control
points, which holds the whole element however curved it is.

Coordinates are (row, col) in px relative to the element's ``centre``, a whole number of pixels,
so rounding is that of the element's size and not of the image's.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.imaging.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

BAND = 16  # rows
ON_EDGE = 1e-9  # pixels this far outside in xi, eta still belong to the element
_NEWTON_STEPS = 25
_DEEPEST = 9  # quarters of quarters in the exhaustive search
_ROUNDING_PX = 1e-13
_ACCEPTED_PX = 1e-10


@compiled(inline=True)
def _position(
    a: FloatArray, curved: bool, s: float, t: float
) -> tuple[float, float, float, float, float, float]:
    """Position and its derivatives (p, q, p_s, p_t, q_s, q_t) at local coordinates (s, t)."""
    p = a[0, 0] + s * (a[0, 1] + s * a[0, 3] + t * a[0, 4]) + t * (a[0, 2] + t * a[0, 5])
    q = a[1, 0] + s * (a[1, 1] + s * a[1, 3] + t * a[1, 4]) + t * (a[1, 2] + t * a[1, 5])
    p_s = a[0, 1] + 2.0 * s * a[0, 3] + t * a[0, 4]
    q_s = a[1, 1] + 2.0 * s * a[1, 3] + t * a[1, 4]
    p_t = a[0, 2] + s * a[0, 4] + 2.0 * t * a[0, 5]
    q_t = a[1, 2] + s * a[1, 4] + 2.0 * t * a[1, 5]
    if curved:
        st = s * t
        p += st * (s * a[0, 6] + t * a[0, 7] + st * a[0, 8])
        q += st * (s * a[1, 6] + t * a[1, 7] + st * a[1, 8])
        p_s += t * (2.0 * s * a[0, 6] + t * a[0, 7] + 2.0 * st * a[0, 8])
        q_s += t * (2.0 * s * a[1, 6] + t * a[1, 7] + 2.0 * st * a[1, 8])
        p_t += s * (s * a[0, 6] + 2.0 * t * a[0, 7] + 2.0 * st * a[0, 8])
        q_t += s * (s * a[1, 6] + 2.0 * t * a[1, 7] + 2.0 * st * a[1, 8])
    return p, q, p_s, p_t, q_s, q_t


@compiled(inline=True)
def _outside(triangular: bool, s: float, t: float) -> float:
    """How far (s, t) lies outside the reference domain; 0 or negative inside."""
    if triangular:
        return max(-s, -t, s + t - 1.0)
    return max(abs(s), abs(t)) - 1.0


@compiled()
def _newton(
    a: FloatArray, curved: bool, row: float, col: float, s: float, t: float
) -> tuple[bool, float, float]:
    """Solve position(s, t) = (row, col) from a start; (converged, s, t)."""
    before = np.inf
    for _ in range(_NEWTON_STEPS):
        p, q, p_s, p_t, q_s, q_t = _position(a, curved, s, t)
        p -= row
        q -= col
        residual = p * p + q * q
        if residual <= _ROUNDING_PX**2 or (
            residual <= _ACCEPTED_PX**2 and residual >= 0.25 * before
        ):
            return True, s, t
        before = residual
        determinant = p_s * q_t - p_t * q_s
        if determinant == 0.0:
            return False, s, t
        ds = (p_t * q - q_t * p) / determinant
        dt = (q_s * p - p_s * q) / determinant
        longest = max(abs(ds), abs(dt))
        if longest > 2.0:  # a leap this long is no use of a local model
            ds *= 2.0 / longest
            dt *= 2.0 / longest
        s += ds
        t += dt
    return False, s, t


@compiled()
def _may_hold(
    a: FloatArray, bezier: FloatArray, s: float, t: float, scale: float, row: float, col: float
) -> bool:
    """Whether the control points' box of the part (s, t) + scale (s', t') holds the pixel."""
    b = np.empty(9)
    for k in range(2):
        c = a[k]
        b[0] = c[0] + s * (c[1] + s * c[3] + t * c[4]) + t * (c[2] + t * c[5])
        b[0] += s * t * (s * c[6] + t * c[7] + s * t * c[8])
        b[1] = scale * (c[1] + 2.0 * s * c[3] + t * c[4])
        b[1] += scale * t * (2.0 * s * c[6] + t * c[7] + 2.0 * s * t * c[8])
        b[2] = scale * (c[2] + s * c[4] + 2.0 * t * c[5])
        b[2] += scale * s * (s * c[6] + 2.0 * t * c[7] + 2.0 * s * t * c[8])
        b[3] = scale**2 * (c[3] + t * c[6] + t * t * c[8])
        b[4] = scale**2 * (c[4] + 2.0 * s * c[6] + 2.0 * t * c[7] + 4.0 * s * t * c[8])
        b[5] = scale**2 * (c[5] + s * c[7] + s * s * c[8])
        b[6] = scale**3 * (c[6] + 2.0 * t * c[8])
        b[7] = scale**3 * (c[7] + 2.0 * s * c[8])
        b[8] = scale**4 * c[8]
        low, high = np.inf, -np.inf
        for i in range(bezier.shape[0]):
            value = 0.0
            for m in range(9):
                value += bezier[i, m] * b[m]
            low, high = min(low, value), max(high, value)
        target = row if k == 0 else col
        slack = 1e-9 * (1.0 + high - low)
        if target < low - slack or target > high + slack:
            return False
    return True


@compiled()
def _search(
    a: FloatArray,
    bezier: FloatArray,
    quarters: FloatArray,
    triangular: bool,
    row: float,
    col: float,
) -> tuple[bool, float, float]:
    """Exhaustive search: halve the element, drop parts that can't hold the pixel, try the rest."""
    stack = np.empty((4 * _DEEPEST + 4, 4))
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0.0, 0.0, 1.0, 0.0
    top = 1
    while top > 0:
        top -= 1
        s0, t0, scale, depth = stack[top]
        if not _may_hold(a, bezier, s0, t0, scale, row, col):
            continue
        middle = scale / 3.0 if triangular else 0.0
        converged, s, t = _newton(a, not triangular, row, col, s0 + middle, t0 + middle)
        if converged and _outside(triangular, s, t) <= ON_EDGE:
            return True, s, t
        if depth < _DEEPEST:
            for i in range(4):
                stack[top, 0] = s0 + scale * quarters[i, 0]
                stack[top, 1] = t0 + scale * quarters[i, 1]
                stack[top, 2] = scale * quarters[i, 2]
                stack[top, 3] = depth + 1.0
                top += 1
    return False, 0.0, 0.0


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


@compiled()
def _fill(
    number: int,
    a: FloatArray,
    hull: FloatArray,
    centre: FloatArray,
    one_to_one: bool,
    bezier: FloatArray,
    quarters: FloatArray,
    triangular: bool,
    first: int,
    last: int,
    element: NDArray[np.int32],
    xi: FloatArray,
) -> None:
    """Claim the element's unowned pixels in image rows ``first`` ... ``last`` - 1."""
    cols = element.shape[1]
    middle = 1.0 / 3.0 if triangular else 0.0
    row_s = row_t = middle
    for image_row in range(first, last):
        row = image_row - centre[0]
        low, high = _row_range(hull, row)
        if low > high:
            continue
        from_col = max(0, int(np.ceil(low - 1e-9 + centre[1])))
        to_col = min(cols - 1, int(np.floor(high + 1e-9 + centre[1])))
        s, t = row_s, row_t
        first_of_row = True
        for image_col in range(from_col, to_col + 1):
            if element[image_row, image_col] >= 0:
                continue
            col = image_col - centre[1]
            converged, s, t = _newton(a, not triangular, row, col, s, t)
            outside = _outside(triangular, s, t)
            found = converged and outside <= ON_EDGE
            # On an element that is one to one well beyond its edges, the root found outside
            # is the only one; elsewhere there may be another inside.
            if not found and not (converged and one_to_one and outside < 0.25):
                found, s, t = _search(a, bezier, quarters, triangular, row, col)
            if found:
                element[image_row, image_col] = number
                xi[image_row, image_col, 0] = s
                xi[image_row, image_col, 1] = t
                if first_of_row:
                    row_s, row_t, first_of_row = s, t, False
            else:
                s, t = row_s, row_t


@compiled(parallel=True)
def rasterise(
    polynomials: FloatArray,
    hulls: FloatArray,
    centres: FloatArray,
    one_to_one: BoolArray,
    bezier: FloatArray,
    quarters: FloatArray,
    triangular: bool,
    visit_start: IntArray,
    visits: IntArray,
    row_from: IntArray,
    row_to: IntArray,
    element: NDArray[np.int32],
    xi: FloatArray,
) -> None:
    """Fill ``element`` (rows, cols) and ``xi`` (rows, cols, 2), which start as -1 and NaN.

    ``visits[visit_start[b]:visit_start[b + 1]]`` are the elements of band b, ascending;
    ``row_from`` ... ``row_to`` - 1 are the image rows of each element.
    """
    for band in prange(visit_start.size - 1):
        top = band * BAND
        bottom = min(top + BAND, element.shape[0])
        for v in range(visit_start[band], visit_start[band + 1]):
            e = visits[v]
            _fill(
                e, polynomials[e], hulls[e], centres[e], one_to_one[e], bezier, quarters,
                triangular, max(top, row_from[e]), min(bottom, row_to[e]), element, xi,
            )  # fmt: skip


@compiled(parallel=True)
def evaluate(
    polynomials: FloatArray,
    curved: bool,
    element: NDArray[np.int32],
    xi: FloatArray,
    out: FloatArray,
) -> None:
    """Write a field's polynomials (m, c, 9) at located pixels to ``out`` (c, rows, cols)."""
    for row in prange(element.shape[0]):
        for col in range(element.shape[1]):
            e = element[row, col]
            s, t = xi[row, col, 0], xi[row, col, 1]
            for k in range(out.shape[0]):
                if e < 0:
                    out[k, row, col] = np.nan
                    continue
                a = polynomials[e, k]
                value = a[0] + s * (a[1] + s * a[3] + t * a[4]) + t * (a[2] + t * a[5])
                if curved:
                    value += s * t * (s * a[6] + t * a[7] + s * t * a[8])
                out[k, row, col] = value


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
