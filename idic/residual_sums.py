"""The compiled sums over a residual image from which its agreement with noise is judged.

NaN is where no pixel counts. Each row, or row of blocks, is summed on its own, so the result does
not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from modeharvest.imaging.compiled import compiled


@compiled(parallel=True, relaxed=True)
def lagged_products(residual: Any, lags: Any, products: Any, counts: Any) -> None:
    """Sum residual times residual a lag further on, row by row.

    Parameters
    ----------
    residual
        (rows, cols).
    lags
        (k,) [px].
    products, counts
        (rows, 2, k) to fill: sums and numbers of pairs, down the columns and along the rows.
    """
    rows, cols = residual.shape
    for i in prange(rows):
        own = residual[i]
        first, last = 0, cols
        while first < last and np.isnan(own[first]):
            first += 1
        while first < last and np.isnan(own[last - 1]):
            last -= 1
        own = own[first:last]
        for k in range(lags.size):
            lag = lags[k]
            if i + lag < rows:
                below = residual[i + lag, first:last]
                _products(own, below, last - first, products[i, 0], counts[i, 0], k)
            _products(own, own[lag:], last - first - lag, products[i, 1], counts[i, 1], k)


@compiled(inline=True, relaxed=True)
def _products(one: Any, other: Any, n: int, products: Any, counts: Any, k: int) -> None:
    total, count = 0.0, 0.0
    for j in range(n):
        product = float(one[j] * other[j])
        pair = 0.0 if np.isnan(product) else 1.0
        total += product if pair > 0.0 else 0.0
        count += pair
    products[k], counts[k] = total, count


@compiled(parallel=True, relaxed=True)
def block_moments(f: Any, residual: Any, size: int, sums: Any) -> None:
    """Sum 1, f, g, f g, f f and g g with g = f - residual over blocks of pixels.

    Parameters
    ----------
    f, residual
        (rows, cols).
    size
        Edge of the blocks [px].
    sums
        (block rows, block columns, 6) to fill; blocks at the right and at the bottom may be
        incomplete.
    """
    rows, cols = f.shape
    for block_row in prange(sums.shape[0]):
        for block_col in range(sums.shape[1]):
            n, s_f, s_g, s_fg, s_ff, s_gg = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            first, last = block_col * size, min(cols, (block_col + 1) * size)
            for i in range(block_row * size, min(rows, (block_row + 1) * size)):
                for j in range(first, last):
                    r = float(residual[i, j])
                    if not np.isnan(r):
                        a = float(f[i, j])
                        b = a - r
                        n += 1.0
                        s_f += a
                        s_g += b
                        s_fg += a * b
                        s_ff += a * a
                        s_gg += b * b
            to = sums[block_row, block_col]
            to[0], to[1], to[2], to[3], to[4], to[5] = n, s_f, s_g, s_fg, s_ff, s_gg
