"""The whole displacement of one photograph: initial guess, brightness, mask, measurement.

No number is typed in: blocks of the speckle give the motion to a pixel, and a first measurement
with the mask of the reference gives the mask of the deformed image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import label, mean
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.idic.chebyshev import Box, ChebyshevField
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.local_light import (
    ROUNDS,
    UNLIKE,
    WINDOW,
    local_gain_and_offset,
)
from modeharvest.idic.finite_element.measure import (
    FiniteElementOptions,
    coarse_displacement,
    measure_displacement,
)
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import Slow, first_motion
from modeharvest.idic.photograph.matching.blocks import (
    BLOCKS,
    REACH_PX,
    BlockMatch,
    expected_by,
    match_blocks,
    require_same_surface,
)
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.noise import estimated_noise, slope_noise
from modeharvest.idic.solver.pyramid import smoothed
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import non_positive_jacobians
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.masks import shrunk
from modeharvest.util.progress import Progress, silent

_FAR_PX = 4 * REACH_PX
"""How far blocks are searched where they aren't found nearby."""
_ENOUGH = 0.9
"""Share of blocks that are found nearby, unless some have moved far."""
_CLOSE_PX = 1.5
"""Largest residual of a polynomial for nine tenths of the blocks' motion."""
_DENSER = 5, 16
"""Factors by which blocks are more, in turn: the widest places are junctions, which only turn.
"""
_SMOOTH_PX = 60.0
"""Shorter waves of an initial guess come from motions in whole pixels, and would remain."""
_SMOOTHER_FROM, _OVER_CUTOFFS = 0.75, (4.0, 2.0)
"""Ratio of cut-off to shortest wave of the initial guess from which on a smoother one is tried, and
over how many cut-offs it is smoothed: over fewer if the images then require a shorter cut-off (over
one, errors of smooth waves are 1.4 times their standard deviation)."""
_LOST = 0.1
"""Share of nodes at which images don't match from which on even light is tried, too."""
_STRAY, _NEIGHBOURS = 8.0, 8
"""Largest difference of a block's motion from its neighbours' median, over their spread; and how
many neighbours these are."""
_SLENDER, _DETERMINED = 1.0 / 3.0, 1e-2
"""Width over length below which a body has axes of its own; least singular value of a polynomial
through blocks, over the largest: those of blocks that are spread over a body are a tenth."""
_FIRST = FiniteElementOptions(edge_px=4)
"""Options of the measurement from which only the deformed image's mask is taken."""
_LAST = FiniteElementOptions(edge_px=1)
"""A camera's pixel on an edge shows some background; one such row lets the edge drift off."""
_BLUR_PX, _SPECKLE = 1.5, 3.0
"""Blur of the reference, and least power of its slopes, over that of noise, with speckle."""
_MISFIT, _SLIGHT = 2.0, 0.03
"""Residual, over the images' noise and over their contrast, beyond which they don't match."""
_OFF_PX, _AT_EDGE_PX = (4.0, 2.0, 2.0, 2.0, 2.0, 2.0), 1.0
"""Possible error of edges after blocks of speckle, one for each first measurement (repeated until
the images match everywhere, or no better), and before the last measurement."""
UNEVEN, _MOST = 0.02, 0.96
"""Range of the light's relative change over most of the material that polynomials may leave
undescribed. Without any change, noise of 3 % in a strip of 360 x 40 px makes 0.012 of it."""
_BY_CHANCE = 0.2
"""That range by noise alone, at most, over the noise's share of the mean level."""
LOCAL = "local"
"""Gain and offset from around each pixel, instead of a degree."""
_SAMPLES, _LEAST = 100_000, 0.1
"""Pixels from which brightness is fitted; least gain anywhere, over the mean."""


class _Swept(NamedTuple):
    """Displacement after the first measurements."""

    known: BoolArray
    """(n,) True at nodes at which the images match."""
    start: FloatArray
    """(n, 2) start of the last measurement, smooth and from around where they don't match [mm]."""
    u: FloatArray
    """(n, 2) displacement of the nodes [mm]."""

    @property
    def unknown(self) -> int:
        """Number of nodes at which the images don't match."""
        return int((~self.known).sum())


