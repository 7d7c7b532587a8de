"""Covariance of the unknowns by noise and by model error, and standard deviations of the fields.

Linear propagation of the unknowns' covariance, at any positions. Two causes are kept apart:

* the images' noise, from :meth:`modeharvest.idic.result.Result.covariance`;
* the model error w: its residual moves the unknowns, cell by cell. Taking the cells for independent
  gives the sandwich covariance H⁻¹ (Σ_b g_b g_bᵀ) H⁻¹ of robust statistics, with the block
  gradients g_b = Σ_{x in b} Jᵀr and one block per unit cell.

How far a gradient moves the unknowns depends on the cost's Hessian H. The Gauss-Newton matrix JᵀJ
is H without residual; with a large w the curvature is smaller, and the same noise does more.

Sources: G. Besnard, F. Hild, S. Roux, Exp. Mech. 46 (2006), doi 10.1007/s11340-006-9824-8 (noise);
H. White, Econometrica 48 (1980), doi 10.2307/1912934 (sandwich).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.idic.ansatz import open_grid
from modeharvest.idic.result import Covariance, Result, determined_part
from modeharvest.idic.solver.assembly import Assembly, valid_pixels
from modeharvest.idic.solver.final_smoothing import smoothed_pair
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.passes import Runs, runs_of
from modeharvest.idic.solver.pyramid import FULL, level_pair
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError

_FEWEST_BLOCKS = 8
"""Fewest blocks from which the scatter of their gradients can be estimated."""
_ENOUGH_PX, _STEP_PX = 200_000, 0.002
_SMALL = np.float32(0.05)
"""Noise is scaled down by this factor, and its effect up again: only the linear part counts."""
_EXAMPLES = 4
"""Realisations of filtered noise: with 100 cells a standard deviation is good to 4 %."""


def covariance(
    result: Result, pair: ImagePair, noise: ImageNoise, block: float, edge_px: int
) -> Covariance:
    """Find the covariances of a correlation's unknowns; ``pair``: images without final smoothing.

    Blocks of edge ``block`` [mm], the unit cell, are taken for independent; ``edge_px`` as in
    :class:`~modeharvest.idic.setup.CorrelationOptions`.
    """
    if result.outcome is Outcome.REFITTED:
        why = "No error bars by model error: of that a fit to the whole displacement is free."
        return Covariance(result.covariance(noise), None, (why,))
    blur_px = result.final_smoothing.blur_px if result.final_smoothing else 0.0
    matched = MatchedImages.of(result, smoothed_pair(pair, blur_px), edge_px)
    by_noise = matched.hessian_corrected_covariance(noise)
    try:
        by_model_error = matched.sandwich_covariance(block)
        if blur_px > 0.0:
            by_noise = matched.noise_covariance(_smoothed_noise(pair, blur_px, noise), block)
    except InputError as error:
        return Covariance(by_noise, None, (f"No error bars by model error: {error}.",))
    return Covariance(by_noise, by_model_error)


def _smoothed_noise(
    pair: ImagePair, blur_px: float, noise: ImageNoise
) -> Iterator[tuple[FloatImage, FloatImage]]:
    """Realisations of white noise in both images, after the blur."""
    rng = np.random.default_rng(0)
    without = smoothed_pair(pair, blur_px)
    for _ in range(_EXAMPLES):
        f, g = (
            image + np.float32(sd) * rng.standard_normal(image.shape, dtype=np.float32)
            for image, sd in ((pair.reference, noise.reference), (pair.deformed, noise.deformed))
        )
        noisy = smoothed_pair(pair.with_images(f, g), blur_px)
        yield noisy.reference - without.reference, noisy.deformed - without.deformed


@dataclass(frozen=True, eq=False)
class MatchedImages:
    """A result and the images as the last level of the correlation compared them."""

    result: Result
    reference: FloatImage
    deformed: FloatImage
    """(rows, cols) f, and g continued into its holes [grey levels]: otherwise g would have edges at
    its holes, whose curvature isn't the cost's."""
    used: BoolArray
    """(rows, cols) True on the pixels that count."""

    @classmethod
    def of(cls, result: Result, pair: ImagePair, edge_px: int) -> MatchedImages:
        """Prepare the images of a result again as the last level of its correlation did."""
        level = level_pair(pair, FULL, edge_px, result.order)
        assert level.valid is not None  # on the finest level
        every = Assembly(result.ansatz, result.grid, level.mask)
        used, _ = valid_pixels(every, result.unknowns, level.reference, level.deformed, level.valid)
        deformed = np.empty(result.grid.shape, np.float32)
        for row, line in enumerate(deformed):
            line[:] = level.deformed.sample(row, np.arange(line.size))[0]
        return cls(result, level.reference, deformed, used)

    @cached_property
    def inverse_hessian(self) -> FloatArray:
        """(n, n) inverse of the cost's Hessian H; infinite where M⁻¹ is.

        H is found by differences of the gradient; for large images on some of the rows, which show
        enough speckles.
        """
        result, mask = self.result, self.used
        every = int(np.clip(mask.sum() // _ENOUGH_PX, 1, 4))
        some = np.zeros_like(mask)
        some[::every] = mask[::every]
        assembly = Assembly(result.ansatz, result.grid, some)
        f, g = self.reference, SplineImage.of(self.deformed, result.order)
        kept = np.flatnonzero(np.isfinite(np.diag(result.inverse)))
        matrix = np.linalg.inv(result.inverse[np.ix_(kept, kept)])
        # Steps that move the image by about _STEP_PX: rms grey levels over the rms gradient.
        per_px = np.sqrt(np.trace(matrix[:2, :2]) / max(1, result.pixels)) * result.grid.pixel_size
        steps = _STEP_PX * per_px / np.sqrt(np.diag(matrix) / max(1, result.pixels))

        def at(number: int, step: float) -> FloatArray:
            a = result.unknowns.copy()
            a[kept[number]] += step
            return np.asarray(assembly.images(a, f, g, False).gradient[kept])

        here = at(0, 0.0)
        columns = [(at(k, h) - here) / h for k, h in enumerate(steps)]
        share = some.sum() / max(1, mask.sum())
        curvature = 0.5 * (np.array(columns) + np.array(columns).T) / share
        found = result.inverse.copy()
        found[np.ix_(kept, kept)] = np.linalg.inv(curvature)
        return found

    def hessian_corrected_covariance(self, noise: ImageNoise | float) -> FloatArray:
        """(n, n) covariance by white noise in both images, with the cost's Hessian.

        H⁻¹ V H⁻¹, where V = M C M, C = ``result.covariance(noise)`` and M is the Gauss-Newton
        matrix. Where the residual is noise, H and M are the same, and C itself is returned.
        """
        result = self.result
        found = result.covariance(noise)
        if result.residual_test().is_white:
            return found
        kept = np.ix_(*[np.flatnonzero(np.isfinite(np.diag(result.inverse)))] * 2)
        M = (1.0 - result.noise_in_slope(ImageNoise.of(noise))) * np.linalg.inv(
            result.inverse[kept]
        )
        inverse = self.inverse_hessian[kept]
        found[kept] = inverse @ M @ found[kept] @ M @ inverse.T
        return found

    def sandwich_covariance(self, block: float) -> FloatArray:
        """(n, n) covariance of the unknowns by the model error, by blocks of edge ``block`` [mm].

        It includes the images' noise, which is in the residual. If w has the lattice's own period,
        the block gradients are alike, and their independence is an assumption. Raises InputError if
        there are fewer than eight blocks.
        """
        gradients = self._block_gradients(self._blocks(block), self.reference, self.deformed)
        return _sandwich(self.inverse_hessian, gradients)

    def noise_covariance(
        self, examples: Iterable[tuple[FloatImage, FloatImage]], block: float,
        inverse: FloatArray | None = None,
    ) -> FloatArray:  # fmt: skip
        """(n, n) covariance of the unknowns by noise of any kind, from realisations of it.

        For images that were filtered before they were correlated: their noise is no longer white,
        and :meth:`modeharvest.idic.result.Result.covariance` does not hold. Every realisation gives
        each block a gradient; the covariance is their mean square. The effect of noise on the
        gradient that weighs w is included. ``examples``: noise in f and in g, (rows, cols) each,
        filtered as the images were; ``inverse`` (n, n) is used in place of :attr:`inverse_hessian`.
        """
        blocks, f, g = self._blocks(block), self.reference, self.deformed
        without = self._block_gradients(blocks, f, g)
        found = []
        for in_f, in_g in examples:
            noisy = self._block_gradients(blocks, f + _SMALL * in_f, g + _SMALL * in_g)
            found.append((noisy - without) / _SMALL)
        inverse = self.inverse_hessian if inverse is None else inverse
        return _sandwich(inverse, np.vstack(found)) / len(found)

    def _blocks(self, block: float) -> list[Runs]:
        """The pixels of each block; InputError if there are fewer than eight."""
        grid, runs = self.result.grid, runs_of(self.used)
        side = max(1, round(block / grid.pixel_size))
        corners = product(range(0, grid.rows, side), range(0, grid.cols, side))
        blocks = (runs.within(*corner, side) for corner in corners)
        found = [part for part in blocks if part.pixels]
        if len(found) < _FEWEST_BLOCKS:
            raise InputError(
                f"expected at least {_FEWEST_BLOCKS} blocks of {block} mm with material, got "
                f"{len(found)}"
            )
        return found

    def _block_gradients(self, blocks: list[Runs], f: FloatImage, g: FloatImage) -> FloatArray:
        """(blocks, n): the derivative of each block's share of the cost."""
        a, spline = self.result.unknowns, SplineImage.of(g, self.result.order)
        every = Assembly(self.result.ansatz, self.result.grid, self.used)
        return np.array([every.images(a, f, spline, False, runs=part).gradient for part in blocks])


