"""How precise subset DIC is, told from the grey levels that it leaves over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.fields.local_field import LocalField
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def predicted_sd(
    reference: NDArray[Any],
    mask: BoolArray,
    grid: PixelGrid,
    field: LocalField,
    correlation: FloatArray,
    subset_px: int,
) -> FloatArray:
    """Standard deviations that the grey levels left over predict, (n, 2) [mm].

    The zero-normalised correlation C of a subset tells what is left between its two images,
    2 (1 − C) of their variance. Were it white noise, the displacement's covariance would be that
    times (Σ ∇f ∇fᵀ)⁻¹ over the subset. Much of it is not white: it is what an affine subset can't
    follow, and is alike over a speckle. It is counted as one independent value per
    ``speckle_area`` pixels, the area of f's autocorrelation.

    Parameters
    ----------
    reference
        (rows, cols) f.
    mask
        (rows, cols) True on material.
    grid
        The pixels.
    field
        The subsets' centres.
    correlation
        (n,) C of each [-]; NaN where lost.
    subset_px
        Edge of a subset [px].
    """
    f = np.where(mask, np.asarray(reference, np.float64) - float(reference[mask].mean()), 0.0)

    def summed(image: FloatArray) -> FloatArray:
        return np.asarray(ndimage.uniform_filter(image, subset_px, mode="constant")) * subset_px**2

    down, right = np.gradient(f)
    down, right = np.where(mask, down, 0.0), np.where(mask, right, 0.0)
    row, col = (np.rint(i).astype(int) for i in grid.to_px(field.x, field.y))
    xx, xy, yy, count, one, two = (
        summed(i)[row, col] for i in (right**2, right * down, down**2, mask.astype(float), f, f**2)
    )
    variance = np.maximum(two / count - (one / count) ** 2, 0.0)
    left = 2.0 * np.clip(1.0 - correlation, 0.0, None) * variance * speckle_area(f, mask)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = xx * yy - xy**2
        cov = left[:, None] * np.column_stack([yy, xx]) / determinant[:, None]
        return np.asarray(grid.pixel_size * np.sqrt(cov))


def speckle_area(image: FloatArray, mask: BoolArray) -> float:
    """Area of the autocorrelation of a mean-free image over a mask, to its half height [px]."""
    size = 32
    product = np.zeros(size)
    for k in range(size):
        both = mask[:, k:] & mask[:, : mask.shape[1] - k]
        product[k] = float(np.mean((image[:, k:] * image[:, : image.shape[1] - k])[both]))
    below = np.flatnonzero(product < 0.5 * product[0])
    radius = float(below[0]) if len(below) else float(size)
    return float(max(1.0, np.pi * radius**2))
