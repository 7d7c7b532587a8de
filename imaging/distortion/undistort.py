"""Images freed from an optical distortion, ideal points of distorted pixels, affine parts.

f(phi_S(x)) of the paper's Eq. (r2) is :func:`undistorted`: each image is resampled once on the
ideal pixel grid, and a correlation of such images needs to know nothing of the lens.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.distortion.lens import Distortion, PolynomialDistortion
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

Positions = tuple[FloatArray, FloatArray]
"""(row, col) [px], both of one shape."""
_BAND = 64
"""Rows that are resampled, or inverted, in one go."""


def undistorted(image: ArrayLike, distortion: Distortion, order: int = 5) -> NDArray[np.float32]:
    """Free an image (rows, cols) from its distortion: f(phi_S(x)) at pixels x of the ideal grid.

    Where phi_S leaves the photograph, the grey level is that of its nearest pixel, and
    :func:`undistorted_mask` is False. ``order`` is of the B-spline that interpolates the
    photograph. InputError if the image isn't two-dimensional, or there is no such order.
    """
    spline = SplineImage.of(image, order)
    rows, cols = spline.shape
    result = np.empty(spline.shape, dtype=np.float32)
    for first in range(0, rows, _BAND):
        row, col = _observed_from(distortion, spline.shape, slice(first, first + _BAND))
        np.clip(row, 0, rows - 1, out=row)
        np.clip(col, 0, cols - 1, out=col)
        result[first : first + _BAND] = spline.sample(row, col)[0]
    return result


def undistorted_mask(mask: ArrayLike, distortion: Distortion) -> NDArray[np.bool_]:
    """Free a mask (rows, cols) from the distortion: that of the photograph's nearest pixel.

    All True gives the pixels of the ideal grid that were photographed. InputError if not plane.
    """
    inside = np.asarray(mask, dtype=np.bool_)
    if inside.ndim != 2:
        raise InputError(f"expected a mask of shape (rows, cols), got {inside.shape}")
    rows, cols = inside.shape
    result = np.zeros(inside.shape, dtype=np.bool_)
    for first in range(0, rows, _BAND):
        band = slice(first, first + _BAND)
        row, col = _observed_from(distortion, inside.shape, band)
        kept = (row >= 0) & (row <= rows - 1) & (col >= 0) & (col <= cols - 1)
        i, j = (np.rint(a[kept]).astype(np.intp) for a in (row, col))
        result[band][kept] = inside[i, j]
    return result


def _observed_from(distortion: Distortion, shape: tuple[int, ...], band: slice) -> Positions:
    """phi_S at the pixels of some rows."""
    row = np.arange(shape[0], dtype=np.float64)[band, None]
    col = np.arange(shape[1], dtype=np.float64)[None, :]
    return distortion.observed(row, col)


_DEGREE = 9
_NEGLIGIBLE_PX = 1e-12


def ideal_points(distortion: Distortion, shape: tuple[int, int]) -> Positions:
    """Ideal positions, each (rows, cols) [px], that the pixels show; InputError if S folds."""
    row, col = np.ogrid[: shape[0], : shape[1]]
    strips = [slice(k, k + _BAND) for k in range(0, shape[0], _BAND)]
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        found = list(pool.map(lambda strip: distortion.ideal(row[strip], col), strips))
    return np.concatenate([r for r, _ in found]), np.concatenate([c for _, c in found])


def without_affine(distortion: Distortion, shape: tuple[int, int]) -> PolynomialDistortion:
    """The same distortion without its affine part over images of (rows, cols) px, as a polynomial.

    The terms 1, xi, eta of its Chebyshev series over the image are left out, and those of the
    highest degrees where they are negligible; exact for lenses that are polynomials of degree 9
    or less (those of k1 ... k3, p1, p2).
    """
    nodes = chebyshev.chebpts1(_DEGREE + 1)
    row, col = (0.5 * (n - 1) * (1.0 + nodes) for n in shape)
    fields = distortion.shift(row[:, None], col[None, :])
    transform = chebyshev.chebvander(nodes, _DEGREE) * 2.0 / (_DEGREE + 1)
    transform[:, 0] *= 0.5
    series = [transform.T @ np.broadcast_to(f, (nodes.size,) * 2) @ transform for f in fields]
    orders = PolynomialDistortion.orders(_DEGREE)
    coefficients = np.array([[s[j, i] for i, j in orders] for s in series])
    coefficients[:, :3] = 0.0
    is_large = np.abs(coefficients).max(axis=0) > _NEGLIGIBLE_PX
    degree = int(np.max(np.sum(orders, axis=1)[is_large], initial=0))
    return PolynomialDistortion(shape, coefficients[:, : PolynomialDistortion.size_of(degree)])
