"""Photographs of a plain specimen, without speckle: its material, its contours, its holes.

Such a picture has two grey levels, and its information is where they meet. Contours are taken at
half-way between the levels around, which may vary slowly over the picture, after a blur of less
than a pixel. What blur moves curved edges by, its variance over twice their radius, is put back.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, label
from scipy.optimize import linear_sum_assignment
from scipy.signal import savgol_filter
from skimage.filters import threshold_otsu

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
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic
from modeharvest.util.masks import large_parts, shrunk
from modeharvest.util.progress import Progress, silent

_BLUR_PX = 0.7
_CORRELATED_PX = 2.0 * np.sqrt(np.pi) * _BLUR_PX
"""Length over which that correlates white noise."""
_TWO_LEVELS = 0.9
"""Share of a picture's variance that two grey levels explain: 0.98 of plain pictures with noise of
1 %, 0.67 to 0.81 of speckled ones with a background."""
_LIGHT_SHARE = 0.1
"""Over which part of the picture's shorter side grey levels are averaged."""
_ROUNDS, _SAMPLES_A_WIDTH = 3, 10
_COARSE_PX = 400
"""Shorter side of what is looked at first: most pictures have speckle, which shows there, too."""
_INSIDE_PX = 4.0
"""Pixels farther than this from any edge show the grey levels."""
_SPECKLE_PX, _LAG_PX = 8.0, 2
_FAINTEST, _ALIKE_GREY = 0.02, 0.3
"""Speckle is what varies by more than a fiftieth of the step at edges, and is alike 2 px away."""
_DIFFERENCE_PX2 = 1.0 / 3.0
"""Variance of the blur that differences over two pixels add."""
_EVERY_PX, _CURVED_PX, _SHARPENED = 0.5, 5.0, 2
"""Distance of a contour's points; polynomials through so many px on both sides have its curvature,
as it is after so many steps."""
_SHARPEST = 1.0 / 3.0
"""Largest curvature [1/px]: that of a corner is no radius."""
_LEAST_PX2 = 60.0
"""Area of a hole or island; smaller ones are dirt."""
_SECOND = 0.2
"""Area over the largest one's from which on another island is a specimen."""
_TURNS_DEG = np.arange(-24.0, 25.0, 6.0)
"""Rotations of the specimen between two pictures that are tried."""
_CONTOURS = (
    "No speckle: the displacement is that of a hyperelastic body held to its contours, and the "
    "ansatz is fitted to it."
)
_ALIKE = 0.4
"""Share of the distance to the next hole within which a hole is looked for."""


@dataclass(frozen=True, eq=False)
class PlainSurface:
    """A picture of two grey levels."""

    mask: BoolArray
    """(rows, cols) True on material."""
    contours: tuple[FloatArray, ...]
    """(n, 2) points (row, col) [px] of each, the outer one of the material first, then those of its
    holes."""
    noise: float
    """Variance of a contour's distance times the length over which it is correlated [px^3]."""
    warnings: tuple[str, ...] = ()
    """Whether there are other specimens in the picture."""


