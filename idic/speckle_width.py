"""How wide a speckle is, from an image of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from modeharvest.idic.pyramid import eroded

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

_LONGEST = 64
"""Lags looked at [px]."""
_EDGE_PX = 3
"""Pixels closer than this to an edge show some of what is beyond it."""
_LINES = 256
"""Rows, and columns, that are enough: neighbouring ones say nearly the same."""


def speckle_width(image: NDArray[Any], mask: BoolArray | None = None) -> float:
    """Full width at half maximum of the autocorrelation of an image's material [px].

    Parameters
    ----------
    image
        (rows, cols) grey levels.
    mask
        (rows, cols) True on material; None for everywhere.

    Returns
    -------
    float
        At most twice the largest lag looked at, 128 px; that for an image without contrast, too.
    """
    mask = np.ones(image.shape, dtype=np.bool_) if mask is None else mask
    inner = eroded(mask, _EDGE_PX)
    inner = inner if inner.any() else mask
    curve = 0.5 * (_autocorrelation(image, inner) + _autocorrelation(image.T, inner.T))
    below = int(np.argmax(curve < 0.5))
    if below == 0:
        return 2.0 * _LONGEST
    fraction = (curve[below - 1] - 0.5) / (curve[below - 1] - curve[below])
    return float(2.0 * (below - 1 + fraction))


def _autocorrelation(image: NDArray[Any], inner: BoolArray) -> FloatArray:
    """(_LONGEST,) along the rows, over pairs of pixels that are both inside."""
    lines = np.flatnonzero(inner.any(axis=1))
    lines = lines[:: len(lines) // _LINES + 1]
    values, weights = image[lines], inner[lines]
    level = values[weights].mean(dtype=np.float64) if weights.any() else 0.0
    shown = np.where(weights, values - np.float32(level), np.float32(0.0))
    n = fft.next_fast_len(shown.shape[1] + _LONGEST, real=True)
    products, pairs = _lagged(shown, n), _lagged(weights, n)
    means = products / np.maximum(pairs, 1.0)
    return np.asarray(means / means[0] if means[0] > 0.0 else np.ones(_LONGEST))


def _lagged(values: NDArray[Any], n: int) -> FloatArray:
    """(_LONGEST,) sums over an image of products of pixels that lag along its rows."""
    part = fft.rfft(values.astype(np.float32), n, axis=1)
    power = (part.real**2 + part.imag**2).sum(axis=0, dtype=np.float64)
    return np.asarray(fft.irfft(power, n)[:_LONGEST])
