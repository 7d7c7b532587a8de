"""Photographs of a plain specimen, without speckle: its material, its contours, holes and dots.

Such a picture has two grey levels; its information is where they meet. After a blur below a pixel,
contours are taken half-way between the levels nearby, which may vary slowly over the picture. Blur
shifts curved edges by its variance over twice their radius; that is corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_fill_holes, gaussian_filter, label
from scipy.optimize import linear_sum_assignment
from scipy.signal import savgol_filter
from scipy.spatial import cKDTree
from skimage.filters import threshold_otsu

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.contours import displacement_from_contours
from modeharvest.idic.finite_element.mesh import find_contours
from modeharvest.idic.finite_element.result import NodalResult, WholeField, refitted
from modeharvest.idic.finite_element.system import SAMPLES, Body
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.measure import POINTS_A_CELL, MeasuredPhotograph, found_modes
from modeharvest.idic.setup import PhotographOptions
from modeharvest.idic.solver.noise import estimated_noise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.contour import Contour, HoleShape, SeenContours, signed_area
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import write_csv
from modeharvest.util.masks import grown, large_parts, shrunk
from modeharvest.util.progress import Progress, silent
from modeharvest.util.typed import picked

_BLUR_PX = 0.7
_CORRELATED_PX = 2.0 * np.sqrt(np.pi) * _BLUR_PX
"""Length over which that blur correlates white noise."""
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
_DOT, _DOT_GROWS = 1.0 / 6.0, 1.8
"""Largest area of a dot on the material, over that of the largest hole; and in another picture,
where holes may be nearly closed, over that of the reference's largest dot."""
_CLEAR = 0.02
"""Share of the picture's border that may be dirt."""
_ONE_OF_MANY = 0.2
"""Largest area of a hole over that of all holes, where the picture's border is all material."""
_SHORTEST_CUT = 24
"""Least number of points of a contour that ends at the picture's border: corners are no use."""
_SECOND = 0.2
"""Least area of another island, over the largest one's, that counts as a specimen."""
_TURNS_DEG = np.arange(-24.0, 25.0, 6.0)
"""Rotations of the specimen between two pictures that are tried."""
_CONTOURS = (
    "No speckle: the displacement is that of a hyperelastic body held to its contours, and the "
    "ansatz is fitted to it."
)
CUT = (
    "Not all of the specimen is in view: what holds it where the picture cuts it isn't known, so "
    "that nothing is said within about a cell of there."
)
_DOTS = (
    "{} dots are on the material: what its edges surround of less than a sixth of the largest "
    "hole's area is taken for one; give a mask if these are holes."
)
_LEFT = "Some of the specimen has left the picture: what is there follows from a law alone."
_GROWING = np.array([4.0, 6.0, 9.0, 14.0, 20.0, 30.0, np.inf, np.inf])
"""Distances from the picture's middle within which holes are matched in turn, over the reach of a
match: holes matched before predict where the next ones are."""
_ALIKE = 0.4
"""Radius within which a hole is searched, over the distance to the next hole."""


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


