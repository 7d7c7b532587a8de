"""Compare two lens distortions up to an affine map; used by distortion.py.

Photographs of a target under unknown shifts are the same for phi_S and for phi_S after any affine
map A, because A turns shifts into shifts. The difference is therefore taken after the A that makes
it smallest. Subtracting the affine parts of S instead would be wrong by some tenths of a px for an
S of 15 px over 1000 px (docs/how-to/distortion.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.distortion.lens import Distortion

FloatArray = NDArray[np.float64]

_LINES = 33
"""Number of rows and of columns of the grid on which distortions are compared."""


@dataclass(frozen=True, eq=False)
class AffineAside:
    """Difference of two distortions up to an affine map.

    Parameters
    ----------
    rms_px, largest_px
        Over the image: rms per component; largest length [px].
    difference
        (2, 33, 33) phi_found(x) - phi_truth(A x), along rows and columns, on a regular grid over
        the image [px].
    matrix, offset
        (2, 2) and (2,): A x = matrix x + offset, with x = (row, col) [px].
    """

    rms_px: float
    largest_px: float
    difference: FloatArray
    matrix: FloatArray
    offset: FloatArray


def affine_aside(found: Distortion, truth: Distortion, shape: tuple[int, int]) -> AffineAside:
    """Compare two distortions up to an affine map, over an image of ``shape`` (rows, cols) [px]."""
    axes = [np.linspace(0.0, n - 1.0, _LINES) for n in shape]
    row, col = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    seen = np.stack(found.observed(row, col))
    terms = np.stack([np.ones(row.size), row, col])
    affine = np.eye(2, 3, 1)
    for _ in range(6):  # Gauss-Newton, from the identity
        at = affine @ terms
        misfit = np.stack(truth.observed(*at)) - seen
        slope = truth.gradient(*at) + np.eye(2)[:, :, None]
        columns = np.einsum("ijn,kn->injk", slope, terms).reshape(2 * row.size, 6)
        step = np.linalg.lstsq(columns, -misfit.ravel(), rcond=None)[0]
        affine = affine + step.reshape(2, 3)
    misfit = seen - np.stack(truth.observed(*(affine @ terms)))
    return AffineAside(
        rms_px=float(np.sqrt(np.mean(misfit**2))),
        largest_px=float(np.hypot(*misfit).max()),
        difference=misfit.reshape(2, _LINES, _LINES),
        matrix=affine[:, 1:],
        offset=affine[:, 0],
    )
