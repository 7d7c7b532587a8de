"""Material in a photograph: the speckled surface against holes and background.

The grey level of a speckled material varies within some pixels; that of the background hardly does,
whether it is black, grey or white. That finds the background roughly; its grey level there then
gives its extent pixel by pixel. What is out of focus at the edges is the wall of a hole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, label, mean, uniform_filter
from scipy.optimize import least_squares
from scipy.special import ndtr, ndtri
from skimage.filters import threshold_otsu

from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.noise import estimated_noise
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.masks import connected_to, grown, large_parts, opened, shrunk

_WINDOW_SHARE, _WIDEST_PX = 0.15, 25
"""Window over cell size, small because buckled holes are narrow, and the largest window [px]."""
_REACH = 0.4
"""Least radius of curvature of a hole [windows]. Where the background is as dark or as bright as
some speckles, only this separates such speckles at its edge from it."""
_SMOOTH_PX = 1.0
"""Blur that takes away most of a camera's noise and little of a speckle of 3 px."""
_APART = 3.0
"""Least ratio of the typical contrasts on material and on background that separates them."""
_SIGMAS = 4.0
"""A pixel within 4 standard deviations of the background's level may be background."""
_FAINTEST = 0.002
"""A difference of grey levels that counts as none, as a share of their range."""
_LENS_PX = 3.0
"""Beyond this a lens doesn't mix material with background."""
_WIDE = 2.0
"""Patches of the background's grey level that are larger than two disks of that radius are holes,
however little of them was wide enough to lack contrast."""
_SPECK_PX2 = 6
"""Area of what can be a few pixels' noise in the background."""
_WALL_WINDOW, _WALL_PX, _WALL_SHARPNESS = 0.6, 13, 0.3
"""Window of sharpness over that of speckle; its least size, more than flat speckles have [px]; and
share of the material's fine contrast below which a region is out of focus."""
_SLIGHTEST = 0.02
"""Share of material with grey levels of the background from which on that is reported."""
_EDGE_PX, _STEP_PX = 4.0, 0.5
"""Pixels farther from a mask's edge are material or background; steps of an edge's profile [px]."""
AROUND_PX = 25.0
"""Gaussian width of windows in which the background has one level [px]."""
_SLIGHT, _MOST_SLIGHT = 2.0, 0.3
"""What a row of pixels may show of the background, over the image's noise; largest such share."""


@dataclass(frozen=True, eq=False)
class MaterialMask:
    """The material found in an image."""

    mask: BoolArray
    """(rows, cols) True on material."""
    text: tuple[str, ...]


def window_for(cell_px: float) -> int:
    """The window of :func:`find_material` for cells of this size [px]."""
    return int(np.clip(_WINDOW_SHARE * cell_px, 9, _WIDEST_PX)) // 2 * 2 + 1


def find_material(
    image: ArrayLike, window: int = _WIDEST_PX, coat: BoolArray | None = None
) -> MaterialMask:
    """Find the material in an image (rows, cols) of a speckled specimen, grey levels in any unit.

    ``window`` is the size of the square in which the speckle's contrast is evaluated [px]: two to
    three speckles across, and well below a hole's diameter. ``coat``: True on the coat of paint
    around dots, which is material, however dull. Raises InputError unless the image is plane,
    finite, larger than the window, and shows a speckle.
    """
    grey = _checked(image, window)
    contrast = _local_contrast(grey, window)
    sure, ratio = _surely_background(contrast, window)
    if coat is not None:
        sure &= ~coat
    if not sure.any():
        if not contrast.max() > 0.0:
            raise InputError("expected a speckled material in the image, got a constant grey level")
        text = ("No background was found: the whole image counts as material.",)
        return MaterialMask(np.ones(grey.shape, dtype=np.bool_), text)
    if sure.all():
        raise InputError(
            "expected a speckled material in the image, got a mask with nothing in it: no part has "
            "more contrast than the rest; give the mask as an image"
        )
    material, alike = _refined(grey, sure, window)
    if not material.any():
        raise InputError(
            "expected a speckled material in the image, got a mask with nothing in it: the "
            "background's grey levels are everywhere; give the mask as an image"
        )
    material, walls = _without_walls(grey, material, window)
    if coat is not None:
        material = material | coat
    return MaterialMask(material, _text(material, ratio, alike, walls))


