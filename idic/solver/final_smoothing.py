"""Final smoothing: the last level's blur where the model error is large for the speckle size.

A correlation weighs the model error w by the grey-level gradient, as long as w is short compared
with a speckle. Beyond that the grey levels carry no more information, parts of the image that match
badly lose their weight, and the result moves away from the best fit of the ansatz. Speckles that
are much finer than w is long have to be blurred first. The price is more noise, of which there is
little compared with w.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from modeharvest.idic.solver.pyramid import eroded, locally_normalised, smoothed
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage

_LONGEST = 64
"""Lags of the autocorrelation [px]."""
_SPECKLE_EDGE_PX = 3
"""Pixels closer than this to an edge show some of what is beyond it."""
_LINES = 256
"""Rows, and columns, that are used: neighbouring ones show nearly the same."""


def speckle_size(image: NDArray[Any], mask: BoolArray | None = None) -> float:
    """Full width at half maximum of the autocorrelation of an image's material [px].

    The mask (rows, cols) is True on material; None for everywhere. The size is at most twice the
    largest lag, 128 px, which is also that of an image without contrast.
    """
    mask = np.ones(image.shape, dtype=np.bool_) if mask is None else mask
    interior = eroded(mask, _SPECKLE_EDGE_PX)
    interior = interior if interior.any() else mask
    curve = 0.5 * (_autocorrelation(image, interior) + _autocorrelation(image.T, interior.T))
    below = int(np.argmax(curve < 0.5))
    if below == 0:
        return 2.0 * _LONGEST
    fraction = (curve[below - 1] - 0.5) / (curve[below - 1] - curve[below])
    return float(2.0 * (below - 1 + fraction))


def spline_order(speckle_size_px: float) -> int:
    """Order of the spline for a speckle of this size [px]: 5, or 11 if narrower than 6.5 px."""
    return 5 if speckle_size_px >= 6.5 else 11


def _autocorrelation(image: NDArray[Any], interior: BoolArray) -> FloatArray:
    """(_LONGEST,) autocorrelation along the rows, over pairs of pixels that are both inside."""
    lines = np.flatnonzero(interior.any(axis=1))
    lines = lines[:: len(lines) // _LINES + 1]
    values, weights = image[lines], interior[lines]
    level = values[weights].mean(dtype=np.float64) if weights.any() else 0.0
    shown = np.where(weights, values - np.float32(level), np.float32(0.0))
    n = fft.next_fast_len(shown.shape[1] + _LONGEST, real=True)
    products, pairs = _lagged(shown, n), _lagged(weights, n)
    means = products / np.maximum(pairs, 1.0)
    return np.asarray(means / means[0] if means[0] > 0.0 else np.ones(_LONGEST))


def _lagged(values: NDArray[Any], n: int) -> FloatArray:
    """(_LONGEST,) sums over an image of products of pixels a lag apart along its rows."""
    part = fft.rfft(values.astype(np.float32), n, axis=1)
    power = (part.real**2 + part.imag**2).sum(axis=0, dtype=np.float64)
    return np.asarray(fft.irfft(power, n)[:_LONGEST])


WIDTHS = 6.0
"""Least width of speckles over the rms of w per component. In the paper's virtual experiment
(speckles of 12.2 px, w of 2.0 px) nothing has to be blurred."""
AROUND = 2.0
"""Width over which local mean and contrast are taken [blurs]: nearly a single speckle."""
_LEAST_BLUR = 1.0
"""Blurs of less than this change nothing [px]."""
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclass(frozen=True)
class FinalSmoothing:
    """The blur of the images that the last level compares."""

    speckle_size_px: float
    """Full width at half maximum of the speckle's autocorrelation [px]."""
    model_error_px: float
    """Estimate of w on a coarser level, rms per component [px]."""
    blur_px: float
    """Standard deviation of the blur [px]; 0 for none."""

    @classmethod
    def of(cls, pair: ImagePair, model_error_px: float) -> FinalSmoothing:
        """Choose the blur that makes speckles as wide as the model error needs."""
        size = speckle_size(pair.reference, pair.mask)
        wanted = (WIDTHS * model_error_px) ** 2 - size**2
        # Widths of Gaussians add up in squares; a blur of s widens an autocorrelation by sqrt(2) s.
        blur = float(np.sqrt(max(0.0, wanted / 2.0)) / _FWHM)
        return cls(size, model_error_px, blur if blur >= _LEAST_BLUR else 0.0)

    @classmethod
    def given(cls, pair: ImagePair, blur_px: float) -> FinalSmoothing:
        """Make the smoothing of a given blur, without an estimate of the model error."""
        return cls(speckle_size(pair.reference, pair.mask), np.nan, blur_px)

    @property
    def text(self) -> str:
        """The smoothing in words."""
        start = (
            f"The speckle size (autocorrelation) is {self.speckle_size_px:.1f} px, the model error "
            f"about {self.model_error_px:.2g} px"
        )
        if self.blur_px == 0.0:
            return f"{start}: the correlation ends on the unfiltered images."
        return (
            f"{start}, too much for such fine speckles: the correlation ends on images blurred "
            f"by {self.blur_px:.1f} px, with a local mean of 0 and a local contrast of 1."
        )


def smoothed_pair(pair: ImagePair, blur_px: float) -> ImagePair:
    """Both images blurred over their material and locally normalised, in f's grey levels.

    The blur's standard deviation is in px; 0 gives the pair itself.
    """
    if blur_px == 0.0:
        return pair
    contrast = contrast_after(pair.reference, pair.mask, blur_px)
    f, g = (
        contrast * locally_normalised(smoothed(image, mask, blur_px), blur_px, AROUND)
        for image, mask in ((pair.reference, pair.mask), (pair.deformed, pair.deformed_mask))
    )
    return pair.with_images(f, g)


def contrast_after(image: FloatImage, mask: BoolArray | None, blur_px: float) -> np.float32:
    """Standard deviation that a speckle has after a blur [grey levels]."""
    interior = np.ones(image.shape, np.bool_) if mask is None else mask
    reach = eroded(interior, int(np.ceil(3.0 * blur_px)))
    smooth = ndimage.gaussian_filter(np.asarray(image, dtype=np.float32), blur_px)
    return np.float32(smooth[reach if reach.any() else interior].std(dtype=np.float64))
