"""The cut-off wavelength of the regularisation with the least estimated risk; standard deviations.

Near a solution the displacement is linear in the images' noise. For any weight lambda of the
smoothness R, one factorisation of A = M + lambda R therefore gives the residual's sum of squares Q
and the effective number of unknowns t = tr A^-1 M, by random probes (M. F. Hutchinson, Commun.
Stat. Simul. Comput. 19 (1990), doi 10.1080/03610919008812866). The chosen weight minimises

    Q/(1 - 1.4 c t/p)^2,

generalised cross-validation with p pixels (G. Golub, M. Heath, G. Wahba, Technometrics 21 (1979),
doi 10.1080/00401706.1979.10489751). Without the 1.4 it is, but for a constant, an unbiased estimate
of the remaining error in g(x + u). The 1.4 prevents too little smoothing, which costs more than too
much: Y.-J. Kim, C. Gu, J. R. Stat. Soc. B 66 (2004), doi
10.1046/j.1369-7412.2003.05316.x. c is the noise's power at the long wavelengths of displacements
over its variance at the pixels: interpolated noise is smoother than that of the pixels.

The covariance by noise is A^-1 C A^-1. C, the gradient's covariance, is the sum over the pixels of
s_f^2 h_0 h_0' + s_g^2 h h'/det F, h_0 being h without its noise (see ``solver.weighting``). The
bias by smoothing is estimated from the change of u under a weight four times as large, as mean
square around each node. Without speckle a larger weight changes nothing, and the smoothest
displacement has no noise. There the covariance that the regularisation allows is added,
s^2 lambda A^-1 R A^-1 (G. Wahba, J. R. Stat. Soc. B 45 (1983), doi
10.1111/j.2517-6161.1983.tb01239.x), times the share of noise in the slopes around a node. With a
material law a larger weight says little, because a law's errors are the same at all long
wavelengths. The true u is then taken to be at most d from the solution with the law, d being its
distance to the one without, and most probably at it: a triangular distribution of variance d^2/6
(Guide to the Expression of Uncertainty in Measurement, JCGM 100, 4.3.9).

Smoothing takes A^-1 lambda R(u - u_0) from the true displacement u. The same term of the measured u
is added back where it exceeds noise and the elements' interpolation error: J. Tukey's twicing, a
second step of iterated Tikhonov regularisation. This concerns few places, mainly tips of holes,
that are rougher than the displacement for which the cut-off wavelength was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.equations.system import SAMPLES, SOME, Linearised, Smoothness
from modeharvest.idic.finite_element.fields import interpolation_error, mean_around, nodal_gradient
from modeharvest.util.arrays import FloatArray, IntArray

_PROBES, _DEGREES = 4, 1.4
_LEAST_SHARE = 0.05
"""Least share of the noise that remains in the residual; less can't be told from none [-]."""
_STEP = 1.4
"""Ratio of neighbouring cut-off wavelengths in the search."""
_TINY = float(np.finfo(np.float64).tiny)
_LEAST_PX, _MOST_PX = 10.0, 400.0  # one within 5 % of the least counts as the least
"""Bounds of the search; shorter ones expose nodes to errors of image splines at edges."""
_STRONGER = 4.0
"""Weight of the regularisation that shows its bias, over the weight used [-]."""
_OF_SLOPES = 2.0
"""Bias of gradients over its estimate: waves already lost (half, for k^-3.5) can't change."""
_SIGNIFICANT = 3.0
"""A difference of more standard deviations is significant."""
_STANDS_OUT = 6.0
"""Square of the part removed by smoothing over its variance, above which it is put back [-]."""


@dataclass(frozen=True)
class Risk:
    """Estimated error for a cut-off wavelength."""

    cutoff_px: float
    """Cut-off wavelength [px]."""
    value: float
    """Generalised cross-validation score per pixel [grey levels^2]."""
    unknowns: float
    """Effective number of unknowns t."""
    noise: float
    """Estimated standard deviation of the residual's noise [grey levels]."""


