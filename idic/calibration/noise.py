"""What becomes of white noise where a blurred image is sampled between its pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
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
    lags, correlations = _correlations(blur_px, order, stride_px)
    one = float(correlations[lags == 0.0].sum())
    return one**2, float(correlations.sum()) ** 2


def undistorted_noise(order: int = 5) -> tuple[float, float]:
    """Variance of white noise of variance 1 in an undistorted image, and where that is sampled.

    The residual of a correlation of two undistorted images holds the first of f and the second of
    g: its variance is their sum times that of the camera's noise. The unknowns see slower waves,
    of which no noise is lost: their covariance is that of the camera's noise itself.

    Parameters
    ----------
    order
        Of both splines, 3 or 5.
    """
    _, correlations = _correlations(0.0, order, 1.0)
    once = float(correlations.max())
    # Sampling noise with correlations R at a phase that is anything: sum over lags of R R.
    return once**2, float((correlations**2).sum()) ** 2


def _correlations(
    blur_px: float, order: int, stride_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lags [px] along an axis, and covariances of sampled noise at them."""
    reach = int(np.ceil(16 + 6 * blur_px))
    impulse = np.zeros((24, 2 * reach + 1))
    impulse[:, reach] = 1.0  # a line, so that the other axis has no say
    if blur_px > 0.0:
        impulse = ndimage.gaussian_filter1d(impulse, blur_px, axis=1)
    along = np.arange(2 * reach * _FINE) / _FINE
    response, _, _ = SplineImage.of(impulse, order, np.float64).sample(12.0, along)
    count = int(reach / stride_px)
    lags = stride_px * np.arange(-count, count + 1, dtype=np.float64)
    shifted = np.interp(along + lags[:, None], along, response, left=0.0, right=0.0)
    correlations: NDArray[np.float64] = shifted @ response / _FINE
    return lags, correlations
