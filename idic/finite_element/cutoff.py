"""The cut-off wavelength of the regularisation with the least estimated risk; standard deviations.

Near a solution the displacement is linear in the images' noise, so that for any weight lambda of
the smoothness R the residual's sum of squares Q and the effective number of unknowns t = tr A^-1 M,
A = M + lambda R, follow from one factorisation; t by random probes (M. F. Hutchinson, Commun.
Stat. Simul. Comput. 19 (1990), doi 10.1080/03610919008812866). The weight taken minimises

    Q/(1 - 1.4 c t/p)^2,

generalised cross-validation with p pixels (G. Golub, M. Heath, G. Wahba, Technometrics 21 (1979),
doi 10.1080/00401706.1979.10489751): without the 1.4, but for a constant, an unbiased estimate of
the error that is left in g(x + u). The 1.4 keeps it from smoothing too little, which costs more
than smoothing too much: Y.-J. Kim, C. Gu, J. R. Stat. Soc. B 66 (2004), doi
10.1046/j.1369-7412.2003.05316.x. c is what the noise has at the long wavelengths of which
displacements are made, over its variance at the pixels: interpolated noise is smoother than that of
the pixels.

The posterior covariance s^2 A^-1 counts noise and smoothing alike, s^2 A^-1 M A^-1 noise alone:
D. Nychka, J. Am. Stat. Assoc. 83 (1988), doi 10.1080/01621459.1988.10478711.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array

from modeharvest.util.arrays import FloatArray

if TYPE_CHECKING:
    from modeharvest.idic.finite_element.measure import Body

_PROBES = 4
_DEGREES = 1.4
_STEP = 1.4
"""Between neighbouring cut-off wavelengths."""
_LEAST_PX, _MOST_PX = 2.0, 400.0


@dataclass(frozen=True, eq=False)
class Linearised:
    """Normal equations at some displacement of the nodes.

    Parameters
    ----------
    u
        (2 n,) [mm].
    M, gradient
        (2 n, 2 n) and (2 n,): sums of h h' and of h r.
    square_sum, pixels
        Sum of r^2, and how many pixels it is over.
    blocks
        (m, 3, 6, 6) parts of M, element by element.
    """

    u: FloatArray
    M: csr_array
    gradient: FloatArray
    square_sum: float
    pixels: int
    blocks: FloatArray


@dataclass(frozen=True)
class Risk:
    """What a cut-off wavelength is expected to cost.

    Parameters
    ----------
    cutoff_px
        Cut-off wavelength [px].
    value
        Generalised cross-validation [grey levels^2].
    unknowns
        Their effective number t.
    noise
        Estimated standard deviation of the residual's noise [grey levels].
    """

    cutoff_px: float
    value: float
    unknowns: float
    noise: float


def risk(body: Body, at: Linearised, cutoff_px: float, pixel_size: float, excess: float) -> Risk:
    """Estimate the risk of one cut-off wavelength; ``excess`` is c."""
    weight = body.weight(at.M, cutoff_px * pixel_size)
    z = np.random.default_rng(0).choice([-1.0, 1.0], (at.u.size, _PROBES))
    right = at.gradient - weight * (body.R @ (at.u - body.start.ravel()))
    found = body.factor(at.M, weight).solve(np.column_stack([right, at.M @ z]))
    step = found[:, 0]
    Q = at.square_sum - 2.0 * float(step @ at.gradient) + float(step @ (at.M @ step))
    t = float(np.sum(z * found[:, 1:])) / _PROBES
    value = Q / (1.0 - _DEGREES * excess * t / at.pixels) ** 2
    return Risk(cutoff_px, value / at.pixels, t, float(np.sqrt(Q / (at.pixels - t))))


def least_risk(
    body: Body, at: Linearised, first_px: float, pixel_size: float, excess: float
) -> tuple[Risk, ...]:
    """Try cut-off wavelengths from one on until the risk rises on both sides; ascending."""
    tried = {0: risk(body, at, first_px, pixel_size, excess)}
    while True:
        best = min(tried, key=lambda k: tried[k].value)
        missing = [k for k in (best - 1, best + 1) if k not in tried]
        if not missing or not _LEAST_PX < tried[best].cutoff_px < _MOST_PX:
            return tuple(tried[k] for k in sorted(tried))
        cutoff = first_px * _STEP ** missing[0]
        tried[missing[0]] = risk(body, at, cutoff, pixel_size, excess)


def best_of(tried: tuple[Risk, ...]) -> float:
    """The cut-off wavelength at the vertex of the parabola through the best three [px]."""
    k = min(range(len(tried)), key=lambda i: tried[i].value)
    if not 0 < k < len(tried) - 1:
        return tried[k].cutoff_px
    low, here, high = (tried[i].value for i in (k - 1, k, k + 1))
    shift = 0.5 * (low - high) / (low - 2.0 * here + high)
    return float(tried[k].cutoff_px * _STEP**shift)


_SAMPLES = 16
"""Of the posterior distribution: its standard deviations are known to 18 %."""


def deviations(body: Body, at: Linearised, cutoff: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2) standard deviations of u by noise and smoothing, and by noise alone, for s = 1.

    Samples of A^-1 (e + d) and of A^-1 e, e and d being of the covariances M and lambda R: those of
    M from its diagonal blocks, element by element.
    """
    weight = body.weight(at.M, cutoff)
    random = np.random.default_rng(0)
    e, d = body.samples(at.blocks, random, _SAMPLES)
    factor = body.factor(at.M, weight)
    noise = factor.solve(e)
    both = noise + factor.solve(np.sqrt(weight) * d)
    sd, by_noise = (np.sqrt(np.mean(x**2, axis=1)).reshape(-1, 2) for x in (both, noise))
    return sd, by_noise
