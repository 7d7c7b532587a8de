"""A deformed image brought back to the reference's frame by a displacement that was measured.

With it a sequence can be correlated image by image: g_k against g_(k-1) at x + u_(k-1), which
takes the reference's place. The unknowns stay those of the whole displacement, so there is
nothing to add up, and the ansatz and its taper stay where they are; what one image loses,
however, the next ones inherit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.result import Result
from modeharvest.imaging.interpolation import SplineImage

_BAND = 64
"""Rows at a time, so that little memory is needed."""


def pulled_back(
    deformed: NDArray[Any], result: Result, order: int = 5
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Show a deformed image in the frame of the reference.

    Parameters
    ----------
    deformed
        (rows, cols) g [grey levels].
    result
        The measured displacement, and gain and offset if they were unknowns.
    order
        Of the spline, 3 or 5.

    Returns
    -------
    image, seen
        (rows, cols) (1 + b) g(x + u) + c, and where x + u lies inside the image.
    """
    grid, ansatz, a = result.grid, result.ansatz, result.unknowns
    spline = SplineImage.of(np.asarray(deformed, dtype=np.float32), order)
    image = np.empty(grid.shape, dtype=np.float32)
    col = np.arange(grid.cols)
    for first in range(0, grid.rows, _BAND):
        band = slice(first, min(first + _BAND, grid.rows))
        u = result.ansatz.displacement(a, grid.x, grid.y[band]) / grid.pixel_size
        row = np.arange(band.start, band.stop)[:, None]
        value, _, _ = spline.sample(row - u[..., 1], col + u[..., 0])
        gain, offset = ansatz.gain_and_offset(a, grid.x, grid.y[band])
        image[band] = gain * value + offset
    seen = np.isfinite(image)
    image[~seen] = 0.0
    return image, seen
