"""The whole displacement of a speckled body by regularised finite-element DIC.

Minimises sum (f(x) - g(x + u))^2 + lambda (u - u_0)'R(u - u_0) over the nodal displacements u of a
mesh of the material. Gauss-Newton steps go from blurred images and long cut-off wavelengths to the
unfiltered images. R penalises the roughness of the difference from the start u_0. The last cut-off
wavelength is estimated from the images alone, see ``cutoff``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.materials import Material
from modeharvest.idic.finite_element.continued import (
    NONE_CONTINUED,
    ContinuedPixels,
    continued_pixels,
    continued_spline,
    images_on,
)
from modeharvest.idic.finite_element.cutoff import (
    Deviations,
    Risk,
    best_of,
    contradicted,
    deviations,
    least_risk,
    risk,
    uncertain,
)
from modeharvest.idic.finite_element.fields import determinant, element_gradients
from modeharvest.idic.finite_element.mesh import mesh_of_mask, quadratic
from modeharvest.idic.finite_element.normal_equations import normal_equations
from modeharvest.idic.finite_element.pixels import ElementPixels, flat
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.finite_element.system import Body, Imbalance, Linearised, Smoothness
from modeharvest.idic.result import Result
from modeharvest.idic.solver.final_smoothing import speckle_size, spline_order
from modeharvest.idic.solver.free_edges import FreeEdges
from modeharvest.idic.solver.noise import (
    NoiseTransfer,
    estimated_noise,
    power_of_long_waves,
    slope_noise,
)
from modeharvest.idic.solver.pyramid import FULL, Level, LevelPair, eroded, smoothed
from modeharvest.idic.solver.weighting import best_blur
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.masks import grown
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.typed import picked

_FIRST_PX = 18.0
"""Cut-off wavelength at which the search for the best one begins [px]; below, with a law."""
_FIRST_WITH_LAW_PX = 150.0
_WRONG = 0.075
"""Share of edge nodes contradicting a law above which a warning says it is wrong; not 0.003, as
smoothing removes more at edges than error bars include (docs/explanation/whole_field_laws.md)."""
_BLANK = 0.01
"""Share of the material without speckle above which a warning is given [-]."""
_SHORT_PX, _SHORT_AT_A_NODE_PX = 0.1, 0.5
"""Matrices are kept after steps shorter than these, rms over nodes and longest of one node [px],
if only the images change them (no law) and steps decrease."""
_LEAST_DET = 0.1
"""Lower bound on det F [-]: an element that shrinks to less shows a diverged iteration."""
_UNLIKE, _SEEN = 0.25, 0.25
"""Images don't match in an element whose mean square residual less noise, over the reference's
variance, is larger, or whose share of pixels on the deformed image's material is smaller."""
_BY_CHANCE = 5.0
"""Largest departure of a mean square of noise from its variance [standard deviations]."""
_SOME_PIXELS = 200
"""So many pixels in all may not match: elements of an edge that show some background."""
_AROUND, _AROUND_PX = 2, 60.0
"""Layers of elements around such elements that count, too, as few speckles also match elsewhere;
and the shortest wave of their neighbours' displacement from which they are measured again."""
_DIFFERS, _BESIDE_PX, _MOST_HIDDEN = 0.5, 4.0, 0.8
"""Where that doesn't help, pixels don't count if their residual, beyond noise, is larger than this,
over the speckle's standard deviation, nor pixels so close to them, which splines mix; unless that
concerns a larger share of the material."""
_BORDER_PX = 2.0
"""Edges closer than this to the image's border are no edges of the body [px]."""
_SAMPLED = 200_000
"""Pixels from which the correlation of noise is estimated."""
_ROUNDS = 3
_SETTLED = 0.5
"""No further round is made if the log of the cut-off wavelength changes by less [-]."""


@dataclass(frozen=True)
class _Stage:
    """One stage of the coarse-to-fine sequence."""

    level: Level
    """Binning and blur of the images."""
    cutoff_px: float
    """Wavelength whose amplitude the regularisation halves [px]."""
    tolerance_px: float = 0.1
    """The stage ends once the step's rms over nodes and a tenth of its longest are below [px]."""


