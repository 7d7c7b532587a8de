"""Transfer of polynomials fitted to a wave over a rectangle, by Bessel's formula."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import spherical_jn

from modeharvest.idic.chebyshev import orders

FloatArray = NDArray[np.float64]


def polynomial_transfer(degree: int, waves_x: ArrayLike, waves_y: ArrayLike = 0.0) -> FloatArray:
    """T of a polynomial of total degree ``degree`` fitted to a wave over a full rectangle [-].

    The share of the wave's power, mean over its phases, that the polynomials describe; with
    Legendre's P_n and exp(i k t) = sum_n (2n + 1) i^n j_n(k) P_n(t),

        T = sum_{m + n <= degree} (2m + 1) j_m(k_x)^2 (2n + 1) j_n(k_y)^2,   k = pi waves.

    It is also the slope of the fit's values against the wave's, all over the rectangle.

    Parameters
    ----------
    degree
        i + j of the polynomials x^i y^j, at most.
    waves_x, waves_y
        Periods along the width and the height of the rectangle [-]; they broadcast together.
    """
    k_x, k_y = (np.pi * np.abs(np.asarray(w, dtype=np.float64)) for w in (waves_x, waves_y))
    along_x, along_y = ([_power(n, k) for n in range(degree + 1)] for k in (k_x, k_y))
    return np.asarray(sum(along_x[m] * along_y[n] for m, n in orders(degree)))


def _power(n: int, k: FloatArray) -> FloatArray:
    """Share of a wave's power in Legendre's polynomial n."""
    return np.asarray((2 * n + 1) * spherical_jn(n, k) ** 2)
