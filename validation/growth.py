"""The critical load from the growth of an imperfect pattern, before it buckles.

The pattern of an imperfect specimen grows from the start, a = a0 p / (p_c - p) + c p + d p^2 with
the load p. The first term is that of the critical mode, with an imperfection a0 (R. V. Southwell,
Proc. R. Soc. A 135 (1932), doi 10.1098/rspa.1932.0055); the others are due to all other modes, far
from their critical loads, and to the model error. The posterior probability of p_c is computed with
a0, c, d and the error common to all images integrated out.

Modes differ by their envelopes. That of the critical mode is a half wave across the lattice in both
directions; :func:`half_wave` extracts its amplitude from v. The others are nearly orthogonal to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.result import Result
from modeharvest.util.arrays import FloatArray

FEWEST = 5
"""Least number of images for a prediction."""
NEAR = 0.9
"""Fraction of the critical load beyond which the amplitude is no longer small."""
OF_METHOD = 0.01
"""Standard deviation of a prediction without noise, relative to the critical load: see
docs/how-to/sequences.md."""
_QUANTILES = (0.025, 0.5, 0.975)
_COMMON = 0.5
"""Share of the amplitudes' noise variance from the reference image, common to all images."""
_OTHERS = 0.15
"""Prior scale of c p relative to a0 p / p_c; the standard deviation by model error at the last
image is added to it, and is the prior scale of d p^2: see docs/how-to/sequences.md."""
_FAR, _NEGLIGIBLE = 10.0, 0.02
"""Largest p_c tried, in largest loads; relative density there above which p_c has no upper end."""
_TRIED, _ROUNDS = 2000, 4
_POINTS = 41
_STEP, _BEFORE, _SLOWER, _CERTAIN = 0.02, 0.5, 0.9, 3.0
"""Least step between images whose growth is compared, in largest loads; rates of growth before and
after buckling at most, relative to the largest, and by how many standard deviations."""


@dataclass(frozen=True)
class Prediction:
    """The critical load, extrapolated from images at lower loads."""

    critical: float
    low: float
    high: float
    """Median and 95 % interval; ``high`` is infinite if the growth may be linear in the load."""
    imperfection: float
    """a0, in the unit of the amplitudes."""
    others: tuple[float, float, float]
    """(d, c, 0): coefficients of the polynomial d p^2 + c p, highest power first."""
    largest: float
    """Largest load of the images used."""
    count: int
    """Number of images used."""

    @property
    def interval(self) -> str:
        """The interval as text, for loads that are strains [%]."""
        high = "no upper end" if not np.isfinite(self.high) else f"{100 * self.high:.2f} %"
        return f"{100 * self.low:.2f} … {high}"

    @property
    def is_useful(self) -> bool:
        """Whether the interval is finite and narrower than the critical load itself."""
        return self.high - self.low < self.critical


def half_wave(result: Result, cellular: Box, noise: float) -> tuple[float, float, float]:
    """Amplitude of a half wave in v1 across ``cellular`` in both directions [mm].

    Also its standard deviations [mm] by ``noise`` [grey levels] and by the whole residual.
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

    ``columns`` (4, n): load, amplitude, its standard deviation by noise (increased to the observed
    scatter if that is larger) and by model error, which grows with the load; loads are below the
    critical one. None with fewer than five finite columns, or if the amplitude doesn't grow.
    """
    load, amplitude, sd, model = columns[:, (columns[0] > 0.0) & np.isfinite(columns).all(axis=0)]
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
    for _ in range(_ROUNDS):  # for each critical load: a0, c, d, and the common error
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


def fastest_growth(columns: FloatArray) -> tuple[float, float] | None:
    """The loads between which the amplitude grew fastest, once the pattern has buckled; else None.

    ``columns`` (4, n): as for :func:`predict`, in the order of the test. Towards buckling a pattern
    grows faster, here at least twice as fast as before, and after it more slowly, here by a tenth
    in the last two steps; both beyond noise.
    """
    load, amplitude, sd, _ = columns[:, np.isfinite(columns).all(axis=0)]
    if not load.size or load.max() <= 0.0:
        return None
    loading = np.flatnonzero(load[: int(np.argmax(load)) + 1] >= 0.0)
    _, first = np.unique((load[loading] / load.max() / _STEP).astype(int), return_index=True)
    load, amplitude, sd = (part[loading][first] for part in (load, amplitude, sd))
    if len(load) < FEWEST:
        return None
    rate = np.diff(amplitude) / np.diff(load) * np.sign(amplitude[-1])
    rate_sd = np.hypot(sd[1:], sd[:-1]) / np.diff(load)
    k = int(np.argmax(rate))
    apart = rate + _CERTAIN * np.hypot(rate_sd, rate_sd[k])
    has_grown = k > 0 and apart[:k].min() < _BEFORE * rate[k]
    is_over = k < len(rate) - 2 and apart[-2:].max() < _SLOWER * rate[k]
    return (float(load[k]), float(load[k + 1])) if has_grown and is_over else None


def follow_growth(
    columns: FloatArray, known: Sequence[Prediction | None] = ()
) -> list[Prediction | None]:
    """The prediction after each image of a test, in order; ``known``: those of the first images.

    ``columns`` (4, n): as for :func:`predict`. A prediction is kept once the load exceeds nine
    tenths of it, because buckling is then no longer ahead, and during unloading. Once the growth
    has slowed down, the last one from before it did is kept.
    """
    found = list(known)
    for n in range(len(found) + 1, columns.shape[1] + 1):
        load, last = columns[0, :n], found[-1] if found else None
        is_ahead = last is None or not last.is_useful or load[-1] < NEAR * last.critical
        if (fastest := fastest_growth(columns[:, :n])) is not None:
            before = (p for p in reversed(found) if p is not None and p.largest <= fastest[0])
            is_ahead, last = False, next(before, None)
        found.append(predict(columns[:, :n]) if is_ahead and load[-1] >= load.max() else last)
    return found
