"""Displacement and modes of a plain specimen, measured by its contours; its holes' shapes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.contours.measure import UNSETTLED, displacement_from_contours
from modeharvest.idic.finite_element.equations.system import SAMPLES, Body
from modeharvest.idic.finite_element.result import NodalResult, WholeField, refitted
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.measure import POINTS_A_CELL, MeasuredPhotograph, found_modes
from modeharvest.idic.photograph.plain.matching import (
    MatchedContours,
    affine_displacement,
    fitted_affine,
    matched_contours,
    median_spacing,
)
from modeharvest.idic.photograph.plain.surface import (
    MaterialContours,
    away_from_cuts,
    plain_surface,
)
from modeharvest.idic.setup import PhotographOptions
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.contour import HoleShape, signed_area
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import write_csv
from modeharvest.util.progress import Progress, silent
from modeharvest.util.typed import picked

_DOT_GROWS = 1.8
"""Largest area of a dot in another picture, where holes may be nearly closed, over that of the
reference's largest dot."""
_CONTOURS = (
    "No speckle: the displacement is that of a hyperelastic body held to its contours, and the "
    "ansatz is fitted to it."
)
_LEFT = "Some of the specimen has left the picture: what is there follows from a law alone."


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
        found = _inner_part(found, reference.mask, median_spacing(centres))
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
        there = start + before - affine_displacement(nodes, fitted_affine(nodes, nodes + before))
        with suppress(InputError):
            found = displacement_from_contours(matched.seen, body, grid, there, progress=progress)
    if found is None or found.warnings:
        found = displacement_from_contours(matched.seen, body, grid, start, progress=progress)
    return found


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
    if UNSETTLED in measured.warnings:
        result = replace(result, outcome=Outcome.MAX_ITERATIONS)
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
