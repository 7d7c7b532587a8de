"""From the grey levels of an image to the coefficients of the B-spline that passes through them.

Each line of the image goes through a recursive filter, forwards and backwards, once for every
pole; the mirrored border makes it exact. Lines are independent, so the result does not depend on
the number of threads.

Source: Unser, Aldroubi, Eden 1993, doi 10.1109/78.193220 (poles, initial values).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from modeharvest.imaging.compiled import compiled, readable

FloatArray = NDArray[np.float64]


@cache
def poles(order: int) -> FloatArray:
    """Roots of the z-transform of a B-spline's samples inside the unit circle, the largest first.

    Parameters
    ----------
    order
        Odd.
    """
    knots = np.arange(order + 2.0)
    samples = BSpline.basis_element(knots)(knots[1:-1])
    polynomial = np.polynomial.Polynomial(samples)
    roots = polynomial.roots().real
    found: FloatArray = roots[abs(roots) < 1.0]
    for _ in range(3):  # Newton, because the roots of an eigenvalue problem have lost digits
        found = found - polynomial(found) / polynomial.deriv()(found)
    return np.asarray(np.sort(found))


_LINES = 16
"""Lines filtered side by side: two vectors of float64."""
_NEGLIGIBLE = 1e-18


def border_reach(order: int, share: float) -> int:
    """How far from an image's border what lies beyond it is felt by more than a share [px].

    A spline passes through every pixel whatever continues the image, but between the pixels the
    continuation is felt: less with every pixel by the largest pole, 0.27, 0.43 or 0.66.

    Parameters
    ----------
    order
        3, 5 or 11.
    share
        Of what is felt at the border itself [-].
    """
    return int(np.ceil(np.log(share) / np.log(abs(poles(order)).max())))


def spline_coefficients(image: NDArray[Any], order: int, pad: int) -> NDArray[Any]:
    """Coefficients of the spline of order 3, 5 or 11 that passes through every pixel.

    Parameters
    ----------
    image
        (rows, cols) grey levels, float32 or float64, at least 2 x 2; mirrored about
        its outermost pixels.
    order
        3, 5 or 11.
    pad
        Rows and columns of mirrored coefficients to put around it [px].

    Returns
    -------
    (rows + 2 pad, cols + 2 pad)
        Of the image's type; the recursion itself runs in float64.
    """
    rows, cols = image.shape
    padded = np.empty((rows + 2 * pad, cols + 2 * pad), dtype=image.dtype)
    inner = padded[pad : pad + rows, pad : pad + cols]
    z = poles(order)
    gain = float(np.prod((1.0 - z) * (1.0 - 1.0 / z)))
    _filter_columns(readable(image), z, _mirrored(z, rows), gain, inner)
    _filter_rows(z, _mirrored(z, cols), gain, inner)
    _pad_mirrored(padded, pad)
    return padded


def _mirrored(poles: FloatArray, n: int) -> FloatArray:
    """(poles, taps): weights of a line's first values in the first value of the filtered line.

    The line is mirrored at both of its ends, so that it has a period of 2 n - 2.
    """
    taps = min(n, int(np.log(_NEGLIGIBLE) / np.log(abs(poles).max())) + 1)
    k, z = np.arange(taps), poles[:, None]
    weights = z**k
    again = (k > 0) & (k < n - 1)
    weights[:, again] += z ** (2 * n - 2 - k[again])
    return np.asarray(weights / (1.0 - z ** (2 * n - 2)))


@compiled(relaxed=True)
def _filter(lines: Any, n: int, poles: Any, first: Any, gain: float) -> None:
    """Filter lines[:n, :] along its first axis, all of its columns side by side."""
    width = lines.shape[1]
    start = np.empty(width)
    for p in range(poles.size):
        z = poles[p]
        start[:] = 0.0
        for k in range(first.shape[1]):
            for m in range(width):
                start[m] += first[p, k] * lines[k, m]
        # One by one: assigning arrays brings error messages that take a second to compile.
        for m in range(width):
            lines[0, m] = start[m]
        for i in range(1, n):
            for m in range(width):
                lines[i, m] += z * lines[i - 1, m]
        end = z / (z * z - 1.0)
        for m in range(width):
            lines[n - 1, m] = end * (lines[n - 1, m] + z * lines[n - 2, m])
        for i in range(n - 2, -1, -1):
            for m in range(width):
                lines[i, m] = z * (lines[i + 1, m] - lines[i, m])
    for i in range(n):
        for m in range(width):
            lines[i, m] *= gain


@compiled(parallel=True, relaxed=True)
def _filter_columns(image: Any, poles: Any, first: Any, gain: float, out: Any) -> None:
    rows, cols = image.shape
    for block in prange((cols + _LINES - 1) // _LINES):
        lines = np.zeros((rows, _LINES))
        left, width = block * _LINES, min(_LINES, cols - block * _LINES)
        for i in range(rows):
            for m in range(width):
                lines[i, m] = image[i, left + m]
        _filter(lines, rows, poles, first, gain)
        for i in range(rows):
            for m in range(width):
                out[i, left + m] = lines[i, m]


@compiled(parallel=True, relaxed=True)
def _filter_rows(poles: Any, first: Any, gain: float, image: Any) -> None:
    rows, cols = image.shape
    for block in prange((rows + _LINES - 1) // _LINES):
        lines = np.zeros((cols, _LINES))
        top, height = block * _LINES, min(_LINES, rows - block * _LINES)
        for m in range(height):
            for j in range(cols):
                lines[j, m] = image[top + m, j]
        _filter(lines, cols, poles, first, gain)
        for m in range(height):
            for j in range(cols):
                image[top + m, j] = lines[j, m]


def _pad_mirrored(padded: NDArray[Any], pad: int) -> None:
    """Fill the frame of an array from what it frames, mirrored about the outermost values."""
    rows, cols = (size - 2 * pad for size in padded.shape)
    up, left = (_reflected(size, pad) for size in (rows, cols))
    inner = padded[pad : pad + rows]
    inner[:, :pad], inner[:, pad + cols :] = inner[:, left[:pad]], inner[:, left[pad + cols :]]
    padded[:pad], padded[pad + rows :] = padded[up[:pad]], padded[up[pad + rows :]]


def _reflected(size: int, pad: int) -> NDArray[np.int64]:
    """For each padded index the padded index of the value that it mirrors."""
    period = 2 * size - 2
    index = np.arange(-pad, size + pad) % period
    return np.asarray(pad + np.minimum(index, period - index))
