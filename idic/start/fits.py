"""Robust least squares for a start: the slow field and the amplitudes through points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.ansatz import Ansatz

FloatArray = NDArray[np.float64]

HUBER = 1.345
"""Residual beyond which a point counts less [standard deviations]; 95 % efficient for normal
errors (Huber, 1964, doi 10.1214/aoms/1177703732)."""
SET_ASIDE = 5.0
"""Residual beyond which a point is called an outlier [standard deviations]."""
MOST_POINTS = 6000
"""Points of a field that are used; more would not make a start better."""
_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Coefficients, and how well they fit.

    Parameters
    ----------
    coefficients
        (c,) or as the unknowns of the ansatz.
    sd
        Robust standard deviation of a component that is left (1.4826 times the median) [mm].
    outliers
        Number of points more than 5 of these off.
    """

    coefficients: FloatArray
    sd: float
    outliers: int


def robust_fit(matrix: FloatArray, values: FloatArray) -> RobustFit:
    """Fit linear unknowns so that stray points hardly count (Huber's weights, iterated).

    Parameters
    ----------
    matrix
        (n, c) with n > c.
    values
        (n,) what matrix times coefficients should be [mm].
    """
    weights = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(matrix * root[:, None], values * root, rcond=1e-10)[0]
        off = np.abs(values - matrix @ fit)
        sd = 1.4826 * float(np.median(off))
        if sd <= 1e-12 * float(np.abs(values).max(initial=1e-300)):
            break
        before, weights = weights, np.minimum(1.0, HUBER * sd / np.maximum(off, 1e-300))
        if np.abs(weights - before).max() < 1e-3:
            break
    return RobustFit(fit, sd, int((off > SET_ASIDE * sd).sum()) if sd > 0 else 0)


def degree_for(count: int, most: int) -> int:
    """Total degree of a slow field that so many points can bear: three points a coefficient."""
    fitting = [d for d in range(1, most + 1) if 3 * (d + 1) * (d + 2) // 2 <= count]
    return max(fitting, default=0)


def fit_unknowns(
    ansatz: Ansatz, a: ArrayLike, points: FloatArray, u: FloatArray, v0_degree: int, v_degree: int
) -> RobustFit:
    """Fit v0, and every v_i, to displacements at points; the modes stay as they are.

    Parameters
    ----------
    ansatz
        The kinematics.
    a
        (size,) unknowns, of which the modes' parameters are taken.
    points, u
        (n, 2) positions and displacements [mm].
    v0_degree, v_degree
        Total degrees that are fitted, at most those of the ansatz; the rest is zero. A negative
        ``v_degree`` leaves every v_i as it is in ``a``.
    """
    a = ansatz.checked(a).copy()
    stride = max(1, -(-len(points) // MOST_POINTS))
    points, u = points[::stride], u[::stride]
    free = _low_orders(ansatz, v0_degree, v_degree)
    if 2 * len(points) < free.size:
        raise InputError(
            f"automatic start: expected at least {-(-free.size // 2)} points, got {len(points)}"
        )
    columns = ansatz.sensitivities(a, points[:, None, 0], points[:, None, 1])[..., free]
    held = a.copy()
    held[free] = 0.0
    rest = u - ansatz.displacement_at(held, points)
    fit = robust_fit(columns.reshape(-1, free.size), rest.ravel())
    held[free] = fit.coefficients
    return RobustFit(held, fit.sd, fit.outliers)


def _low_orders(ansatz: Ansatz, v0_degree: int, v_degree: int) -> NDArray[np.intp]:
    """Where v0 and v_i up to these degrees are among the unknowns."""
    low0 = [k for k, (i, j) in enumerate(ansatz.v0_space.orders) if i + j <= v0_degree]
    low = [k for k, (i, j) in enumerate(ansatz.v_space.orders) if i + j <= v_degree]
    places = [ansatz.v0_slice(c).start + k for c in (0, 1) for k in low0]
    places += [ansatz.v_slice(m).start + k for m in range(len(ansatz.modes)) for k in low]
    return np.array(places, dtype=np.intp)
