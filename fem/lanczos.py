"""Lanczos' method in blocks, for many Hermitian eigenproblems of one size at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.copies import Batch

FloatArray = NDArray[np.float64]
Operator = Callable[[Batch], Batch]

_LARGEST_SPACE = 60  # in blocks


def largest(
    solve: Operator, weigh: Operator, start: Batch, fixed: Batch, tolerance: float
) -> tuple[FloatArray, Batch]:
    """The largest eigenvalues of A^-1 M, as many for each problem as ``start`` has vectors.

    Every new block is made orthogonal to all others: there are few.

    Parameters
    ----------
    solve, weigh
        A^-1 and M, both positive definite, applied to batches (size, w, m).
    start
        (size, w, m) to begin with.
    fixed
        (size, w, f) M-orthonormal vectors to be left out of the space.
    tolerance
        About the relative error of the eigenvalues that is allowed.

    Returns
    -------
    values, vectors
        (w, m) descending, and (size, w, m) M-orthonormal.
    """
    count, width = start.shape[2], start.shape[1]
    images, spaces = [weigh(fixed)], [fixed]
    block = start - _mixed(fixed, _products(images[0], start))
    block, image, _ = _orthonormal(block, weigh)
    projected: Batch = np.zeros((width, 0, 0))
    for _ in range(_LARGEST_SPACE):
        spaces.append(block)
        images.append(image)
        block = solve(image)
        columns = [_products(weighted, block) for weighted in images]
        for vectors, column in zip(spaces, columns, strict=True):
            block = block - _mixed(vectors, column)
        projected = _bordered(projected, np.concatenate(columns[1:], axis=1))
        block, image, rest = _orthonormal(block, weigh)
        values, mix = np.linalg.eigh(projected)
        values, mix = values[:, ::-1][:, :count], mix[:, :, ::-1][:, :, :count]
        residual = np.linalg.norm(rest @ mix[:, -count:], axis=1)
        if np.all(residual**2 <= tolerance * values**2):
            break
    parts = np.split(mix, len(spaces) - 1, axis=1)
    found = sum(_mixed(vectors, part) for vectors, part in zip(spaces[1:], parts, strict=True))
    return values, np.asarray(found)


def _products(left: Batch, right: Batch) -> Batch:
    """(w, i, j) left_i^H right_j."""
    return np.asarray(np.einsum("nwi,nwj->wij", left.conj(), right))


def _mixed(vectors: Batch, factors: Batch) -> Batch:
    """(size, w, j) sum of vectors_i factors_ij."""
    return np.asarray(np.einsum("nwi,wij->nwj", vectors, factors))


def _orthonormal(block: Batch, weigh: Operator) -> tuple[Batch, Batch, Batch]:
    """The block made M-orthonormal, its image by M, and R with block = orthonormal . R."""
    image = weigh(block)
    R = np.linalg.cholesky(_products(block, image)).conj().transpose(0, 2, 1)
    inverse = np.linalg.inv(R)
    return _mixed(block, inverse), _mixed(image, inverse), R


def _bordered(projected: Batch, column: Batch) -> Batch:
    """The projected matrices with one block column more, Hermitian."""
    old, new = projected.shape[1], column.shape[1]
    result = np.zeros((len(column), new, new), dtype=column.dtype)
    result[:, :old, :old] = projected
    result[:, :, old:] = column
    result[:, old:, :old] = column[:, :old].conj().transpose(0, 2, 1)
    return result