def risk(at: Linearised, cutoff_px: float, pixel_size: float, excess: float) -> Risk:
    """Estimate the risk of one cut-off wavelength; ``excess`` is c of the module's text."""
    weight = at.weight(cutoff_px * pixel_size)
    z = np.random.default_rng(0).choice([-1.0, 1.0], (at.u.size, _PROBES))
    found = at.factor(weight).solve(np.column_stack([at.right(weight), at.M @ z]))
    step = found[:, 0]
    Q = at.sums.square_sum - 2.0 * float(step @ at.gradient) + float(step @ (at.M @ step))
    t = float(np.sum(z * found[:, 1:])) / _PROBES
    p = at.sums.pixels
    value = Q / max(1.0 - _DEGREES * excess * t / p, _LEAST_SHARE) ** 2
    noise = np.sqrt(Q / (p - t)) if Q >= 0.0 and t < p else np.nan  # diverged
    return Risk(cutoff_px, value / p, t, float(noise))


def least_risk(
    at: Linearised, first_px: float, pixel_size: float, excess: float
) -> tuple[Risk, ...]:
    """Try three or more, ascending, until the risk rises on both sides or a bound is reached."""

    def tried_at(cutoff_px: float) -> Risk:
        return risk(at, float(np.clip(cutoff_px, _LEAST_PX, _MOST_PX)), pixel_size, excess)

    first_px = np.clip(first_px, _STEP * _LEAST_PX, _MOST_PX / _STEP)
    tried = [tried_at(first_px * ratio) for ratio in (1.0 / _STEP, 1.0, _STEP)]
    while _lowest(tried) == 0 and tried[0].cutoff_px > 1.05 * _LEAST_PX:
        tried.insert(0, tried_at(tried[0].cutoff_px / _STEP))
    while _lowest(tried) == len(tried) - 1 and tried[-1].cutoff_px < _MOST_PX:
        tried.append(tried_at(tried[-1].cutoff_px * _STEP))
    return tuple(tried)


def longer_cutoff(at: Linearised, first_px: float, pixel_size: float, excess: float) -> float:
    """Cut-off wavelength up to which the estimated risk falls, in steps of a factor of two [px]."""
    value, cutoff_px = np.inf, first_px
    while cutoff_px < _MOST_PX and (found := risk(at, cutoff_px, pixel_size, excess).value) < value:
        value, cutoff_px = found, 2.0 * cutoff_px
    return max(first_px, 0.5 * cutoff_px)


def best_of(tried: Sequence[Risk]) -> float:
    """Cut-off wavelength at the vertex of the parabola through the lowest risk and neighbours [px].

    ``tried`` are three or more. The vertex is kept within the bounds of the search.
    """
    k = _lowest(tried)
    first = min(max(k - 1, 0), len(tried) - 3)
    x, y = np.transpose([(np.log(t.cutoff_px), t.value) for t in tried[first : first + 3]])
    a, b, _ = np.polyfit(x, y, 2)
    vertex = -0.5 * b / a if a > 0.0 else np.log(tried[k].cutoff_px)
    return float(np.exp(np.clip(vertex, np.log(_LEAST_PX), np.log(_MOST_PX))))


def _lowest(tried: Sequence[Risk]) -> int:
    return int(np.argmin([one.value for one in tried]))


