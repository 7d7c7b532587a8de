"""Predictors of a path: the tangent of one point, or the cubic through two, which extrapolates.

Values may be numbers, arrays or PETSc vectors: anything with sums and multiples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from scipy.optimize import brentq


def hermite_weights(a: float, b: float, at: float) -> tuple[float, float, float, float]:
    """Weights of value and slope at ``a``, value and slope at ``b``."""
    h = b - a
    t = (at - a) / h
    before, after = (1 - t) ** 2, t**2
    return (1 + 2 * t) * before, h * t * before, after * (3 - 2 * t), h * after * (t - 1)


def extrapolate(points: Sequence[tuple[float, Any, Any]], at: float) -> Any:
    """The value at a parameter, from (parameter, value, rate) of one point or of the last two."""
    b, value, rate = points[-1]
    if len(points) == 1:
        return _combined((1.0, float(at - b)), (value, rate))
    a, before, rate_before = points[-2]
    weights = hermite_weights(float(a), float(b), float(at))
    return _combined(weights, (before, rate_before, value, rate))


def _combined(weights: Sequence[float], values: Sequence[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        if hasattr(total, "axpy"):  # PETSc's, in place
            total.axpy(weight, value)
        else:
            total = total + weight * value
    return total


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch by its mode's amplitude; the rates are derivatives by that."""

    amplitude: float
    """[mm]."""
    load: float
    """[-]."""
    load_rate: float
    value: Any
    """Of the state, such as displacements [mm]."""
    rate: Any


def load_at(points: Sequence[BranchPoint], amplitude: float) -> float:
    """The load expected at an amplitude, from one point or the last two."""
    known = [(p.amplitude, p.load, p.load_rate) for p in points[-2:]]
    return float(extrapolate(known, amplitude))


def value_at(points: Sequence[BranchPoint], amplitude: float) -> Any:
    """The state expected at an amplitude, from one point or the last two."""
    return extrapolate([(p.amplitude, p.value, p.rate) for p in points[-2:]], amplitude)


def amplitude_at(points: Sequence[BranchPoint], load: float, low: float, high: float) -> float:
    """Where ``load_at`` meets a load that lies between its values at two amplitudes."""
    return float(brentq(lambda amplitude: load_at(points, amplitude) - load, low, high))