def mixed_edge_px(image: FloatImage, mask: BoolArray) -> int:
    """Distance from a mask's edge of pixels that show background, and of one row more [px].

    Lens, finite pixels, and a mask that is too large mix background and material. The share of
    background is fitted to the mean profile across the edge, as a Gaussian distribution function;
    shares that hardly matter beside the noise don't count. At least 1, and at most 4.
    """
    inward = np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))
    material, background = inward > _EDGE_PX, inward < -_EDGE_PX
    if not (material.any() and background.any()):
        return 1
    inside = mean_over(image, material, max(_EDGE_PX, speckle_size(image, material)))
    near = abs(inward) < _EDGE_PX
    contrast = (mean_over(image, background, AROUND_PX) - inside)[near]
    at, place = np.unique(np.floor(inward[near] / _STEP_PX), return_inverse=True)
    power, product, moment = (
        np.bincount(place, contrast * part, at.size)
        for part in (contrast, (image - inside)[near], contrast * inward[near])
    )
    typical = float(np.sqrt(np.mean(contrast**2)))
    if typical < image[material].std():  # as where a mask ends within the speckle
        return 1
    share, x, weight = product / power, moment / power, np.sqrt(power / power.sum())
    fit = least_squares(
        lambda edge: weight * (ndtr((edge[0] - x) / edge[1]) - share), [0.0, 0.5],
        bounds=([-_EDGE_PX, 0.01], [_EDGE_PX, _EDGE_PX]),
    )  # fmt: skip
    slight = np.clip(_SLIGHT * estimated_noise(image, mask).sd / typical, 1e-3, _MOST_SLIGHT)
    mixed = float(fit.x[0] - fit.x[1] * ndtri(slight))
    return int(np.clip(1.0 + mixed, 1.0, _EDGE_PX))


def mean_over(grey: FloatImage, region: BoolArray, width: float) -> FloatImage:
    """(rows, cols) mean grey level of a region's pixels around each, in a Gaussian window [px]."""
    typical = np.float32(grey[region].mean()) if region.any() else np.float32(0.0)
    total = gaussian_filter(np.where(region, grey - typical, np.float32(0.0)), width)
    weight = gaussian_filter(region.astype(np.float32), width) + np.float32(1e-6)
    return np.asarray(typical + total / weight, dtype=np.float32)


def _checked(image: ArrayLike, window: int) -> FloatImage:
    if window < 5:
        raise InputError(f"expected a window of 5 px or more, got {window} px")
    grey = np.asarray(image, dtype=np.float32)
    if grey.ndim != 2 or min(grey.shape) < 2 * window:
        raise InputError(
            f"expected a plane image of at least {2 * window} px each way to look for "
            f"material with a window of {window} px, got shape {grey.shape}"
        )
    if not np.isfinite(grey).all():
        raise InputError("expected finite grey levels to find material, got NaN or infinity")
    return grey


def _local_contrast(grey: FloatImage, window: int) -> FloatImage:
    """Standard deviation of the grey level in a square around every pixel, fine noise removed."""
    smooth = gaussian_filter(grey, _SMOOTH_PX).astype(np.float64)
    smooth -= smooth.mean()
    mean = uniform_filter(smooth, window)
    variance = uniform_filter(smooth * smooth, window) - mean * mean
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float32)


def _surely_background(contrast: FloatImage, window: int) -> tuple[BoolArray, float]:
    """Where there is surely no speckle, and how much more contrast there is elsewhere."""
    log = np.log(np.maximum(contrast, 1e-6 * max(float(contrast.max()), 1e-30)))
    dull = log < threshold_otsu(log[::4, ::4])  # type: ignore[no-untyped-call]
    ratio = float(np.exp(np.median(log[~dull]) - np.median(log[dull]))) if dull.any() else np.inf
    if ratio < _APART:
        return np.zeros(contrast.shape, dtype=np.bool_), np.inf
    # Flat patches of a few joined speckles are dull, too, but not wide.
    return opened(dull, 0.25 * window), ratio


def _refined(grey: FloatImage, sure: BoolArray, window: int) -> tuple[BoolArray, float]:
    """(material, share of it that looks like background), from the background's own level."""
    sure = _without_speckle(grey, sure, window)
    level, spread = _background_level(grey, sure, 4 * window)
    away = np.abs(grey - level)
    tolerance = np.maximum(_SIGMAS * spread, _FAINTEST * float(np.ptp(grey)))
    first = _background(away < tolerance, sure, _REACH * window)
    some = (slice(None, None, 2),) * 2  # every fourth pixel will do for statistics
    inside = shrunk(~first[some], 0.5 * _LENS_PX)
    if not inside.any():
        return ~first, 1.0
    # Half-way to the material's nearest levels where they leave a gap, else as near as the
    # noise allows.
    half = 0.5 * float(np.quantile(away[some][inside], 0.01))
    background = _background(away < np.maximum(tolerance, half), sure, _REACH * window)
    share = float((away < tolerance)[some][inside].mean())
    return large_parts(~background, window**2 + 1), share


