"""Compiled kernels: where a row of pixels enters and leaves an element, and a start in between.

The extreme points of an element on a row of pixels lie on its sides, whose positions are
quadratic in the parameter along them; so the row's pixels in it are bounded by the roots of
quadratic equations. There the local coordinates are known; between the two a cubic with the right
values and slopes at both ends is a start for Newton's method.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.inversion import coefficients, value_and_slopes

FloatArray = NDArray[np.float64]
End = tuple[float, float, float]
"""Column relative to the element's centre [px], and the local coordinates there."""

_CLOSE_PX = 1e-6  # rows that miss a side or a corner by less meet it; pixels are looked at anyway
_CLOSE = 1e-6  # the same along a side


@compiled(relaxed=True)
def ends(sides: FloatArray, corners: FloatArray, row: float) -> tuple[End, End]:
    """Where a row (relative to the centre [px]) first and last meets the element's sides.

    The first column is infinite if it doesn't. For ``sides`` and ``corners`` see Elements.
    """
    low, low_at, high, high_at = np.inf, 0.0, -np.inf, 0.0
    for side in range(sides.shape[0]):
        c0, b, a = sides[side, 0, 0] - row, sides[side, 0, 1], sides[side, 0, 2]
        u, v = _roots(a, b, c0)
        corner = 0.0 if abs(c0) <= _CLOSE_PX else np.nan
        for at in (u, v, corner):
            col = sides[side, 1, 0] + at * (sides[side, 1, 1] + at * sides[side, 1, 2])
            # Which root counts is hard to predict, so there are selections instead of branches.
            on_side = (at >= -_CLOSE) & (at <= 1.0 + _CLOSE)  # NaN isn't
            lower, higher = on_side & (col < low), on_side & (col > high)
            low, low_at = col if lower else low, side + at if lower else low_at
            high, high_at = col if higher else high, side + at if higher else high_at
    return _end(corners, low, low_at), _end(corners, high, high_at)


@compiled(inline=True, relaxed=True)
def _end(corners: FloatArray, col: float, at: float) -> End:
    """``at`` is the number of the side plus the parameter along it."""
    whole = np.floor(at)
    side, after = int(whole) % len(corners), (int(whole) + 1) % len(corners)
    u = at - whole
    s = corners[side, 0] + u * (corners[after, 0] - corners[side, 0])
    t = corners[side, 1] + u * (corners[after, 1] - corners[side, 1])
    return col, s, t


@compiled(inline=True, relaxed=True)
def _roots(a: float, b: float, c: float) -> tuple[float, float]:
    """Roots of a u^2 + b u + c, NaN where there is none; c may be off by _CLOSE_PX."""
    if a == 0.0:
        return -c / b, np.nan
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        if discriminant < -4.0 * abs(a) * _CLOSE_PX:
            return np.nan, np.nan
        discriminant = 0.0
    q = -0.5 * (b + np.copysign(np.sqrt(discriminant), b))
    return q / a, c / q


@compiled(relaxed=True)
def start_cubic(
    polynomial: FloatArray,
    curved: bool,
    low: End,
    high: End,
    col: float,
    s: FloatArray,
    t: FloatArray,
) -> None:
    """Start for the pixels col, col + 1, ... of a row between its two ends."""
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
    """Coefficients of x, x^2, x^3 of the cubic from y0 with slope d0 at 0 to y1, d1 at 1."""
    return d0, 3.0 * (y1 - y0) - 2.0 * d0 - d1, 2.0 * (y0 - y1) + d0 + d1
