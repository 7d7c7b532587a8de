"""The whole displacement of a speckled body by regularised finite-element DIC.

Minimises sum (f(x) - g(x + u))^2 + lambda (u - u_0)'R(u - u_0) over the nodal displacements u of a
mesh of the material, in stages (see ``correlation``). R penalises the roughness of the difference
from the start u_0. The last cut-off wavelength is estimated from the images alone, see ``cutoff``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.materials import Material
from modeharvest.idic.finite_element.correlation import MeshCorrelation, Stage, coarseness
from modeharvest.idic.finite_element.cutoff import (
    Deviations,
    Risk,
    best_of,
    contradicted,
    deviations,
    least_risk,
    longer_cutoff,
    risk,
    uncertain,
)
from modeharvest.idic.finite_element.equations.normal_equations import normal_equations
from modeharvest.idic.finite_element.equations.system import Body, Imbalance, Linearised, Smoothness
from modeharvest.idic.finite_element.mesh import mesh_of_mask, quadratic
from modeharvest.idic.finite_element.mismatch import (
    again_where_unlike,
    leave_out_specks,
    matched,
    mismatches,
    noise_power,
    not_compared,
)
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.idic.solver.free_edges import FreeEdges
from modeharvest.idic.solver.pyramid import FULL, eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.typed import picked

_FIRST_WITH_LAW_PX = 150.0
"""Cut-off wavelength at which the search for the best one begins with a law [px]."""
_WRONG = 0.075
"""Share of edge nodes contradicting a law above which a warning says it is wrong; not 0.003, as
smoothing removes more at edges than error bars include (docs/explanation/whole_field_laws.md)."""
_BORDER_PX = 2.0
"""Edges closer than this to the image's border are no edges of the body [px]."""
_ROUNDS = 3
_SETTLED = 0.5
"""No further round is made if the log of the cut-off wavelength changes by less [-]."""
_LAST_TOLERANCE_PX = 0.01


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
    first_px: float = 18.0
    """Cut-off wavelength at which that search begins without a law [px]."""
    law: Law | None = None
    """Regularises the last stage; None for smoothness of the difference from the start."""
    edge_px: int = 0
    """Pixels closer than this to the mask's edge are left out of unfiltered images [px]."""
    steps: int = 4
    """Largest number of Gauss-Newton steps in each stage."""
    free_edges: bool = True
    """Without a law: whether to use the strain relation of free edges, see ``free_edges``."""

    def __post_init__(self) -> None:
        for name, low in (
            ("element_px", 4),
            ("edge_element_px", 4),
            ("edge_px", 0),
            ("steps", 1),
            ("first_px", 1),
        ):
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
    options = options or FiniteElementOptions()
    correlation = started(pair, start, on, options)
    last = LastStage(correlation, options)
    for stage in counted((*correlation.coarse, None), progress, "whole displacement"):
        if stage is None:
            again_where_unlike(correlation)
            leave_out_specks(correlation)
            last.regularise()
        else:
            correlation.through(stage)
    return last.result()


def coarse_displacement(
    pair: ImagePair, start: Start, on: Body, *, options: FiniteElementOptions
) -> tuple[FloatArray, BoolArray, float]:
    """(n, 2) u [mm], (n,) True at nodes where the images match, and the cut-off wavelength [px].

    At other nodes u is in a local minimum. For the arguments see :func:`measure_displacement`.
    """
    correlation = started(pair, start, on, options)
    for stage in correlation.coarse:
        correlation.through(stage)
    first, at = options.first_px * coarseness(correlation.speckle_px), correlation.linearised(True)
    # Shorter waves of coarse or noisy speckle are noise that takes corners into the background.
    cutoff = longer_cutoff(at, first, pair.grid.pixel_size, at.mean(correlation.noise_in(at)))
    correlation.through(Stage(FULL, cutoff))
    return correlation.u.reshape(-1, 2), matched(correlation), cutoff


def started(
    pair: ImagePair, start: Start, on: Mesh | Body | None, options: FiniteElementOptions
) -> MeshCorrelation:
    """The correlation at its start; InputError if that isn't a displacement of the nodes."""
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
    return MeshCorrelation(pair, begin, body, options.edge_px, options.steps)


