"""Covariance of the unknowns by noise and by model error, and standard deviations of the fields.

Linear propagation of the unknowns' covariance, at any positions. Two causes are kept apart:

* the images' noise, from :meth:`modeharvest.idic.result.Result.covariance`;
* what the ansatz leaves over (w): its residual pushes the unknowns about, cell by cell. Taking
  the cells' pushes for independent gives the covariance H⁻¹ (Σ_b g_b g_bᵀ) H⁻¹ with
  g_b = Σ_{x in b} Jᵀr, the "sandwich" of robust statistics with one block for a unit cell.

How far a push moves the unknowns is a matter of the cost's curvature H. Gauss and Newton's JᵀJ is
that without residual; with a large w the cost is softer, and the same noise does more.

Sources: G. Besnard, F. Hild, S. Roux, Exp. Mech. 46 (2006), doi 10.1007/s11340-006-9824-8 (noise);
H. White, Econometrica 48 (1980), doi 10.2307/1912934 (sandwich).

The deformed image as it is has edges at its holes, and pixels that land there took no part. A
curvature that sees them is none of the cost's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.idic.result import Result
from modeharvest.idic.solver.assembly import Assembly, valid_pixels
from modeharvest.idic.solver.pyramid import FULL, level_pair
from modeharvest.idic.uncertainty.noise import ImageNoise
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

_FEWEST_BLOCKS = 8
"""Fewer cells than this tell nothing about how their pushes scatter."""


@dataclass(frozen=True, eq=False)
class FieldErrors:
    """Standard deviations at positions that broadcast to a shape (...).

    Parameters
    ----------
    v0
        (..., 2) of the slow field's components [mm].
    v
        (modes, ...) of the amplitudes v_i [mm].
    fluctuation
        (modes, ..., 2) of the components of v_i phi_i [mm].
    displacement
        (..., 2) of the whole displacement [mm].
    """

    v0: FloatArray
    v: FloatArray
    fluctuation: FloatArray
    displacement: FloatArray


def field_errors(result: Result, x: ArrayLike, y: ArrayLike, covariance: ArrayLike) -> FieldErrors:
    """Propagate a covariance of the unknowns to the fields.

    Parameters
    ----------
    result
        Of a correlation.
    x, y
        Positions [mm] that broadcast together, or two axes. The errors are as smooth as the
        ansatz: a coarse grid will do.
    covariance
        (n, n) of the unknowns: ``result.covariance(noise_sd)`` for the images' noise, or
        :func:`model_error_covariance` for what the ansatz leaves over. Unknowns of infinite
        variance, about which the images say nothing, make the fields they touch infinite.
    """
    ansatz, a = result.ansatz, result.unknowns
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (ansatz.size, ansatz.size):
        raise InputError(f"expected a covariance of {(ansatz.size,) * 2}, got {matrix.shape}")
    S = ansatz.sensitivities(a, x, y)
    slow = slice(0, 2 * ansatz.v0_space.size)
    modes = range(len(ansatz.modes))
    x_open, y_open = _open(x, y)
    basis = ansatz.v_space.basis(*np.broadcast_arrays(x_open, y_open))
    amplitude, pattern = [], []
    for i in modes:
        part = ansatz.v_slice(i)
        amplitude.append(_sd(basis, matrix[part, part]))
        own = np.r_[part, ansatz.phi_slice(i)]
        pattern.append(_sd(S[..., own], matrix[np.ix_(own, own)]))
    shape = S.shape[:-2]
    return FieldErrors(
        v0=_sd(S[..., slow], matrix[slow, slow]),
        v=np.array(amplitude).reshape(len(modes), *shape),
        fluctuation=np.array(pattern).reshape(len(modes), *shape, 2),
        displacement=_sd(S, matrix),
    )


def sandwich_covariance(
    result: Result,
    reference: ArrayLike,
    deformed: ArrayLike,
    mask: NDArray[np.bool_],
    block: float,
    order: int = 5,
    soft: FloatArray | None = None,
) -> FloatArray:
    """(n, n) covariance of the unknowns by what the ansatz leaves over, its residual included.

    The images' noise is in it, too: it is in the residual. Where w has the lattice's own period
    its pushes are alike in all cells, and the blocks' independence is an assumption.

    Parameters
    ----------
    result
        Of a correlation.
    reference, deformed
        (rows, cols) f and g, as they were correlated.
    mask
        (rows, cols) pixels that counted.
    block
        Edge of the blocks [mm]: the unit cell.
    order
        Of the spline.
    soft
        Of :func:`softness`, if it is known already.

    Raises
    ------
    InputError
        If there are fewer than eight blocks.
    """
    blocks = _blocks(result, mask, block)
    pushes = _block_gradients(blocks, result, reference, deformed, order)
    if soft is None:
        soft = inverse_hessian(result, reference, deformed, mask, order)
    return _sandwich(soft, pushes)


def noise_covariance(
    result: Result,
    reference: ArrayLike,
    deformed: ArrayLike,
    noises: Iterable[tuple[ArrayLike, ArrayLike]],
    mask: NDArray[np.bool_],
    block: float,
    order: int = 5,
    soft: FloatArray | None = None,
) -> FloatArray:
    """(n, n) covariance of the unknowns by noise of any kind, from examples of it.

    For images that were filtered before they were correlated: their noise is not white any more,
    and :meth:`modeharvest.idic.result.Result.covariance` does not hold. Every example pushes the
    unknowns in every block independently; the covariance is the pushes' mean square. What the
    noise does to the gradient that w is seen with is in it.

    Parameters
    ----------
    result, reference, deformed, mask, block, order, soft
        As for :func:`model_error_covariance`.
    noises
        Examples of the noise in f and in g, (rows, cols) each, filtered as they were.
    """
    blocks = _blocks(result, mask, block)
    f, g = (np.asarray(image, dtype=np.float32) for image in (reference, deformed))
    quiet = _block_gradients(blocks, result, f, g, order)
    examples = []
    for in_f, in_g in noises:
        small_f, small_g = (_SMALL * np.asarray(n, dtype=np.float32) for n in (in_f, in_g))
        pushed = _block_gradients(blocks, result, f + small_f, g + small_g, order)
        examples.append((pushed - quiet) / _SMALL)
    if soft is None:
        soft = inverse_hessian(result, f, g, mask, order)
    return _sandwich(soft, np.vstack(examples)) / len(examples)


def hessian_corrected_covariance(
    result: Result, noise: ImageNoise | float, soft: FloatArray
) -> FloatArray:
    """(n, n) covariance by white noise in both images against the cost's own curvature.

    H⁻¹ V H⁻¹, where V = M C M are the pushes that make C = ``result.covariance(noise)`` with
    Gauss and Newton's curvature M. Where the residual is noise there is no such difference, and
    C itself is given.

    Parameters
    ----------
    result
        Of a correlation.
    noise
        Of the images, or the standard deviation of both [grey levels].
    soft
        (n, n) of :func:`softness`.
    """
    found = result.covariance(noise)
    if result.residual_test().is_white:
        return found
    kept = np.ix_(*[np.flatnonzero(np.isfinite(np.diag(result.inverse)))] * 2)
    M = (1.0 - result.noise_in_slope(ImageNoise.of(noise))) * np.linalg.inv(result.inverse[kept])
    found[kept] = soft[kept] @ M @ found[kept] @ M @ soft[kept].T
    return found


def inverse_hessian(
    result: Result,
    reference: ArrayLike,
    deformed: ArrayLike,
    mask: NDArray[np.bool_],
    order: int = 5,
) -> FloatArray:
    """(n, n) inverse of the cost's own curvature H at a result; infinite where M⁻¹ is.

    H by differences of the gradient; of large images from some of the rows, which is what the
    speckles in them are many enough for.

    Parameters
    ----------
    result, reference, deformed, mask, order
        As for :func:`model_error_covariance`.
    """
    every = int(np.clip(mask.sum() // _ENOUGH_PX, 1, 4))
    some = np.zeros_like(mask)
    some[::every] = mask[::every]
    assembly = Assembly(result.ansatz, result.grid, some)
    f = np.ascontiguousarray(reference, dtype=np.float32)
    g = SplineImage.of(np.asarray(deformed, dtype=np.float32), order)
    kept = np.flatnonzero(np.isfinite(np.diag(result.inverse)))
    matrix = np.linalg.inv(result.inverse[np.ix_(kept, kept)])
    # Steps that move the image by about _STEP_PX: rms grey levels over the rms gradient.
    gradient = np.sqrt(np.trace(matrix[:2, :2]) / max(1, result.pixels)) * result.grid.pixel_size
    steps = _STEP_PX * gradient / np.sqrt(np.diag(matrix) / max(1, result.pixels))

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


_ENOUGH_PX, _STEP_PX = 400_000, 0.002


_SMALL = np.float32(0.05)
"""Noise is made that much smaller, and its effect larger again: the linear part is wanted."""


def _blocks(result: Result, mask: NDArray[np.bool_], block: float) -> list[Assembly]:
    """The pixels of each block; InputError if there are fewer than eight."""
    grid = result.grid
    side = max(1, round(block / grid.pixel_size))
    found = []
    for top in range(0, grid.rows, side):
        for left in range(0, grid.cols, side):
            here = (slice(top, top + side), slice(left, left + side))
            if mask[here].any():
                inside = np.zeros(mask.shape, np.bool_)
                inside[here] = mask[here]
                found.append(Assembly(result.ansatz, grid, inside))
    if len(found) < _FEWEST_BLOCKS:
        raise InputError(
            f"expected at least {_FEWEST_BLOCKS} blocks of {block} mm with material, got "
            f"{len(found)}"
        )
    return found


def _block_gradients(
    blocks: list[Assembly], result: Result, reference: ArrayLike, deformed: ArrayLike, order: int
) -> FloatArray:
    """(blocks, n): the derivative of each block's share of the cost."""
    f = np.ascontiguousarray(reference, dtype=np.float32)
    g = SplineImage.of(np.asarray(deformed, dtype=np.float32), order)
    return np.array([b.images(result.unknowns, f, g, False).gradient for b in blocks])


