"""Sums of products of a function of x and a function of y."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def sum_of_products(along_x: FloatArray, along_y: FloatArray) -> FloatArray:
    """Sum over k the products along_x[k] * along_y[k], which broadcast together.

    On an open grid, along_x of shape (n, 1, cols) and along_y of shape (n, rows, 1), it is a
    matrix product, and some ten times faster than going through all pixels n times.
    """
    if along_x.ndim == 3 and along_x.shape[1] == 1 and along_y.shape[2:] == (1,):
        return np.asarray(along_y[:, :, 0].T @ along_x[:, 0, :])
    total = along_x[0] * along_y[0]
    for x, y in zip(along_x[1:], along_y[1:], strict=True):
        total = total + x * y
    return np.asarray(total)
