"""Test of model error: whether corrections of a model would lower the cost by more than noise.

If a model is right, the score of corrections (the cost's slope along them with the parameters free)
is noise of known covariance V, and its square in units of V is chi squared: Rao, Math. Proc. Camb.
Phil. Soc. 44 (1948), doi 10.1017/S0305004100023987; Breusch & Pagan, Rev. Econ. Stud. 47 (1980),
doi 10.2307/2297111. Corrections are terms of the law's energy, or displacements that are
independent of law and supports: polynomials times 1 and times waves of the lattice's periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from modeharvest.idic.finite_element.identification.observed import StateObservation
from modeharvest.util.arrays import FloatArray
from modeharvest.util.scaled_eigen import ScaledEigen

if TYPE_CHECKING:  # dolfinx makes the model; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState

_SIGNIFICANT = 0.01  # probability under a right model, below which it is said to be wrong
_EXPECTED = 0.5  # sd of errors by a mesh, over their size: as orders of 1.5 to 3 instead of 2 make
_CUTOFF = 1e-6  # of eigenvalues, over the largest: corrections that are others' combinations


@dataclass(frozen=True)
class ScoreTest:
    """Whether the data contradict a model."""

    chi_squared: float
    degrees_of_freedom: int
    p_value: float
    """Probability of such a chi squared or a larger one if the model is right [-]."""
    rms: float
    """Size of corrections that would raise chi squared above its expectation by this excess."""

    @property
    def is_rejected(self) -> bool:
        """Whether noise alone would hardly cause such a chi squared."""
        return self.p_value < _SIGNIFICANT

    def __str__(self) -> str:
        count, p = self.degrees_of_freedom, self.p_value
        return f"chi squared {self.chi_squared:.4g} with {count} degrees of freedom, p = {p:.2g}"


def in_words(model: ScoreTest | None, law: ScoreTest | None) -> list[str]:
    """State the results of the tests of a model and of its law in words."""
    found = list[str]()
    if model:
        wrong = f"wrong, by displacements of {1e3 * model.rms:.2g} um rms,"
        verdict = wrong if model.is_rejected else "not seen to be wrong"
        found.append(f"the model is {verdict} ({model})")
    if law:
        verdict = "lacks" if law.is_rejected else "isn't seen to lack"
        found.append(f"the material's law {verdict} terms of its energy ({law})")
    return found


class JointScore(NamedTuple):
    """Joint score of the parameters and corrections of a model, n together."""

    score: FloatArray
    """(n,) minus the slope of the cost."""
    information: FloatArray
    noise: FloatArray
    """(n, n) second derivatives of the cost (Gauss-Newton), and the score's covariance by noise."""
    by_mesh: FloatArray
    """(n, m) expected part of the score due to the model's mesh, by each of m causes."""

    def test(self, parameters: int, first: int, last: int) -> ScoreTest:
        """Test corrections ``first`` to ``last`` with the parameters, which come first, free."""
        p, q = np.arange(parameters), np.arange(first, last)
        inverse = ScaledEigen.of(self.information[np.ix_(p, p)]).inverse()
        # Part of the score that the parameters would take up when they move.
        C = np.zeros((len(q), len(self.score)))
        C[:, p] = -self.information[np.ix_(q, p)] @ np.where(np.isfinite(inverse), inverse, 0.0)
        C[:, q] = np.eye(len(q))
        by_mesh = C @ self.by_mesh
        V = ScaledEigen.of(C @ self.noise @ C.T + _EXPECTED**2 * by_mesh @ by_mesh.T)
        keep = V.values > _CUTOFF * V.values[-1]
        parts = (V.vectors.T @ ((C @ self.score - by_mesh.sum(axis=1)) / V.scale))[keep]
        square, count = float(np.sum(parts**2 / V.values[keep])), int(keep.sum())
        rms = np.sqrt(max(0.0, square - count) / np.diag(self.information)[q].mean())
        return ScoreTest(square, count, float(chi2.sf(square, count)), float(rms))


def joint_score(
    data: Sequence[StateObservation | None],
    states: Sequence[ModelState],
    extrapolated: Sequence[ModelState],
    scalars: Sequence[tuple[float, Any]],
    expected: Sequence[tuple[float, Any]],
    corrections: FloatArray,
    readings: int,
) -> JointScore:
    """Joint score of the parameters of states, and of the corrections of each state.

    extrapolated : the states as they are expected to be for elements of zero size.
    scalars, expected : residuals of single numbers with minus their derivatives; and with those.
    corrections : (j, n, 2) displacements, of which every state has a combination of its own.
    readings : number of the first scalars that have a correction each, too, the last ones of all.
    """
    k, j = len(states[0].displacement_by), len(corrections)
    seen: list[Any] = [each for each in zip(data, states, extrapolated, strict=True) if each[0]]
    n = k + j * len(seen) + readings
    score, information, errors = np.zeros(n), np.zeros((n, n)), list[FloatArray]()
    # The parameters' fields differ from state to state; all are needed where noise is shared.
    fields = np.concatenate([*(state.displacement_by for _, state, _ in seen), corrections])
    parts = []
    for number, (observed, state, limit) in enumerate(seen):
        by = np.concatenate([fields, [limit.displacement - state.displacement]])
        part = observed.equations(replace(state, displacement_by=by))
        to = np.r_[:k, k + j * number : k + j * (number + 1)]
        of = np.r_[k * number : k * (number + 1), k * len(seen) : len(fields)]
        parts.append((part, observed, replace(state, displacement_by=fields), to, of))
        score[to] -= part.blocks.sum(axis=0)[of]
        information[np.ix_(to, to)] += part.matrix[np.ix_(of, of)]
        errors.append(np.zeros(n))
        errors[-1][to] = part.matrix[of, -1]
    noise = information.copy()
    for (one, observed, state, to, of), (other, _, state_t, to_t, of_t) in combinations(parts, 2):
        if factor := one.shared * other.shared:
            both = factor * observed.shared(state, state_t)[np.ix_(of, of_t)]
            noise[np.ix_(to, to_t)] += both
            noise[np.ix_(to_t, to)] += both.T
    for number, ((r, slopes), (r_expected, _)) in enumerate(zip(scalars, expected, strict=True)):
        row = np.append(slopes, np.zeros(n - len(slopes)))
        if number < readings:
            row[n - readings + number] = 1.0
        score += r * row
        information += np.outer(row, row)
        noise += np.outer(row, row)
        errors.append((r - r_expected) * row)
    return JointScore(score, information, noise, np.array(errors).T)


def corrections(points: FloatArray, vectors: FloatArray, degree: int = 2) -> FloatArray:
    """(j, n, 2) displacements of rms 1 that no law bounds, at points (n, 2) of a body [-].

    vectors : (2, 2) lattice vectors as rows [mm]. Waves have the lattice's period and twice that;
        polynomials have total degrees up to ``degree``.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = (2.0 * (points - low) / (high - low) - 1.0).T
    smooth = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    b1, b2 = 2.0 * np.pi * np.linalg.inv(vectors).T
    waves = [np.ones_like(x)]
    for k in (b1, b2, b1 / 2, b2 / 2, (b1 + b2) / 2, (b1 - b2) / 2):
        waves += [np.cos(points @ k), np.sin(points @ k)]
    fields = np.array([p * w for p in smooth for w in waves])
    fields /= np.sqrt((fields**2).mean(axis=1, keepdims=True) + np.finfo(float).tiny)
    return np.concatenate([fields[..., None] * axis for axis in np.eye(2)])
