"""Binning and Gaussian blur of images, compiled: what a pyramid is made of.

Every output row is made on its own, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.imaging.compiled import compiled, readable

BoolArray = NDArray[np.bool_]
Float32Image = NDArray[np.float32]

_ENDS = 4.0
"""Standard deviations after which the Gaussian is cut off."""


def binned(
    image: Float32Image, weight: BoolArray | None, factor: int
) -> tuple[Float32Image, Float32Image]:
    """Means over blocks; incomplete blocks at the right and at the bottom are dropped.

    Parameters
    ----------
    image
        (rows, cols) float32 grey levels.
    weight
        (rows, cols) True where they count; None for everywhere.
    factor
        Edge of the blocks [px].

    Returns
    -------
    mean, share
        (rows // factor, cols // factor): mean of grey level times weight, and mean of weight.
    """
    weight = np.ones(image.shape, dtype=np.bool_) if weight is None else weight
    shape = image.shape[0] // factor, image.shape[1] // factor
    mean, share = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    _bin(readable(image), readable(weight), factor, mean, share)
    return mean, share


def blurred(image: Float32Image, sigma: float) -> Float32Image:
    """Blur with a Gaussian; the outermost pixels are repeated beyond the border.

    Parameters
    ----------
    image
        (rows, cols) float32.
    sigma
        Standard deviation [px]; 0 gives the image as it is.
    """
    if sigma == 0:
        return image
    reach = int(_ENDS * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    weights /= weights[0] + 2.0 * weights[1:].sum()
    out = np.empty_like(image)
    _blur(readable(image), weights.astype(np.float32), out)
    return out


@compiled(parallel=True, relaxed=True)
def _bin(image: Any, weight: Any, factor: int, mean: Any, share: Any) -> None:
    rows, cols = mean.shape
    size = np.float32(1.0 / (factor * factor))
    for i in prange(rows):
        along, count = np.zeros(cols * factor, np.float32), np.zeros(cols * factor, np.float32)
        for row in range(i * factor, (i + 1) * factor):
            for j in range(cols * factor):
                # Not a product: what lies outside the material may be anything.
                along[j] += image[row, j] if weight[row, j] else np.float32(0.0)
                count[j] += np.float32(weight[row, j])
        for j in range(cols):
            total, number = np.float32(0.0), np.float32(0.0)
            for k in range(j * factor, (j + 1) * factor):
                total += along[k]
                number += count[k]
            mean[i, j], share[i, j] = total * size, number * size


@compiled(parallel=True, relaxed=True)
def _blur(image: Any, weights: Any, out: Any) -> None:
    rows, cols = image.shape
    reach = weights.size - 1
    for i in prange(rows):
        line = np.empty(cols + 2 * reach, np.float32)
        middle, own = line[reach : reach + cols], image[i]
        for j in range(cols):
            middle[j] = weights[0] * own[j]
        for k in range(1, reach + 1):
            up, down, w = image[max(0, i - k)], image[min(rows - 1, i + k)], weights[k]
            for j in range(cols):
                middle[j] += w * (up[j] + down[j])
        line[:reach], line[reach + cols :] = middle[0], middle[cols - 1]
        to = out[i]
        for j in range(cols):
            to[j] = weights[0] * middle[j]
        for k in range(1, reach + 1):
            before, after, w = line[reach - k :], line[reach + k :], weights[k]
            for j in range(cols):
                to[j] += w * (before[j] + after[j])
