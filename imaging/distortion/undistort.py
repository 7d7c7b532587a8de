"""Images freed from an optical distortion, and the kinds of distortion.

f(phi_S(x)) of the paper's Eq. (r2) is :func:`undistorted`: each image is resampled once on the
ideal pixel grid, and a correlation of such images needs to know nothing of the lens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.distortion.camera import CameraDistortion
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.distortion.polynomial import PolynomialDistortion
from modeharvest.imaging.distortion.sampled import SampledDistortion
from modeharvest.imaging.interpolation import SplineImage

__all__ = [
    "CameraDistortion",
    "PolynomialDistortion",
    "SampledDistortion",
    "undistorted",
    "undistorted_mask",
]

FloatArray = NDArray[np.float64]

_BAND = 64
"""Rows that are resampled in one go."""


def undistorted(image: ArrayLike, distortion: Distortion, order: int = 5) -> NDArray[np.float32]:
    """Free an image from its distortion: f(phi_S(x)) at every pixel x of the ideal grid.

    Parameters
    ----------
    image
        (rows, cols) grey levels as photographed.
    distortion
        Of the lens.
    order
        Of the B-spline that interpolates the photograph: 5 or 3.

    Returns
    -------
    (rows, cols) grey levels. Where phi_S leaves the photograph, that of its nearest pixel;
    :func:`undistorted_mask` is False there.

    Raises
    ------
    InputError
        If the image isn't two-dimensional, or the order neither 3 nor 5.
    """
    spline = SplineImage.of(image, order)
    rows, cols = spline.shape
    result = np.empty(spline.shape, dtype=np.float32)
    for first in range(0, rows, _BAND):
        row, col = _seen_from(distortion, spline.shape, slice(first, first + _BAND))
        np.clip(row, 0, rows - 1, out=row)
        np.clip(col, 0, cols - 1, out=col)
        result[first : first + _BAND] = spline.sample(row, col)[0]
    return result


def undistorted_mask(mask: ArrayLike, distortion: Distortion) -> NDArray[np.bool_]:
    """Free a mask from the distortion: what the nearest pixel of the photograph's mask says.

    Parameters
    ----------
    mask
        (rows, cols) True on material, as photographed. All True gives the pixels of the ideal
        grid that were photographed at all.
    distortion
        Of the lens.

    Raises
    ------
    InputError
        If the mask is not plane.
    """
    inside = np.asarray(mask, dtype=np.bool_)
    if inside.ndim != 2:
        raise InputError(f"expected a mask of shape (rows, cols), got {inside.shape}")
    rows, cols = inside.shape
    result = np.zeros(inside.shape, dtype=np.bool_)
    for first in range(0, rows, _BAND):
        band = slice(first, first + _BAND)
        row, col = _seen_from(distortion, inside.shape, band)
        kept = (row >= 0) & (row <= rows - 1) & (col >= 0) & (col <= cols - 1)
        i, j = (np.rint(a[kept]).astype(np.intp) for a in (row, col))
        result[band][kept] = inside[i, j]
    return result


def _seen_from(
    distortion: Distortion, shape: tuple[int, ...], band: slice
) -> tuple[FloatArray, FloatArray]:
    """phi_S at the pixels of some rows."""
    row = np.arange(shape[0], dtype=np.float64)[band, None]
    col = np.arange(shape[1], dtype=np.float64)[None, :]
    return distortion.observed(row, col)
