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

The covariance by noise is A^-1 C A^-1, C that of the gradient: s_f^2 h_0 h_0' + s_g^2 h h'/det F
summed over the pixels, h_0 being h without its noise (see ``solver.weighting``). What smoothing
takes away is estimated by what a weight four times as large changes, in the mean square around each
node. Where there is no speckle nothing changes that, and the smoothest displacement shows no noise:
there it counts what the regularisation lets a displacement do, s^2 lambda A^-1 R A^-1 (G. Wahba, J.
R. Stat. Soc. B 45 (1983), doi 10.1111/j.2517-6161.1983.tb01239.x), by how much of the slopes around
a node is noise. With a material law a larger weight says little, because errors of a law are the
same at all long wavelengths. There the truth is taken to be at most as far from the solution with
the law as that without it is, d, and most probably with it, which adds the variance d^2/6 of a
triangular distribution (Guide to the Expression of Uncertainty in Measurement, JCGM 100, 4.3.9).

Smoothing takes A^-1 lambda R(u - u_0) from the true displacement u. That of the measured one is put
back where it stands out from noise and the elements' own error: J. Tukey's twicing, a second step
of iterated Tikhonov regularisation, at the few places, tips of holes first of all, that are rougher
than the cut-off wavelength was found for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.fields import interpolation_error, mean_around, nodal_gradient
from modeharvest.idic.finite_element.system import SAMPLES, SOME, Linearised, Smoothness
from modeharvest.util.arrays import FloatArray, IntArray

_PROBES, _DEGREES = 4, 1.4
_STEP = 1.4
"""Between neighbouring cut-off wavelengths."""
_TINY = float(np.finfo(np.float64).tiny)
_LEAST_PX, _MOST_PX = 10.0, 400.0
"""Shorter ones leave single nodes to what splines make of edges."""
_STRONGER = 4.0
"""Weight of the regularisation that shows its bias, over the weight used [-]."""
_OF_SLOPES = 2.0
"""Bias of gradients over what that shows: waves that are gone (half, in k^-3.5) can't change."""
_SIGNIFICANT = 3.0
"""Standard deviations."""
_STANDS_OUT = 6.0
"""Square of what smoothing takes over its variance, around a node."""


@dataclass(frozen=True)
class Risk:
    """What a cut-off wavelength is expected to cost."""

    cutoff_px: float
    """Cut-off wavelength [px]."""
    value: float
    """Generalised cross-validation [grey levels^2]."""
    unknowns: float
    """Their effective number t."""
    noise: float
    """Estimated standard deviation of the residual's noise [grey levels]."""


def risk(at: Linearised, cutoff_px: float, pixel_size: float, excess: float) -> Risk:
    """Estimate the risk of one cut-off wavelength; ``excess`` is c."""
    weight = at.weight(cutoff_px * pixel_size)
    z = np.random.default_rng(0).choice([-1.0, 1.0], (at.u.size, _PROBES))
    found = at.factor(weight).solve(np.column_stack([at.right(weight), at.M @ z]))
    step = found[:, 0]
    Q = at.sums.square_sum - 2.0 * float(step @ at.gradient) + float(step @ (at.M @ step))
    t = float(np.sum(z * found[:, 1:])) / _PROBES
    p = at.sums.pixels
    value = Q / (1.0 - _DEGREES * excess * t / p) ** 2
    return Risk(cutoff_px, value / p, t, float(np.sqrt(Q / (p - t))))


def least_risk(
    at: Linearised, first_px: float, pixel_size: float, excess: float
) -> tuple[Risk, ...]:
    """Try cut-off wavelengths from one on until the risk rises on both sides; ascending."""
    tried = {0: risk(at, first_px, pixel_size, excess)}
    while True:
        best = min(tried, key=lambda k: tried[k].value)
        missing = [k for k in (best - 1, best + 1) if k not in tried]
        if not missing or not _LEAST_PX < tried[best].cutoff_px / 1.05 < _MOST_PX:
            return tuple(tried[k] for k in sorted(tried))
        cutoff = max(first_px * _STEP ** missing[0], min(first_px, _LEAST_PX))
        tried[missing[0]] = risk(at, cutoff, pixel_size, excess)


