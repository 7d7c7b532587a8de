"""Material in a picture without speckle, and its contours: outer ones, of holes, of dots.

Such a picture has two grey levels; its information is where they meet. After a blur below a pixel,
contours are taken half-way between the levels nearby, which may vary slowly over the picture. Blur
shifts curved edges by its variance over twice their radius; that is corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_fill_holes, center_of_mass, gaussian_filter, label
from scipy.signal import savgol_filter
from scipy.spatial import cKDTree
from skimage.filters import threshold_otsu

from modeharvest.idic.finite_element.mesh import find_contours
from modeharvest.idic.solver.noise import estimated_noise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import Contour, signed_area
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.masks import grown, large_parts, shrunk

_BLUR_PX = 0.7
CORRELATED_PX = 2.0 * np.sqrt(np.pi) * _BLUR_PX
"""Length over which the blur before contours are taken correlates white noise [px]."""
_LENS_PX = 1.0
"""Blur of a lens, which is added to a picture of exactly two grey levels."""
_TWO_LEVELS = 0.9
"""Share of a picture's variance that two grey levels explain: 0.98 of plain pictures with noise of
1 %, 0.67 to 0.81 of speckled ones with a background."""
_LIGHT_SHARE = 0.1
"""Share of the picture's shorter side over which grey levels are averaged."""
_ROUNDS, _SAMPLES_A_WIDTH = 3, 10
_COARSE_PX = 400
"""Shorter side of the coarse picture tested first: most pictures have speckle, also seen there."""
_INSIDE_PX = 4.0
"""Pixels farther than this from any edge show the grey levels."""
_SPECKLE_PX, _LAG_PX = 8.0, 2
_FAINTEST, _ALIKE_GREY = 0.02, 0.3
"""Speckle varies by more than a fiftieth of the step at edges, and is correlated over 2 px."""
_DIFFERENCE_PX2 = 1.0 / 3.0
"""Variance of the blur that differences over two pixels add."""
_EVERY_PX, _CURVED_PX, _SHARPENED = 0.5, 5.0, 2
"""Spacing of a contour's points; half-length of the polynomial fits that give its curvature; number
of iterations after which that is the curvature before the blur."""
_SHARPEST = 1.0 / 3.0
"""Largest curvature [1/px] that is corrected for: a corner has no radius."""
_LEAST_PX2 = 60.0
"""Area of a hole or island; smaller ones are dirt."""
_DOT = 1.0 / 6.0
"""Largest area of a dot on the material, over that of the largest hole."""
_PAINTED, _PAINTED_PX, _PAINTED_PX2 = 10, 45.0, 12
"""Least number of dots of paint, their largest distance from each other [px], and least area."""
_IRREGULAR, _MANY = 0.12, 3
"""Coefficient of variation of the distances between neighbours from which on patches are not holes
of a lattice (0.05 of buckled ones, 0.2 of dots at random), and number of dots for each hole."""
_CLEAR = 0.02
"""Share of the picture's border that may be dirt."""
_ONE_OF_MANY = 0.2
"""Largest area of a hole over that of all holes, where the picture's border is all material."""
_SHORTEST_CUT = 24
"""Least number of points of a contour that ends at the picture's border: corners are no use."""
_SECOND = 0.2
"""Least area of another island, over the largest one's, that counts as a specimen."""
CUT = (
    "Not all of the specimen is in view: what holds it where the picture cuts it isn't known, so "
    "that nothing is said within about a cell of there."
)
_DOTS = (
    "{} dots are on the material: what its edges surround of less than a sixth of the largest "
    "hole's area is taken for one; give a mask if these are holes."
)


