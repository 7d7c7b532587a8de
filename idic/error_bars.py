"""Standard deviations of the fields that a correlation found: v0, v_i and v_i phi_i.

Linear propagation of the unknowns' covariance, at any positions. Two causes are kept apart:

* the images' noise, from :meth:`modeharvest.idic.result.Result.covariance`;
* what the ansatz leaves over (w): its residual pushes the unknowns about, cell by cell. Taking
  the cells' pushes for independent gives the covariance M⁻¹ (Σ_b g_b g_bᵀ) M⁻¹ with
  g_b = Σ_{x in b} Jᵀr, the "sandwich" of robust statistics with one block for a unit cell.

Sources: G. Besnard, F. Hild, S. Roux, Exp. Mech. 46 (2006), doi 10.1007/s11340-006-9824-8 (noise);
H. White, Econometrica 48 (1980), doi 10.2307/1912934 (sandwich).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.normal_equations import Assembly
from modeharvest.idic.result import Result
from modeharvest.imaging.interpolation import SplineImage

FloatArray = NDArray[np.float64]

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
        :func:`leftover_covariance` for what the ansatz leaves over. Unknowns of infinite
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


def leftover_covariance(
    result: Result,
    reference: ArrayLike,
    deformed: ArrayLike,
    mask: NDArray[np.bool_],
    block: float,
    order: int = 5,
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

    Raises
    ------
    InputError
        If there are fewer than eight blocks.
    """
    grid = result.grid
    side = max(1, round(block / grid.pixel_size))
    f = np.ascontiguousarray(reference, dtype=np.float32)
    g = SplineImage.of(np.asarray(deformed, dtype=np.float32), order)
    pushes = []
    for top in range(0, grid.rows, side):
        for left in range(0, grid.cols, side):
            inside = np.zeros_like(mask)
            here = (slice(top, top + side), slice(left, left + side))
            inside[here] = mask[here]
            if inside[here].any():
                assembly = Assembly(result.ansatz, grid, inside)
                pushes.append(assembly.images(result.unknowns, f, g, False).gradient)
    if len(pushes) < _FEWEST_BLOCKS:
        raise InputError(
            f"expected at least {_FEWEST_BLOCKS} blocks of {block} mm with material, got "
            f"{len(pushes)}"
        )
    scatter = np.array(pushes)
    lost = np.isinf(np.diag(result.inverse))
    inverse = np.where(lost[:, None] | lost[None, :], 0.0, result.inverse)
    half = scatter @ inverse
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
