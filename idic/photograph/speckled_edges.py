"""Contours of a speckled specimen, and its modes from them alone, as a second measurement.

A pixel at an edge shows b + s (m - b), with the background's grey level b around it, the material's
m just inside, and the share s of material. s is found by least squares over a blur, so that bright
speckles count, and dark ones, which look like background, hardly do. A contour is where s is one
half. Polynomials along it remove what is finer than the elements whose edges follow it.

The effect of speckle on an edge is random and rough: the roughness of the reference's contours
shows their uncertainty. Both photographs show the same speckle at an edge, so about half of the
variance is in common and doesn't count. The speckle inside isn't used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, map_coordinates

from modeharvest.idic.ansatz import FEWEST_CELLS, cells_across, for_cells
from modeharvest.idic.finite_element.equations.system import SAMPLES, Body
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import refitted
from modeharvest.idic.photograph.geometry import box_of
from modeharvest.idic.photograph.material import AROUND_PX, mean_over
from modeharvest.idic.photograph.plain.measure import displacement_between
from modeharvest.idic.photograph.plain.surface import (
    CUT,
    MaterialContours,
    away_from_cuts,
    contours_around,
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
"""Elements per cell, along edges."""
_SURE_PX, _BAND_PX = 2.0, 3.0
"""Pixels farther than this from a mask's edge are material or background, however wrong the mask
is; and distance from that edge within which edges are searched."""
_REACH_PX, _BLUR_PX = 1.5, 0.7
"""Gaussian widths for the material's level and the least squares."""
_SMOOTHED = 1.0 / 6.0
"""Gaussian width of the windows that polynomials are fitted in, over an element's edge."""
_STEP_PX = 0.5
_CURVED, _ROUGH = 1.0 / 8.0, 1.0 / 10.0
"""Gaussian width [cells] of the parabolas relative to which a contour's roughness is measured, and
length over which that is averaged, longer than speckles are."""
_COMMON = 0.5
"""Share of the variance that both photographs' contours have in common: assumed, not measured; see
docs/explanation/contours_beside.md."""
_SHOWN_PX = 10.0
_LEAST_HOLE = 0.1
"""Area of a contour over the holes' median; smaller ones are dirt, or speckle taken for a hole."""


@dataclass(frozen=True, eq=False)
class ByContours:
    """The ansatz of a photograph, measured by contours instead of speckle."""

    result: Result
    """Result with ``errors``: by the contours' noise, and by all that contours leave undetermined,
    as for a specimen without speckle: its law, whether it slides on plates, springs."""
    speckle: Result
    """Result by speckle for the same ansatz; of a part in view, on the same pixels."""
    edge_sd_px: float
    """Standard deviation of an edge's displacement, averaged along 10 px [px]."""


def body_for_edges(mask: BoolArray, grid: PixelGrid, cell_px: float) -> Body:
    """Mesh the material with element edges as long as contours can resolve.

    Material between a hole and the picture's border that is narrower than an edge is left out: it
    would make all elements as small.
    """
    edge = max(4.0, cell_px / ELEMENTS_A_CELL)
    slim = mask & ~opened(mask, 0.5 * edge, at_border=True)
    inner = slice(round(edge), -round(edge))
    slim[inner, inner] = False
    return FiniteElementOptions(2.0 * edge, edge).body(mask & ~slim, grid)


def edges_of_speckled(image: FloatImage, mask: BoolArray, cell_px: float) -> MaterialContours:
    """Find contours (row, col) of a speckled material in an image (rows, cols), near a mask's edge.

    Their ``noise`` is what one of two photographs of the same speckle adds to a displacement's. The
    contours of a part in view end at the image's border. InputError if no edges are found.
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
    """Variance of contours' distances by speckle, times their correlation length [px^3].

    D. W. Allan's variance, of means over neighbouring lengths, to which shapes hardly add.
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
    inside = mean_over(grey, material, _REACH_PX)
    contrast = inside - mean_over(grey, background, AROUND_PX)
    narrow = mask & ~shrunk(mask, _SURE_PX + 1.0) & material  # as near to the edge as is sure
    ridge = np.float32(np.mean((grey - inside)[narrow] ** 2)) if narrow.any() else np.float32(1e-12)
    product = _blurred((grey - inside + contrast) * contrast + ridge * mask)
    square = _blurred(contrast**2)
    band = grown(mask, _BAND_PX) & ~shrunk(mask, _BAND_PX)
    share = np.where(band, product / (square + ridge), mask)
    return share.astype(np.float64), (square / (square + ridge) + 1e-2).astype(np.float64)


def _blurred(image: FloatImage) -> FloatImage:
    return np.asarray(gaussian_filter(image, _BLUR_PX, output=np.float32))


def _smoothed(
    curve: Contour, weight: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, float]:
    """(n, 2) parabolas fitted along a contour, their residual, and the points' spacing [px].

    Their weights are a Gaussian of ``width`` [px] times ``weight``, and 0 beyond a contour's ends.
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
    """Fit a result's ansatz to contours alone, starting from the result by speckle.

    reference : contours of the reference, by :func:`edges_of_speckled`.
    pair : the photographs with both masks of the material.
    body : by :func:`body_for_edges`, of the reference's mask.

    Of a part in view, only what is farther than a cell from the picture's border is fitted, by an
    ansatz for that number of cells. InputError if there are too few cells, or if the contours can't
    be found or don't belong together.
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
