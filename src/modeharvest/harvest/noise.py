"""The camera's noise: given, measured from repeated exposures, or estimated from one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from modeharvest.errors import InputError

_OTHER_STATE = 0.25
"""Share of an exposure's variance that noise alone can hardly make: speckle has far more."""
_MOVED = 2.0
"""Times the noise that a single image shows, beyond which motion is the likelier cause."""


GIVEN = "given"
"""Source of a noise that the experiment's file states."""


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
        Two or more of (rows, cols) [grey levels], the reference first.
    mask
        (rows, cols) True on material.

    Raises
    ------
    InputError
        If two exposures have so little in common that they are of different states.
    """
    halves = []
    for number, (a, b) in enumerate(pairwise(images), start=1):
        left, there = _unexplained(a[mask], b[mask]), float(b[mask].var(dtype=np.float64))
        if left > _OTHER_STATE * there:
            raise InputError(
                "images.repeats: expected exposures of the reference's state, got number "
                f"{number}, {100 * left / there:.0f} % of whose variance the exposure before "
                f"doesn't explain (a noise of {np.sqrt(0.5 * left):.3g} grey levels); leave it out"
            )
        halves.append(0.5 * left)
    sd, seen = float(np.sqrt(np.mean(halves))), estimated_noise(images[0], mask).sd
    source = f"measured from {len(images)} exposures of the reference"
    if sd > _MOVED * seen:
        source += (
            f"; the reference's finest details show {seen:.2g} grey levels only: if anything "
            "moved between the exposures, leave the repeats out"
        )
    return Noise(sd, source)


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