def displacement_from(
    start: FloatArray, pair: ImagePair, body: Body, options: FiniteElementOptions = _LAST,
    progress: Progress = silent, light_degree: int | None = 0,
) -> NodalResult:  # fmt: skip
    """Measure a photograph's displacement on a mesh, from an initial guess (n, 2) at nodes [mm].

    ``pair``: with the mask of the reference; brightness may differ. InputError if the images don't
    overlap; and as for :func:`~modeharvest.idic.finite_element.measure.measure_displacement`.
    ``light_degree``: of the polynomials by which gain and offset vary over the reference, if these
    describe the light; else it is taken from around each pixel. None for images of one brightness.
    """
    mesh = body.mesh
    is_sought = pair.mask is not None and not pair.mask.all() and pair.deformed_mask is None

    def seen(u: FloatArray, off_px: float, degree: int | str | None) -> ImagePair:
        """The images, equally bright, without what shows background if edges are off this much."""
        u = _unfolded(u, body, _SMOOTH_PX * pair.grid.pixel_size)
        pair_alike = alike(pair, mesh, u, degree)
        mask = deformed_mask(pair.grid, mesh, u, off_px) if is_sought else pair.deformed_mask
        return replace(pair_alike, deformed_mask=mask)

    def swept(degree: int | str | None) -> _Swept:
        """Repeat the first measurement until the images match everywhere, or no better."""
        known: BoolArray = np.full(len(start), pair.deformed_mask is not None)
        found = _Swept(known, start, start)
        for sweep, off_px in enumerate(_OFF_PX if pair.deformed_mask is None else ()):
            before, shown = found.unknown, seen(found.u, off_px, degree)
            u, known = coarse_displacement(shown, found.start, body, options=_FIRST)
            # Where the images don't match, the next one starts from the neighbours' displacement.
            better = body.smoothed(u, _SMOOTH_PX * pair.grid.pixel_size, known)
            found = _Swept(known, better, u)
            if sweep and not 0 < found.unknown < before:
                break
        return found

    first = swept(light_degree)
    if light_degree and first.unknown > _LOST * len(start):  # slopes adapt to a start far off
        first = min(first, swept(0), key=lambda each: each.unknown)
    if pair.deformed_mask is not None and light_degree is not None:  # not measured yet
        shown = seen(start, _AT_EDGE_PX, light_degree)
        u, known = coarse_displacement(shown, start, body, options=_FIRST)
        first = _Swept(known, start, u)
    matched = np.where(first.known[:, None], first.u, np.nan)
    light = light_for(pair, _on_pixels(pair, mesh, matched), light_degree)
    if light == LOCAL and pair.deformed_mask is None:
        local = swept(light)
        is_lost = local.unknown > first.unknown + _LOST * len(start)
        first, light = (first, light_degree) if is_lost else (local, light)
    _, start, u = first
    measured = partial(measure_displacement, on=body, options=options, progress=progress)
    pair_alike = seen(u, _AT_EDGE_PX, light)
    found = measured(pair_alike, start)
    if found.cutoff_px is None or found.cutoff_px < _SMOOTHER_FROM * _SMOOTH_PX:
        return found
    # Shorter waves of the start are noise of the same images, which no error estimate would count.
    wave = found.cutoff_px * pair.grid.pixel_size
    for over in _OVER_CUTOFFS:
        smoother = measured(pair_alike, body.smoothed(start, over * wave))
        if smoother.cutoff_px is not None and smoother.cutoff_px >= found.cutoff_px:
            break
    return smoother


def _unfolded(u: FloatArray, body: Body, wave: float) -> FloatArray:
    """u (n, 2) [mm], but that around them, of waves so long [mm], at nodes of folded elements."""
    mesh, folded = body.mesh, np.zeros(len(body.mesh.cells), np.bool_)
    folded[non_positive_jacobians(mesh.nodes + u, mesh.cells, mesh.element)] = True
    if not folded.any():
        return u
    known = body.away_from(folded)
    return np.where(known[:, None], u, body.smoothed(u, wave, known))