class LastStage:
    """Last stage of a correlation: cut-off wavelength, relation at edges, law, deviations."""

    def __init__(self, correlation: MeshCorrelation, options: FiniteElementOptions) -> None:
        self.correlation, self.options = correlation, options
        self.body, self.pair = correlation.body, correlation.pair
        self.free: tuple[FloatArray, Deviations] | None = None
        self.contradicted: float | None = None
        self.by_edges: FloatArray = np.zeros_like(correlation.u)  # change of u by them
        self.tried: tuple[Risk, ...] = ()
        self.warnings = self.body.changes

    def regularise(self) -> None:
        """Find the last cut-off wavelength and its u: without a law, then with one if given."""
        correlation, mesh = self.correlation, self.body.mesh
        law, given = self.options.law, self.options.cutoff_px
        correlation.noise_power = noise_power(correlation)
        self.with_cutoff(self.options.first_px, None if law is not None else given)
        if law is None and self.options.free_edges:
            self._through_edges()
        elif law is not None:
            self.free = correlation.u.copy(), self._assessed()[2]
            correlation.regularised_by(Imbalance(mesh, law.material, law.loaded(mesh.nodes)))
            self.with_cutoff(_FIRST_WITH_LAW_PX, given)

    def with_cutoff(self, first_px: float, cutoff: float | None) -> None:
        """Measure with a given cut-off wavelength, or search for the best one from ``first_px``."""
        correlation, px, self.tried = self.correlation, self.pair.grid.pixel_size, ()
        if cutoff is None:
            cutoff = first_px
            for _ in range(_ROUNDS):
                correlation.through(Stage(FULL, cutoff))
                at, before = correlation.linearised(anew=True), cutoff
                self.tried = least_risk(at, before, px, at.mean(correlation.noise_in(at)))
                cutoff = best_of(self.tried)
                if abs(np.log(cutoff / before)) < _SETTLED:
                    break
        correlation.through(last := Stage(FULL, cutoff, _LAST_TOLERANCE_PX))
        if isinstance(correlation.prior, Smoothness):  # short ones may lose what noisy images show
            again_where_unlike(correlation, last)
        self.cutoff_px = cutoff

    def _through_edges(self) -> None:
        """Learn the strain relation of free edges, and measure again with it as additional data."""
        correlation, px = self.correlation, self.pair.grid.pixel_size
        at = correlation.linearised()
        left, right, bottom, top = self.pair.grid.extent
        off = _BORDER_PX * px
        edges = FreeEdges(self.body.mesh, (left + off, right - off, bottom + off, top - off))
        noise = at.variance * correlation.noise_in(at)
        edges.learn(at.u, uncertain(at, self.cutoff_px * px, noise))
        if edges.deviation:
            correlation.edges = edges
            correlation.through(Stage(FULL, self.cutoff_px, _LAST_TOLERANCE_PX))
            self.by_edges = correlation.u - at.u

    def _assessed(self) -> tuple[Linearised, Risk, Deviations]:
        """Normal equations, risk and standard deviations at the present displacement."""
        at, px = self.correlation.linearised(), self.pair.grid.pixel_size
        noise = self.correlation.noise_in(at)
        here = risk(at, self.cutoff_px, px, at.mean(noise))
        return at, here, deviations(at, self.cutoff_px * px, here.noise, noise, here.unknowns)

    def _against_law_free(self, sd: Deviations) -> Deviations:
        """Add the difference from the law-free solution as bias; warn if it contradicts the law."""
        if self.free is None or self.options.law is None:
            return sd
        (u, free), mesh = self.free, self.body.mesh
        difference = (self.correlation.u - u).reshape(-1, 2)
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

    def _without_edges(self, at: Linearised) -> FloatArray:
        """(n, 2, 1) change of u [mm] if twice as many rows of pixels are left out at edges, or one.

        Shows errors of the images at edges and of elements that reach beyond their pixels. The
        relation at free edges would hide them: the change is that of a measurement without it.
        """
        on, body = self.correlation.on(FULL), self.body
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
        (at, here, sd), body, correlation = self._assessed(), self.body, self.correlation
        sd, lost = self._against_law_free(sd), not_compared(correlation)
        if not np.isfinite([correlation.u.sum(), (sd.by_noise + sd.bias).sum(), here.noise]).all():
            raise InputError(
                "expected images that determine a displacement, got no finite one: too much of "
                "the mesh, or of the mask, shows no speckle that is in both images; check them"
            )
        return NodalResult(
            mesh=body.mesh,
            displacement=correlation.u.reshape(-1, 2) + sd.taken,
            standard_deviation=np.hypot(sd.by_noise, sd.bias),
            noise_deviation=sd.by_noise,
            gradient_covariance=sd.gradient,
            roots=np.dstack([sd.roots, self.by_edges.reshape(-1, 2), self._without_edges(at)]),
            grid=self.pair.grid,
            residual_rms=at.sums.rms,
            residual_noise=here.noise,
            effective_unknowns=here.unknowns,
            library=body.library,
            warnings=(*self.warnings, *mismatches(correlation, at, lost)),
            not_compared=int(np.sum(lost)),
            **picked(self, "cutoff_px tried contradicted"),
            **picked(correlation, "start noise_power"),
            **picked(at.sums, "pixels outside"),
        )