@dataclass(frozen=True, eq=False)
class MaterialContours:
    """Contours of the material in a picture: of two grey levels, or with speckle on it."""

    mask: BoolArray
    """(rows, cols) True on material."""
    contours: tuple[FloatArray, ...]
    """(n, 2) points (row, col) [px] of each closed one: the outer one of the material first, if all
    of it is in view, then those of its holes."""
    noise: float
    """Variance of a contour's distance times the length over which it is correlated [px^3]."""
    warnings: tuple[str, ...] = ()
    """Remarks: other specimens in the picture, parts of this one out of view, dots."""
    cut: tuple[FloatArray, ...] = ()
    """Contours cut by the picture's border; none if all of the specimen is in view."""
    dots: tuple[FloatArray, ...] = ()
    """(n, 2) points (row, col) [px] around marks on the material, which belong to it."""

    @property
    def is_part(self) -> bool:
        """Whether the picture's border cuts the specimen, or all of it is material."""
        around = self.mask[[0, -1]].all() and self.mask[:, [0, -1]].all()
        return bool(self.cut) or bool(around)

    def on(self, grid: PixelGrid) -> tuple[list[Contour], ...]:
        """Contours in a grid's frame [mm]: outer ones, those of holes, cut ones, those of dots."""
        kinds = (self.contours, True), (self.cut, False), (self.dots, True)
        closed, cut, dots = (
            [Contour(np.column_stack(grid.to_mm(*points.T)), whole) for points in part]
            for part, whole in kinds
        )
        outer = 0 if self.is_part else 1
        return closed[:outer], closed[outer:], cut, dots


def coat_of_paint(image: FloatImage) -> BoolArray | None:
    """(rows, cols) True on the coat of paint around dots of another grey level; None without dots.

    Unlike holes, dots are many, close to each other, and irregular in their places. They give more
    information by their grey levels than by their contours, as speckle does.
    """
    found = _material(np.asarray(image, dtype=np.float32))
    return found[0] if found and _has_dots_of_paint(found[0]) else None


def _has_dots_of_paint(material: BoolArray) -> bool:
    """Whether the patches that a material surrounds are dots of paint instead of holes."""
    whole = binary_fill_holes(material)
    parts, count = label(large_parts(whole & ~material, _PAINTED_PX2))
    if count < _PAINTED or whole.sum() > count * _PAINTED_PX**2:
        return False
    areas = np.bincount(parts.ravel())[1:]
    large = np.flatnonzero(areas >= _DOT * areas.max()) + 1
    if count > (1 + _MANY) * len(large):
        return True
    centres = np.array(center_of_mass(parts > 0, parts, large))
    near = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return bool(len(large) >= _PAINTED and near.std() > _IRREGULAR * near.mean())


def plain_surface(
    image: FloatImage, like: BoolArray | None = None, dot_px2: float | None = None
) -> MaterialContours | None:
    """Find the contours of a plain material in a picture (rows, cols); None if it has speckle.

    Of several specimens the largest is taken, or the one where ``like`` is True (its reference,
    which decides whether patches are holes or dots of paint). One that reaches
    the picture's border is in view in part: its contours end there. Contours within the material of
    an area [px^2] below ``dot_px2``, by default a sixth of the largest hole's, are dots on it.
    """
    image = np.asarray(image, dtype=np.float32)
    if ((image == image.min()) | (image == image.max())).all():  # thresholded: soften the steps
        image = gaussian_filter(image, _LENS_PX)
    found = _material(image)
    if found is None or (like is None and _has_dots_of_paint(found[0])):
        return None
    material, grey, middle, step = found
    material = material | ~large_parts(~material, _LEAST_PX2)
    material, text = one_specimen(material, like, "crop the pictures to measure another one")
    contours, cut = contours_around(grey - middle, material)
    if not contours:
        return None
    if is_part := MaterialContours(material, (), 0.0, cut=cut).is_part:
        text += (CUT,)
    contours, dots, most = _without_dots(contours, 0 if is_part else 1, dot_px2)
    if dots:
        text += (_DOTS.format(len(dots)),)
    slope = _slope(grey, contours + cut)
    # White noise of the pixels, blurred: its variance at a point times its correlation length.
    noise = estimated_noise(image, material).sd ** 2 / CORRELATED_PX
    # The slope of a straight edge shows the blur by lens, pixels and the filter above.
    blur = float(np.abs(step[material]).mean()) / (slope * np.sqrt(2.0 * np.pi))
    variance = max(0.0, blur**2 - _DIFFERENCE_PX2)
    sharp = tuple(_unbent(Contour(points), variance) for points in contours)
    ends = tuple(_unbent(Contour(points, False), variance) for points in cut)
    marks = tuple(_unbent(Contour(points), variance) for points in dots)
    # Noise and grey level were taken without the dots, which are material all the same.
    mask = _filled(material, most) if dots else material
    return MaterialContours(mask, sharp, noise / slope**2, text, ends, marks)