def speckled(image: FloatImage, mask: BoolArray) -> tuple[BoolArray, tuple[str, ...]]:
    """Select the islands of a mask that show speckle in an image (rows, cols); text on the others.

    The mask is True on material. Slopes of speckle are compared with those of the image's noise,
    both blurred, because few speckles are as small as pixels. InputError if there is none.
    """
    noise = estimated_noise(image, mask).sd ** 2 * slope_noise(5, _BLUR_PX)
    slopes = np.gradient(smoothed(image, mask, _BLUR_PX))
    power = 0.5 * (slopes[0] ** 2 + slopes[1] ** 2)
    islands, count = label(mask)
    numbers = np.arange(1, count + 1)
    is_blank = mean(power, islands, numbers) < np.maximum(_SPECKLE * noise, 1e-12)
    blank = np.isin(islands, numbers[is_blank])
    if count and is_blank.all():
        raise InputError(
            "expected speckle on the material, got nothing but noise there; check the mask: it is "
            "not black on the material, and black elsewhere"
        )
    if not is_blank.any():
        return mask, ()
    row, col = np.argwhere(blank)[0]
    return mask & ~blank, (
        f"{int(is_blank.sum())} island(s) of the mask without speckle, {int(blank.sum())} px, "
        f"the first at row {row}, column {col}, were left out.",
    )


def block_motion(
    pair: ImagePair, body: Body, known: FloatArray, names: Sequence[str] = ()
) -> FloatArray:
    """(n, 2) displacement of the nodes [mm] to some pixels: ``known`` and the motion of blocks.

    A polynomial is fitted to the motion of speckle blocks relative to a known displacement (n, 2);
    if that isn't close to them, a spline through more of them is added. InputError if the blocks
    aren't found.
    """
    mesh = body.mesh
    match = _matched(pair, mesh, known, BLOCKS)
    require_same_surface(match, *names)
    added = match.in_mm(pair.grid).less(_at_nearest(mesh, known))
    known = known + _polynomial(mesh, pair, added)
    for times in _DENSER:
        dense = _matched(pair, mesh, known, times * BLOCKS)
        if dense.found.sum() <= _NEIGHBOURS:  # too few to be compared
            break
        left = dense.in_mm(pair.grid).less(_at_nearest(mesh, known))
        if np.quantile(np.linalg.norm(left.u, axis=1), 0.9) < _CLOSE_PX * pair.grid.pixel_size:
            break
        keep = _like_neighbours(left, pair.grid.pixel_size)
        spline = RBFInterpolator(left.points[keep], left.u[keep], neighbors=30)
        known = known + spline(mesh.nodes)
    return body.smoothed(known, _SMOOTH_PX * pair.grid.pixel_size)


def _polynomial(mesh: Mesh, pair: ImagePair, blocks: LocalField) -> FloatArray:
    """(n, 2) polynomial through the motion of blocks, at the nodes [mm].

    Blocks of a slender body lie on a line, so its polynomials are those along and across it, and
    what the blocks don't determine is left out.
    """
    _, extents, axes = np.linalg.svd(mesh.nodes - mesh.nodes.mean(axis=0), full_matrices=False)
    if extents[1] > _SLENDER * extents[0] or blocks.good.sum() < _NEIGHBOURS + 1:
        axes = np.eye(2)
    nodes, (x, y), u = mesh.nodes @ axes.T, (blocks.points @ axes.T).T, blocks.u @ axes.T
    box = Box(*np.quantile(nodes, [0, 1], axis=0).T.ravel())
    slow, _ = first_motion(box, pair, replace(blocks, x=x, y=y, u=u), _DETERMINED)
    return np.asarray(slow(nodes) @ axes)


def _like_neighbours(blocks: LocalField, pixel_size: float) -> BoolArray:
    """(n,) False for blocks that moved otherwise than their neighbours: found at a wrong place.

    The normalised median test of J. Westerweel, F. Scarano, Exp. Fluids 39 (2005), doi
    10.1007/s00348-005-0016-6.
    """
    around = blocks.u[cKDTree(blocks.points).query(blocks.points, k=1 + _NEIGHBOURS)[1][:, 1:]]
    median = np.median(around, axis=1)
    spread = np.median(np.linalg.norm(around - median[:, None], axis=-1), axis=1)
    off = np.linalg.norm(blocks.u - median, axis=1)
    return np.asarray(off < _STRAY * (spread + pixel_size))