def plain_surface(
    image: FloatImage, name: str = "the picture", like: BoolArray | None = None
) -> PlainSurface | None:
    """What a picture (rows, cols) shows if it shows a plain material; None if it has speckle.

    Of several specimens the largest is taken, or the one where ``like`` is True. InputError, in
    which the picture has a name, if the specimen reaches its border.
    """
    grey = gaussian_filter(np.asarray(image, dtype=np.float32), _BLUR_PX)
    few = max(1, min(grey.shape) // _COARSE_PX)
    found = None if _two_levels(grey[::few, ::few]) is None else _two_levels(grey)
    if found is None:
        return None
    bright, middle, step = found
    border = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
    material = large_parts(bright if border.mean() < 0.5 else ~bright, _LEAST_PX2)
    if not material.any() or _shows_speckle(image, material, step):
        return None
    material, text = _one_specimen(material | ~large_parts(~material, _LEAST_PX2), like)
    reached = sum(int(side.sum()) for side in (*material[[0, -1]], *material[:, [0, -1]].T))
    if reached:
        raise InputError(
            f"expected all of a specimen without speckle in {name}, got material at "
            f"{reached} px of its border; take it from farther away, or crop nothing"
        )
    contours = closed_contours(grey - middle, material)
    if not contours:
        return None
    slope = _slope(grey, contours)
    # White noise of the pixels, blurred: its variance at a point times its correlation length.
    noise = estimated_noise(image, material).sd ** 2 / _CORRELATED_PX
    # The slope of a straight edge says how far the lens, the pixels and this have blurred it.
    blur = float(np.abs(step[material]).mean()) / (slope * np.sqrt(2.0 * np.pi))
    variance = max(0.0, blur**2 - _DIFFERENCE_PX2)
    sharp = tuple(_unbent(points, variance) for points in contours)
    return PlainSurface(material, sharp, noise / slope**2, text)


def _two_levels(grey: FloatImage) -> tuple[BoolArray, FloatArray, FloatArray] | None:
    """(rows, cols) where a picture is bright, the middle of its two levels, and their difference.

    None unless these explain most of it.
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


def closed_contours(signed: FloatArray, material: BoolArray) -> tuple[FloatArray, ...]:
    """Closed contours (n, 2) at 0 around a material, the longest first."""
    found = []
    for points in find_contours(signed.astype(np.float64), 0.0):
        row, col = np.rint(points[len(points) // 2]).astype(int)
        around = np.s_[max(0, row - 2) : row + 3, max(0, col - 2) : col + 3]
        closed = len(points) > 8 and np.allclose(points[0], points[-1])
        if closed and material[around].any() and abs(signed_area(points)) > _LEAST_PX2:
            found.append(points[:-1])
    return tuple(sorted(found, key=lambda points: -abs(signed_area(points))))


def _one_specimen(material: BoolArray, like: BoolArray | None) -> tuple[BoolArray, tuple[str, ...]]:
    """The largest island, or the one where ``like`` is True; what there is besides."""
    islands, _ = label(material)
    sizes = np.bincount(islands.ravel())[1:]
    at = sizes if like is None else np.bincount(islands[like], minlength=len(sizes) + 1)[1:]
    mine, count = int(np.argmax(at)), int((sizes >= _SECOND * sizes.max()).sum())
    text = (
        f"There are {count} specimens in the picture; the one of {sizes[mine]} px was measured: "
        "crop the pictures to measure another one."
    )
    return np.asarray(islands == 1 + mine), (text,) * (count > 1)


def _inside(material: BoolArray) -> BoolArray:
    inside = shrunk(material, _INSIDE_PX)
    return inside if inside.any() else material


def _level(grey: FloatImage, region: BoolArray) -> FloatArray:
    """(rows, cols) grey level of a region, away from its edges, as it is around each pixel."""
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
    """Whether the material's grey level varies by more than noise, which pixels don't share."""
    inside = _inside(material)
    weight = gaussian_filter(inside.astype(np.float32), _SPECKLE_PX) + np.float32(1e-6)
    grey = np.where(inside, image, 0.0).astype(np.float32)
    fine = np.where(inside, image - gaussian_filter(grey, _SPECKLE_PX) / weight, 0.0)
    both = inside[:, _LAG_PX:] & inside[:, :-_LAG_PX]
    if fine[inside].std() < _FAINTEST * abs(float(step[inside].mean())) or not both.any():
        return False
    alike = np.corrcoef(fine[:, _LAG_PX:][both], fine[:, :-_LAG_PX][both])[0, 1]
    return bool(alike > _ALIKE_GREY)


def _unbent(points: FloatArray, variance: float) -> FloatArray:
    """A contour (n, 2) less what a blur of that variance [px^2] has moved it, 1/2R times that.

    To the centre of curvature, that is, of the contour before the blur: found by iteration.
    """
    seen, step = Contour(points).evenly(_EVERY_PX)
    found, window = seen, 2 * round(_CURVED_PX / step) + 1
    for _ in range(_SHARPENED):
        bent = savgol_filter(found, min(window, len(seen)), 5, 2, step, axis=0, mode="wrap")
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
    """In the reference and in the deformed picture."""
    lost: int
    """Holes of the reference that weren't found in the deformed picture."""

    def start(self, points: FloatArray) -> FloatArray:
        """(n, 2) displacement of points (n, 2) [mm] by the affine motion."""
        return np.column_stack([points, np.ones(len(points))]) @ self.affine


def matched_contours(
    reference: PlainSurface, deformed: PlainSurface, grid: PixelGrid
) -> MatchedContours:
    """Find each contour of a picture again in another one.

    InputError if fewer than half of the holes are found.
    """
    f, g = (
        [Contour(np.column_stack(grid.to_mm(*points.T))) for points in surface.contours]
        for surface in (reference, deformed)
    )
    outer, holes, others = (f[0], g[0]), f[1:], g[1:]
    a = np.array([contour.moments[1] for contour in f])
    b = np.array([contour.moments[1] for contour in g])
    pairs = _paired(a[1:], b[1:]) if len(holes) > 2 and len(others) > 2 else []
    if 2 * len(pairs) < len(holes):
        raise InputError(
            f"expected the reference's {len(holes)} holes in the deformed picture, found "
            f"{len(pairs)} of them among {len(others)}; give pictures in "
            "between, or of one and the same specimen"
        )
    found = tuple((holes[i], others[j]) for i, j in pairs)
    if len(pairs) < 3:
        sizes = [np.sqrt(np.diag(contour.moments[2])) for contour in outer]
        linear = np.diag(sizes[1] / sizes[0])
        affine = np.vstack([linear - np.eye(2), b[0] - a[0] @ linear])
    else:
        at = 1 + np.array(pairs).T
        affine = _affine(a[at[0]], b[at[1]])
    every = (outer, *found)
    noise = (reference.noise + deformed.noise) * grid.pixel_size**3
    sides = tuple(c for c, _ in every), tuple(c for _, c in every)
    seen = SeenContours(*sides, noise, _CORRELATED_PX * grid.pixel_size)
    return MatchedContours(seen, affine, found, len(holes) - len(found))


def _affine(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 2) the affine displacement of points a to points b (n, 2)."""
    return np.asarray(np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b - a)[0])


def _paired(a: FloatArray, b: FloatArray) -> list[tuple[int, int]]:
    """Which of the points a (n, 2) is which of b (m, 2), turned, stretched and shifted."""
    near = np.linalg.norm(a[:, None] - a, axis=2) + 1e9 * np.eye(len(a))
    reach = _ALIKE * float(np.median(near.min(axis=1)))
    best: tuple[float, FloatArray] = (np.inf, a)
    for turn in np.deg2rad(_TURNS_DEG):
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        upright = (b - b.mean(axis=0)) @ back
        centred = a - a.mean(axis=0)
        scale = upright.std(axis=0) / np.maximum(centred.std(axis=0), 1e-12)
        there = (centred * np.where(centred.std(axis=0) > 0.0, scale, 1.0)) @ back.T + b.mean(
            axis=0
        )
        distance = np.linalg.norm(there[:, None] - b, axis=2)
        cost = float(np.minimum(distance.min(axis=1), reach).sum())
        best = min(best, (cost, there), key=lambda found: found[0])
    there = best[1]
    for _ in range(3):
        distance = np.linalg.norm(there[:, None] - b, axis=2)
        i, j = linear_sum_assignment(np.minimum(distance, 2.0 * reach))
        ok = distance[i, j] < reach
        i, j = i[ok], j[ok]
        if len(i) < 3:
            break
        there = a + np.column_stack([a, np.ones(len(a))]) @ _affine(a[i], b[j])
    return list(zip(i.tolist(), j.tolist(), strict=True))


def displacement_of_plain(
    reference: PlainSurface,
    image: FloatImage,
    grid: PixelGrid,
    body: Body,
    progress: Progress = silent,
    name: str = "the picture",
) -> tuple[NodalResult, MatchedContours]:
    """The displacement in another picture (rows, cols) of a plain specimen, and its contours.

    ``body``: a mesh of the reference's material. InputError, in which the picture has a name, if it
    shows no plain specimen, or another one.
    """
    deformed = plain_surface(image, name, reference.mask)
    if deformed is None:
        raise InputError(
            f"expected two grey levels in {name}, like the reference's, got more: a plain specimen "
            "can't be found there; light it evenly, or give a mask if it has speckle"
        )
    matched = matched_contours(reference, deformed, grid)
    start = matched.start(body.mesh.nodes)
    found = displacement_from_contours(matched.seen, body, grid, start, progress=progress)
    if matched.lost:
        lost = f"{matched.lost} holes weren't found again: what is around them follows from a law."
        found = replace(found, warnings=(*found.warnings, lost))
    return found, matched


def measure_contours(
    reference: PlainSurface, pair: ImagePair, name: str, geometry: Geometry, cell_size: float,
    how: PhotographOptions, body: Body, progress: Progress = silent,
) -> tuple[MeasuredPhotograph, MatchedContours]:  # fmt: skip
    """Measure a photograph of a specimen without speckle, by its contours, and the modes in it.

    The result is the ansatz fitted to the displacement that contours determine, its covariance that
    by noise; the refitted ansatz' is by all that this displacement is uncertain by, laws and plates
    included. ``reference``: what the pair's reference shows; ``name``: of the photograph, for
    messages; for the rest see :func:`~modeharvest.idic.photograph.measure.measure`. InputError if
    the photograph shows no such specimen, or the spectrum contradicts the cell size.
    """
    measured, contours = displacement_of_plain(
        reference, pair.deformed, geometry.grid, body, progress, name
    )
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


def write_holes(path: Path, matched: MatchedContours, unit: str = "mm") -> None:
    """Write the holes' shapes in both pictures as a table (CSV), atomically."""
    own = f"x [{unit}]", f"y up [{unit}]", f"area [{unit}^2]"
    heads = (*own, "ellipticity [-]", "orientation [degrees]")
    with atomic(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([f"{when} {head}" for when in ("reference", "deformed") for head in heads])
        for pair in matched.holes:
            values = [value for hole in pair for value in astuple(HoleShape.of(hole))]
            table.writerow([f"{value:.6g}" for value in values])