_STAGES = (_Stage(Level(2, 3.0), 120.0, 0.2), _Stage(Level(2, 1.5), 50.0, 0.2), _Stage(FULL, 30.0))
"""Stages before the last, which uses unfiltered images and the cut-off that is searched for. Coarse
ones of tolerance 0.4 left places in local minima ("lens" in docs/how-to/scoring.md)."""
_LAST_TOLERANCE_PX = 0.01
_LONGEST_STEP_PX = 8.0
"""Largest change of a node's displacement in one step."""


@dataclass(frozen=True)
class Law:
    """A material law that regularises the displacement."""

    material: Material
    """Material of the body, in plane strain; a common factor of its moduli has no effect."""
    loaded: Callable[[FloatArray], BoolArray]
    """Maps points (n, 2) of the body [mm] to (n,) True where unknown forces may act."""


@dataclass(frozen=True)
class FiniteElementOptions:
    """Options of a measurement on a mesh."""

    element_px: float = 24.0
    edge_element_px: float = 12.0
    """Edge length of elements inside the body and along its edges, if a mesh is generated [px]."""
    cutoff_px: float | None = None
    """Cut-off wavelength of the last stage [px]; None for that of the lowest estimated risk."""
    law: Law | None = None
    """Regularises the last stage; None for smoothness of the difference from the start."""
    edge_px: int = 0
    """Pixels closer than this to the mask's edge are left out of unfiltered images [px]."""
    steps: int = 4
    """Largest number of Gauss-Newton steps in each stage."""
    free_edges: bool = True
    """Without a law: whether to use the strain relation of free edges, see ``free_edges``."""

    def __post_init__(self) -> None:
        for name, low in (("element_px", 4), ("edge_element_px", 4), ("edge_px", 0), ("steps", 1)):
            require_within(f"finite-element DIC: expected {name}", getattr(self, name), low)
        if self.cutoff_px is not None:
            require_within("finite-element DIC: expected cutoff_px", self.cutoff_px, 0, above=True)

    def body(self, mask: BoolArray, grid: PixelGrid) -> Body:
        """Mesh a mask (rows, cols) as far as possible; InputError as for ``mesh_of_mask``."""
        return Body(*mesh_of_mask(mask, grid, self.element_px, self.edge_element_px))


Start = Result | Callable[[FloatArray], FloatArray] | FloatArray
"""Result of a correlation, a function of points (n, 2) that returns displacements (n, 2), or the
displacements (n, 2) of the nodes; all in mm."""


def measure_displacement(
    pair: ImagePair,
    start: Start,
    on: Mesh | Body | None = None,
    *,
    options: FiniteElementOptions | None = None,
    progress: Progress = silent,
) -> NodalResult:
    """Measure the whole displacement on a mesh of the material.

    InputError if the mesh is folded or has other elements, covers only a part of the mask, or has
    parts without pixels.

    pair : images. Without a mask every pixel counts.
    start : initial guess: a correlation's result, or any displacement within about 10 px of the
        true one. The difference between the measured displacement and the start is smooth.
    on : mesh of T6 or T3 elements in the reference's frame [mm]; by default generated from the
        pair's mask. Pass a Body for several images, so that shared computations are done once.
    options : options of the measurement.
    progress : receives the progress.
    """
    course = _Measurement(pair, start, on, options or FiniteElementOptions())
    for stage in counted((*_STAGES, None), progress, "whole displacement"):
        if stage is None:
            course.again_where_unlike(*_STAGES)
            course.regularise()
        else:
            course.through(stage)
    return course.result()


def coarse_displacement(
    pair: ImagePair, start: Start, on: Body, *, options: FiniteElementOptions
) -> tuple[FloatArray, BoolArray]:
    """(n, 2) u [mm] before the search for the last cut-off; (n,) True at nodes with matched images.

    At other nodes u is in a local minimum. For the arguments see :func:`measure_displacement`.
    """
    course = _Measurement(pair, start, on, options)
    for stage in (*_STAGES, _Stage(FULL, _FIRST_PX)):
        course.through(stage)
    unseen = course.linearised().sums.counts < _SEEN * np.diff(course._prepare(FULL).pixels.start)
    known = on.away_from(course.unlike(), _AROUND) & on.away_from(unseen)
    return course.u.reshape(-1, 2), known


