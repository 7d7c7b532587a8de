"""Images continued beyond the edges of their material, and the variance of continued pixels.

Near an edge the spline through the deformed image reads pixels beyond it. There the material is
continued by local quadratic polynomials, which cause the errors at edges: they predict little of
fine speckle. The variance of continued pixels is therefore estimated as the one that the outermost
pixels of the material have when they are continued from the others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.solver.pyramid import FELT, FULL, Level, LevelPair, binned, eroded, level_pair
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage, border_reach
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.compiled import compiled, in_parallel, readable
from modeharvest.util.masks import grown

_REACH_PX = 4
"""Distance beyond the material up to which pixels are continued by polynomials [px]."""
_MIXED_PX = 2
"""Pixels along edges that may show some background, on masks found in photographs."""
_SIGMA_PX = 1.5
"""Standard deviation of the Gaussian weights of the material's pixels for that."""
_WINDOW_PX = 6
_BLURS, _WIDEST = 2.0, 1 / 16
"""Width of the strip along the image's border where a blur depends on what is beyond [blurs]; at
most this share of the shorter side."""
_RIDGE = 1e-3
"""Regularisation of polynomials that too few pixels determine, over the sum of weights."""


def images_on(pair: ImagePair, level: Level, edge_px: int, order: int) -> LevelPair:
    """Make one level of an image pair; on the finest, g is continued by quadratic polynomials.

    pair, level : as for :func:`modeharvest.idic.solver.pyramid.level_pair`.
    edge_px : pixels closer than this to the mask's edge are left out on the finest level [px]; on
        others, up to 2 px from the edge, those farther inside are continued in their place.
    order : of the spline that samples g.
    """
    inside, mask = pair.masks
    if level != FULL:
        # Background at the reference's edges, which g's mask leaves out, would move its corners.
        margin = min(edge_px, _MIXED_PX)
        pure = pair if pair.mask is None else replace(pair, mask=eroded(pair.mask, margin))
        covered = binned(pair.reference, inside, level.factor)[1] >= 0.5
        within = np.zeros(covered.shape, np.bool_)
        width = round(min(_BLURS * level.blur, _WIDEST * min(within.shape)))
        within[width : within.shape[0] - width, width : within.shape[1] - width] = True
        coarse = level_pair(pure, level, edge_px, order)
        return replace(coarse, mask=covered & within, valid=within)
    valid = ndimage.binary_dilation(eroded(mask, max(0, edge_px - 1)))
    g, inside = continued_spline(pair.deformed, mask, order), eroded(inside, edge_px)
    return LevelPair(pair.grid, pair.reference, g, inside, None if valid.all() else valid)


def continued_spline(image: FloatImage, mask: BoolArray, order: int) -> SplineImage:
    """The spline through an image (rows, cols), continued beyond its material and its border."""
    width = border_reach(order, FELT)
    framed = continued(np.pad(image, width), np.pad(mask, width))
    inner = SplineImage.of(framed, order).coefficients[width:-width, width:-width]
    return SplineImage(np.ascontiguousarray(inner), order)


class ContinuedPixels(NamedTuple):
    """Which pixels of the deformed image are continued, and their error's variance."""

    outside: NDArray[Any]
    """(rows, cols) float32, 1 where a pixel is continued and 0 on material; (0, 0) if none is."""
    variance: float
    """Variance of a continued pixel's error, over that of the residual's noise [-]."""
    summed: NDArray[Any]
    """(rows + 1, cols + 1) int32 summed-area table of continued and of invalid pixels."""


NONE_CONTINUED = ContinuedPixels(np.zeros((0, 0), np.float32), 0.0, np.zeros((0, 0), np.int32))
_LARGEST_VARIANCE = 1e6
"""Largest variance of continued pixels, which they have where there is no noise [-]."""


def continued_pixels(
    pair: ImagePair, noise_f: float, noise_g: float, valid: BoolArray | None = None
) -> ContinuedPixels:
    """Estimate the continued pixels' variance from the outermost pixels of the material.

    ``noise_f``, ``noise_g``: variances of the images' noise [grey levels^2]; ``valid``: valid
    pixels of the deformed image (rows, cols), None for all.
    """
    g, mask = pair.deformed, pair.deformed_mask
    if mask is None or mask.all():
        return NONE_CONTINUED
    inside = ndimage.binary_erosion(mask, border_value=1)
    outermost = mask & ~inside
    ratio = _LARGEST_VARIANCE
    if inside.any():
        found, (rows, cols) = np.empty(g.shape, np.float32), np.nonzero(outermost)
        in_parallel(_continue, *map(readable, (g, inside, rows, cols)), found)
        error = float(np.mean((found[outermost] - g[outermost]) ** 2))
        # The pixel tried has noise itself, and so would the missing pixel that it stands for.
        excess, noise = max(0.0, error - 2.0 * noise_g), noise_f + noise_g
        ratio = min(ratio, excess / noise) if noise > 0.0 else ratio
    lost = ~mask if valid is None else ~(mask & valid)
    summed = np.pad(lost, ((1, 0), (1, 0))).cumsum(0, np.int32).cumsum(1, np.int32)
    return ContinuedPixels((~mask).astype(np.float32), ratio, summed)


def continued(image: FloatImage, mask: BoolArray) -> FloatImage:
    """Continue an image a few pixels beyond its material, by local quadratic fits.

    image : (rows, cols) grey levels.
    mask : (rows, cols) True on material; farther than 4 px from it the nearest pixel's value is
        kept.
    """
    row, col = ndimage.distance_transform_edt(~mask, None, False, True)
    filled = np.ascontiguousarray(image[row, col])
    rows, cols = np.nonzero(grown(mask, _REACH_PX) & ~mask)
    in_parallel(_continue, *map(readable, (image, mask, rows, cols)), filled)
    return filled


@compiled(relaxed=True)
def _continue(
    image: Any, mask: Any, rows: Any, cols: Any, out: NDArray[Any], thread: int, threads: int
) -> None:
    A, b, phi = np.empty((6, 6)), np.empty(6), np.ones(6)  # of A only the upper triangle
    decay = np.exp(-0.5 * (np.arange(_WINDOW_PX + 1) / _SIGMA_PX) ** 2)
    for p in range(thread, rows.size, threads):
        i, j = rows[p], cols[p]
        A[:], b[:] = 0.0, 0.0
        for k in range(max(0, i - _WINDOW_PX), min(image.shape[0], i + _WINDOW_PX + 1)):
            for m in range(max(0, j - _WINDOW_PX), min(image.shape[1], j + _WINDOW_PX + 1)):
                if not mask[k, m]:
                    continue
                y, x = float(k - i), float(m - j)
                phi[1], phi[2], phi[3], phi[4], phi[5] = x, y, x * x, x * y, y * y
                w, grey = decay[abs(k - i)] * decay[abs(m - j)], image[k, m]
                for a in range(6):
                    share = w * phi[a]
                    b[a] += share * grey
                    for c in range(a, 6):
                        A[a, c] += share * phi[c]
        for a in range(1, 6):
            A[a, a] += _RIDGE * A[0, 0]
        # A is positive definite: without its last unknowns, eliminated in turn, the first remains.
        for c in range(5, 0, -1):
            for a in range(c):
                share = A[a, c] / A[c, c]
                b[a] -= share * b[c]
                for d in range(a, c):
                    A[a, d] -= share * A[d, c]
        out[i, j] = b[0] / A[0, 0]
