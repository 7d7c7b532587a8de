"""Contours of a speckled specimen, and the modes that they alone show, as a second measurement.

A pixel at an edge shows b + s (m - b), b the background's grey level around, m the material's just
inside, and s the share of material that is sought: by least squares over a blur, so that bright
speckles count and dark ones, which look like background, hardly do. A contour is where s is one
half. Polynomials along it take away what is finer than the elements whose edges follow it.

What the speckle does to an edge is random, and rough: how rough the reference's contours are says
how uncertain they are. Both photographs show the same speckle at an edge, so about half of the
variance is in common and doesn't count. Of the speckle inside nothing is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, map_coordinates

from modeharvest.idic.ansatz import FEWEST_CELLS, cells_across, for_cells
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import refitted
from modeharvest.idic.finite_element.system import SAMPLES, Body
from modeharvest.idic.photograph.geometry import box_of
from modeharvest.idic.photograph.plain import (
    CUT,
    MaterialContours,
    away_from_cuts,
    contours_around,
    displacement_between,
)
from modeharvest.idic.result import Covariance, Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.contour import Contour, signed_area
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown, opened, shrunk
from modeharvest.util.progress import Progress, silent

ELEMENTS_A_CELL = 5
"""Along edges."""
_SURE_PX, _BAND_PX = 2.0, 3.0
"""Farther than this from a mask's edge pixels are material or background, whatever the mask is off
by; and how far from it edges are looked for."""
_REACH_PX, _AROUND_PX, _BLUR_PX = 1.5, 25.0, 0.7
"""Gaussian widths: of the material's level, the background's, and the least squares."""
_SMOOTHED = 1.0 / 6.0
"""Gaussian width of what polynomials are fitted to, over an element's edge."""
_STEP_PX = 0.5
_CURVED, _ROUGH = 1.0 / 8.0, 1.0 / 10.0
"""Gaussian width of parabolas that leave a contour's roughness [cells], and length over which that
is averaged, longer than speckles are."""
_COMMON = 0.5
"""Share of the variance that both photographs' contours have in common, about: see
docs/explanation/contours_beside.md."""
_SHOWN_PX = 10.0
_LEAST_HOLE = 0.1
"""Area of a contour over the holes' median; smaller ones are dirt, or speckle taken for a hole."""


@dataclass(frozen=True, eq=False)
class ByContours:
    """The ansatz of a photograph, measured by contours instead of speckle."""

    result: Result
    """With ``errors``: by the contours' noise, and by all that they leave open, as for a specimen
    without speckle: its law, whether it slides on plates, springs."""
    speckle: Result
    """The same by the speckle; of a part in view by that of the same pixels."""
    edge_sd_px: float
    """Standard deviation of an edge's displacement, averaged along 10 px [px]."""


def body_for_edges(mask: BoolArray, grid: PixelGrid, cell_px: float) -> Body:
    """A mesh of the material whose edges are as long as contours can tell.

    Without what is narrower than them between a hole and the picture's border: it would make all
    elements as small.
    """
    edge = max(4.0, cell_px / ELEMENTS_A_CELL)
    slim = mask & ~opened(mask, 0.5 * edge, at_border=True)
    inner = slice(round(edge), -round(edge))
    slim[inner, inner] = False
    return FiniteElementOptions(2.0 * edge, edge).body(mask & ~slim, grid)


def edges_of_speckled(image: FloatImage, mask: BoolArray, cell_px: float) -> MaterialContours:
    """Contours (row, col) of a speckled material in an image (rows, cols); ``mask``: about where.

    Their noise is what one of two photographs of the same speckle adds to a displacement's.
    Those of a part in view end at the image's border. InputError if the material shows no edges.
    """
    share, weight = _share_of_material(np.asarray(image, np.float32), mask)
    found, cut = contours_around(share - 0.5, mask)
    areas = [abs(signed_area(points)) for points in found]
    seen = MaterialContours(mask, (), 0.0, cut=cut)
    holes = areas if seen.is_part else areas[1:]
    least = _LEAST_HOLE * float(np.median(holes)) if holes else 0.0
    kept = [Contour(p) for p, area in zip(found, areas, strict=True) if area >= least]
    ends = [Contour(points, False) for points in cut]
    if not kept:
        raise InputError("contours: expected edges of the material in the picture, got none")
    width = _SMOOTHED * max(4.0, cell_px / ELEMENTS_A_CELL)
    contours, arcs = ([_smoothed(c, weight, width)[0] for c in part] for part in (kept, ends))
    noise = (1.0 - _COMMON) * _roughness(kept, weight, cell_px)
    return replace(seen, contours=(*contours,), noise=noise, cut=(*arcs,),
                   warnings=(CUT,) if seen.is_part else ())  # fmt: skip


def _roughness(contours: Sequence[Contour], weight: FloatArray, cell_px: float) -> float:
    """Variance of contours' distances by speckle, times the length over which they are correlated.

    That of means over neighbouring lengths (D. W. Allan's), which shapes hardly add to [px^3].
    """
    squares = []
    for contour in contours:
        smooth, off, step = _smoothed(contour, weight, _CURVED * cell_px)
        along = np.gradient(smooth, axis=0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=1)
        distance = (off * across).sum(axis=1) / np.linalg.norm(across, axis=1)
        few = max(1, round(_ROUGH * cell_px / step))
        count = len(distance) // few
        means = distance[: count * few].reshape(count, few).mean(axis=1)
        squares.append(0.5 * few * step * np.diff(means) ** 2)
    return float(np.mean(np.concatenate(squares)))


