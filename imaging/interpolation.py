"""Value and gradient of an image between its pixels, by B-splines of order 3, 5 or 11.

The image is prefiltered once, so that the spline passes through every pixel; afterwards a
sample costs 16, 36 or 144 coefficients. On a speckle blurred by 3 px the cubic is off by 6e-5 of
full scale and the quintic by 8e-7. Speckles finer than 6 px want order 11: docs/metrology.md.

Source: Unser, Aldroubi, Eden 1993, doi 10.1109/78.193220.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.prefilter import spline_coefficients
from modeharvest.imaging.taps import eleventh_at, quintic_at

FloatArray = NDArray[np.float64]

ORDERS = (3, 5, 11)
"""Of splines."""
PAD = 6
"""Rows and columns of mirrored coefficients around the image, so that no tap needs a test."""


@dataclass(frozen=True, eq=False)
class SplineImage:
    """An image that can be evaluated anywhere.

    Parameters
    ----------
    coefficients
        (rows + 2 PAD, cols + 2 PAD) B-spline coefficients, float32 or float64.
    order
        3, 5 or 11.
    """

    coefficients: NDArray[Any]
    order: int

    def __post_init__(self) -> None:
        if self.order not in ORDERS:
            raise InputError(f"expected a spline of order 3, 5 or 11, got {self.order}")
        if self.coefficients.ndim != 2 or min(self.coefficients.shape) < 2 * PAD + 2:
            raise InputError(
                f"expected padded coefficients of at least {2 * PAD + 2} x {2 * PAD + 2}, "
                f"got shape {self.coefficients.shape}"
            )

    @classmethod
    def of(cls, image: ArrayLike, order: int = 5, dtype: Any = np.float32) -> SplineImage:
        """Prefilter an image (mirrored at its border) and keep the coefficients.

        Parameters
        ----------
        image
            (rows, cols) grey levels.
        order
            3, 5 or 11.
        dtype
            How the coefficients are stored: float32 costs 1e-7 of full scale. The recursive
            filter itself runs in float64, line by line.

        Raises
        ------
        InputError
            If the image isn't two-dimensional or smaller than 2 x 2 px, or the order is
            not among the three.
        """
        pixels = np.asarray(image, dtype=np.dtype(dtype))
        if pixels.ndim != 2 or min(pixels.shape) < 2:
            raise InputError(f"expected an image of at least 2 x 2 px, got shape {pixels.shape}")
        if order not in ORDERS:
            raise InputError(f"expected a spline of order 3, 5 or 11, got {order}")
        return cls(spline_coefficients(pixels, order, PAD), order)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the image [px]."""
        return self.coefficients.shape[0] - 2 * PAD, self.coefficients.shape[1] - 2 * PAD

    def sample(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value, derivative along the rows' index and along the columns' index.

        Parameters
        ----------
        row, col
            Positions [px], of any common shape; those outside the image give NaN.

        Returns
        -------
        value, d_row, d_col
            Grey levels, and grey levels per px; d_row is along *increasing row*, i.e. down.
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        value, d_row, d_col = (np.empty(row.size) for _ in range(3))
        sample_points(
            self.coefficients, self.order, row.ravel(), col.ravel(), row.size, value, d_row, d_col
        )
        return value.reshape(row.shape), d_row.reshape(row.shape), d_col.reshape(row.shape)


@compiled(inline=True, relaxed=True)
def cubic_weights(t: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Weights of the 4 taps -1 ... 2 and their derivatives, at the fraction 0 <= t <= 1."""
    s = 1.0 - t
    sixth = 1.0 / 6.0
    w = (
        s * s * s * sixth,
        (4.0 + t * t * (3.0 * t - 6.0)) * sixth,
        (4.0 + s * s * (3.0 * s - 6.0)) * sixth,
        t * t * t * sixth,
    )
    d = (-0.5 * s * s, t * (1.5 * t - 2.0), -s * (1.5 * s - 2.0), 0.5 * t * t)
    return w, d


@compiled(inline=True, relaxed=True)
def _dot4(c: Any, i: int, j: int, w: Any) -> float:
    total: float = w[0] * c[i, j] + w[1] * c[i + 1, j] + w[2] * c[i + 2, j] + w[3] * c[i + 3, j]
    return total


@compiled(inline=True, relaxed=True)
def sample_cubic(c: Any, row: float, col: float) -> tuple[float, float, float]:
    """(value, d_row, d_col) at a position inside the image [px]."""
    i, j = min(int(row), c.shape[0] - 2 * PAD - 2), min(int(col), c.shape[1] - 2 * PAD - 2)
    wr, dr = cubic_weights(row - i)
    wc, dc = cubic_weights(col - j)
    i, j = i + PAD - 1, j + PAD - 1
    a0, a1 = _dot4(c, i, j, wr), _dot4(c, i, j + 1, wr)
    a2, a3 = _dot4(c, i, j + 2, wr), _dot4(c, i, j + 3, wr)
    b0, b1 = _dot4(c, i, j, dr), _dot4(c, i, j + 1, dr)
    b2, b3 = _dot4(c, i, j + 2, dr), _dot4(c, i, j + 3, dr)
    return (
        a0 * wc[0] + a1 * wc[1] + a2 * wc[2] + a3 * wc[3],
        b0 * wc[0] + b1 * wc[1] + b2 * wc[2] + b3 * wc[3],
        a0 * dc[0] + a1 * dc[1] + a2 * dc[2] + a3 * dc[3],
    )


@compiled(inline=True, relaxed=True)
def sample_quintic(c: Any, row: float, col: float) -> tuple[float, float, float]:
    """(value, d_row, d_col) at a position inside the image [px]."""
    i, j = min(int(row), c.shape[0] - 2 * PAD - 2), min(int(col), c.shape[1] - 2 * PAD - 2)
    found: tuple[float, float, float] = quintic_at(c, i + PAD - 2, j + PAD - 2, row - i, col - j)
    return found


@compiled(inline=True, relaxed=True)
def sample_eleventh(c: Any, row: float, col: float) -> tuple[float, float, float]:
    """(value, d_row, d_col) at a position inside the image [px]."""
    i, j = min(int(row), c.shape[0] - 2 * PAD - 2), min(int(col), c.shape[1] - 2 * PAD - 2)
    found: tuple[float, float, float] = eleventh_at(c, i + PAD - 5, j + PAD - 5, row - i, col - j)
    return found


@compiled(relaxed=True)
def sample_points(
    c: Any, order: int, row: Any, col: Any, n: int, value: Any, d_row: Any, d_col: Any
) -> None:
    """Fill value, d_row and d_col at the first n positions; NaN outside the image."""
    last_row, last_col = c.shape[0] - 2 * PAD - 1.0, c.shape[1] - 2 * PAD - 1.0
    for k in range(n):
        r, q = row[k], col[k]
        if not (0.0 <= r <= last_row and 0.0 <= q <= last_col):
            value[k] = d_row[k] = d_col[k] = np.nan
        elif order == 5:
            value[k], d_row[k], d_col[k] = sample_quintic(c, r, q)
        elif order == 11:
            value[k], d_row[k], d_col[k] = sample_eleventh(c, r, q)
        else:
            value[k], d_row[k], d_col[k] = sample_cubic(c, r, q)