def plain_surface(
    image: FloatImage, like: BoolArray | None = None, dot_px2: float | None = None
) -> MaterialContours | None:
    """Find the contours of a plain material in a picture (rows, cols); None if it has speckle.

    Of several specimens the largest is taken, or the one where ``like`` is True. One that reaches
    the picture's border is in view in part: its contours end there. Contours within the material of
    an area [px^2] below ``dot_px2``, by default a sixth of the largest hole's, are dots on it.
    """
    image = np.asarray(image, dtype=np.float32)
    if ((image == image.min()) | (image == image.max())).all():  # thresholded: soften the steps
        image = gaussian_filter(image, _LENS_PX)
    grey = gaussian_filter(image, _BLUR_PX)
    few = max(1, min(grey.shape) // _COARSE_PX)
    found = None if _two_levels(grey[::few, ::few]) is None else _two_levels(grey)
    if found is None:
        return None
    bright, middle, step = found
    material = large_parts(bright if _is_material(bright) else ~bright, _LEAST_PX2)
    if not material.any() or _shows_speckle(image, material, step):
        return None
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
    noise = estimated_noise(image, material).sd ** 2 / _CORRELATED_PX
    # The slope of a straight edge shows the blur by lens, pixels and the filter above.
    blur = float(np.abs(step[material]).mean()) / (slope * np.sqrt(2.0 * np.pi))
    variance = max(0.0, blur**2 - _DIFFERENCE_PX2)
    sharp = tuple(_unbent(Contour(points), variance) for points in contours)
    ends = tuple(_unbent(Contour(points, False), variance) for points in cut)
    marks = tuple(_unbent(Contour(points), variance) for points in dots)
    # Noise and grey level were taken without the dots, which are material all the same.
    mask = _filled(material, most) if dots else material
    return MaterialContours(mask, sharp, noise / slope**2, text, ends, marks)


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


@dataclass(frozen=True, eq=False)
class MatchedContours:
    """The same contours in two pictures."""

    seen: SeenContours
    affine: FloatArray
    """(3, 2): a point's displacement is about (x, y, 1) times this [-, and mm]."""
    holes: tuple[tuple[Contour, Contour], ...]
    """Contours of the same holes in the reference and in the deformed picture."""
    lost: int
    """Holes of the reference that weren't found in the deformed picture."""

    def start(self, points: FloatArray) -> FloatArray:
        """(n, 2) displacement of points (n, 2) [mm] by the affine motion."""
        return _affinely(points, self.affine)


def matched_contours(
    reference: MaterialContours, deformed: MaterialContours, grid: PixelGrid
) -> MatchedContours:
    """Find each contour of a picture again in another one.

    InputError if fewer than half of the holes are found, or fewer than three in a part of a
    specimen. Contours that are cut are searched where the holes' affine motion takes them.
    """
    outer, holes, cut, dots = reference.on(grid)
    outer_g, others, cut_g, dots_g = deformed.on(grid)
    whole = bool(outer and outer_g)
    a = np.array([hole.moments[1] for hole in holes]).reshape(-1, 2)
    b = np.array([hole.moments[1] for hole in others]).reshape(-1, 2)
    pairs = _paired(a, b, whole) if len(holes) > 2 and len(others) > 2 else []
    if 2 * len(pairs) < len(holes) or not (whole or len(pairs) > 2):
        part = "," if whole else ", of which not all is in view,"
        raise InputError(
            f"expected the reference's {len(holes)} holes in the deformed picture{part} found "
            f"{len(pairs)} of them among {len(others)}; give pictures in "
            "between, or of one and the same specimen"
        )
    found = tuple((holes[i], others[j]) for i, j in pairs)
    if len(pairs) < 3:
        (centre, second), (centre_g, second_g) = (c[0].moments[1:] for c in (outer, outer_g))
        linear = np.diag(np.sqrt(np.diag(second_g)) / np.sqrt(np.diag(second)))
        affine = np.vstack([linear - np.eye(2), centre_g - centre @ linear])
    else:
        i, j = np.array(pairs).T
        affine = _affine(a[i], b[j])
    left = [hole for k, hole in enumerate(holes) if k not in dict(pairs)]
    taken = {j for _, j in pairs}
    left_g = [hole for k, hole in enumerate(others) if k not in taken]
    rest, rest_g = [*cut, *left, *outer], [*cut_g, *left_g, *outer_g]
    arcs = () if whole else _paired_arcs(rest, rest_g, affine, _ALIKE * _spacing(a))
    every = (*zip(outer, outer_g, strict=False), *found) if whole else (*found, *arcs)
    noise = (reference.noise + deformed.noise) * grid.pixel_size**3
    sides = tuple(c for c, _ in every), tuple(c for _, c in every)
    seen = SeenContours(*sides, noise, _CORRELATED_PX * grid.pixel_size,
                        _paired_dots(dots, dots_g, affine), reference.is_part)  # fmt: skip
    lost = len(left) - sum(any(c is hole for hole in left) for c, _ in arcs)
    return MatchedContours(seen, affine, found, lost)


def _paired_arcs(
    f: Sequence[Contour], g: Sequence[Contour], affine: FloatArray, reach: float
) -> tuple[tuple[Contour, Contour], ...]:
    """Pairs of the same contour in two pictures; at least one of each pair is cut."""
    trees, found = [cKDTree(contour.points) for contour in g], []
    for contour in f:
        x = contour.points + _affinely(contour.points, affine)
        far = [
            float(np.median(tree.query(x)[0])) if not (contour.closed and other.closed) else np.inf
            for tree, other in zip(trees, g, strict=True)
        ]
        if far and min(far) < reach:
            found.append((contour, g[int(np.argmin(far))]))
    return tuple(found)


def _paired_dots(
    f: Sequence[Contour], g: Sequence[Contour], affine: FloatArray
) -> tuple[tuple[Contour, Contour], ...]:
    """Pairs of the same dot in two pictures, near where the holes' affine motion takes it."""
    if not (f and g):
        return ()
    a, b = (np.array([contour.moments[1] for contour in side]) for side in (f, g))
    reach = _ALIKE * _spacing(a) if len(a) > 1 else np.inf
    pairs = _assigned(a + _affinely(a, affine), b, reach)
    return tuple((f[i], g[j]) for i, j in pairs)


def _spacing(a: FloatArray) -> float:
    """Median distance of points (n, 2) to their nearest."""
    return float(np.median(cKDTree(a).query(a, k=2)[0][:, 1]))


def _affine(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 2) the affine displacement of points a to points b (n, 2)."""
    return np.asarray(np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b - a)[0])


def _affinely(points: FloatArray, affine: FloatArray) -> FloatArray:
    """(n, 2) an affine displacement (3, 2) of points (n, 2)."""
    return np.asarray(np.column_stack([points, np.ones(len(points))]) @ affine)


def _assigned(a: FloatArray, b: FloatArray, reach: float) -> IntArray:
    """(k, 2) indices of points a (n, 2) and b (m, 2) that are the same, nearer than ``reach``."""
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    i, j = linear_sum_assignment(np.minimum(distance, 2.0 * reach))
    return np.asarray(np.stack([i, j], axis=1)[distance[i, j] < reach])


def _paired(a: FloatArray, b: FloatArray, whole: bool) -> list[tuple[int, int]]:
    """Pairs of indices of points a (n, 2) and the same points in b (m, 2), after a motion.

    If not all is in view, those in the middle have moved by less than 0.4 of their spacing.
    """
    reach = _ALIKE * _spacing(a)
    there, far = (_laid_over(a, b, reach), [np.inf] * _ROUNDS) if whole else (a, _GROWING * reach)
    for radius in far:
        pairs = _assigned(there, b, reach)
        pairs = pairs[np.linalg.norm(a[pairs[:, 0]], axis=1) < radius]
        if len(pairs) > 2:
            there = a + _affinely(a, _affine(a[pairs[:, 0]], b[pairs[:, 1]]))
    return [(int(i), int(j)) for i, j in pairs]


def _laid_over(a: FloatArray, b: FloatArray, reach: float) -> FloatArray:
    """Points a (n, 2) rotated, stretched and shifted so that they lie about upon b (m, 2)."""
    best: tuple[float, FloatArray] = (np.inf, a)
    for turn in np.deg2rad(_TURNS_DEG):
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        upright = (b - b.mean(axis=0)) @ back
        centred = a - a.mean(axis=0)
        scale = upright.std(axis=0) / np.maximum(centred.std(axis=0), 1e-12)
        stretched = centred * np.where(centred.std(axis=0) > 0.0, scale, 1.0)
        there = stretched @ back.T + b.mean(axis=0)
        distance = cKDTree(b).query(there)[0]
        cost = float(np.minimum(distance, reach).sum())
        best = min(best, (cost, there), key=lambda found: found[0])
    return best[1]


def displacement_of_plain(
    reference: MaterialContours, image: FloatImage, grid: PixelGrid, body: Body,
    progress: Progress = silent, name: str = "the picture", before: FloatArray | None = None,
) -> tuple[NodalResult, MatchedContours]:  # fmt: skip
    """Find the displacement in another picture (rows, cols) of a plain specimen; and contours.

    For the other arguments see :func:`displacement_between`. InputError, which names the picture,
    if it shows no plain specimen, or another one.
    """
    dot_px2 = max((abs(signed_area(points)) for points in reference.dots), default=0.0)
    deformed = plain_surface(image, reference.mask, _DOT_GROWS * dot_px2)
    if deformed is None:
        raise InputError(
            f"expected two grey levels in {name}, like the reference's, got more: a plain specimen "
            "can't be found there; light it evenly, or give a mask if it has speckle"
        )
    return displacement_between(reference, deformed, grid, body, progress, before)


def displacement_between(
    reference: MaterialContours, deformed: MaterialContours, grid: PixelGrid, body: Body,
    progress: Progress = silent, before: FloatArray | None = None,
) -> tuple[NodalResult, MatchedContours]:  # fmt: skip
    """Find the displacement between two pictures from their contours; and the matched contours.

    If the reference shows only a part, of material farther than a cell from the picture's border.

    body : a mesh of the reference's material.
    before : (n, 2) displacement of its nodes [mm] in the picture before, which the iteration begins
        from, by default an affine motion.

    InputError if the contours don't match, or don't hold the body.
    """
    matched = matched_contours(reference, deformed, grid)
    found = _after(matched, body, grid, before, progress)
    if reference.is_part:
        centres = np.array([hole.moments[1] for hole, _ in matched.holes])
        found = _inner_part(found, reference.mask, _spacing(centres))
    if matched.lost:
        lost = f"{matched.lost} holes weren't found again: what is around them follows from a law."
        found = replace(found, warnings=(*found.warnings, lost))
    if deformed.is_part and not reference.is_part:
        found = replace(found, warnings=(*found.warnings, _LEFT))
    return found, matched


def _after(
    matched: MatchedContours, body: Body, grid: PixelGrid, before: FloatArray | None,
    progress: Progress,
) -> NodalResult:  # fmt: skip
    """Start from the displacement before, its affine part replaced; if that fails, without it."""
    nodes = body.mesh.nodes
    start, found = matched.start(nodes), None
    if before is not None and len(before) == len(nodes):  # of a part in view fewer are known
        there = start + before - _affinely(nodes, _affine(nodes, nodes + before))
        with suppress(InputError):
            found = displacement_from_contours(matched.seen, body, grid, there, progress=progress)
    if found is None or found.warnings:
        found = displacement_from_contours(matched.seen, body, grid, start, progress=progress)
    return found


def away_from_cuts(mask: BoolArray, grid: PixelGrid, cell_size: float) -> BoolArray:
    """(rows, cols) where a material is farther than a cell [mm] from where the border cuts it."""
    cut = np.zeros_like(mask)
    cut[[0, -1]], cut[:, [0, -1]] = mask[[0, -1]], mask[:, [0, -1]]
    return mask & ~grown(cut, cell_size / grid.pixel_size)


def _inner_part(found: NodalResult, mask: BoolArray, reach: float) -> NodalResult:
    """Keep elements with a node farther than ``reach`` [mm] from where a picture cuts material."""
    mesh, grid = found.mesh, found.grid
    at = np.rint(grid.to_px(*mesh.nodes.T)).astype(np.int64).T
    row, col = np.clip(at, 0, np.array(mask.shape) - 1).T
    far = away_from_cuts(mask, grid, reach)[row, col]
    cells = mesh.cells[far[mesh.cells].any(axis=1)]
    if not cells.size:
        raise InputError(
            "contours: expected a specimen of which more is in view than a cell beside the "
            "picture's border, got less; take it from farther away"
        )
    kept = np.unique(cells)
    nodal = "displacement start standard_deviation noise_deviation gradient_covariance roots"
    parts = {name: part[kept] for name, part in picked(found, nodal).items()}
    return replace(
        found, mesh=Mesh(mesh.nodes[kept], np.searchsorted(kept, cells), mesh.element), **parts
    )


def measure_contours(
    reference: MaterialContours, pair: ImagePair, name: str, geometry: Geometry, cell_size: float,
    how: PhotographOptions, body: Body, progress: Progress = silent,
    before: MeasuredPhotograph | None = None,
) -> tuple[MeasuredPhotograph, MatchedContours]:  # fmt: skip
    """Measure a photograph of a specimen without speckle, by its contours, and the modes in it.

    The result is the ansatz fitted to the displacement from contours, with a covariance by noise.
    The refitted ansatz in ``whole`` has a covariance by all uncertainties of this displacement,
    laws and plates included. ``reference``: contours of the pair's reference; ``name``: of the
    photograph, for messages; ``before``: the previous photograph, as an initial guess; for the rest
    see :func:`~modeharvest.idic.photograph.measure.measure`. InputError if the photograph shows no
    such specimen, or the spectrum contradicts the cell size.
    """
    measured, contours = displacement_of_plain(
        reference, pair.deformed, geometry.grid, body, progress, name,
        before.whole.measured.displacement if before and before.whole else None,
    )  # fmt: skip
    guess, ansatz, unknowns, text = found_modes(
        pair, geometry, cell_size, how, measured.at_points(cell_size / POINTS_A_CELL)
    )
    assert measured.roots is not None
    fit = refitted(measured, ansatz, unknowns, geometry.mask)
    by_noise = replace(measured, roots=measured.roots[..., :SAMPLES])
    result = refitted(by_noise, fit.ansatz, fit.unknowns, geometry.mask)
    whole = WholeField(measured, fit, start="an affine motion of the holes")
    text = (_CONTOURS, *text)
    return MeasuredPhotograph(result, guess.local, text, whole, measured.warnings), contours


def write_shapes(
    folder: Path, name: str, matched: MatchedContours, unit: str = "mm"
) -> tuple[Path, ...]:
    """Write the holes' and the dots' shapes in both pictures as tables (CSV), atomically.

    Returns ``NAME_holes.csv``, and ``NAME_dots.csv`` if there are some.
    """
    lengths = f"x [{unit}]", f"y up [{unit}]", f"area [{unit}^2]"
    own = (*lengths, "ellipticity [-]", "orientation [degrees]")
    heads = [f"{when} {head}" for when in ("reference", "deformed") for head in own]
    kinds = {"holes": matched.holes} | ({"dots": dots} if (dots := matched.seen.dots) else {})
    paths = tuple(folder / f"{name}_{kind}.csv" for kind in kinds)
    for path, pairs in zip(paths, kinds.values(), strict=True):
        shapes = ([HoleShape.of(hole) for hole in pair] for pair in pairs)
        write_csv(path, heads, ([f"{v:.6g}" for s in two for v in astuple(s)] for two in shapes))
    return paths