def _share_of_material(grey: FloatImage, mask: BoolArray) -> tuple[FloatArray, FloatArray]:
    """(rows, cols) share of material in each pixel near the edge, and how well it is known.

    Where the material is as dark as the background the mask decides.
    """
    material, background = shrunk(mask, _SURE_PX), shrunk(~mask, _SURE_PX + 1.0)
    inside = _mean_over(grey, material, _REACH_PX)
    contrast = inside - _mean_over(grey, background, _AROUND_PX)
    narrow = mask & ~shrunk(mask, _SURE_PX + 1.0) & material  # as near to the edge as is sure
    ridge = np.float32(np.mean((grey - inside)[narrow] ** 2)) if narrow.any() else np.float32(1e-12)
    product = _blurred((grey - inside + contrast) * contrast + ridge * mask)
    square = _blurred(contrast**2)
    band = grown(mask, _BAND_PX) & ~shrunk(mask, _BAND_PX)
    share = np.where(band, product / (square + ridge), mask)
    return share.astype(np.float64), (square / (square + ridge) + 1e-2).astype(np.float64)


def _blurred(image: FloatImage) -> FloatImage:
    return np.asarray(gaussian_filter(image, _BLUR_PX, output=np.float32))


def _mean_over(grey: FloatImage, region: BoolArray, width: float) -> FloatImage:
    """(rows, cols) mean grey level of a region's pixels around each."""
    typical = np.float32(grey[region].mean()) if region.any() else np.float32(0.0)
    total = gaussian_filter(np.where(region, grey - typical, np.float32(0.0)), width)
    weight = gaussian_filter(region.astype(np.float32), width) + np.float32(1e-6)
    return np.asarray(typical + total / weight, dtype=np.float32)


def _smoothed(
    curve: Contour, weight: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, float]:
    """(n, 2) parabolas fitted along a contour, what they leave of it, and the points' step [px].

    Their weights are Gaussian, of a width [px], times the image's; beyond a contour's end none.
    """
    x, step = curve.evenly(_STEP_PX)
    w = map_coordinates(weight, x.T, order=1, mode="nearest")
    reach = int(min(4.0 * width / step, (len(x) - 1) // 2))
    t = np.arange(-reach, reach + 1) * (step / width)
    window = np.exp(-0.5 * t**2)
    around = [(window * t**k)[::-1] for k in range(5)]
    mode = "wrap" if curve.closed else "constant"
    moments = np.stack([convolve1d(w, part, mode=mode) for part in around])
    right = [convolve1d(w[:, None] * x, part, axis=0, mode=mode) for part in around[:3]]
    A = np.stack([moments[k : k + 3] for k in range(3)]).transpose(2, 0, 1)
    smooth = np.linalg.solve(A, np.stack(right, axis=1))[:, 0]
    return smooth, x - smooth, step


def measure_by_contours(
    reference: MaterialContours, pair: ImagePair, speckle: Result, cell_size: float, body: Body,
    progress: Progress = silent,
) -> ByContours:  # fmt: skip
    """Measure a result's ansatz by contours alone; the result is where iterations start.

    reference : its contours, by :func:`edges_of_speckled`.
    pair : the photographs with both masks of the material.
    body : by :func:`body_for_edges`, of the reference's mask.

    Of a part in view the fit is that of what is farther than a cell from the picture's border, by
    an ansatz for so many cells. InputError if these are too few, if the contours don't belong
    together, or can't be found.
    """
    grid, there = pair.grid, pair.masks[1]
    mask = away_from_cuts(pair.masks[0], grid, cell_size)
    ansatz, a = speckle.ansatz, speckle.unknowns
    if reference.is_part:
        across = cells_across(part := box_of(mask, grid), cell_size) if mask.any() else 0.0
        if round(across) < FEWEST_CELLS:
            raise InputError(
                f"contours: expected {FEWEST_CELLS} cells across or more that are farther than one "
                f"from the picture's border, got {across:.1f}; take more into view"
            )
        ansatz = for_cells(ansatz, part, part, cell_size)
        a = ansatz.initial_guess()
    deformed = edges_of_speckled(pair.deformed, there, cell_size / grid.pixel_size)
    # A buckled hole's ends are too sharp to tell roughness from shape: the speckle is the same.
    deformed = replace(deformed, noise=reference.noise)
    begin = speckle.ansatz.displacement_at(speckle.unknowns, body.mesh.nodes)
    measured, _ = displacement_between(reference, deformed, grid, body, progress, begin)
    fit = refitted(measured, ansatz, a, mask)
    assert measured.roots is not None
    by_noise = replace(measured, roots=measured.roots[..., :SAMPLES])
    result = refitted(by_noise, fit.ansatz, fit.unknowns, mask)
    warnings = *reference.warnings, *measured.warnings
    errors = Covariance(result.covariance(), fit.covariance(), warnings)
    edge_sd = float(np.sqrt(2.0 * reference.noise / _SHOWN_PX))
    return ByContours(replace(result, errors=errors), speckle, edge_sd)
