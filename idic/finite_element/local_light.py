"""Light that changed otherwise than polynomials can: gain and offset from around each pixel.

Both images get the same mean and contrast in windows of many speckles. Windows average the light,
so gain and offset are found again in what is left, some times. A displacement that is off by some
pixels hardly matters, because mean and contrast are those of the same speckles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from modeharvest.util.arrays import FloatArray

WINDOW = 3.0
"""Standard deviation of the Gaussian window, over the speckle size."""
UNLIKE, ROUNDS = 4.5, 4
"""Residual over its median, 3 standard deviations of noise, beyond which pixels don't match; how
often gain and offset are found without these."""
_BINS = 4.0
"""Bins in a window's standard deviation."""
_FEW = 2e-3
"""Weight of the whole material in each window, over that of a window full of material: it alone
counts far from the material."""


def local_gain_and_offset(
    row: NDArray[Any], col: NDArray[Any], both: FloatArray, shape: tuple[int, int], width: float
) -> tuple[FloatArray, FloatArray]:
    """Gain [-] and offset [grey levels], maps of a shape (rows, cols): f = gain g + offset.

    row, col : (p,) pixels that are compared.
    both : (p, 2) f and g(x + u) there [grey levels]; g is NaN where it isn't known.
    width : standard deviation of the window [px].
    """
    bin_px = max(1, int(width / _BINS))
    bins = tuple(-(-size // bin_px) for size in shape)
    place, there = (row // bin_px) * bins[1] + col // bin_px, np.isfinite(both[:, 1])
    levels = both[there].mean(axis=0)
    f, g = (both - levels).T  # for variances without loss of digits

    def on(part: FloatArray, rows: NDArray[Any], cols: NDArray[Any]) -> FloatArray:
        at = np.broadcast_arrays((rows + 0.5) / bin_px - 0.5, (cols + 0.5) / bin_px - 0.5)
        return np.asarray(map_coordinates(part, at, mode="nearest"))

    gain, offset, lit = np.ones(bins), np.zeros(bins), g
    for _ in range(ROUNDS):
        powers = np.stack([np.ones_like(f), f, lit, f**2, lit**2])[:, there]
        sums = np.stack([np.bincount(place[there], power, bins[0] * bins[1]) for power in powers])
        few = _FEW * bin_px**2 * powers.mean(axis=1)
        around = gaussian_filter(sums.reshape(-1, *bins), (0.0, width / bin_px, width / bin_px),
                                 mode="constant") + few[:, None, None]  # fmt: skip
        mean_f, mean_g, square_f, square_g = around[1:] / around[0]
        more = np.sqrt((square_f - mean_f**2) / (square_g - mean_g**2))
        gain, offset = more * gain, more * (offset - mean_g) + mean_f
        lit = on(gain, row, col) * g + on(offset, row, col)
        left = np.abs(f - lit)
        there = left <= UNLIKE * np.nanmedian(left)
    gain, offset = (on(part, *np.ogrid[: shape[0], : shape[1]]) for part in (gain, offset))
    return gain, offset + levels[0] - gain * levels[1]
