"""Images ready for finite-element DIC up to the edges of the material.

Near an edge the spline through the deformed image reads pixels beyond it. What continues the
material there is what errors at edges are made of: a masked blur, a polynomial of degree 0, leaves
0.075 px within 10 px of the demo's edges, one of degree 2 leaves 0.028 px, without leaving out any
pixel of the material.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.solver.pyramid import FULL, Level, LevelPair, level_pair
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.compiled import compiled, readable

_REACH_PX = 4
"""How far beyond the material pixels are continued by polynomials."""
_SIGMA_PX = 1.5
"""Of the Gaussian that weighs the material's pixels for that."""
_WINDOW_PX = 6
_RIDGE = 1e-3
"""Against polynomials that too few pixels determine, of the sum of weights."""


def images_on(pair: ImagePair, level: Level, edge_px: int, order: int) -> LevelPair:
    """Make one level of a pair of images; on the finest, g continued by quadratic polynomials.

    Parameters
    ----------
    pair, level
        As for :func:`modeharvest.idic.solver.pyramid.level_pair`.
    edge_px
        Pixels closer than this to the mask's edge are left out on the finest level [px].
    order
        Of the spline.
    """
    found = level_pair(pair, level, edge_px, order)
    mask = pair.deformed_mask
    if level != FULL or mask is None or mask.all():
        return found
    g = SplineImage.of(continued(pair.deformed, mask), order)
    border = found.valid if found.valid is None else ndimage.binary_dilation(found.valid)
    return replace(found, deformed=g, valid=border)


def continued(image: FloatImage, mask: BoolArray) -> FloatImage:
    """Continue an image a few pixels beyond its material, by local quadratic fits.

    Parameters
    ----------
    image
        (rows, cols) grey levels.
    mask
        (rows, cols) True on material; farther than 4 px from it the nearest pixel's value is kept.
    """
    distance, nearest = ndimage.distance_transform_edt(~mask, return_indices=True)
    filled = np.ascontiguousarray(image[tuple(nearest)])
    rows, cols = np.nonzero((distance > 0) & (distance <= _REACH_PX))
    _continue(readable(image), readable(mask), rows, cols, filled)
    return filled


@compiled(parallel=True, relaxed=True)
def _continue(image: Any, mask: Any, rows: Any, cols: Any, out: NDArray[Any]) -> None:
    for p in prange(rows.size):
        i, j = rows[p], cols[p]
        A, b, phi = np.zeros((6, 6)), np.zeros(6), np.ones(6)
        for k in range(max(0, i - _WINDOW_PX), min(image.shape[0], i + _WINDOW_PX + 1)):
            for m in range(max(0, j - _WINDOW_PX), min(image.shape[1], j + _WINDOW_PX + 1)):
                if not mask[k, m]:
                    continue
                y, x = float(k - i), float(m - j)
                phi[1], phi[2], phi[3], phi[4], phi[5] = x, y, x * x, x * y, y * y
                w = np.exp(-0.5 * (x * x + y * y) / _SIGMA_PX**2)
                for a in range(6):
                    b[a] += w * phi[a] * image[k, m]
                    for c in range(6):
                        A[a, c] += w * phi[a] * phi[c]
        for a in range(1, 6):
            A[a, a] += _RIDGE * A[0, 0]
        out[i, j] = np.linalg.solve(A, b)[0]
