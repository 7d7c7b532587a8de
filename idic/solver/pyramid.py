"""Image pyramid: a pair of images binned, blurred and locally normalised over its material.

A level bins the images and blurs them. Where masks are given, binning and blur are normalised
by them, so that no grey level of a hole or of the surroundings leaks into the material.

Every output row is made on its own, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage, border_reach
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.compiled import compiled, in_parallel, readable
from modeharvest.util.errors import InputError

_ENDS = 4.0
"""Standard deviations after which the Gaussian is cut off."""


def binned(
    image: FloatImage, weight: BoolArray | None, factor: int
) -> tuple[FloatImage, FloatImage]:
    """Means over blocks of ``factor`` px; incomplete ones at the right and bottom are dropped.

    The image is float32, ``weight`` (rows, cols) True where grey levels count, None for everywhere.
    Returns the means of grey level times weight and of weight, (rows // factor, cols // factor).
    """
    weight = np.ones(image.shape, dtype=np.bool_) if weight is None else weight
    shape = image.shape[0] // factor, image.shape[1] // factor
    mean, share = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    in_parallel(_bin, readable(image), readable(weight), factor, mean, share)
    return mean, share


def blurred(image: FloatImage, sigma: float) -> FloatImage:
    """Blur a float32 image with a Gaussian of ``sigma`` px; the outermost pixels are repeated."""
    if sigma == 0:
        return image
    reach = int(_ENDS * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    weights /= weights[0] + 2.0 * weights[1:].sum()
    out = np.empty_like(image)
    in_parallel(_blur, readable(image), weights.astype(np.float32), out)
    return out


@compiled(relaxed=True)
def _bin(
    image: Any, weight: Any, factor: int, mean: Any, share: Any, thread: int, threads: int
) -> None:
    rows, cols = mean.shape
    size = np.float32(1.0 / (factor * factor))
    for i in range(thread, rows, threads):
        along, count = np.zeros(cols * factor, np.float32), np.zeros(cols * factor, np.float32)
        for row in range(i * factor, (i + 1) * factor):
            for j in range(cols * factor):
                # Not a product: what lies outside the material may be anything.
                along[j] += image[row, j] if weight[row, j] else np.float32(0.0)
                count[j] += np.float32(weight[row, j])
        for j in range(cols):
            total, number = np.float32(0.0), np.float32(0.0)
            for k in range(j * factor, (j + 1) * factor):
                total += along[k]
                number += count[k]
            mean[i, j], share[i, j] = total * size, number * size


@compiled(relaxed=True)
def _blur(image: Any, weights: Any, out: Any, thread: int, threads: int) -> None:
    rows, cols = image.shape
    reach = weights.size - 1
    for i in range(thread, rows, threads):
        line = np.empty(cols + 2 * reach, np.float32)
        middle, own = line[reach : reach + cols], image[i]
        for j in range(cols):
            middle[j] = weights[0] * own[j]
        for k in range(1, reach + 1):
            up, down, w = image[max(0, i - k)], image[min(rows - 1, i + k)], weights[k]
            for j in range(cols):
                middle[j] += w * (up[j] + down[j])
        line[:reach], line[reach + cols :] = middle[0], middle[cols - 1]
        to = out[i]
        for j in range(cols):
            to[j] = weights[0] * middle[j]
        for k in range(1, reach + 1):
            before, after, w = line[reach - k :], line[reach + k :], weights[k]
            for j in range(cols):
                to[j] += w * (before[j] + after[j])


@dataclass(frozen=True)
class Level:
    """One step from coarse to fine."""

    factor: int
    """Edge of the blocks of pixels that are averaged [px]."""
    blur: float
    """Standard deviation of the Gaussian blur after that [binned px]; 0 for none."""

    def __post_init__(self) -> None:
        if self.factor < 1 or self.blur < 0:
            raise InputError(
                "expected a binning of at least 1 px and a blur of at least 0 px, got "
                f"{self.factor} and {self.blur}"
            )


FULL = Level(1, 0.0)
"""The finest level: the unfiltered images."""
COARSE_TO_FINE = (Level(8, 3.0), Level(4, 3.0), Level(2, 3.0), FULL)
"""Blurs of 24, 12, 6 and 0 px."""

FELT, _MOST = 2e-3, 1 / 16
"""On the finest level no pixel counts that is mapped to where the spline of g depends on the mirror
image beyond the border by more than 0.2 %: 8 px for a quintic spline, 5 for a cubic. The rest of
that influence moves float images by 5e-6 px. The strip is at most a sixteenth of the image's
shorter side: polynomials are extrapolated in it, which costs small images more than it mends."""
_CONTINUED = 1.5
"""Blur that continues the material into holes on a level without blur of its own [binned px]."""
_FAR = np.float32(1e-4)
"""Share of material below which a place is far from any, and takes the mean grey level."""

_AROUND = 3.0
"""Width of the local mean and contrast, in blurs: nothing finer than the blur is lost."""


@dataclass(frozen=True, eq=False)
class LevelPair:
    """Reference, deformed image and masks on one level."""

    grid: PixelGrid
    reference: FloatImage
    """(rows, cols) float32: f."""
    deformed: SplineImage
    """g, ready to be sampled."""
    mask: BoolArray
    """(rows, cols): pixels of f that count."""
    valid: BoolArray | None
    """(rows, cols) where g may be sampled; None for everywhere."""


def level_pair(
    pair: ImagePair, level: Level, edge_px: int, order: int, *, normalised: bool = False
) -> LevelPair:
    """Make one level of a pair of images.

    Holes are kept out of the blur only if both masks are known: f and g have to be treated alike.

    edge_px : Pixels closer than this to the mask's edge are left out on the finest level [px].
    order : Order of the spline: 3, 5 or 11.
    normalised : Give both images a local mean of 0 and a local contrast of 1, so that differences
        of brightness that vary slowly are gone; for blurred levels only.
    """
    grid, f_weight = pair.grid, pair.mask if pair.deformed_mask is not None else None
    is_finest = level == FULL
    # The reference is never sampled between its pixels: no need to continue it into holes.
    f = pair.reference if is_finest else _smooth(pair.reference, f_weight, level)
    g = _smooth(pair.deformed, pair.deformed_mask, level)
    if normalised and level.blur > 0:
        f, g = locally_normalised(f, level.blur), locally_normalised(g, level.blur)
    inside = pair.masks[0]
    if is_finest:
        inside = eroded(inside, edge_px)
        valid = _valid(pair.deformed_mask, grid.shape, edge_px, order)
    else:
        inside = binned(pair.reference, inside, level.factor)[1] >= 0.5
        valid = None
    return LevelPair(grid.binned(level.factor), f, SplineImage.of(g, order), inside, valid)


def _valid(mask: BoolArray | None, shape: tuple[int, int], edge_px: int, order: int) -> BoolArray:
    """Where g may be sampled: away from its border, and from the edges of its mask if known."""
    border = min(border_reach(order, FELT), int(_MOST * min(shape)))
    valid = np.zeros(shape, dtype=np.bool_)
    interior = (slice(border, shape[0] - border), slice(border, shape[1] - border))
    # The reference's eroded edge lands near edge_px from the edge of g, give or take the
    # local strain; one pixel less leaves those pixels in.
    valid[interior] = True if mask is None else eroded(mask, max(0, edge_px - 1))[interior]
    return valid


def eroded(mask: BoolArray, distance_px: int) -> BoolArray:
    """Remove pixels within ``distance_px`` of the mask's edge; the image's border isn't one."""
    if distance_px < 1 or mask.all():
        return mask
    for _ in range(2):  # along the rows, then along what were the columns
        kept = mask.copy(order="K")
        for shift in range(1, distance_px + 1):
            kept[shift:] &= mask[:-shift]
            kept[:-shift] &= mask[shift:]
        mask = kept.T
    return np.ascontiguousarray(mask)


def _smooth(image: FloatImage, weight: BoolArray | None, level: Level) -> FloatImage:
    """Binned and blurred; where there is no material, a smooth continuation of the material."""
    if weight is None or weight.all():
        return blurred(binned(image, None, level.factor)[0], level.blur)
    mean, share = binned(image, weight, level.factor)
    overall = np.float32(mean.sum(dtype=np.float64) / share.sum(dtype=np.float64))
    blur = level.blur or _CONTINUED
    mean, share = blurred(mean, blur), blurred(share, blur)
    mean += _FAR * overall
    share += _FAR
    mean /= share
    if level.factor == 1 and level.blur == 0:
        np.copyto(mean, image, where=weight)
    return mean


def locally_normalised(image: FloatImage, blur: float, around: float = _AROUND) -> FloatImage:
    """Give an image blurred by ``blur`` px a local mean of 0 and a local contrast of 1.

    All speckles count alike then, and the model error has the same weight everywhere. ``around``:
    width over which local mean and contrast are taken [blurs].
    """
    around *= blur
    image = image - blurred(image, around)
    contrast = np.sqrt(blurred(image**2, around))
    return np.asarray(image / (contrast + 1e-3 * contrast.max()))


def smoothed(image: FloatImage, mask: BoolArray | None, blur: float) -> FloatImage:
    """Blur an image by ``blur`` px over its material, True in the mask, and continue it beyond."""
    return _smooth(np.asarray(image, np.float32), mask, Level(1, blur))
