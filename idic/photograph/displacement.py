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
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import label, mean
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.finite_element.correlation import coarseness
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.light import LOCAL, Light, alike, light_for, on_pixels
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
_OFF_PX = (4.0, 2.0, 2.0, 2.0, 2.0, 2.0)
"""Possible error of edges after blocks of speckle, one for each first measurement: these are
repeated until the images match everywhere, or twice no better [px]."""


class _Coarse(NamedTuple):
    """Displacement after the first measurements."""

    known: BoolArray
    """(n,) True at nodes at which the images match."""
    start: FloatArray
    """(n, 2) start of the last measurement, smooth and from around where they don't match [mm]."""
    u: FloatArray
    """(n, 2) displacement of the nodes [mm]."""
    cutoff_px: float = _LAST.first_px
    """Cut-off wavelength that suits the noise [px]."""

    @property
    def unknown(self) -> int:
        """Number of nodes at which the images don't match."""
        return int((~self.known).sum())


class _FirstMeasurements:
    """They find the deformed image's mask, how the light changed, and the last one's start."""

    def __init__(self, start: FloatArray, pair: ImagePair, body: Body) -> None:
        self.start, self.pair, self.body = start, pair, body
        self.is_given = pair.deformed_mask is not None
        self.wave = shortest_wave(pair)

    def images(self, u: FloatArray, off_px: float, light: Light) -> ImagePair:
        """The images, equally bright, without what shows background if edges are off this much."""
        pair, mesh = self.pair, self.body.mesh
        u = _unfolded(u, self.body, self.wave)
        pair_alike, mask = alike(pair, mesh, u, light), pair.deformed_mask
        if pair.mask is not None and not pair.mask.all() and not self.is_given:
            mask = deformed_mask(pair.grid, mesh, u, off_px)
        return replace(pair_alike, deformed_mask=mask)

    def next_start(self, u: FloatArray, cutoff_px: float, known: BoolArray) -> FloatArray:
        """(n, 2) u [mm] without waves that are noise, from nodes (n,) at which the images match.

        Elsewhere it is the neighbours' displacement, brought closer by blocks.
        """
        cutoff = cutoff_px * self.pair.grid.pixel_size
        wave = _OVER_CUTOFFS[0] * cutoff if cutoff > _SMOOTHER_FROM * self.wave else self.wave
        start = self.body.smoothed(u, wave, known)
        if known.all():
            return start
        match = _matched(self.pair, self.body.mesh, start, BLOCKS)
        return _closer(self.pair, self.body, start, match) if match.is_same else start

    def by(self, light: Light) -> _Coarse:
        """Measure until the images match everywhere, or twice no better; once with a mask given.

        The start of a photograph whose mask is known is kept.
        """
        found = best = _Coarse(np.zeros(len(self.start), np.bool_), self.start, self.start)
        no_better = 0
        for sweep, off_px in enumerate(_OFF_PX):
            images = self.images(found.u, off_px, light)
            u, known, cutoff_px = coarse_displacement(
                images, found.start, self.body, options=_FIRST
            )
            if self.is_given:
                return _Coarse(known, self.start, u, cutoff_px)
            found = _Coarse(known, self.next_start(u, cutoff_px, known), u, cutoff_px)
            no_better += sweep > 1 and found.unknown >= best.unknown
            best = found if sweep < 2 or found.unknown <= best.unknown else best
            if sweep and (found.unknown == 0 or no_better == 2):
                break
        return best

    def with_its_light(self, degree: int | None) -> tuple[_Coarse, Light]:
        """Measure with the light that describes the images: the degree, or LOCAL."""
        if degree is None and self.is_given:
            return _Coarse(np.ones(len(self.start), np.bool_), self.start, self.start), None
        first, lost = self.by(degree), _LOST * len(self.start)
        if degree and first.unknown > lost:  # slopes adapt to a start far off
            first = min(first, self.by(0), key=lambda each: each.unknown)
        matched = np.where(first.known[:, None], first.u, np.nan)
        light = light_for(self.pair, on_pixels(self.pair.grid, self.body.mesh, matched), degree)
        if light != LOCAL:
            return first, light
        local = self.by(light)
        return (first, degree) if local.unknown > first.unknown + lost else (local, light)


def displacement_from(
    start: FloatArray, pair: ImagePair, body: Body, options: FiniteElementOptions = _LAST,
    progress: Progress = silent, light_degree: int | None = 0,
) -> NodalResult:  # fmt: skip
    """Measure a photograph's displacement on a mesh, from an initial guess (n, 2) at nodes [mm].

    ``pair``: with the mask of the reference; brightness may differ. InputError if the images don't
    overlap; and as for :func:`~modeharvest.idic.finite_element.measure.measure_displacement`.
    ``options``: their ``edge_px`` also holds in the deformed image, whose mask isn't known.
    ``light_degree``: of the polynomials by which gain and offset vary over the reference, if these
    describe the light; else it is taken from around each pixel. None for images of one brightness.
    """
    first = _FirstMeasurements(start, pair, body)
    coarse, light = first.with_its_light(light_degree)
    options = replace(options, first_px=coarse.cutoff_px)
    measured = partial(measure_displacement, on=body, options=options, progress=progress)
    images = first.images(coarse.u, options.edge_px, light)
    found = measured(images, coarse.start)
    u = on_pixels(pair.grid, body.mesh, found.displacement)
    if light != LOCAL and light_for(pair, u, light_degree) == LOCAL:  # the first one followed it
        light, images = LOCAL, first.images(found.displacement, options.edge_px, LOCAL)
        found = measured(images, coarse.start)
    found = replace(found, light=light)
    wave = (found.cutoff_px or 0.0) * pair.grid.pixel_size
    if wave < _SMOOTHER_FROM * first.wave:
        return found
    # Shorter waves of the start are noise of the same images, which no error estimate would count.
    for over in _OVER_CUTOFFS:
        smoother = measured(images, body.smoothed(coarse.start, over * wave))
        if (smoother.cutoff_px or 0.0) * pair.grid.pixel_size >= wave:
            break
    return replace(smoother, light=light)


def shortest_wave(pair: ImagePair) -> float:
    """Wavelength of an initial guess below which it is noise [mm]."""
    speckle_px = speckle_size(pair.reference, pair.masks[0])
    return _SMOOTH_PX * coarseness(speckle_px) * pair.grid.pixel_size


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
    match = _matched(pair, body.mesh, known, BLOCKS)
    require_same_surface(match, *names)
    return _closer(pair, body, known, match)


def _closer(pair: ImagePair, body: Body, known: FloatArray, match: BlockMatch) -> FloatArray:
    """(n, 2) known displacement of the nodes, and the motion of blocks relative to it [mm]."""
    mesh = body.mesh
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
    return body.smoothed(known, shortest_wave(pair))


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
