"""Transfer functions of least-squares fits: subsets, polynomials, and an ansatz near a state.

A local DIC whose subsets have polynomial shape functions is, to first order, the least-squares fit
of these to the displacement in the subset, read at its centre: a Savitzky–Golay filter [1]_, [2]_.
A global one with polynomials over the whole domain is the same fit there. The share of a wave's
amplitude that comes back is its transfer T; the finest period is the one with T = 0.9 [2]_.

Near a state a an ansatz can follow small changes S da of the displacement; the best it can make of
a wave w are the da that minimise the sum of |w - S da|^2 over the material. A correlation weighs
the same sum by the speckle's gradient, which averages out over many speckles.

References
----------
.. [1] M. Grédiac, B. Blaysat, F. Sur, Exp. Mech. 57 (2017) 871, doi 10.1007/s11340-017-0279-x.
.. [2] P. L. Reu et al., Exp. Mech. 62 (2022) 639, doi 10.1007/s11340-021-00806-6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import spherical_jn

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.slow_fields import orders
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

KEPT = 0.9
"""Share of the amplitude that comes back at the finest period: an attenuation of 10 % [-]."""
_SCAN = 4001


def subset_transfer(width: int, degree: int, period: ArrayLike) -> FloatArray:
    """T of a square subset for a wave along one of its edges, read at its centre [-].

    Parameters
    ----------
    width
        Edge of the subset, odd [px].
    degree
        Of the shape functions: 0 rigid, 1 affine (the same at the centre), 2 quadratic.
    period
        (...) of the wave [px].

    Returns
    -------
    (...) T. For an affine subset it is sin(pi w/p) / (w sin(pi/p)).
    """
    offsets, weights = savitzky_golay(width, degree)
    phase = 2.0 * np.pi * offsets / np.asarray(period, dtype=np.float64)[..., None]
    return np.asarray(np.cos(phase) @ weights)


def subset_noise(width: int, degree: int) -> float:
    """Noise floor of a square subset's centre on even speckle, over sqrt(2) s / G [1/px].

    s is the noise in each image [grey levels], G the rms gradient of the speckle along the
    displacement [grey levels/px]: the root of the summed squares of the fit's weights, 1/width for
    affine shape functions. Real speckle isn't even, and n is larger.
    """
    offsets, _ = savitzky_golay(width, degree)
    x, y = (a.ravel() / offsets[-1] for a in np.meshgrid(offsets, offsets))
    basis = np.stack([x**i * y**j for i, j in orders(degree)], axis=-1)
    return float(np.sqrt(np.linalg.inv(basis.T @ basis)[0, 0]))


def savitzky_golay(width: int, degree: int) -> tuple[FloatArray, FloatArray]:
    """(width,) offsets [px] and weights [-] of the fitted polynomial's value at the centre."""
    if width < 3 or width % 2 == 0 or not 0 <= degree < width:
        raise InputError(
            f"expected an odd subset of at least 3 px and a degree from 0 to {width - 1}, got "
            f"{width} px and {degree}"
        )
    offsets = np.asarray(np.arange(width) - 0.5 * (width - 1), dtype=np.float64)
    basis = np.polynomial.legendre.legvander(offsets / offsets[-1], degree)
    return offsets, np.asarray(np.linalg.pinv(basis).T @ basis[width // 2])


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


def finest_period(transfer: Callable[[FloatArray], FloatArray], low: float, high: float) -> float:
    """The period above which a transfer stays at 0.9 or more.

    Parameters
    ----------
    transfer
        From periods (n,) to T (n,).
    low, high
        Where to look; in the periods' unit.

    Raises
    ------
    InputError
        If the transfer is below 0.9 at the longest period or nowhere.
    """
    periods = np.asarray(np.geomspace(low, high, _SCAN), dtype=np.float64)
    below = np.flatnonzero(transfer(periods) < KEPT)
    if not len(below) or below[-1] == _SCAN - 1:
        raise InputError(
            f"expected a transfer that rises through {KEPT} between periods of {low:g} and "
            f"{high:g}, got none"
        )
    at = below[-1]
    found = brentq(lambda p: float(transfer(np.array([p]))[0]) - KEPT, periods[at], periods[at + 1])
    return float(found)


@dataclass(frozen=True, eq=False)
class PartFields:
    """Changes of the displacement in the parts of an ansatz, at points.

    Parameters
    ----------
    v0, v1
        (points, 2, waves): of v0 and of v1 phi1 [mm].
    """

    v0: FloatArray
    v1: FloatArray

    @property
    def whole(self) -> FloatArray:
        """(points, 2, waves): of the displacement [mm]."""
        return self.v0 + self.v1

    def of(self, part: str) -> FloatArray:
        """One of "v0", "v1" and "whole"."""
        return np.asarray(getattr(self, part))


@dataclass(frozen=True, eq=False)
class TangentFit:
    """An ansatz with one mode near some unknowns.

    Parameters
    ----------
    ansatz, unknowns
        The kinematics, and (n,) where.
    points
        (m, 2) of the material that the fit counts [mm].
    """

    ansatz: Ansatz
    unknowns: FloatArray
    points: FloatArray

    def fit(self, waves: FloatArray) -> PartFields:
        """The best fits of waves (m, 2, k) at the points [mm]."""
        x, y = self.points.T
        S = self.ansatz.sensitivities(self.unknowns, x[:, None], y[:, None])[:, 0]
        flat = S.reshape(-1, self.ansatz.size)
        scale = np.sqrt((flat**2).sum(axis=0))
        q, r = np.linalg.qr(flat / scale)
        step = np.linalg.solve(r, q.T @ waves.reshape(len(flat), -1)) / scale[:, None]
        slow = 2 * self.ansatz.v0_space.size
        v0, v1 = S[..., :slow] @ step[:slow], S[..., slow:] @ step[slow:]
        return PartFields(v0, v1)


def wave_share(found: FloatArray, wave: FloatArray) -> FloatArray:
    """(k,) slope of what was found (m, 2, k) against the waves (m, 2, k) [-]."""
    return np.asarray((found * wave).sum(axis=(0, 1)) / (wave**2).sum(axis=(0, 1)))
