"""Compiled kernels: inverse of one element's map, (row, col) to (xi, eta), and initial guesses.

The two ends of a pixel row within an element lie on its sides. The position along a side is
quadratic in its parameter, so the ends follow from the roots of quadratic equations. The local
coordinates at both ends are known; between them, the cubic with the exact values and slopes at
both ends is the initial guess of Newton's method.

A batch of pixels runs through Newton's method together, in a loop without branches that the
compiler vectorises; the result is checked pixel by pixel. Where the check fails, an exhaustive
search follows: the element is subdivided until the bounding box of a part's Bézier control points
excludes the pixel or Newton's method finds it.

Coordinates are (row, col) in px relative to a whole pixel near the element's centre.
"""

from __future__ import annotations

import numpy as np

from modeharvest.util.arrays import FloatArray
from modeharvest.util.compiled import compiled

Coefficients = tuple[float, ...]

ACCEPTED_PX = 1e-10
ON_EDGE = 1e-9  # in xi, eta: pixels at most so far outside still belong to the element
_BATCH_STEPS = 8
_NEWTON_STEPS = 20
_SETTLED = 1e-8  # in xi, eta: convergence is quadratic, so the error after this step is rounding
_RUNAWAY = 10.0  # in xi, eta: from so far outside, no root inside is reached
_NEARLY_PX = 1e-7  # residual from which the next step reaches rounding (quadratic convergence)
_DEEPEST = 9  # levels of subdivision in the exhaustive search


@compiled(inline=True)
def coefficients(a: FloatArray) -> Coefficients:
    """Copy a polynomial (9,) to registers: the compiler can't exclude that arrays alias."""
    return a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]


@compiled(inline=True, relaxed=True)
def value(a: Coefficients, curved: bool, s: float, t: float) -> float:
    """Evaluate a polynomial at (s, t) [-]; ``curved``: it has terms of total degree 3 and 4."""
    p = a[0] + s * (a[1] + s * a[3] + t * a[4]) + t * (a[2] + t * a[5])
    if curved:
        p += s * t * (s * a[6] + t * a[7] + s * t * a[8])
    return p


@compiled(inline=True, relaxed=True)
def value_and_slopes(
    a: Coefficients, curved: bool, s: float, t: float
) -> tuple[float, float, float]:
    """Evaluate a polynomial and its derivatives along s and t."""
    p = a[0] + s * (a[1] + s * a[3] + t * a[4]) + t * (a[2] + t * a[5])
    p_s = a[1] + 2.0 * s * a[3] + t * a[4]
    p_t = a[2] + s * a[4] + 2.0 * t * a[5]
    if curved:
        st = s * t
        p += st * (s * a[6] + t * a[7] + st * a[8])
        p_s += t * (2.0 * s * a[6] + t * a[7] + 2.0 * st * a[8])
        p_t += s * (s * a[6] + 2.0 * t * a[7] + 2.0 * st * a[8])
    return p, p_s, p_t


@compiled(inline=True, relaxed=True)
def distance_px(
    x: Coefficients, y: Coefficients, curved: bool, s: float, t: float, at: tuple[float, ...]
) -> float:
    """Distance [px] of the mapped (s, t) from a pixel; ``at``: x, y, pixel size [mm]."""
    right, down = at[0] - value(x, curved, s, t), at[1] - value(y, curved, s, t)
    return float(np.sqrt(down * down + right * right) / at[2])


@compiled(inline=True)
def outside(triangular: bool, s: float, t: float) -> float:
    """Distance of (s, t) outside the reference domain; 0 or negative inside."""
    if triangular:
        return max(-s, -t, s + t - 1.0)
    return max(abs(s), abs(t)) - 1.0


@compiled(inner=True, relaxed=True)
def invert(
    polynomial: FloatArray, triangular: bool, affine: bool, row: FloatArray, col: FloatArray,
    s: FloatArray, t: FloatArray, count: int,
) -> None:  # fmt: skip
    """Solve position(s, t) = (row, col) for ``count`` pixels from s, t; may not converge."""
    a, b = coefficients(polynomial[0]), coefficients(polynomial[1])
    curved = not triangular
    for _ in range(1 if affine else _BATCH_STEPS):
        total = 0.0  # of squared residuals before the step
        for k in range(count):
            p, p_s, p_t = value_and_slopes(a, curved, s[k], t[k])
            q, q_s, q_t = value_and_slopes(b, curved, s[k], t[k])
            p -= row[k]
            q -= col[k]
            total += p * p + q * q
            inverse = 1.0 / (p_s * q_t - p_t * q_s)
            s[k] += (p_t * q - q_t * p) * inverse
            t[k] += (q_s * p - p_s * q) * inverse
        if total <= _NEARLY_PX**2:
            break