def best_of(tried: tuple[Risk, ...]) -> float:
    """The cut-off wavelength at the vertex of the parabola through the best three [px]."""
    k = min(range(len(tried)), key=lambda i: tried[i].value)
    if not 0 < k < len(tried) - 1:
        return max(tried[k].cutoff_px, _LEAST_PX)
    three = tried[k - 1 : k + 2]
    a, b, _ = np.polyfit(np.log([t.cutoff_px for t in three]), [t.value for t in three], 2)
    return max(float(np.exp(-0.5 * b / a)), _LEAST_PX)


class Deviations(NamedTuple):
    """Standard deviations of u and of its gradient."""

    samples: FloatArray
    """(n, 2, s) what random noise makes of u [mm]."""
    lost: FloatArray
    """(n, 2, s) random displacements, of any size, like those that smoothing takes away [mm]."""
    changes: FloatArray
    """(n, 2, k) what smoothing, or no law, may change u by [mm]."""
    bias: FloatArray
    """(n, 2) of u by that, and by the elements' own error [mm]."""
    gradient: FloatArray
    """(n, 4, 4) covariance by both of xx, xy, yx, yy of grad u [-]."""
    taken: FloatArray | float = 0.0
    """(n, 2) what smoothing has taken from u, where that stands out [mm]."""

    @property
    def by_noise(self) -> FloatArray:
        """(n, 2) of u [mm]."""
        return np.asarray(np.sqrt(np.mean(self.samples**2, axis=2)))

    @property
    def roots(self) -> FloatArray:
        """(n, 2, s + k) vectors whose outer products sum up to the covariance of all nodes [mm]."""
        by_noise = self.samples / np.sqrt(self.samples.shape[2])
        scale = self.bias / np.sqrt(np.maximum((self.lost**2).sum(axis=2), _TINY))
        return np.concatenate([by_noise, scale[..., None] * self.lost, self.changes], axis=2)

    def with_bias(self, mesh: Mesh, change: FloatArray, of_slopes: float = 1.0) -> Deviations:
        """Count a possible change (n, 2) of u [mm], rms around nodes; its slope so many times."""
        slope = of_slopes * nodal_gradient(mesh, change)
        spread = smoothed(mesh, np.einsum("nij,nkl->nijkl", slope, slope))
        return self._replace(
            changes=np.concatenate([self.changes, change[..., None]], axis=2),
            bias=np.sqrt(self.bias**2 + smoothed(mesh, change**2)),
            gradient=self.gradient + spread.reshape(-1, 4, 4),
        )