@dataclass(frozen=True, eq=False)
class _LevelOnMesh:
    """A pyramid level of an image pair on a mesh, with the gradient that weighs its residual."""

    level: Level
    images: LevelPair
    pixels: ElementPixels
    slope_noise: float = 0.0
    """Noise variance of the gradient that weighs the residual [grey levels^2/mm^2]."""
    continued: ContinuedPixels = NONE_CONTINUED


class _Measurement:
    """State of a running measurement: the images of a stage and the nodal displacements."""

    def __init__(
        self, pair: ImagePair, start: Start, on: Mesh | Body | None, options: FiniteElementOptions
    ) -> None:
        if on is None:
            on = options.body(pair.masks[0], pair.grid)
        body = on if isinstance(on, Body) else Body(quadratic(on))
        nodes = body.mesh.nodes
        if isinstance(start, Result):
            start = start.ansatz.displacement_at(start.unknowns, nodes)
        begin = np.asarray(start(nodes) if callable(start) else start, dtype=np.float64)
        if begin.shape != nodes.shape or not np.isfinite(begin).all():
            raise InputError(
                f"expected a start of finite displacements {nodes.shape} at the nodes, got "
                f"{begin.shape} with {int((~np.isfinite(begin)).sum())} NaN or infinite"
            )
        pair = pair if body.mask is None else replace(pair, mask=pair.masks[0] & body.mask)
        self.speckle_px = speckle_size(pair.reference, pair.mask)
        self.order = spline_order(self.speckle_px)
        blank, hidden = (
            grown(flat(image, mask, self.speckle_px), _BESIDE_PX)
            for image, mask in zip((pair.reference, pair.deformed), pair.masks, strict=True)
        )
        self.hidden = self.blank = blank & pair.masks[0]
        """(rows, cols) True for pixels that don't count; for those of them without speckle."""
        if hidden.any() and (pair.deformed_mask is not None or pair.masks[0].all()):
            pair = replace(pair, deformed_mask=pair.masks[1] & ~hidden)
        self.pair, self.body, self.start, self.options = pair, body, begin, options
        self.prior: Smoothness | Imbalance = Smoothness(body, begin)
        self.u = begin.ravel().copy()
        self.level: _LevelOnMesh | None = None
        self.kept: Linearised | None = None
        self.free: tuple[FloatArray, Deviations] | None = None
        self.contradicted: float | None = None
        self.edges: FreeEdges | None = None
        self.by_edges: FloatArray = np.zeros_like(self.u)  # change of u by the relation at edges
        self.tried: tuple[Risk, ...] = ()
        self.warnings = body.changes
        images = zip((pair.reference, pair.deformed), pair.masks, strict=True)
        self.noise = tuple(estimated_noise(image, mask).sd ** 2 for image, mask in images)
        """Variances of the noise of f and g [grey levels^2]."""
        self.noise_power = 1.0
        """Power of the noise at long waves, over its variance."""

    def _prepare(self, level: Level) -> _LevelOnMesh:
        if self.level is None or self.level.level != level:
            order = self.order if level == FULL else 5
            images = images_on(self.pair, level, self.options.edge_px, order)
            (rows, cols), n = images.mask.shape, level.factor
            hidden = self.hidden[: rows * n, : cols * n].reshape(rows, n, cols, n).any(axis=(1, 3))
            pixels = self.body.pixels.on(images.grid, images.mask & ~hidden, images.reference)
            self.level, self.kept = _LevelOnMesh(level, images, pixels), None
            if level == FULL:
                self.level = self._weighed_by_reference(self.level)
        return self.level

    def _weighed_by_reference(self, on: _LevelOnMesh) -> _LevelOnMesh:
        """Weigh the residual by the reference's gradient, blurred as much as its noise requires."""
        f, mask, px = self.pair.reference, self.pair.masks[0], self.pair.grid.pixel_size
        spline = continued_spline(f, mask, self.order)
        _, d_row, d_col = spline.sample(on.pixels.row, on.pixels.col)
        noise, noise_g = self.noise
        square = 0.5 * float(np.mean(d_row**2 + d_col**2)) - noise * slope_noise(self.order, 0.0)
        blur = best_blur(noise / max(square, 0.2 * square), self.speckle_px, self.order)
        if blur > 0.0:
            spline = SplineImage.of(smoothed(f, mask, blur), self.order)
            _, d_row, d_col = spline.sample(on.pixels.row, on.pixels.col)
        slope = np.stack([d_col, -d_row]).astype(np.float32) / np.float32(px)
        return replace(
            on, pixels=on.pixels._replace(slope=slope),
            slope_noise=noise * slope_noise(self.order, blur) / px**2,
            continued=continued_pixels(self.pair, noise, noise_g, on.images.valid),
        )  # fmt: skip

    def linearised(self) -> Linearised:
        """Normal equations at u; after short steps the previous matrices are used again."""
        on, kept, body = self.level, self.kept, self.body
        assert on is not None
        if kept and kept.u is self.u and kept.prior is self.prior and kept.edges is self.edges:
            return kept
        nodal, is_new = self.u.reshape(-1, 2), kept is None
        sums = normal_equations(on.pixels, body.mesh, on.images, nodal, on.continued, is_new)
        if sums.pixels == 0:
            raise InputError("expected pixels of the material in both images, got none in common")
        R, penalty = self.prior.linearised(self.u)
        if kept is None:
            F = self._deformation_gradient()
            pushed = (F**2).sum(axis=(1, 2)) / np.maximum(determinant(F), _LEAST_DET) ** 2
            signal, gain = sums.signal(on.slope_noise * pushed)
            blocks = (gain * signal[:, None, None, None]) ** 2 * sums.blocks
            M = body.matrix(blocks)
            rough = body.roughness if R is body.smoothness else body.energies(R)
            ratio = body.energies(M) / rough
        else:
            blocks, M, ratio = kept.sums.blocks, kept.M, kept.ratio
            signal, gain = kept.signal, kept.gain
        gradient = body.vector(gain * signal[:, None, None] * sums.gradient)
        sums = replace(sums, blocks=blocks)
        known = self.edges, kept.known[0] if kept and kept.edges is self.edges else None
        found = body, self.prior, self.u, sums, signal, gain, M, gradient, R, penalty, ratio
        self.kept = Linearised(*found, *known)
        return self.kept

    def through(self, stage: _Stage) -> None:
        """Make Gauss-Newton steps until they are shorter than the stage's tolerance."""
        self._prepare(stage.level)
        px, last = self.pair.grid.pixel_size, np.inf
        for _ in range(self.options.steps):
            at = self.linearised()
            step = at.step(stage.cutoff_px * px)
            length = np.linalg.norm(step.reshape(-1, 2), axis=1) / px
            share = np.minimum(1.0, _LONGEST_STEP_PX / np.maximum(length, 1e-12))
            self.u = at.u + step * np.repeat(share, 2)
            rms, longest = float(np.sqrt(np.mean(length**2))), float(length.max())
            is_short = rms <= min(_SHORT_PX, 0.5 * last) and longest <= _SHORT_AT_A_NODE_PX
            if isinstance(self.prior, Imbalance) or not is_short:
                self.kept = None
            if max(last := rms, 0.1 * longest) < stage.tolerance_px:
                break

    def unlike(self, at: Linearised | None = None) -> BoolArray:
        """(m,) True for elements in which the unfiltered images don't match."""
        grey, sums = self._prepare(FULL).pixels.grey, (at or self.linearised()).sums
        chance = sums.weights + _BY_CHANCE * np.sqrt(2.0 * sums.weights)
        found = sums.squares > _UNLIKE * float(grey.var()) * sums.weights + sum(self.noise) * chance
        return np.asarray(found)

    def again_where_unlike(self, *stages: _Stage) -> None:
        """Measure again from the displacement around where images don't match, while that helps.

        Where it doesn't, pixels don't count: paint may have come off, or something hides it.
        """
        body, pixels = self.body, np.diff(self._prepare(FULL).pixels.start)
        while pixels[unlike := self.unlike()].sum() > _SOME_PIXELS:
            last, known = (self.u, self.prior), body.away_from(unlike, _AROUND)
            start = np.where(known[:, None], self.start, self._smoothed(self.start, known))
            self._start_from(start, known)
            for stage in stages:
                self.through(stage)
            if self.unlike().sum() >= unlike.sum():
                (self.u, self.prior), self.kept = last, None
                self._hide(np.asarray(~known[body.mesh.cells].any(axis=1)), *stages)
                break
            self.start = start

    def _hide(self, cells: BoolArray, *stages: _Stage) -> None:
        """Measure without the pixels of elements (m,), then with those of them that match."""
        on, full = self._prepare(FULL), [stage for stage in stages if stage.level == FULL]
        around, before = on.pixels.only(np.repeat(cells, np.diff(on.pixels.start))), self.hidden
        if around.row.size > _MOST_HIDDEN * on.pixels.row.size:
            return
        differ: BoolArray = np.ones(around.row.size, np.bool_)
        limit = _DIFFERS * float(on.pixels.grey.std()) + _BY_CHANCE * np.sqrt(sum(self.noise))
        for then in (stages, full, full):  # blurred images mix them with what is around
            hidden = np.zeros_like(before)
            hidden[around.row[differ], around.col[differ]] = True
            self.hidden, self.level = before | grown(hidden, _BESIDE_PX), None
            known = self.body.away_from(np.diff(self._prepare(FULL).pixels.start) == 0)
            self.start = self._smoothed(self.u.reshape(-1, 2), known)
            self._start_from(self.start, known)
            for stage in then:
                self.through(stage)
            residual = self._residual(on, around)[around.row, around.col]
            differ = around.with_rest_of_elements(~(np.abs(residual) <= limit))

    def _smoothed(self, nodal: FloatArray, known: BoolArray) -> FloatArray:
        return self.body.smoothed(nodal, _AROUND_PX * self.pair.grid.pixel_size, known)

    def _start_from(self, start: FloatArray, known: BoolArray) -> None:
        """Start from (n, 2) [mm], with u where it is known (n,), else that of its neighbours."""
        nodal = self.u.reshape(-1, 2)
        u = np.where(known[:, None], nodal, self._smoothed(nodal, known))
        self.prior, self.u, self.kept = Smoothness(self.body, start), u.ravel(), None

    def regularise(self) -> None:
        """Find the last cut-off wavelength and its u: without a law, then with one if given."""
        self.noise_power = self._power_of_noise(self._prepare(FULL))
        law, given = self.options.law, self.options.cutoff_px
        self._regularised(_FIRST_PX, None if law is not None else given)
        if law is None and self.options.free_edges:
            self._through_edges()
        elif law is not None:
            mesh = self.body.mesh
            self.free = self.u.copy(), self._assessed()[2]
            self.prior = Imbalance(mesh, law.material, law.loaded(mesh.nodes))
            self.kept = None
            self._regularised(_FIRST_WITH_LAW_PX, given)

    def _through_edges(self) -> None:
        """Learn the strain relation of free edges, and measure again with it as additional data."""
        at, px = self.linearised(), self.pair.grid.pixel_size
        left, right, bottom, top = self.pair.grid.extent
        off = _BORDER_PX * px
        edges = FreeEdges(self.body.mesh, (left + off, right - off, bottom + off, top - off))
        edges.learn(at.u, uncertain(at, self.cutoff_px * px, at.variance * self._noise_in(at)))
        if edges.deviation:
            self.edges = edges
            self.through(_Stage(FULL, self.cutoff_px, _LAST_TOLERANCE_PX))
            self.by_edges = self.u - at.u

    def _assessed(self) -> tuple[Linearised, Risk, Deviations]:
        """Normal equations, risk and standard deviations at the present displacement."""
        at, px = self.linearised(), self.pair.grid.pixel_size
        noise = self._noise_in(at)
        here = risk(at, self.cutoff_px, px, at.mean(noise))
        return at, here, deviations(at, self.cutoff_px * px, here.noise, noise, here.unknowns)

    def _against_law_free(self, sd: Deviations) -> Deviations:
        """Add the difference from the law-free solution as bias; warn if it contradicts the law."""
        if self.free is None or self.options.law is None:
            return sd
        (u, free), mesh = self.free, self.body.mesh
        difference = (self.u - u).reshape(-1, 2)
        edges = np.unique(boundary_sides(mesh))
        edges = edges[~self.options.law.loaded(mesh.nodes[edges])]
        nodes = edges if edges.size else np.arange(len(mesh.nodes))
        self.contradicted = contradicted(difference, free, sd, nodes)
        if self.contradicted > _WRONG:
            self.warnings += (
                f"The material law doesn't fit: at {100 * self.contradicted:.1f} % of the nodes of "
                "free edges it changes the displacement by more than 3 standard deviations, where "
                f"{100 * _WRONG:.1f} % are usual at most; measure without it, or correct the law.",
            )
        return sd.with_bias(mesh, difference / np.sqrt(6.0))

    def _regularised(self, first_px: float, cutoff: float | None) -> None:
        """Measure with a given cut-off wavelength, or search for the best one from ``first_px``."""
        px, self.tried = self.pair.grid.pixel_size, ()
        if cutoff is None:
            cutoff = first_px
            for _ in range(_ROUNDS):
                self.through(_Stage(FULL, cutoff))
                before, self.kept = cutoff, None  # the risk needs the matrix at the present u
                at = self.linearised()
                self.tried = least_risk(at, before, px, at.mean(self._noise_in(at)))
                cutoff = best_of(self.tried)
                if abs(np.log(cutoff / before)) < _SETTLED:
                    break
        self.through(last := _Stage(FULL, cutoff, _LAST_TOLERANCE_PX))
        if isinstance(self.prior, Smoothness):  # short cut-offs may lose what noisy images show
            self.again_where_unlike(*_STAGES, last)
        self.cutoff_px = cutoff

    def _deformation_gradient(self) -> FloatArray:
        """(m, 2, 2) F of each element [-]."""
        gradients = element_gradients(self.body.mesh, self.u.reshape(-1, 2))
        return np.asarray(np.eye(2) + gradients.mean(axis=1))

    def _noise_in(self, at: Linearised) -> FloatArray:
        """(m,) noise variance of each element's gradient over that of the residual [-].

        Noise of f is independent of its slopes' noise: only their signal counts; g's is over det F.
        """
        u, det = self.u.reshape(-1, 2)[self.body.mesh.cells], self._deformation_gradient()
        det = np.maximum(determinant(det), _LEAST_DET)
        value = NoiseTransfer.at(u.mean(axis=1) / self.pair.grid.pixel_size, det, self.order).value
        f, g = self.noise if any(self.noise) else (1.0, 1.0)
        return np.asarray(self.noise_power * (f * at.signal + g / det) / (f + g * value))

    def _power_of_noise(self, on: _LevelOnMesh) -> float:
        """Power of the noise at long waves over its variance, from middle rows of the residual."""
        pixels = on.pixels
        share = min(1.0, _SAMPLED / pixels.row.size)
        low, high = np.quantile(pixels.row, [0.5 - 0.5 * share, 0.5 + 0.5 * share])
        alike = np.repeat(~self.unlike(), np.diff(pixels.start))
        some = pixels.only((pixels.row >= low) & (pixels.row <= high) & alike)
        residual = self._residual(on, some)
        contrast = float(some.grey.std()) if some.grey.size else 0.0
        return power_of_long_waves(np.nan_to_num(residual), np.isfinite(residual), contrast)

    def _residual(self, on: _LevelOnMesh, some: ElementPixels) -> FloatArray:
        """(rows, cols) f - g(x + u) of some of the unfiltered pixels, else NaN [grey levels]."""
        N, cells = shape_functions("T6", some.xi.T), self.body.mesh.cells
        nodal = self.u.reshape(-1, 2)[np.repeat(cells, np.diff(some.start), axis=0)]
        right, up = np.einsum("pk,pki->ip", N, nodal) / self.pair.grid.pixel_size
        g, _, _ = on.images.deformed.sample(some.row - up, some.col + right)
        residual = np.full(self.pair.grid.shape, np.nan)
        residual[some.row, some.col] = some.grey - g
        return residual

    def _without_edges(self, at: Linearised) -> FloatArray:
        """(n, 2, 1) change of u [mm] if twice as many rows of pixels are left out at edges, or one.

        Shows errors of the images at edges and of elements that reach beyond their pixels. The
        relation at free edges would hide them: the change is that of a measurement without it.
        """
        on, body = self._prepare(FULL), self.body
        weight = at.weight(self.cutoff_px * self.pair.grid.pixel_size)
        keep = eroded(on.images.mask, max(1, self.options.edge_px))[on.pixels.row, on.pixels.col]
        some, u = on.pixels.only(keep), at.u.reshape(-1, 2)
        left = normal_equations(some, body.mesh, on.images, u, on.continued)
        share = at.gain * at.signal[:, None, None]
        M = body.matrix(share[..., None] ** 2 * left.blocks)
        others = replace(at, M=M, gradient=body.vector(share * left.gradient), edges=None)
        return (others.factor(weight).solve(others.right(weight)) + self.by_edges).reshape(-1, 2, 1)

    def result(self) -> NodalResult:
        """Result of the measurement, with standard deviations."""
        (at, here, sd), body = self._assessed(), self.body
        sd = self._against_law_free(sd)
        if not (np.isfinite(self.u).all() and np.isfinite(sd.by_noise + sd.bias).all()):
            raise InputError(
                "expected images that determine a displacement, got no finite one: too much of "
                "the mesh, or of the mask, shows no speckle that is in both images; check them"
            )
        counts = np.diff(self._prepare(FULL).pixels.start)
        total, lost = counts.sum() + self.hidden.sum(), int(self.blank.sum())
        blank = float((counts[at.signal == 0.0].sum() + lost) / total)
        guess = "there the displacement is the smoothest that fits around, and its standard "
        if blank > _BLANK:
            self.warnings += (
                f"{100 * blank:.0f} % of the material shows no speckle that is in both images: "
                f"{guess}deviation a guess.",
            )
        if (changed := self.hidden & ~self.blank).any():
            (row, col), share = np.argwhere(changed).mean(axis=0), 100.0 * changed.sum() / total
            self.warnings += (
                f"Around row {row:.0f}, column {col:.0f} the surface has changed, or is hidden (on "
                f"{share:.2g} % of the material): {guess}deviation a guess.",
            )
        if counts[unlike := self.unlike(at)].sum() > _SOME_PIXELS:
            worst = np.argmax(at.sums.squares / np.maximum(at.sums.weights, 1.0))
            row, col = self.pair.grid.to_px(*body.mesh.nodes[body.mesh.cells[worst]].mean(axis=0))
            self.warnings += (
                f"Around row {row:.0f}, column {col:.0f} the images don't match (on "
                f"{100 * counts[unlike].sum() / counts.sum():.2g} % of the material): there the "
                "surface has changed, or the displacement is wrong.",
            )
        return NodalResult(
            mesh=body.mesh,
            displacement=self.u.reshape(-1, 2) + sd.taken,
            standard_deviation=np.hypot(sd.by_noise, sd.bias),
            noise_deviation=sd.by_noise,
            gradient_covariance=sd.gradient,
            roots=np.dstack([sd.roots, self.by_edges.reshape(-1, 2), self._without_edges(at)]),
            grid=self.pair.grid,
            residual_rms=at.sums.rms,
            residual_noise=here.noise,
            effective_unknowns=here.unknowns,
            library=body.library,
            **picked(self, "start cutoff_px tried warnings contradicted noise_power"),
            **picked(at.sums, "pixels outside"),
        )
