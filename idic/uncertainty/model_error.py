"""Test of model error: whether corrections that no law bounds would lower the cost beyond noise.

To the model's displacement of each state a correction is added that knows of no law and no support:
polynomials over the body, times 1 and times waves of the lattice's periods; to each force, one of
its own. Under a right model the score of the corrections, the cost's slope along them with the
parameters free, is noise of known covariance V, and its square in units of V is chi squared with as
many degrees of freedom as there are corrections: Rao, Math. Proc. Camb. Phil. Soc. 44 (1948) 50-57,
doi 10.1017/S0305004100023987; Breusch & Pagan, Rev. Econ. Stud. 47 (1980), doi 10.2307/2297111.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from modeharvest.util.arrays import FloatArray
from modeharvest.util.scaled_eigen import ScaledEigen

SIGNIFICANT = 0.01
"""Probability under a right model below which a test says that the model is wrong."""
_CUTOFF = 1e-6  # of eigenvalues, over the largest: corrections that are others' combinations


@dataclass(frozen=True)
class ScoreTest:
    """Whether the data contradict a model."""

    chi_squared: float
    degrees_of_freedom: int
    p_value: float
    """Probability of such a chi squared or a larger one if the model is right [-]."""
    rms: float = 0.0
    """Size of a displacement that would make chi squared exceed its expectation by as much [mm]."""

    @property
    def is_rejected(self) -> bool:
        """Whether noise alone would hardly do this."""
        return self.p_value < SIGNIFICANT

    def __str__(self) -> str:
        sizes = f"chi squared {self.chi_squared:.4g} with {self.degrees_of_freedom} degrees"
        how = f"({sizes} of freedom, p = {self.p_value:.2g})"
        if not self.is_rejected:
            return f"no model error shows in the residuals {how}"
        return (
            f"the model is wrong {how}: displacements or forces do what it can't, by some "
            f"{1e3 * self.rms:.2g} um rms; the law may be another, a support, a hole, or the light"
        )


def score_test(
    score: FloatArray,
    information: FloatArray,
    noise: FloatArray,
    systematic: FloatArray,
    parameters: int,
    mean_squares: FloatArray,
) -> ScoreTest:
    """Test corrections against none, with the parameters free.

    score : (n,) minus the slope of the cost along parameters and, behind them, corrections.
    information : (n, n) the cost's second derivatives (Gauss-Newton).
    noise : (n, n) covariance of the score, where the model is right.
    systematic : (n, m) contributions to the score that are expected, and known no better than
        with a standard deviation of their own size: those of the model's mesh.
    parameters : how many of the n are the model's own.
    mean_squares : of the displacements of the first corrections over the body [mm^2].
    """
    p, q = slice(parameters), slice(parameters, None)
    eigen = ScaledEigen.of(information[p, p])
    # What of the score the parameters would take up when they moved.
    known = np.where(np.isfinite(inverse := eigen.inverse()), inverse, 0.0)
    C = np.hstack([-information[q, p] @ known, np.eye(len(score) - parameters)])
    rest = C @ (score - systematic.sum(axis=1))
    V = ScaledEigen.of(C @ (noise + systematic @ systematic.T) @ C.T)
    keep = V.values > _CUTOFF * V.values[-1]
    parts = (V.vectors.T @ (rest / V.scale))[keep]
    chi_squared = float(np.sum(parts**2 / V.values[keep]))
    count, moving = int(keep.sum()), slice(parameters, parameters + len(mean_squares))
    density = float(np.mean(np.diag(information)[moving] / mean_squares))
    rms = np.sqrt(max(0.0, chi_squared - count) / density) if density > 0.0 else 0.0
    return ScoreTest(chi_squared, count, float(chi2.sf(chi_squared, count)), float(rms))


def corrections(points: FloatArray, vectors: FloatArray, degree: int = 2) -> FloatArray:
    """(j, n, 2) displacements that no law bounds, at points (n, 2) of a lattice's body [-].

    vectors : (2, 2) the lattice's as rows [mm]. Waves have its period and twice that.
    degree : of the polynomials.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = (2.0 * (points - low) / (high - low) - 1.0).T
    smooth = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    b1, b2 = 2.0 * np.pi * np.linalg.inv(vectors).T
    waves = [np.ones_like(x)]
    for k in (b1, b2, b1 / 2, b2 / 2, (b1 + b2) / 2, (b1 - b2) / 2):
        waves += [np.cos(points @ k), np.sin(points @ k)]
    fields = np.array([p * w for p in smooth for w in waves])
    return np.concatenate([fields[..., None] * axis for axis in np.eye(2)])
