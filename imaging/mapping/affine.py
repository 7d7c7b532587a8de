"""Compiled kernels for elements whose map is affine: a row of pixels at a time, in vectors.

Local coordinates are linear along a row, and an affine image of the reference domain is convex:
its pixels are those between two, and nothing has to be solved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.mapping.element_table import (
    CLEAR_OF_EDGES,
    EDGE,
    INSIDE,
    OVERLAPPING,
    UNASSIGNED,
    ElementTable,
    Pixels,
)
from modeharvest.imaging.mapping.inversion import (
    ON_EDGE,
    Coefficients,
    coefficients,
    distance_px,
    outside,
    value,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.util.compiled import compiled

_MARGIN_PX = 1e-3  # the bounds are found much more closely, and checked
_FAR_PX = 1e9


class _Inverse(NamedTuple):
    """xi = s + s_row row + s_col col and eta = t + t_row row + t_col col, row and col relative."""

    s: float
    s_row: float
    s_col: float
    t: float
    t_row: float
    t_col: float


@compiled()
def fill_affine(
    elements: ElementTable,
    fields: FloatArray,
    pixels: Pixels,
    e: int,
    first: int,
    last: int,
    state: NDArray[np.uint8],
    begin: int,
) -> None:
    """Assign the element's pixels in image rows ``first`` ... ``last`` - 1.

    ``state`` holds those of a band of rows, whose pixels begin at ``begin``.
    """
    triangular, back = elements.triangular, _inverse(elements.polynomials[e])
    centre_row, centre_col = int(elements.centres[e, 0]), int(elements.centres[e, 1])
    element, values, residual = pixels.element, pixels.values, pixels.residual
    x, y = coefficients(elements.absolute[e, 0]), coefficients(elements.absolute[e, 1])
    first_row, cols, h = pixels.first_row, pixels.cols, pixels.pixel_size
    for image_row in range(first, last):
        row = float(image_row - centre_row)
        low, high = _between(back, triangular, row)
        col = max(0, int(np.ceil(low)) + centre_col)
        past = min(cols, int(np.floor(high)) + centre_col + 1)
        row_begin = (image_row - first_row) * cols
        while col < past:
            s, t = _local(back, row, float(col - centre_col))
            depth = -outside(triangular, s, t)
            found = state[row_begin + col - begin]
            if depth < -ON_EDGE or found != UNASSIGNED:
                if found == INSIDE and depth > CLEAR_OF_EDGES:
                    state[row_begin + col - begin] = OVERLAPPING
                col += 1
                continue
            at = row_begin + col
            n = _assign_run(back, triangular, s, t, state[at - begin : at - begin + past - col])
            element[at : at + n] = e
            if fields.shape[1] == 0:
                _line(values[0, at : at + n], s, back.s_col)
                _line(values[1, at : at + n], t, back.t_col)
            for k in range(fields.shape[1]):
                a = coefficients(fields[e, k])
                _run(values[k, at : at + n], a, not triangular, back, s, t)
            if residual.size:
                place = (pixels.x0 + h * col, pixels.y0 - h * image_row, h)
                _residuals(residual[at : at + n], x, y, not triangular, back, s, t, place)
            col += n


@compiled(relaxed=True)
def _assign_run(
    back: _Inverse, triangular: bool, s: float, t: float, state: NDArray[np.uint8]
) -> int:
    """Assign the pixels from (s, t) on, up to the first that is outside or already assigned."""
    n = state.size
    while -outside(triangular, s + (n - 1) * back.s_col, t + (n - 1) * back.t_col) < -ON_EDGE:
        n -= 1
    for k in range(n):
        if state[k] != UNASSIGNED:
            n = k
            break
    for k in range(n):
        depth = -outside(triangular, s + k * back.s_col, t + k * back.t_col)
        state[k] = INSIDE if depth > CLEAR_OF_EDGES else EDGE
    return n


@compiled(relaxed=True)
def _line(out: FloatArray, begin: float, step: float) -> None:
    for k in range(out.size):
        out[k] = begin + k * step


@compiled(relaxed=True)
def _run(
    out: FloatArray, a: Coefficients, curved: bool, back: _Inverse, s: float, t: float
) -> None:
    """Values of a polynomial along a row from (s, t) on."""
    for k in range(out.size):
        out[k] = value(a, curved, s + k * back.s_col, t + k * back.t_col)


@compiled(relaxed=True)
def _residuals(
    out: NDArray[np.float32],
    x: Coefficients,
    y: Coefficients,
    curved: bool,
    back: _Inverse,
    s: float,
    t: float,
    place: tuple[float, float, float],
) -> None:
    """Distances in the physical plane [px] along a row from (s, t) on."""
    x0, y0, h = place
    for k in range(out.size):
        at = x0 + h * k, y0, h
        out[k] = distance_px(x, y, curved, s + k * back.s_col, t + k * back.t_col, at)


@compiled(relaxed=True)
def _inverse(polynomial: FloatArray) -> _Inverse:
    """Invert (row, col) = polynomial(xi, eta), (2, 9), of which terms of degree 0 and 1 count."""
    a0, a1, a2 = polynomial[0, 0], polynomial[0, 1], polynomial[0, 2]
    b0, b1, b2 = polynomial[1, 0], polynomial[1, 1], polynomial[1, 2]
    over = 1.0 / (a1 * b2 - a2 * b1)
    s_row, s_col, t_row, t_col = b2 * over, -a2 * over, -b1 * over, a1 * over
    return _Inverse(-s_row * a0 - s_col * b0, s_row, s_col, -t_row * a0 - t_col * b0, t_row, t_col)


@compiled(inline=True, relaxed=True)
def _between(back: _Inverse, triangular: bool, row: float) -> tuple[float, float]:
    """Least and greatest column of the element on a row, a margin included; low > high: none."""
    s, t = back.s + back.s_row * row, back.t + back.t_row * row
    low, high = -_FAR_PX, _FAR_PX
    if triangular:
        low, high = _limited(low, high, s, back.s_col)
        low, high = _limited(low, high, t, back.t_col)
        low, high = _limited(low, high, 1.0 - s - t, -back.s_col - back.t_col)
    else:
        low, high = _limited(low, high, 1.0 + s, back.s_col)
        low, high = _limited(low, high, 1.0 - s, -back.s_col)
        low, high = _limited(low, high, 1.0 + t, back.t_col)
        low, high = _limited(low, high, 1.0 - t, -back.t_col)
    return low - _MARGIN_PX, high + _MARGIN_PX


@compiled(inline=True, relaxed=True)
def _limited(low: float, high: float, g: float, slope: float) -> tuple[float, float]:
    """Keep the columns where g + slope col >= 0, but for what counts as on the edge."""
    at = -(g + ON_EDGE) / slope if slope != 0.0 else np.copysign(_FAR_PX, -g - ON_EDGE)
    if slope < 0.0:
        return low, min(high, at)
    return max(low, at), high


@compiled(inline=True, relaxed=True)
def _local(back: _Inverse, row: float, col: float) -> tuple[float, float]:
    """(xi, eta) of a pixel."""
    return (
        back.s + back.s_row * row + back.s_col * col,
        back.t + back.t_row * row + back.t_col * col,
    )
