"""The same pair of images, coarser: what lets a correlation start ten speckles away.

A level bins the images and blurs them. Where masks are given, binning and blur are normalised
by them, so that no grey level of a hole or of the surroundings leaks into the material.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.blur import binned, blurred
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import SplineImage
from modeharvest.imaging.prefilter import border_reach

BoolArray = NDArray[np.bool_]
Image = NDArray[Any]


@dataclass(frozen=True)
class Level:
    """One step from coarse to fine.

    Parameters
    ----------
    factor
        Edge of the blocks of pixels that are averaged [px].
    blur
        Standard deviation of the Gaussian blur after that [binned px]; 0 for none.
    """

    factor: int
    blur: float

    def __post_init__(self) -> None:
        if self.factor < 1 or self.blur < 0:
            raise InputError(
                "expected a binning of at least 1 px and a blur of at least 0 px, got "
                f"{self.factor} and {self.blur}"
            )


FULL = Level(1, 0.0)
"""The images as they are."""
COARSE_TO_FINE = (Level(8, 3.0), Level(4, 3.0), Level(2, 3.0), FULL)
"""Blurs of 24, 12, 6 and 0 px."""

_FELT, _MOST = 2e-3, 1 / 16
"""On the finest level no pixel counts that lands where the spline of g feels the mirror image
beyond the border by more than 0.2 % of its pull: 8 px for a quintic spline, 5 for a cubic. What
is left of it moves float images by 5e-6 px. At most a sixteenth of the image's shorter side: in the
strip left out, polynomials are extrapolated, and on small images that costs more than it mends."""
_CONTINUED = 1.5
"""Blur that continues the material into holes on a level without blur of its own [binned px]."""

_AROUND = 3.0
"""How far the local mean and contrast reach, in blurs: nothing finer than the blur is lost."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Reference, deformed image and masks on one level.

    Parameters
    ----------
    grid
        The pixels of both images.
    reference
        (rows, cols) float32: f.
    deformed
        g, ready to be sampled.
    mask
        (rows, cols): pixels of f that count.
    allowed
        (rows, cols) where g may be sampled; None for everywhere.
    """

    grid: PixelGrid
    reference: Image
    deformed: SplineImage
    mask: BoolArray
    allowed: BoolArray | None


def prepare(
    reference: Image,
    deformed: Image,
    grid: PixelGrid,
    mask: BoolArray | None,
    deformed_mask: BoolArray | None,
    level: Level,
    edge_px: int,
    order: int,
    levelled: bool = False,
) -> Pair:
    """Make one level of a pair of images.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f and g.
    grid
        Their pixels.
    mask, deformed_mask
        (rows, cols) True on material, of f and of g; None if not known. Holes are kept out of
        the blur only if both are known: they have to look alike in the two images.
    level
        Binning and blur.
    edge_px
        Pixels closer than this to the mask's edge are left out on the finest level [px].
    order
        Of the spline, 3 or 5.
    levelled
        Give both images a local mean of 0 and a local contrast of 1, so that differences of
        brightness that vary slowly are gone; for blurred levels only.
    """
    reference, deformed = (np.asarray(image, np.float32) for image in (reference, deformed))
    f_weight = mask if deformed_mask is not None else None
    is_finest = level == FULL
    # The reference is never sampled between its pixels: no need to continue it into holes.
    f = reference if is_finest else _smooth(reference, f_weight, level)
    g = _smooth(deformed, deformed_mask, level)
    if levelled and level.blur > 0:
        f, g = _levelled(f, level.blur), _levelled(g, level.blur)
    inside = np.ones(grid.shape, dtype=np.bool_) if mask is None else mask
    if is_finest:
        inside = eroded(inside, edge_px)
        allowed = _allowed(deformed_mask, grid.shape, edge_px, order)
    else:
        inside = binned(reference, inside, level.factor)[1] >= 0.5
        allowed = None
    return Pair(grid.binned(level.factor), f, SplineImage.of(g, order), inside, allowed)


def _allowed(mask: BoolArray | None, shape: tuple[int, int], edge_px: int, order: int) -> BoolArray:
    """Where g may be sampled: away from its border, and from the edges of its mask if known."""
    border = min(border_reach(order, _FELT), int(_MOST * min(shape)))
    allowed = np.zeros(shape, dtype=np.bool_)
    inner = (slice(border, shape[0] - border), slice(border, shape[1] - border))
    # The reference's eroded edge lands near edge_px from the edge of g, give or take the
    # local strain; one pixel less leaves those pixels in.
    allowed[inner] = True if mask is None else eroded(mask, max(0, edge_px - 1))[inner]
    return allowed


def eroded(mask: BoolArray, distance_px: int) -> BoolArray:
    """Take away the pixels within ``distance_px`` of the mask's edge; the image border is none."""
    if distance_px < 1 or mask.all():
        return mask
    for _ in range(2):  # along the rows, then along what were the columns
        kept = mask.copy(order="K")
        for shift in range(1, distance_px + 1):
            kept[shift:] &= mask[:-shift]
            kept[:-shift] &= mask[shift:]
        mask = kept.T
    return np.ascontiguousarray(mask)


def _smooth(image: Image, weight: BoolArray | None, level: Level) -> Image:
    """Binned and blurred; where there is no material, a smooth continuation of the material."""
    if weight is None or weight.all():
        return blurred(binned(image, None, level.factor)[0], level.blur)
    mean, share = binned(image, weight, level.factor)
    filled = _continued(mean, share, level.blur or _CONTINUED)
    if level.factor == 1 and level.blur == 0:
        np.copyto(filled, image, where=weight)
    return filled


def _continued(mean: Image, share: Image, blur: float) -> Image:
    """Blur both, and divide; far from any material, its mean grey level.

    Parameters
    ----------
    mean, share
        (rows, cols) grey level times share of material, and that share.
    blur
        Standard deviation [binned px].
    """
    overall = float(mean.sum(dtype=np.float64) / share.sum(dtype=np.float64))
    far = np.float32(1e-4)
    mean, share = blurred(mean, blur), blurred(share, blur)
    mean += far * np.float32(overall)
    share += far
    mean /= share
    return mean


def _levelled(image: Image, blur: float, around: float = _AROUND) -> Image:
    """The image less its local mean, over its local standard deviation."""
    around *= blur
    image = image - blurred(image, around)
    contrast = np.sqrt(blurred(image**2, around))
    return np.asarray(image / (contrast + 1e-3 * contrast.max()))


def smoothed(image: Image, mask: BoolArray | None, blur: float) -> Image:
    """Blur an image over its material, and continue it beyond.

    Parameters
    ----------
    image
        (rows, cols) grey levels.
    mask
        (rows, cols) True on material; None for everywhere.
    blur
        Standard deviation [px].
    """
    return _smooth(np.asarray(image, np.float32), mask, Level(1, blur))


def levelled(
    image: Image, mask: BoolArray | None, blur: float, around: float = _AROUND
) -> NDArray[np.float32]:
    """Blur an image over its material, and give it a local mean of 0 and a local contrast of 1.

    Where all speckles count alike, what an ansatz leaves over weighs alike everywhere.

    Parameters
    ----------
    image
        (rows, cols) grey levels.
    mask
        (rows, cols) True on material; what is elsewhere has no part in it.
    blur
        Standard deviation [px].
    around
        How far the local mean and contrast reach [blurs].
    """
    smooth = smoothed(image, mask, blur)
    return np.asarray(_levelled(smooth, blur, around), dtype=np.float32)