def _material(image: FloatImage) -> tuple[BoolArray, FloatImage, FloatArray, FloatArray] | None:
    """Material of one level, the blurred picture, the middle of its levels, their difference.

    All are (rows, cols). None if the picture has more than two grey levels, or speckle.
    """
    grey = gaussian_filter(image, _BLUR_PX)
    few = max(1, min(grey.shape) // _COARSE_PX)
    found = None if _two_levels(grey[::few, ::few]) is None else _two_levels(grey)
    if found is None:
        return None
    bright, middle, step = found
    material = large_parts(bright if _is_material(bright) else ~bright, _LEAST_PX2)
    if not material.any() or _shows_speckle(image, material, step):
        return None
    return material, grey, middle, step


def _without_dots(
    contours: tuple[FloatArray, ...], outer: int, most: float | None
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], float]:
    """Closed contours, the largest first, without dots; the dots; an area between both [px^2]."""
    areas = np.abs([signed_area(points) for points in contours])
    if most is None:
        most = _DOT * float(areas[outer:].max(initial=0.0))
    first = max(outer, int((areas >= most).sum()))
    if first == outer or first == len(contours):  # dots alone might as well be holes
        return contours, (), most
    return contours[:first], contours[first:], float(np.sqrt(areas[first - 1] * areas[first]))


def _filled(material: BoolArray, area: float) -> BoolArray:
    """The material, with the holes in it smaller than ``area`` [px^2] filled."""
    inside = binary_fill_holes(material) & ~material
    return np.asarray(material | (inside & ~large_parts(inside, area)))


def _two_levels(grey: FloatImage) -> tuple[BoolArray, FloatArray, FloatArray] | None:
    """(rows, cols) where a picture is bright, the middle of its two levels, and their difference.

    None unless the two levels explain most of the picture's variance.
    """
    bright = grey > float(threshold_otsu(grey))  # type: ignore[no-untyped-call]
    for _ in range(_ROUNDS):
        if not 0 < bright.sum() < bright.size:
            return None
        above, below = _level(grey, bright), _level(grey, ~bright)
        left = grey - np.where(bright, above, below)
        bright = grey > 0.5 * (above + below)
    if left.var() > (1.0 - _TWO_LEVELS) * grey.var():
        return None
    return bright, 0.5 * (above + below), above - below


def _is_material(bright: BoolArray) -> bool:
    """Whether the material is the bright level: the material isn't at the picture's border.

    Where both levels are at the border, the material is the one in fewer parts, because holes are
    many. A level at the border that surrounds many similar parts is the material, too.
    """
    border = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]]).mean()
    sizes = [np.bincount(label(large_parts(s, _LEAST_PX2))[0][s])[1:] for s in (bright, ~bright)]
    within = sizes[int(border >= 0.5)]
    if _CLEAR < border < 1.0 - _CLEAR and len(sizes[0]) != len(sizes[1]):
        return len(sizes[0]) < len(sizes[1])
    return bool((border < 0.5) != (within.max(initial=0) < _ONE_OF_MANY * within.sum()))