def _without_speckle(grey: FloatImage, sure: BoolArray, window: int) -> BoolArray:
    """What is surely background, without small patches whose level is that of flat speckles.

    Between coarse speckles there are patches as dull as background. They are known by their level,
    which is off the background's nearby by more than a quarter of the speckle's deviation.
    """
    parts, _ = label(sure)
    small = np.flatnonzero(np.bincount(parts.ravel()) <= window**2)
    if small.size == 0 or sure.all():
        return sure
    away = grey - _background_level(grey, sure, 4 * window)[0]
    off = np.abs(mean(away, parts, small)) > 0.25 * float(grey[~sure].std())
    kept = sure & ~np.isin(parts, small[off])
    return kept if kept.any() else sure


def _background(alike: BoolArray, sure: BoolArray, reach: float) -> BoolArray:
    """Wide regions of the background's grey level, or connected to what is surely background."""
    wide = opened(~large_parts(~alike, _SPECK_PX2 + 1), reach)
    return connected_to(sure, wide) | large_parts(wide, int(_WIDE * np.pi * reach**2) + 1)


def _without_walls(grey: FloatImage, material: BoolArray, window: int) -> tuple[BoolArray, float]:
    """The material without what lies deeper, out of focus: (material, share taken away).

    Through a hole in a thick specimen the camera sees the hole's wall, bright but blurred.
    """
    narrow = max(_WALL_PX, int(_WALL_WINDOW * window))
    fine = gaussian_filter(grey, 0.7) - gaussian_filter(grey, 2.7)
    power = uniform_filter(fine.astype(np.float64) ** 2, narrow)
    sharpness = np.sqrt(np.maximum(power, 0.0))
    some = (slice(None, None, 4),) * 2
    core = shrunk(material[some], 0.25 * narrow)
    if not core.any():
        return material, 0.0
    dull = material & (sharpness < _WALL_SHARPNESS * float(np.median(sharpness[some][core])))
    background = ~material
    wall = opened(dull, 0.25 * narrow) & connected_to(background, dull | background)
    # Near the edge this window holds some sharp material: a wall ends a little further on.
    rest = large_parts(material & ~grown(wall, 0.45 * narrow), window**2 + 1)
    return rest, float((material & ~rest).sum() / material.sum())


def _background_level(
    grey: FloatImage, sure: BoolArray, reach: int
) -> tuple[FloatImage, FloatImage]:
    """(level, standard deviation) of the background nearby, extrapolated into the material."""
    core = shrunk(sure, 2.0)
    core = core if core.any() else sure
    mean = float(grey[core].mean())
    off = np.where(core, grey - mean, np.float32(0.0))  # small numbers, for running sums
    total = _around(core.astype(np.float32), reach)
    known, scale = total > 1e-4, np.maximum(total, 1e-4)
    level = np.where(known, _around(off, reach) / scale, 0.0)
    variance = _around(np.where(core, off - level, 0.0) ** 2, reach) / scale
    spread = np.where(known, np.sqrt(np.maximum(variance, 0.0)), off[core].std())
    return (mean + level).astype(np.float32), spread.astype(np.float32)


def _around(image: NDArray[Any], reach: int) -> NDArray[Any]:
    """Mean around every pixel, weights falling linearly to 0 at ``reach`` along each axis."""
    return np.asarray(uniform_filter(uniform_filter(image, reach), reach))


def _text(material: BoolArray, ratio: float, alike: float, walls: float) -> tuple[str, ...]:
    text = [
        f"Material was found by its speckle, {100 * material.mean():.0f} % of the image, with "
        f"{ratio:.0f} times the contrast of the background."
    ]
    if alike > _SLIGHTEST:
        text.append(
            f"{100 * alike:.0f} % of the material has grey levels of the background; there its "
            "edge is known to some pixels only."
        )
    if walls > 0.0:
        text.append(
            f"At its edges, {100 * walls:.1f} % of it was out of focus and counts as background."
        )
    return tuple(text)
