"""What becomes of white noise where a blurred image is sampled between its pixels."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from modeharvest.imaging.interpolation import SplineImage

_FINE = 16
"""Samples per px of the response to a single noisy pixel."""


def sampled_noise(blur_px: float, order: int, stride_px: float) -> tuple[float, float]:
    """Variance of a sample, and of the mean of many samples, of white noise of variance 1.

    Parameters
    ----------
    blur_px
        Standard deviation of the blur before the spline [px].
    order
        Of the spline, 3 or 5.
    stride_px
        Distance between samples along rows and columns [px].

    Returns
    -------
    one, many
        Mean variance of a sample over all positions between pixels; and that times how much
        neighbouring samples have in common: the variance that a field sees that varies slowly
        from sample to sample. ``many`` is 1 for a stride of 1 px: no information is lost there.
    """
    reach = int(np.ceil(16 + 6 * blur_px))
    impulse = np.zeros((24, 2 * reach + 1))
    impulse[:, reach] = 1.0  # a line, so that the other axis has no say
    if blur_px > 0.0:
        impulse = ndimage.gaussian_filter1d(impulse, blur_px, axis=1)
    along = np.arange(2 * reach * _FINE) / _FINE
    response, _, _ = SplineImage.of(impulse, order, np.float64).sample(12.0, along)
    lags = np.arange(-int(reach / stride_px), int(reach / stride_px) + 1) * stride_px
    shifted = np.interp(along + lags[:, None], along, response, left=0.0, right=0.0)
    correlations = shifted @ response / _FINE
    one = float(correlations[lags.size // 2])
    return one**2, float(correlations.sum()) ** 2
