"""Where a correlation ends: on the images as they are, or on blurred ones if w is large.

A correlation weighs what the ansatz leaves over, w, by the grey-level gradient, as long as w is
short against a speckle: beyond that the grey levels have nothing more to tell, parts of the image
that match badly lose their weight, and the result moves away from the best fit of the ansatz.
Speckles that are much finer than w is long have to be blurred first. What that costs is noise,
of which there is little against w.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.pyramid import eroded, levelled
from modeharvest.idic.speckle_width import speckle_width

FloatImage = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

WIDTHS = 6.0
"""Speckles are as wide as that many rms lengths of w per component. Where 10 px speckles are
measured with w of 2 px, the paper's virtual experiment, nothing has to be blurred."""
AROUND = 2.0
"""How far local mean and contrast reach [blurs]: nearly a single speckle."""
_LEAST_BLUR = 1.0
"""Less than this changes nothing [px]."""
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclass(frozen=True)
class Finish:
    """How the last level looks.

    Parameters
    ----------
    width_px
        Full width at half maximum of the speckle's autocorrelation [px].
    leftover_px
        What the ansatz leaves over, rms per component [px].
    blur_px
        Standard deviation of the blur [px]; 0 for none.
    """

    width_px: float
    leftover_px: float
    blur_px: float

    @property
    def sentence(self) -> str:
        """That in words."""
        start = (
            f"The speckle's autocorrelation is {self.width_px:.1f} px wide, the ansatz leaves "
            f"about {self.leftover_px:.2g} px over"
        )
        if self.blur_px == 0.0:
            return f"{start}: the correlation ends on the images as they are."
        return (
            f"{start}, too much for such fine speckles: the correlation ends on images blurred "
            f"by {self.blur_px:.1f} px, with a local mean of 0 and a local contrast of 1."
        )


def finish_for(image: NDArray[Any], mask: BoolArray, leftover_px: float) -> Finish:
    """Decide how to finish.

    Parameters
    ----------
    image, mask
        (rows, cols) the reference and its material.
    leftover_px
        Rms per component of w, as a coarser level tells it [px].
    """
    width = speckle_width(image, mask)
    wanted = (WIDTHS * leftover_px) ** 2 - width**2
    # Widths of Gaussians add up in squares; a blur of s widens an autocorrelation by sqrt(2) s.
    blur = float(np.sqrt(max(0.0, wanted / 2.0)) / _FWHM)
    return Finish(width, leftover_px, blur if blur >= _LEAST_BLUR else 0.0)


def blurred_pair(
    reference: NDArray[Any],
    deformed: NDArray[Any],
    mask: BoolArray,
    deformed_mask: BoolArray,
    blur_px: float,
) -> tuple[FloatImage, FloatImage]:
    """Both images blurred over their material and levelled, in the reference's grey levels.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f and g.
    mask, deformed_mask
        (rows, cols) True on material.
    blur_px
        Standard deviation [px].
    """
    f = levelled(reference, mask, blur_px, AROUND)
    g = levelled(deformed, deformed_mask, blur_px, AROUND)
    scale = contrast_after(reference, mask, blur_px)
    f *= scale
    g *= scale
    return f, g


def contrast_after(image: NDArray[Any], mask: BoolArray, blur_px: float) -> np.float32:
    """Standard deviation that a speckle has after a blur [grey levels]."""
    inner = eroded(mask, int(np.ceil(3.0 * blur_px)))
    smooth = ndimage.gaussian_filter(np.asarray(image, dtype=np.float32), blur_px)
    return np.float32(smooth[inner if inner.any() else mask].std(dtype=np.float64))
