"""The critical load from the growth of an imperfect pattern, before it buckles.

An imperfect specimen's pattern grows from the beginning, a = c p + a0 p / (p_c - p) with the load
p: the second term is the critical mode's, with an imperfection a0 (R. V. Southwell, Proc. R. Soc.
A 135 (1932), doi 10.1098/rspa.1932.0055), the first that of all others, which are far from theirs.
So p / (a - c p) = (p_c - p) / a0: a straight line that ends at the critical load.

Modes differ by their envelopes. The critical one's is a half wave across the lattice both ways, and
:func:`half_wave` picks its amplitude out of v; the others' are nearly orthogonal to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

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
_SURE = 0.95
_FAR = 10.0
"""Times the largest load: growth that points further isn't seen."""
_TRIED = 4000
_POINTS = 41


@dataclass(frozen=True)
class Prediction:
    """The critical load, extrapolated from images at lower ones."""

    critical: float
    low: float
    high: float
    """And its interval of 95 %; infinite where growth isn't told from a straight line."""
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
    top = float(load.max())
    tried = top * np.geomspace(1.0 + 1e-3, _FAR, _TRIED)
    # For each critical load the best c and a0; c is expected to be some a0 / p_c, or less.
    pole, line, a = load / (tried[:, None] - load) / sd, load / sd, amplitude / sd
    own, both, square = line @ line, pole @ line, (pole**2).sum(axis=1)
    first, second = line @ a, pole @ a
    own = own + (tried / np.maximum(np.abs(second / square), 1e-300)) ** 2
    lines, strengths = (
        (first * square - both * second, own * second - both * first)
        / (own * square - both**2)
    )  # fmt: skip
    left = a - lines[:, None] * line - strengths[:, None] * pole
    cost = (left**2).sum(axis=1) + (own - line @ line) * lines**2
    best = int(np.argmin(cost))
    free = len(load) - 3
    scatter = max(1.0, float(cost[best]) / free)
    reach = float(student.ppf(0.5 * (1.0 + _SURE), free)) ** 2 * scatter
    inside = np.flatnonzero(cost <= cost[best] + reach)
    if strengths[best] * amplitude[np.argmax(load)] <= 0.0:
        return None
    critical, method = float(tried[best]), 2.0 * OF_METHOD * float(tried[best])
    low, high = (float(np.hypot(tried[end] - critical, method)) for end in inside[[0, -1]])
    return Prediction(
        critical, critical - low, critical + high if inside[-1] < _TRIED - 1 else float("inf"),
        float(strengths[best]), float(lines[best]), top, len(load),
    )  # fmt: skip


def follow_growth(
    load: Sequence[float], amplitude: Sequence[float], sd: Sequence[float]
) -> list[Prediction | None]:
    """The prediction after each image of a test, in their order.

    It stays as it is once the load is beyond nine tenths of it, as buckling no longer lies ahead,
    and on the way back.
    """
    found: list[Prediction | None] = []
    last: Prediction | None = None
    for n in range(1, len(load) + 1):
        p, a, s = (np.array(part[:n], np.float64) for part in (load, amplitude, sd))
        is_ahead = last is None or not last.is_useful or p[-1] < NEAR * last.critical
        if is_ahead and p[-1] >= p.max():
            last = predict(p, a, s)
        found.append(last)
    return found