def _sandwich(inverse: FloatArray, gradients: FloatArray) -> FloatArray:
    """H⁻¹ (Σ g gᵀ) H⁻¹; infinite for unknowns that the images don't determine."""
    known, lost = determined_part(inverse)
    half = gradients @ known
    found = half.T @ half
    found[lost, lost] = np.inf
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class FieldErrors:
    """Standard deviations at positions that broadcast to a shape (...)."""

    covariance: FloatArray
    """(n, n) covariance of the unknowns, from which these are propagated."""
    v0: FloatArray
    """(..., 2) of the slow field's components [mm]."""
    v: FloatArray
    """(modes, ...) of the amplitudes v_i [mm]."""
    fluctuation: FloatArray
    """(modes, ..., 2) of the components of v_i phi_i [mm]."""
    displacement: FloatArray
    """(..., 2) of the whole displacement [mm]."""


def field_errors(result: Result, x: ArrayLike, y: ArrayLike, covariance: ArrayLike) -> FieldErrors:
    """Propagate a covariance of the unknowns to the fields.

    x, y : Positions [mm] that broadcast together, or two axes. The errors are as smooth as the
        ansatz: a coarse grid will do.
    covariance : (n, n) of the unknowns: ``result.covariance(noise_sd)``, or one of a
        :class:`Covariance`. Unknowns of infinite variance make the fields they touch infinite.
    """
    ansatz, a = result.ansatz, result.unknowns
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (ansatz.size, ansatz.size):
        raise InputError(f"expected a covariance of {(ansatz.size,) * 2}, got {matrix.shape}")
    S = ansatz.sensitivities(a, x, y)
    slow = slice(0, 2 * ansatz.v0_space.size)
    modes = range(len(ansatz.modes))
    x_open, y_open = open_grid(x, y)
    basis = ansatz.v_space.basis(*np.broadcast_arrays(x_open, y_open))
    amplitude, pattern = [], []
    for i in modes:
        part = ansatz.v_slice(i)
        amplitude.append(propagated_sd(basis, matrix[part, part]))
        own = np.r_[part, ansatz.phi_slice(i)]
        pattern.append(propagated_sd(S[..., own], matrix[np.ix_(own, own)]))
    shape = S.shape[:-2]
    return FieldErrors(
        covariance=matrix, v0=propagated_sd(S[..., slow], matrix[slow, slow]),
        v=np.array(amplitude).reshape(len(modes), *shape),
        fluctuation=np.array(pattern).reshape(len(modes), *shape, 2),
        displacement=propagated_sd(S, matrix),
    )  # fmt: skip


def propagated_sd(sensitivity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Square root of the diagonal of S C Sᵀ; infinite where it touches an infinite variance."""
    known, lost = determined_part(covariance)
    variance = np.einsum("...n,nm,...m->...", sensitivity, known, sensitivity, optimize=True)
    touched = np.any(sensitivity[..., lost] != 0.0, axis=-1)
    return np.asarray(np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0))))