def _matched(pair: ImagePair, mesh: Mesh, u: FloatArray, count: int) -> BlockMatch:
    """Match blocks, searched around where displacements u (n, 2) of the nodes [mm] take them."""
    expected = expected_by(_at_nearest(mesh, u), pair.grid)
    near = match_blocks(pair, expected, REACH_PX, count)
    return near if near.share >= _ENOUGH else match_blocks(pair, expected, _FAR_PX, count)


def _at_nearest(mesh: Mesh, u: FloatArray) -> Slow:
    """Extend displacements u (n, 2) of the nodes [mm] to any point, by the nearest node's."""
    tree = cKDTree(mesh.nodes)
    return lambda points: np.asarray(u[tree.query(points)[1]])


def deformed_mask(grid: PixelGrid, mesh: Mesh, u: FloatArray, less_px: float) -> BoolArray | None:
    """(rows, cols) True where the deformed image shows a mesh, less a margin; None if nowhere.

    ``u`` (n, 2): displacement of the nodes [mm]. Elements that it folds are left out.
    """
    moved = mesh.nodes + u
    cells = np.delete(mesh.cells, non_positive_jacobians(moved, mesh.cells, mesh.element), axis=0)
    inner = shrunk(locate(moved, cells, mesh.element, grid).mask, less_px) if cells.size else None
    return inner if inner is not None and inner.any() else None


def _on_pixels(pair: ImagePair, mesh: Mesh, u: FloatArray) -> FloatArray:
    """(rows, cols, 2) nodal displacement u (n, 2) at the pixels; NaN beside the mesh."""
    at = locate(mesh.nodes, mesh.cells, mesh.element, pair.grid, nodal=u).values
    return np.moveaxis(at, 0, -1)


def alike(pair: ImagePair, mesh: Mesh, u: FloatArray, degree: int | str | None) -> ImagePair:
    """Make brightness and contrast of the pair equal, in the reference's levels; u (n, 2) [mm]."""
    gain, offset = brightness(pair, _on_pixels(pair, mesh, u), degree)
    a, b = (part[pair.masks[0]].mean() for part in (gain, offset))
    reference = a * (pair.reference - offset) / gain + b
    return pair.with_images(reference.astype(np.float32), a * pair.deformed + b)


def brightness(
    pair: ImagePair, u: FloatArray, degree: int | str | None = 0
) -> tuple[FloatArray, FloatArray]:
    """Gain [-] and offset [grey levels], (rows, cols), that make g(x + u) as bright as f.

    Polynomials of total degree ``degree`` that give both images the same mean and contrast: so a
    displacement that is off by some pixels hardly matters. Edges and pixels that don't match don't
    count. ``u`` (rows, cols, 2) [mm], NaN where it isn't known. Degree None: neither, 1 and 0;
    LOCAL: from mean and contrast around each pixel.
    """
    if degree is None:
        return np.ones(pair.grid.shape), np.zeros(pair.grid.shape)
    grid, inner = pair.grid, shrunk(pair.masks[0], _OFF_PX[0])
    inner = (inner if inner.any() else pair.masks[0]) & np.isfinite(u).all(axis=-1)
    every = max(1, int(inner.sum() / _SAMPLES))
    both = np.stack([part[::every] for part in _compared(pair, u, inner)], axis=1, dtype=float)
    there = np.isfinite(both[:, 1])
    if not there.any() or not np.ptp(both[there, 1]) > 0.0:
        raise InputError("expected pixels of the material in both images, got none in common")
    row, col = (places[::every] for places in np.nonzero(inner))
    if degree == LOCAL:
        width = WINDOW * speckle_size(pair.reference, pair.masks[0])
        a, b = local_gain_and_offset(row, col, both, grid.shape, width)
        return np.maximum(a, _LEAST * a[pair.masks[0]].mean()), b
    field = ChebyshevField(Box(*grid.x[[0, -1]], *grid.y[[-1, 0]]), int(degree))
    basis = field.basis(grid.x[col], grid.y[row])
    for _ in range(ROUNDS):
        within = basis[there]
        mean = within @ np.linalg.lstsq(within, both[there])[0]
        f, g = np.abs(both[there] - mean).T
        gain = np.linalg.lstsq(within.T @ (g[:, None] * within), within.T @ f)[0]
        left = both[:, 0] - basis @ gain * both[:, 1]
        offset = np.linalg.lstsq(within, left[there])[0]
        off = np.abs(left - basis @ offset)
        there = off <= UNLIKE * np.nanmedian(off)
    a, b = (field.evaluate(part, grid.x[None], grid.y[:, None]) for part in (gain, offset))
    return np.maximum(a, _LEAST * a[pair.masks[0]].mean()), b


