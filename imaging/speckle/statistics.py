"""Mean, variance and mean square gradient of a speckle from its spectrum, without an image.

A layer is 1 where a Gaussian field with autocorrelation rho exceeds t, and 0 elsewhere. Its
autocovariance is Mehler's series

    C = phi(t)² Σ He_{n-1}(t)² / n! rho^n,   n = 1, 2, ...

(A. Papoulis, S. U. Pillai, Probability, Random Variables and Stochastic Processes, 4th ed. 2002,
chapter 9). Here rho = exp(-r² / (2 a²)), so every term is a Gaussian, also after a Gaussian blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, pi, sqrt

import numpy as np
from scipy.special import ndtri

from modeharvest.imaging.speckle.pattern import BinaryField, SpeckleSpec

_TERMS = 400
"""Terms of the series; the neglected ones are 1e-4 of the mean square gradient."""


@dataclass(frozen=True)
class SpeckleStatistics:
    """Expected statistics of the grey levels [fraction of full scale; variance: squared]."""

    mean: float
    variance: float
    gradient: float
    """Mean square of the gradient's length [1/px²]."""

    @classmethod
    def of(cls, spec: SpeckleSpec, spread: float = 0.0) -> SpeckleStatistics:
        """Statistics of a speckle after a further Gaussian blur of variance ``spread`` [px²].

        Ink is independent of the layer below.
        """
        base = cls._of_layer(spec.binary_field, spread)
        if spec.ink is None:
            return base
        ink = cls._of_layer(spec.ink.binary_field, spread)
        light, dark = 1.0 - spec.ink.darkness * ink.mean, spec.ink.darkness**2
        square, base_square = light**2 + dark * ink.variance, base.mean**2 + base.variance
        mean, gradient = (
            base.mean * light,
            base.gradient * square + base_square * dark * ink.gradient,
        )
        return cls(mean, base_square * square - mean**2, gradient)

    @classmethod
    def _of_layer(cls, field: BinaryField, spread: float) -> SpeckleStatistics:
        (outside, inside), t = field.levels, -float(ndtri(field.coverage))
        hermite = np.ones(_TERMS)  # He_n(t) / sqrt(n!)
        hermite[1] = t
        for n in range(1, _TERMS - 1):
            hermite[n + 1] = (t * hermite[n] - sqrt(n) * hermite[n - 1]) / sqrt(n + 1)
        order = np.arange(1, _TERMS + 1)
        weight = ((inside - outside) * exp(-0.5 * t**2) * hermite) ** 2 / (2.0 * pi * order)
        before = 1.0 / (order * (2.0 * pi * field.cycles_per_px) ** 2)  # squared widths of terms
        after = before + 2.0 * (field.blur_px**2 + spread)
        mean = outside + (inside - outside) * field.coverage
        kept = weight * before / after
        return cls(mean, float(kept.sum()), float((2.0 * kept / after).sum()))