@compiled(inner=True)
def newton(
    a: Coefficients, b: Coefficients, curved: bool, row: float, col: float, s: float, t: float
) -> tuple[bool, float, float]:
    """Solve position(s, t) = (row, col) for one pixel; return (converged, s, t)."""
    for _ in range(_NEWTON_STEPS):
        p, p_s, p_t = value_and_slopes(a, curved, s, t)
        q, q_s, q_t = value_and_slopes(b, curved, s, t)
        determinant = p_s * q_t - p_t * q_s
        if determinant == 0.0:
            return False, s, t
        ds = (p_t * (q - col) - q_t * (p - row)) / determinant
        dt = (q_s * (p - row) - p_s * (q - col)) / determinant
        s += ds
        t += dt
        if max(abs(ds), abs(dt)) < _SETTLED:
            return True, s, t
        if max(abs(s), abs(t)) > _RUNAWAY:
            return False, s, t
    return False, s, t


@compiled(inner=True)
def _may_hold(
    a: FloatArray, bezier: FloatArray, s: float, t: float, scale: float, row: float, col: float
) -> bool:
    """Whether the control points' box of the part (s, t) + scale (s', t') contains the pixel."""
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
            corner = 0.0
            for m in range(9):
                corner += bezier[i, m] * b[m]
            low, high = min(low, corner), max(high, corner)
        target = row if k == 0 else col
        slack = 1e-9 * (1.0 + high - low)
        if target < low - slack or target > high + slack:
            return False
    return True


@compiled(inner=True)
def search(
    polynomial: FloatArray, bezier: FloatArray, quarters: FloatArray, triangular: bool, row: float,
    col: float,
) -> tuple[bool, float, float]:  # fmt: skip
    """Exhaustive search: subdivide, drop parts that exclude the pixel, try Newton in the rest."""
    a, b = coefficients(polynomial[0]), coefficients(polynomial[1])
    stack = np.empty((4 * _DEEPEST + 4, 4))
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0.0, 0.0, 1.0, 0.0
    top = 1
    while top > 0:
        top -= 1
        s0, t0, scale, depth = stack[top]
        if not _may_hold(polynomial, bezier, s0, t0, scale, row, col):
            continue
        middle = scale / 3.0 if triangular else 0.0
        converged, s, t = newton(a, b, not triangular, row, col, s0 + middle, t0 + middle)
        if converged and outside(triangular, s, t) <= ON_EDGE:
            return True, s, t
        if depth < _DEEPEST:
            for i in range(4):
                stack[top, 0] = s0 + scale * quarters[i, 0]
                stack[top, 1] = t0 + scale * quarters[i, 1]
                stack[top, 2] = scale * quarters[i, 2]
                stack[top, 3] = depth + 1.0
                top += 1
    return False, 0.0, 0.0


End = tuple[float, float, float]
"""Column relative to the element's centre [px], and the local coordinates there."""

_CLOSE_PX = 1e-6  # a row that misses a side or corner by less meets it; pixels are checked later
_CLOSE = 1e-6  # the same tolerance for the parameter along a side
_FLAT_PX = 1e-3  # straight sides with a smaller extent in rows are treated as parallel to rows
_FAR_PX = 1e9


@compiled(inline=True, relaxed=True)
def ends(sides: FloatArray, corners: FloatArray, row: float) -> tuple[End, End]:
    """First and last intersection of a row (relative to the centre [px]) with the sides.

    The first column is infinite if there is none. ``sides``, ``corners``: see ElementTable.
    """
    low, low_at, high, high_at = np.inf, 0.0, -np.inf, 0.0
    for side in range(sides.shape[0]):
        c0, b, a = sides[side, 0, 0] - row, sides[side, 0, 1], sides[side, 0, 2]
        u, v = _roots(a, b, c0)
        corner = 0.0 if abs(c0) <= _CLOSE_PX else np.nan
        for at in (u, v, corner):
            col = sides[side, 1, 0] + at * (sides[side, 1, 1] + at * sides[side, 1, 2])
            # Selections instead of branches: which root counts is hard to predict.
            on_side = (at >= -_CLOSE) & (at <= 1.0 + _CLOSE)  # False for NaN
            lower, higher = on_side & (col < low), on_side & (col > high)
            low, low_at = col if lower else low, side + at if lower else low_at
            high, high_at = col if higher else high, side + at if higher else high_at
    return _end(corners, low, low_at), _end(corners, high, high_at)