class Deviations(NamedTuple):
    """Standard deviations of u and of its gradient."""

    samples: FloatArray
    """(n, 2, s) random errors of u by noise [mm]."""
    lost: FloatArray
    """(n, 2, s) random displacements of the kind smoothing removes, of arbitrary size [mm]."""
    changes: FloatArray
    """(n, 2, k) possible changes of u, by smoothing or by leaving out the law [mm]."""
    bias: FloatArray
    """(n, 2) standard deviation of u by these and by the elements' interpolation error [mm]."""
    gradient: FloatArray
    """(n, 4, 4) covariance of xx, xy, yx, yy of grad u, by noise and bias [-]."""
    taken: FloatArray | float = 0.0
    """(n, 2) part of u removed by smoothing, where it is significant, else 0; to be added [mm]."""

    @property
    def by_noise(self) -> FloatArray:
        """(n, 2) standard deviation of u by noise [mm]."""
        return np.asarray(np.sqrt(np.mean(self.samples**2, axis=2)))

    @property
    def roots(self) -> FloatArray:
        """Scaled samples, lost and changes [mm]: their outer products sum up to the covariance."""
        by_noise = self.samples / np.sqrt(self.samples.shape[2])
        scale = self.bias / np.sqrt(np.maximum((self.lost**2).sum(axis=2), _TINY))
        return np.concatenate([by_noise, scale[..., None] * self.lost, self.changes], axis=2)

    def with_bias(self, mesh: Mesh, change: FloatArray, of_slopes: float = 1.0) -> Deviations:
        """Add a change (n, 2) of u [mm] as bias, rms around nodes; slopes ``of_slopes`` times."""
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
    """Estimate errors of u by noise and smoothing, and the part of u that smoothing has removed.

    Noise: A^-1 e for random e of covariance M times the noise variance, more where residuals pull
    more, plus what the regularisation allows where there is no speckle. Bias: change of u by a
    larger weight (long waves less where a part is put back), and elements' interpolation error.

    cutoff : wavelength [mm].
    noise : standard deviation of the residual's noise [grey levels].
    in_gradient : (m,) noise variance of each element's gradient over that of the residual [-].
    unknowns : effective number of unknowns.
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
    if isinstance(at.prior, Smoothness):  # what a law allows is unknown
        lost = factor.solve(at.body.smoothness_samples).reshape(-1, 2, SAMPLES)
        blank = mean_around(mesh, 1.0 - at.signal)
        # If u is rougher than its effective unknowns explain, the weight is too large.
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
    for _ in range(2):  # removes as much as one step with the weight used, or more
        again = at.factor(more).solve(more * (at.R @ again.ravel())).reshape(-1, 2)
    missing = change + share * (again - change)
    sd = Deviations(found, lost, none, error, gradient_covariance(mesh, found), share * taken)
    return sd.with_bias(mesh, change, _OF_SLOPES)._replace(changes=missing[..., None])


def uncertain(at: Linearised, cutoff: float, noise: FloatArray) -> FloatArray:
    """(2 n, SOME + 1) errors of u by noise and bias [mm]; their outer products' sum: covariance."""
    random = at.body.random(noise[:, None, None, None] * at.sums.blocks, SOME)
    here = at.right(weight := at.weight(cutoff))
    found = at.factor(weight).solve(np.column_stack([here, random]))
    change = at.step(cutoff, _STRONGER) - found[:, 0]
    return np.column_stack([found[:, 1:] / np.sqrt(SOME), _OF_SLOPES * change])


def contradicted(
    difference: FloatArray, free: Deviations, lawful: Deviations, nodes: IntArray
) -> float:
    """Share of components at ``nodes`` where solutions with and without a law differ significantly.

    A difference (n, 2) [mm] is significant if it exceeds 3 standard deviations: those by noise of
    the two solutions' difference, and those by smoothing of the solution without a law.
    """
    noise = np.mean((lawful.samples - free.samples) ** 2, axis=2)
    limit = _SIGNIFICANT * np.sqrt(noise + free.bias**2)
    return float(np.mean(np.abs(difference)[nodes] > limit[nodes]))


def gradient_covariance(mesh: Mesh, samples: FloatArray) -> FloatArray:
    """(n, 4, 4) covariance of xx, xy, yx, yy of grad u [-] from random u (n, 2, s) [mm]."""
    n, _, count = samples.shape
    slopes = nodal_gradient(mesh, samples.reshape(n, -1)).reshape(n, 2, count, 2)
    J = slopes.swapaxes(2, 3).reshape(n, 4, count)
    return np.asarray(J @ J.swapaxes(1, 2) / count)


def smoothed(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(n, ...) means of nodal values over the elements around each node."""
    return mean_around(mesh, nodal[mesh.cells].mean(axis=1))
