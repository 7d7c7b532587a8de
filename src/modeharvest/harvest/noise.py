"""The camera's noise: given, measured from repeated exposures, or estimated from one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats


@dataclass(frozen=True)
class Noise:
    """White noise of each photograph.

    Parameters
    ----------
    sd
        Standard deviation over the material [grey levels].
    source
        Where it is known from, in words.
    """

    sd: float
    source: str


def measured_noise(images: Sequence[NDArray[Any]], mask: NDArray[np.bool_]) -> Noise:
    """Measure the noise from exposures of one and the same state.

    Half the variance of what is left of one when the other has been fitted to it by a gain and
    an offset (the lamp may have flickered), pooled over neighbours in the series.

    Parameters
    ----------
    images
        Two or more of (rows, cols) [grey levels].
    mask
        (rows, cols) True on material.
    """
    halves = [0.5 * _unexplained(a[mask], b[mask]) for a, b in pairwise(images)]
    return Noise(
        float(np.sqrt(np.mean(halves))),
        f"measured from {len(images)} exposures of the reference",
    )


def _unexplained(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Variance of b - gain a - offset at the best gain and offset."""
    covariance = np.cov(a, b, dtype=np.float64)
    return float(covariance[1, 1] - covariance[0, 1] ** 2 / covariance[0, 0])


def estimated_noise(image: NDArray[Any], mask: NDArray[np.bool_]) -> Noise:
    """Estimate the noise from a single image, by what no smooth pattern shows.

    The difference of two Laplacians weighs white noise by 6 and a pattern by (k_x k_y)^2, k its
    wave number in rad/px. Too large where the speckles are of 2 px or so themselves.

    Parameters
    ----------
    image
        (rows, cols) [grey levels].
    mask
        (rows, cols) True on material.

    References
    ----------
    J. Immerkaer, Comput. Vis. Image Underst. 64 (1996), doi 10.1006/cviu.1996.0060.
    """
    second = np.array([1.0, -2.0, 1.0])
    details = ndimage.convolve(image.astype(np.float64), np.outer(second, second))
    inner = ndimage.binary_erosion(mask, iterations=2)
    sd = stats.median_abs_deviation(details[inner], scale="normal") / 6.0
    return Noise(
        float(sd), "estimated from the finest details of the reference: two exposures measure it"
    )
