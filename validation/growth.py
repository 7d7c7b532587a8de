"""The critical load from the growth of an imperfect pattern, before it buckles.

An imperfect specimen's pattern grows from the beginning, a = c p + a0 p / (p_c - p) with the load
p: the second term is the critical mode's, with an imperfection a0 (R. V. Southwell, Proc. R. Soc.
A 135 (1932), doi 10.1098/rspa.1932.0055), the first that of all others, which are far from theirs,
and of the model error. Of each p_c the posterior probability is computed, c, a0 and the error that
all images have in common integrated out.

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
OF_METHOD = 0.015
"""Standard deviation of a prediction without noise, of the critical load: see
docs/how-to/sequences.md."""
_QUANTILES = (0.025, 0.5, 0.975)
_COMMON = 0.5
"""Share of the amplitudes' variance by noise of the reference, which all images have in common."""
_OTHERS, _OF_MODEL = 0.15, 1.0
"""c is expected to be so much of a0 / p_c, and so many standard deviations of the last amplitude
over its load, by model error, give or take: see docs/how-to/sequences.md."""
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
    linear: float
    """c, the same per load."""
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


def half_wave(result: Result, cellular: Box, i: int = 0) -> tuple[float, float]:
    """Amplitude of a half wave in v_i, both ways across a part of the specimen, and its sd [mm].

    The latter by white noise of the images, as large as the residual.
    """
    ansatz = result.ansatz
    ends = np.linspace(-1.0, 1.0, _POINTS)
    x, y = (c + h * ends for c, h in zip(cellular.centre, cellular.half, strict=True))
    wave = np.cos(0.5 * np.pi * ends)[:, None] * np.cos(0.5 * np.pi * ends)
    basis = ansatz.v_space.basis(x[None, :], y[:, None])
    weights = np.einsum("yx,yxk->k", wave, basis) / (wave**2).sum()
    part = ansatz.v_slice(i)
    variance = weights @ result.covariance()[part, part] @ weights
    return float(weights @ result.unknowns[part]), float(np.sqrt(variance))


def predict(load: FloatArray, amplitude: FloatArray, sd: FloatArray) -> Prediction | None:
    """Extrapolate the growth of a pattern's amplitude to the critical load.

    ``load``, ``amplitude``, ``sd`` (n,): of the images, the last of one sign and below the critical
    load. Where the amplitudes scatter more than their standard deviations say, that counts. None
    from fewer than five images, or if the pattern doesn't grow.
    """
    used = load > 0.0
    load, amplitude, sd = load[used], amplitude[used], sd[used]
    if len(load) < FEWEST or not (sd > 0.0).all():
        return None
    last = int(np.argmax(load))
    tried = load[last] * np.geomspace(1.0 + 1e-3, _FAR, _TRIED)
    weight = 1.0 / (sd * np.sqrt(1.0 - _COMMON))
    columns = np.stack(np.broadcast_arrays(load / (tried[:, None] - load), load, sd), axis=1)
    columns, a = columns * weight, amplitude * weight
    normal, right = columns @ columns.swapaxes(1, 2), columns @ a
    by_model, scatter = _OF_MODEL * sd[last] / load[last], 1.0
    linear = np.full(_TRIED, np.hypot(by_model, amplitude[last] / load[last]))
    for _ in range(_ROUNDS):  # for each critical load the best a0, c and what errors have in common
        prior = np.stack([0.0 * tried, scatter / linear**2, 0.0 * tried + 1.0 / _COMMON], axis=1)
        A = normal + prior[:, None] * np.eye(3)
        found = np.linalg.solve(A, right[..., None])[..., 0]
        cost = (a @ a - (right * found).sum(axis=1)) / scatter
        chance = -0.5 * cost - 0.5 * np.linalg.slogdet(A)[1] - np.log(linear)
        best = int(np.argmax(chance))
        scatter = max(1.0, float(cost[best]) * scatter / (len(load) - 3))
        linear = np.hypot(by_model, _OTHERS * np.abs(found[:, 0]) / tried)
    share = np.exp(chance - chance[best])
    quantiles = np.interp(_QUANTILES, np.cumsum(share) / share.sum(), tried)
    k = int(np.searchsorted(tried, quantiles[1]))
    if found[k, 0] * amplitude[last] <= 0.0:
        return None
    critical = float(quantiles[1])
    below, _, above = np.hypot(quantiles - critical, 2.0 * OF_METHOD * critical).tolist()
    return Prediction(
        critical, critical - below, critical + above if share[-1] < _NEGLIGIBLE else float("inf"),
        float(found[k, 0]), float(found[k, 1]), float(load[last]), len(load),
    )  # fmt: skip


def follow_growth(
    columns: FloatArray, known: Sequence[Prediction | None] = ()
) -> list[Prediction | None]:
    """The prediction after each image of a test, in their order; of the first ones it is known.

    ``columns`` (3, n): as for :func:`predict`. A prediction stays as it is once the load is beyond
    nine tenths of it, as buckling no longer lies ahead, and on the way back.
    """
    found = list(known)
    for n in range(len(found) + 1, columns.shape[1] + 1):
        load, last = columns[0, :n], found[-1] if found else None
        is_ahead = last is None or not last.is_useful or load[-1] < NEAR * last.critical
        found.append(predict(*columns[:, :n]) if is_ahead and load[-1] >= load.max() else last)
    return found