@compiled(inline=True, relaxed=True)
def straight_ends(sides: FloatArray, row: float) -> tuple[End, End]:
    """Intersections of a row with an element with straight sides, from the lines through them.

    Only the columns are computed. The row must intersect the element; sides parallel to the row
    don't bound the columns and are skipped.
    """
    low, high = -_FAR_PX, _FAR_PX
    for side in range(sides.shape[0]):
        down = sides[side, 0, 1]
        if abs(down) > _FLAT_PX:
            col = sides[side, 1, 0] + (row - sides[side, 0, 0]) * (sides[side, 1, 1] / down)
            # Nodes are counter-clockwise: sides on the left lead down.
            low, high = max(low, col if down > 0.0 else low), min(high, high if down > 0.0 else col)
    return (low, 0.0, 0.0), (high, 0.0, 0.0)


@compiled(inline=True, relaxed=True)
def _end(corners: FloatArray, col: float, at: float) -> End:
    """Column and local coordinates of an end; ``at``: side number plus parameter along it."""
    whole = np.floor(at)
    side, after = int(whole) % len(corners), (int(whole) + 1) % len(corners)
    u = at - whole
    s = corners[side, 0] + u * (corners[after, 0] - corners[side, 0])
    t = corners[side, 1] + u * (corners[after, 1] - corners[side, 1])
    return col, s, t


@compiled(inline=True, relaxed=True)
def _roots(a: float, b: float, c: float) -> tuple[float, float]:
    """Roots of a u^2 + b u + c, NaN where there is none; tolerance of c: _CLOSE_PX."""
    if a == 0.0:
        return -c / b, np.nan
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        if discriminant < -4.0 * abs(a) * _CLOSE_PX:
            return np.nan, np.nan
        discriminant = 0.0
    q = -0.5 * (b + np.copysign(np.sqrt(discriminant), b))
    return q / a, c / q


@compiled(inline=True, relaxed=True)
def start_cubic(
    polynomial: FloatArray, curved: bool, low: End, high: End, col: float, s: FloatArray,
    t: FloatArray,
) -> None:  # fmt: skip
    """Write initial guesses (k,) s, t of the pixels col, col + 1, ... of a row between its ends."""
    length = max(high[0] - low[0], 1e-3)
    ds_low, dt_low = _along_row(polynomial, curved, low[1], low[2])
    ds_high, dt_high = _along_row(polynomial, curved, high[1], high[2])
    s1, s2, s3 = _hermite(low[1], high[1], ds_low * length, ds_high * length)
    t1, t2, t3 = _hermite(low[2], high[2], dt_low * length, dt_high * length)
    step = 1.0 / length
    begin = (col - low[0]) * step
    for k in range(s.size):
        x = begin + k * step
        s[k] = low[1] + x * (s1 + x * (s2 + x * s3))
        t[k] = low[2] + x * (t1 + x * (t2 + x * t3))


@compiled(inline=True, relaxed=True)
def _along_row(polynomial: FloatArray, curved: bool, s: float, t: float) -> tuple[float, float]:
    """Derivatives of (xi, eta) along a row of pixels [1/px]."""
    _, p_s, p_t = value_and_slopes(coefficients(polynomial[0]), curved, s, t)
    _, q_s, q_t = value_and_slopes(coefficients(polynomial[1]), curved, s, t)
    inverse = 1.0 / (p_s * q_t - p_t * q_s)
    return -p_t * inverse, p_s * inverse


@compiled(inline=True, relaxed=True)
def _hermite(y0: float, y1: float, d0: float, d1: float) -> tuple[float, float, float]:
    """Coefficients of x, x^2, x^3 of the cubic with value y0, slope d0 at 0 and y1, d1 at 1."""
    return d0, 3.0 * (y1 - y0) - 2.0 * d0 - d1, 2.0 * (y0 - y1) + d0 + d1