def deviations(
    at: Linearised, cutoff: float, noise: float, in_gradient: FloatArray, unknowns: float
) -> Deviations:
    """Estimate what noise and smoothing make of u, and what smoothing has taken from it.

    By noise, A^-1 e for random e of the covariance M times that of the noise, more of it where
    residuals pull more, with what the regularisation allows for where there is no speckle; by
    smoothing, what a larger weight changes (of long waves less what is put back), and elements.

    cutoff : wavelength [mm].
    noise : its standard deviation in the residual [grey levels].
    in_gradient : (m,) its variance in each element's gradient over that [-].
    unknowns : their effective number.
    """
    mesh, weight, here = at.body.mesh, at.weight(cutoff), at.step(cutoff)
    factor, degrees = at.factor(weight), np.minimum(at.sums.counts, 12.0)
    pull = (at.gain * at.signal)[:, None, None] * at.sums.gradient
    blocks = (noise**2 * in_gradient)[:, None, None, None] * at.sums.blocks
    random, inflation = at.body.samples(blocks, pull, degrees * (1.0 - unknowns / degrees.sum()))
    if at.edges is not None:
        random += at.variance * at.edges.samples(at.u, SAMPLES)
    found = factor.solve(random).reshape(-1, 2, SAMPLES)
    lost = none = found[..., :0]
    taken = share = np.zeros_like(error := interpolation_error(mesh, at.u.reshape(-1, 2)))
    if isinstance(at.prior, Smoothness):  # what a law allows is not known
        lost = factor.solve(at.body.smoothness_samples).reshape(-1, 2, SAMPLES)
        blank = mean_around(mesh, 1.0 - at.signal)
        # The roughness that was found is that of so many unknowns, or the weight is too large.
        grown = float((at.u - at.prior.start) @ at.penalty)
        rough = weight * grown / max(noise**2 * unknowns, _TINY)
        wide = noise * np.sqrt(weight * blank * max(at.mean(in_gradient), rough))
        found += wide[:, None, None] * lost
        noisy = at.R @ found[..., :SOME].reshape(at.u.size, SOME)
        both = weight * factor.solve(np.column_stack([at.penalty, noisy]))
        taken, *by_noise = np.moveaxis(both.reshape(-1, 2, 1 + SOME), 2, 0)
        variance = np.mean(np.square(by_noise), axis=0) / inflation[:, None] + error**2
        beyond = smoothed(mesh, taken**2 - _STANDS_OUT * variance).sum(axis=1, keepdims=True)
        share = smoothed(mesh, (beyond > 0.0).astype(float))
    change = (at.step(cutoff, _STRONGER) - here).reshape(-1, 2)
    more, again = _STRONGER * weight, change
    for _ in range(2):  # as much is taken as with the weight used in one step, or more
        again = at.factor(more).solve(more * (at.R @ again.ravel())).reshape(-1, 2)
    missing = change + share * (again - change)
    sd = Deviations(found, lost, none, error, gradient_covariance(mesh, found), share * taken)
    return sd.with_bias(mesh, change, _OF_SLOPES)._replace(changes=missing[..., None])


def uncertain(at: Linearised, cutoff: float, noise: FloatArray) -> FloatArray:
    """(2 n, SOME + 1) noise and bias of u [mm], whose outer products sum up to its covariance."""
    random = at.body.random(noise[:, None, None, None] * at.sums.blocks, SOME)
    here = at.right(weight := at.weight(cutoff))
    found = at.factor(weight).solve(np.column_stack([here, random]))
    change = at.step(cutoff, _STRONGER) - found[:, 0]
    return np.column_stack([found[:, 1:] / np.sqrt(SOME), _OF_SLOPES * change])


def contradicted(
    difference: FloatArray, free: Deviations, lawful: Deviations, nodes: IntArray
) -> float:
    """Share of components at nodes where solutions with and without a law differ significantly.

    Significant are 3 standard deviations of the difference (n, 2) [mm], by the noise that both have
    in common and by the smoothing of that without a law.
    """
    noise = np.mean((lawful.samples - free.samples) ** 2, axis=2)
    limit = _SIGNIFICANT * np.sqrt(noise + free.bias**2)
    return float(np.mean(np.abs(difference)[nodes] > limit[nodes]))


def gradient_covariance(mesh: Mesh, samples: FloatArray) -> FloatArray:
    """(n, 4, 4) covariance of xx, xy, yx, yy of grad u [-], by random displacements (n, 2, s)."""
    n, _, count = samples.shape
    slopes = nodal_gradient(mesh, samples.reshape(n, -1)).reshape(n, 2, count, 2)
    J = slopes.swapaxes(2, 3).reshape(n, 4, count)
    return np.asarray(J @ J.swapaxes(1, 2) / count)


def smoothed(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(n, ...) means of nodal values over the elements around each node."""
    return mean_around(mesh, nodal[mesh.cells].mean(axis=1))
