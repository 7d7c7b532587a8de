"""Speckle whose edges are sharper than pixels: such images are undersampled.

Interpolation takes the aliases of details finer than pixels for displacement: sub-pixel motions are
measured some percent too short, whatever the noise. A slight blur of both images removes most of
it (M. A. Sutton, J.-J. Orteu, H. W. Schreier, Image Correlation for Shape, Motion and Deformation
Measurements, Springer (2009), doi 10.1007/978-0-387-78747-3, section 5.6). Without a need it would
cost resolution and correlate noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.stats import median_abs_deviation

from modeharvest.idic.solver.pyramid import smoothed
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatImage

_BLUR_PX, _BORDER_PX = 0.7, 2
"""Blur that removes most of the bias of paint with sharp edges, and little else; pixels so close
to the picture's border don't count then."""
_SHARP = 0.06
"""Power of the finest details at edges, over the speckle's variance, times its size [px], above
which edges are sharp: between that of sharp paint and that of random fields, with or without noise
(tests/test_whole_measure.py)."""


def well_sampled(pair: ImagePair, speckle_px: float) -> ImagePair:
    """The same pair, slightly blurred if edges of its reference's speckle are sharper than pixels.

    ``speckle_px``: size of the speckle [px].
    """
    masks, inner = pair.masks, np.zeros(pair.grid.shape, np.bool_)
    if _at_edges(pair.reference, masks[0]) * speckle_px < _SHARP:
        return pair
    inner[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    images = zip((pair.reference, pair.deformed), masks, strict=True)
    blurred = pair.with_images(*(smoothed(image, mask, _BLUR_PX) for image, mask in images))
    if pair.deformed_mask is not None or masks[0].all():
        blurred = replace(blurred, deformed_mask=masks[1] & inner)
    return replace(blurred, mask=masks[0] & inner)


def _at_edges(image: FloatImage, mask: BoolArray) -> float:
    """Power of fourth differences (rows, cols) at few places, over the image's variance [-].

    Those of noise and of random fields are normal numbers: their median shows all of their power.
    """
    inner, found = ndimage.binary_erosion(mask, iterations=3), 0.0
    if not inner.any():
        return found
    fourth = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    for axis in (0, 1):
        details = ndimage.convolve1d(np.asarray(image, np.float64), fourth, axis)[inner]
        everywhere = median_abs_deviation(details, scale="normal") ** 2
        found += float(np.mean(details**2) - everywhere) / (2.0 * float(np.sum(fourth**2)))
    return found / max(float(image[inner].var()), 1e-12)