def residual(pair: ImagePair, u: FloatArray, degree: int | str | None = 0) -> FloatArray:
    """(rows, cols) f - gain g(x + u) - offset [grey levels]; NaN outside material and image."""
    gain, offset = brightness(pair, u, degree)
    known = pair.masks[0] & np.isfinite(u).all(axis=-1)
    f, g = _compared(pair, u, known)
    found = np.full(pair.grid.shape, np.nan)
    found[known] = f - gain[known] * g - offset[known]
    return found


def uneven_light(pair: ImagePair, u: FloatArray, degree: int, finer: int | str) -> float:
    """Range of the light's relative change over the material that a degree doesn't describe [-].

    ``u`` (rows, cols, 2) [mm]; ``finer``: what describes it, another degree, or LOCAL where u is
    near the truth everywhere.
    """
    mask = pair.masks[0] & np.isfinite(u).all(axis=-1)
    typical = float(pair.reference[mask].mean())
    maps = (brightness(pair, u, each) for each in (degree, finer))
    level, around = ((typical - offset[mask]) / gain[mask] for gain, offset in maps)
    low, high = np.quantile(around - level, [0.5 - 0.5 * _MOST, 0.5 + 0.5 * _MOST])
    return float((high - low) / abs(around.mean()))


def light_for(pair: ImagePair, u: FloatArray, degree: int | None) -> int | str | None:
    """The degree, or LOCAL if light changed otherwise; u (rows, cols, 2) [mm], NaN if unknown."""
    if degree is None or not np.isfinite(u).any():
        return degree
    images = zip((pair.reference, pair.deformed), pair.masks, strict=True)
    noise = np.linalg.norm([estimated_noise(image, mask).sd for image, mask in images])
    chance = _BY_CHANCE * float(noise) / abs(float(pair.reference[pair.masks[0]].mean()))
    return LOCAL if uneven_light(pair, u, degree, LOCAL) > max(UNEVEN, chance) else degree


def misfit_of(result: NodalResult, noise: float, reference: FloatImage) -> tuple[str, ...]:
    """Warn if images don't match somewhere: the residual is above noise, and not slight.

    ``noise``: of the residual, rms; ``reference``: (p,) pixels of its material [grey levels]. Noise
    that neighbouring pixels share can't be known from single images: then nothing is said.
    """
    slight = max(_MISFIT * noise, _SLIGHT * float(reference.std()))
    if result.noise_power > 1.0 or result.residual_rms <= slight:
        return ()
    return (
        f"The residual of the whole displacement is {result.residual_rms:.3g} grey levels, of "
        f"which noise is about {noise:.2g}: somewhere the images don't match, see its map; give "
        "images in between, a mask without what is not material, or, where the light changed along "
        "the material, a brightness that varies.",
    )


def _compared(
    pair: ImagePair, u: FloatArray, where: BoolArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """(p,) f and g(x + u) of those pixels where u is known, NaN where that is outside the image."""
    rows, cols = np.nonzero(where & np.isfinite(u).all(axis=-1))
    moved = u[rows, cols] / pair.grid.pixel_size
    g, _, _ = SplineImage.of(pair.deformed, 5).sample(rows - moved[:, 1], cols + moved[:, 0])
    return pair.reference[rows, cols], g