def _sandwich(soft: FloatArray, pushes: FloatArray) -> FloatArray:
    """H⁻¹ (Σ g gᵀ) H⁻¹; infinite for unknowns that the images say nothing about."""
    lost = np.isinf(np.diag(soft))
    half = pushes @ np.where(lost[:, None] | lost[None, :], 0.0, soft)
    covariance = half.T @ half
    covariance[lost, lost] = np.inf
    return np.asarray(covariance)


def _sd(sensitivity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Square root of the diagonal of S C Sᵀ; infinite where it touches an infinite variance."""
    lost = np.isinf(np.diag(covariance))
    known = np.where(lost[:, None] | lost[None, :], 0.0, covariance)
    variance = np.einsum("...n,nm,...m->...", sensitivity, known, sensitivity, optimize=True)
    touched = np.any(sensitivity[..., lost] != 0.0, axis=-1)
    return np.asarray(np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0))))


def _open(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Two axes as an open grid; anything else as it is, like the ansatz does."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    return (x[None, :], y[:, None]) if x.ndim == y.ndim == 1 else (x, y)


@dataclass(frozen=True, eq=False)
class MatchedImages:
    """What a result was found with.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f, and g continued into its holes [grey levels].
    used
        (rows, cols) True on the pixels that count.
    order
        Of the spline.
    """

    reference: NDArray[np.float32]
    deformed: NDArray[np.float32]
    used: BoolArray
    order: int

    @classmethod
    def of(
        cls,
        result: Result,
        images: tuple[NDArray[Any], NDArray[Any]],
        masks: tuple[BoolArray | None, BoolArray | None],
        edge_px: int,
    ) -> MatchedImages:
        """Prepare the images once more as the last level of a correlation did.

        Parameters
        ----------
        result
            Of the correlation.
        images, masks
            (rows, cols) f and g, and where they show material; None if not known.
        edge_px
            Of :class:`~modeharvest.idic.setup.CorrelationOptions`.
        """
        grid, order = result.grid, result.order
        pair = level_pair(*images, grid, *masks, FULL, edge_px, order)
        used = pair.mask
        if pair.valid is not None:
            every = Assembly(result.ansatz, grid, pair.mask)
            used, _ = valid_pixels(
                every, result.unknowns, pair.reference, pair.deformed, pair.valid
            )
        row, col = np.indices(grid.shape, dtype=np.float64)
        deformed = pair.deformed.sample(row, col)[0].astype(np.float32)
        return cls(pair.reference, deformed, used, order)

    def softness(self, result: Result) -> FloatArray:
        """(n, n) H⁻¹, see :func:`~modeharvest.idic.uncertainty.covariance.inverse_hessian`."""
        return inverse_hessian(result, self.reference, self.deformed, self.used, self.order)

    def model_error_covariance(
        self, result: Result, block: float, soft: FloatArray | None = None
    ) -> FloatArray:
        """(n, n) by what the ansatz leaves over.

        Parameters
        ----------
        result
            Of the correlation.
        block, soft
            See :func:`~modeharvest.idic.uncertainty.covariance.sandwich_covariance`.
        """
        return sandwich_covariance(
            result, self.reference, self.deformed, self.used, block, self.order, soft
        )