def contours_around(
    signed: FloatArray, material: BoolArray
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Contours (n, 2) at 0 around a material: closed ones, the largest first, and cut ones."""
    closed, cut = [], []
    for points in find_contours(signed.astype(np.float64), 0.0):
        row, col = np.rint(points[len(points) // 2]).astype(int)
        around = np.s_[max(0, row - 2) : row + 3, max(0, col - 2) : col + 3]
        if len(points) <= 8 or not material[around].any():
            continue
        if not np.allclose(points[0], points[-1]):
            if len(points) > _SHORTEST_CUT:
                cut.append(points)
        elif abs(signed_area(points)) > _LEAST_PX2:
            closed.append(points[:-1])
    return tuple(sorted(closed, key=lambda points: -abs(signed_area(points)))), tuple(cut)


def one_specimen(
    material: BoolArray, like: BoolArray | None, of_another: str, apart_px: float = 0.0
) -> tuple[BoolArray, tuple[str, ...]]:
    """Select the largest island, or the one where ``like`` is True; a text if there are others.

    ``of_another``: what to do to measure another one; islands less than twice ``apart_px`` apart
    are one.
    """
    islands, count = label(grown(material, apart_px) if apart_px else material)
    sizes = np.bincount(islands[material], minlength=count + 1)[1:]
    at = sizes if like is None else np.bincount(islands[like], minlength=count + 1)[1:]
    mine, large = int(np.argmax(at)), int((sizes >= _SECOND * sizes.max()).sum())
    text = (
        f"There are {large} specimens in the picture; the one of {sizes[mine]} px was measured: "
        f"{of_another}."
    )
    return np.asarray(material & (islands == 1 + mine)), (text,) * (large > 1)


def away_from_cuts(mask: BoolArray, grid: PixelGrid, cell_size: float) -> BoolArray:
    """(rows, cols) where a material is farther than a cell [mm] from where the border cuts it."""
    cut = np.zeros_like(mask)
    cut[[0, -1]], cut[:, [0, -1]] = mask[[0, -1]], mask[:, [0, -1]]
    return mask & ~grown(cut, cell_size / grid.pixel_size)


def _inside(material: BoolArray) -> BoolArray:
    inside = shrunk(material, _INSIDE_PX)
    return inside if inside.any() else material


def _level(grey: FloatImage, region: BoolArray) -> FloatArray:
    """(rows, cols) grey level of a region, away from its edges, averaged around each pixel."""
    inside = _inside(region)
    mean, width = float(grey[inside].mean()), _LIGHT_SHARE * min(grey.shape)
    every = max(1, int(width / _SAMPLES_A_WIDTH))  # what varies slowly is known by few pixels
    few = np.s_[::every, ::every]
    weight = gaussian_filter(inside[few].astype(np.float32), width / every) + np.float32(1e-3)
    light = gaussian_filter(np.where(inside, grey - mean, 0.0)[few], width / every) / weight
    rows, cols = (np.arange(n, dtype=np.float32) / every for n in grey.shape)
    spline = RectBivariateSpline(*(np.arange(n) for n in light.shape), light, kx=1, ky=1)
    return np.asarray(mean + spline(rows, cols), dtype=np.float64)


def _shows_speckle(image: FloatImage, material: BoolArray, step: FloatArray) -> bool:
    """Whether the material's grey level varies by more than noise, which is uncorrelated."""
    inside = _inside(material)
    weight = gaussian_filter(inside.astype(np.float32), _SPECKLE_PX) + np.float32(1e-6)
    grey = np.where(inside, image, 0.0).astype(np.float32)
    fine = np.where(inside, image - gaussian_filter(grey, _SPECKLE_PX) / weight, 0.0)
    both = inside[:, _LAG_PX:] & inside[:, :-_LAG_PX]
    if fine[inside].std() < _FAINTEST * abs(float(step[inside].mean())) or not both.any():
        return False
    alike = np.corrcoef(fine[:, _LAG_PX:][both], fine[:, :-_LAG_PX][both])[0, 1]
    return bool(alike > _ALIKE_GREY)


def _unbent(contour: Contour, variance: float) -> FloatArray:
    """(n, 2) points of a contour, corrected for its shift by a blur of ``variance`` [px^2].

    The shift is variance/2R, towards the centre of curvature before the blur, found by iteration.
    """
    seen, step = contour.evenly(_EVERY_PX)
    found, window = seen, min(2 * round(_CURVED_PX / step) + 1, (len(seen) - 1) | 1)
    how = "wrap" if contour.closed else "interp"
    for _ in range(_SHARPENED):
        bent = savgol_filter(found, window, 5, 2, step, axis=0, mode=how)
        length = np.linalg.norm(bent, axis=1, keepdims=True)
        found = seen - 0.5 * variance * bent * np.minimum(1.0, _SHARPEST / np.maximum(length, 1e-9))
    return np.asarray(found)


def _slope(grey: FloatImage, contours: Sequence[FloatArray]) -> float:
    """Typical slope of the grey level at contours [grey levels/px]."""
    row, col = np.rint(np.vstack(contours)).astype(int).T
    slopes = [part[row, col] for part in np.gradient(grey)]
    return float(np.median(np.hypot(*slopes)))
