"""Predictor of a branch: a curve over the amplitude of its mode, by its points and tangents.

Cubic Hermite interpolation, which extrapolates, too; plain numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from modeharvest.util.arrays import FloatArray


def hermite_weights(a: float, b: float, at: float) -> tuple[float, float, float, float]:
    """Weights of value and slope at ``a``, value and slope at ``b``."""
    h = b - a
    t = (at - a) / h
    return (
        (1 + 2 * t) * (1 - t) ** 2,
        h * t * (1 - t) ** 2,
        t**2 * (3 - 2 * t),
        h * t**2 * (t - 1),
    )


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of the branch, seen as a function of the amplitude [mm].

    ``values`` and their derivatives by the amplitude, ``rates``, are as ``flat`` has them: load
    [-], F̄ [-] and fluctuation [mm].
    """

    amplitude: float
    values: FloatArray
    rates: FloatArray

    @property
    def load(self) -> float:
        """The load [-]."""
        return float(self.values[0])


def stacked(load: float, gradient: FloatArray, fluctuation: FloatArray) -> FloatArray:
    """Load, F̄ (2, 2) and fluctuation as one vector."""
    return np.concatenate([[load], gradient.ravel(), fluctuation])


def predicted(points: Sequence[BranchPoint], amplitude: float) -> FloatArray:
    """Values at an amplitude, by the tangent of one point or the cubic through two."""
    if len(points) == 1:
        return points[0].values + (amplitude - points[0].amplitude) * points[0].rates
    p, q = points
    a, b, c, d = hermite_weights(p.amplitude, q.amplitude, amplitude)
    return a * p.values + b * p.rates + c * q.values + d * q.rates


def amplitude_at(load: float, between: tuple[BranchPoint, BranchPoint]) -> float:
    """Where the cubic through two points, one below the load and one above, meets it."""

    def excess(amplitude: float) -> float:
        return float(predicted(between, amplitude)[0]) - load

    return float(brentq(excess, between[0].amplitude, between[1].amplitude))
