"""The critical load from the growth of an imperfect pattern, before it buckles.

An imperfect specimen's pattern grows from the beginning, a = a0 p / (p_c - p) + c p + d p^2 with
the load p: the first term is the critical mode's, with an imperfection a0 (R. V. Southwell, Proc.
R. Soc. A 135 (1932), doi 10.1098/rspa.1932.0055), the others those of all other modes, which are
far from theirs, and of the model error. Of each p_c the posterior probability is computed, a0, c, d
and the error that all images have in common integrated out.

Modes differ by their envelopes. The critical one's is a half wave across the lattice both ways, and
:func:`half_wave` picks its amplitude out of v; the others' are nearly orthogonal to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.result import Result
from modeharvest.util.arrays import FloatArray

FEWEST = 5
"""Images that a prediction needs."""
NEAR = 0.9
"""Of the critical load: beyond, the amplitude is no longer small."""
OF_METHOD = 0.01
"""Standard deviation of a prediction without noise, of the critical load: see
docs/how-to/sequences.md."""
_QUANTILES = (0.025, 0.5, 0.975)
_COMMON = 0.5
"""Share of the amplitudes' variance by noise of the reference, which all images have in common."""
_OTHERS = 0.15
"""c p is expected to be so much of a0 p / p_c and, as d p^2 is, of the standard deviation by model
error at the last image, give or take: see docs/how-to/sequences.md."""
_FAR, _NEGLIGIBLE = 10.0, 0.02
"""Times the largest load: growth that points further, by a density over its largest, isn't seen."""
_TRIED, _ROUNDS = 2000, 4
_POINTS = 41


@dataclass(frozen=True)
class Prediction:
    """The critical load, extrapolated from images at lower ones."""

    critical: float
    low: float
    high: float
    """The median's interval of 95 %; infinite where growth isn't told from a straight line."""
    imperfection: float
    """a0, in the unit of the amplitudes."""
    others: tuple[float, float, float]
    """d, c and 0: the polynomial d p^2 + c p, the highest power first."""
    largest: float
    """Of the loads that it is made from."""
    count: int
    """Of the images."""

    @property
    def interval(self) -> str:
        """In words, of strains."""
        high = "no upper end" if not np.isfinite(self.high) else f"{100 * self.high:.2f} %"
        return f"{100 * self.low:.2f} … {high}"

    @property
    def is_useful(self) -> bool:
        """Whether the interval ends, and isn't wider than the critical load itself."""
        return self.high - self.low < self.critical


def half_wave(result: Result, cellular: Box, noise: float) -> tuple[float, float, float]:
    """Amplitude of a half wave in v1, both ways across a part of the specimen [mm].

    And its standard deviations by noise [grey levels], and by all of the residual, model error too.
    """
    ansatz, ends = result.ansatz, np.linspace(-1.0, 1.0, _POINTS)
    x, y = (c + h * ends for c, h in zip(cellular.centre, cellular.half, strict=True))
    wave = np.cos(0.5 * np.pi * ends)[:, None] * np.cos(0.5 * np.pi * ends)
    basis = ansatz.v_space.basis(x[None, :], y[:, None])
    weights = np.einsum("yx,yxk->k", wave, basis) / (wave**2).sum()
    part = ansatz.v_slice(0)
    of_both = (result.covariance(of)[part, part] for of in (noise, result.noise_sd))
    sd = [float(np.sqrt(weights @ covariance @ weights)) for covariance in of_both]
    return float(weights @ result.unknowns[part]), sd[0], max(sd)


def predict(columns: FloatArray) -> Prediction | None:
    """Extrapolate the growth of a pattern's amplitude to the critical load.

    ``columns`` (4, n): load, amplitude and its standard deviations by noise, which counts as what
    the amplitudes scatter if that is more, and by model error, which grows with the load; the last
    of one sign and below the critical load. None from fewer than five, or if nothing grows.
    """
    load, amplitude, sd, model = columns[:, columns[0] > 0.0]
    if len(load) < FEWEST or not (sd > 0.0).all():
        return None
    last, most = int(np.argmax(load)), float(load.max())
    tried = most * np.geomspace(1.0 + 1e-3, _FAR, _TRIED)
    weight, x = 1.0 / (sd * np.sqrt(1.0 - _COMMON)), load / most
    columns = np.stack(np.broadcast_arrays(load / (tried[:, None] - load), x, x**2, sd), axis=1)
    columns, a = columns * weight, amplitude * weight
    normal, right = columns @ columns.swapaxes(1, 2), columns @ a
    scatter, zero = 1.0, np.zeros(_TRIED)
    linear = zero + np.hypot(model[last], amplitude[last])
    for _ in range(_ROUNDS):  # of each critical load a0, c, d, and what errors have in common
        prior = [zero, scatter / linear**2, zero + scatter / model[last] ** 2, zero + 1.0 / _COMMON]
        A = normal + np.stack(prior, axis=1)[:, None] * np.eye(4)
        found = np.linalg.solve(A, right[..., None])[..., 0]
        cost = (a @ a - (right * found).sum(axis=1)) / scatter
        chance = -0.5 * cost - 0.5 * np.linalg.slogdet(A)[1] - np.log(linear)
        best = int(np.argmax(chance))
        scatter = max(1.0, float(cost[best]) * scatter / (len(load) - 3))
        linear = np.hypot(model[last], _OTHERS * np.abs(found[:, 0]) * most / tried)
    share = np.exp(chance - chance[best])
    quantiles = np.interp(_QUANTILES, np.cumsum(share) / share.sum(), tried)
    k = int(np.searchsorted(tried, quantiles[1]))
    a0, c, d, _ = found[k].tolist()
    if a0 * amplitude[last] <= 0.0:
        return None
    critical = float(quantiles[1])
    below, _, above = map(float, np.hypot(quantiles - critical, 2.0 * OF_METHOD * critical))
    high = critical + above if share[-1] < _NEGLIGIBLE else float("inf")
    others = d / most**2, c / most, 0.0
    return Prediction(critical, critical - below, high, a0, others, most, len(load))


def follow_growth(
    columns: FloatArray, known: Sequence[Prediction | None] = ()
) -> list[Prediction | None]:
    """The prediction after each image of a test, in their order; of the first ones it is known.

    ``columns`` (4, n): as for :func:`predict`. A prediction stays as it is once the load is beyond
    nine tenths of it, as buckling no longer lies ahead, and on the way back.
    """
    found = list(known)
    for n in range(len(found) + 1, columns.shape[1] + 1):
        load, last = columns[0, :n], found[-1] if found else None
        is_ahead = last is None or not last.is_useful or load[-1] < NEAR * last.critical
        found.append(predict(columns[:, :n]) if is_ahead and load[-1] >= load.max() else last)
    return found
