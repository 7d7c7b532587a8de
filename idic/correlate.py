"""Integrated digital image correlation: two images in, the unknowns of an ansatz out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.estimating_equation import instrument
from modeharvest.idic.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Outcome,
    minimise,
)
from modeharvest.idic.inputs import CheckedImages, checked_mask, where
from modeharvest.idic.judged import WITHOUT_RESULT, ended, judged, weighting_for
from modeharvest.idic.level_search import LevelSearch, step_length
from modeharvest.idic.normal_equations import Assembly
from modeharvest.idic.pyramid import COARSE_TO_FINE, FULL, Level, prepare
from modeharvest.idic.result import Result
from modeharvest.idic.speckle_width import speckle_width
from modeharvest.idic.weighting import Gradient
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import ORDERS
from modeharvest.progress import Progress, silent

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_FINE_PX = 6.5
"""Speckles narrower than this want a spline of order 11."""
_LEAST = 1e-3
"""On coarse levels, directions with an eigenvalue below this share of the largest one wait for
the finest level: what a blur does to the images would send them into other valleys."""

_WIDEST_PX = 100
"""Blur of a gradient, rim of the material: wider than any ligament that speckle is seen on."""


@dataclass(frozen=True)
class CorrelationOptions:
    """How to correlate.

    Parameters
    ----------
    levels
        From coarse to fine. Levels that would blur a mode away (a blur above a quarter of l)
        or leave fewer than 32 px across are skipped; the last one never is.
    edge_px
        Pixels of the reference closer than this to the edge of a hole are left out on the
        finest level [px].
    order
        Of the spline that samples the deformed image: 3, 5 or 11. By default 5, or 11 where
        speckles are narrower than 6.5 px: those a quintic displaces by up to 2e-3 px.
    gauss_newton
        Tolerances and limits.
    gradient
        What weighs the residual in the end, see :mod:`modeharvest.idic.weighting`: the gradient
        of the "deformed" image at x + u (the least-squares minimum), or that of the "reference"
        at x. By default the reference's where the residual is noise, else the deformed image's.
    gradient_blur_px
        Blur of the image that this gradient is taken of, on the finest level [px]. By default
        none, unless the residual is noise: then the blur that makes the unknowns' variance
        smallest.
    """

    levels: tuple[Level, ...] = COARSE_TO_FINE
    edge_px: int = 2
    order: int | None = None
    gauss_newton: GaussNewtonOptions = field(default_factory=GaussNewtonOptions)
    gradient: str | None = None
    gradient_blur_px: float | None = None

    def __post_init__(self) -> None:
        known = [gradient.value for gradient in Gradient]
        blur = self.gradient_blur_px or 0.0
        if self.gradient not in (None, *known) or not 0.0 <= blur <= _WIDEST_PX:
            raise InputError(
                f"expected a gradient among {known} and a blur of it of 0 to {_WIDEST_PX} px, got "
                f"{self.gradient!r} and {self.gradient_blur_px}"
            )
        if not self.levels:
            raise InputError("expected at least one level from coarse to fine, got none")
        if not 0 <= self.edge_px <= _WIDEST_PX or self.order not in (None, *ORDERS):
            raise InputError(
                f"expected edge_px from 0 to {_WIDEST_PX} and order 3, 5 or 11, got "
                f"{self.edge_px} and {self.order}"
            )


def correlate(
    reference: ArrayLike,
    deformed: ArrayLike,
    grid: PixelGrid,
    ansatz: Ansatz,
    start: ArrayLike,
    mask: ArrayLike | None = None,
    deformed_mask: ArrayLike | None = None,
    options: CorrelationOptions | None = None,
    progress: Progress = silent,
) -> Result:
    """Find the unknowns that make the deformed image match the reference.

    Minimises 1/2 sum (f(x) - g(x + u(x, a)))^2 over the pixels of the reference that show
    material: the paper's Eqs. (r), (dof_opt) and (u_dic).

    Parameters
    ----------
    reference, deformed
        (rows, cols) grey levels f and g.
    grid
        Where their pixels are.
    ansatz
        The kinematics.
    start
        (size,) unknowns to start from; see :meth:`Ansatz.start`.
    mask, deformed_mask
        (rows, cols) True on material, in f and in g. Without a mask every pixel counts;
        without a deformed mask g is taken as it is.
    options
        How to correlate.
    progress
        Told about every iteration.

    Raises
    ------
    InputError
        If sizes differ, a mask is empty, or an image holds NaN or is constant.
    """
    options = options or CorrelationOptions()
    clock = _Clock()
    images = CheckedImages.checked(reference, deformed, grid, mask, deformed_mask)
    width_px = speckle_width(images.f, images.f_mask)
    order = options.order or (5 if width_px >= _FINE_PX else 11)
    a = before = _lit_alike(ansatz, ansatz.checked(start), *images.grey)
    clock.lap("check")
    levels = _useful(options.levels, ansatz, grid)
    history: tuple[Iteration, ...] = ()
    for k, level in enumerate(levels):
        report = _reporter(progress, k, len(levels), options.gauss_newton)
        search = _level_search(images, ansatz, level, level is levels[-1], order, options, report)
        clock.lap(f"prepare level {level.factor}")
        n = search.ansatz.size
        before = np.append(search.better(a[:n], before[:n]), a[n:])
        found, assembly = search.minimum(before[:n])
        clock.lap(f"iterate level {level.factor}")
        history += found.history
        a = np.append(found.unknowns, a[n:])
        if found.outcome in WITHOUT_RESULT:
            break
    result = judged(search.ansatz, search.pair, found, assembly, width_px)
    clock.lap("judge the residual")
    gradient = None if options.gradient is None else Gradient(options.gradient)
    weighting = weighting_for(result, width_px, gradient, options.gradient_blur_px)
    without = (*WITHOUT_RESULT, Outcome.TRAPPED)
    if level == FULL and result.outcome not in without and not weighting.is_least_squares:
        weights = instrument(weighting, images, search.pair, assembly, found.unknowns)
        found, how = search.reweighed(found, assembly, weights)
        history += found.history
        weighted = (weighting, how) if found.outcome is Outcome.CONVERGED else ()
        result = judged(search.ansatz, search.pair, found, assembly, width_px, *weighted)
        clock.lap("weigh anew")
    progress(len(levels), len(levels), "correlate")
    return replace(result, history=history, timings_s=clock.laps)


def fit_displacement(
    displacement: ArrayLike,
    grid: PixelGrid,
    ansatz: Ansatz,
    start: ArrayLike,
    mask: ArrayLike | None = None,
    options: GaussNewtonOptions | None = None,
    progress: Progress = silent,
) -> Result:
    """Fit an ansatz to a known displacement as well as it can: what IDIC could find at best.

    Minimises 1/2 sum ||u(x) - u(x, a)||^2 over the pixels with the same engine.

    Parameters
    ----------
    displacement
        (rows, cols, 2) u at the reference pixels [mm]; may be NaN outside the mask.
    grid
        Where the pixels are.
    ansatz, start
        The kinematics, and (size,) unknowns to start from.
    mask
        (rows, cols) True where the displacement counts; everywhere by default.
    options
        Tolerances and limits.
    progress
        Told about every iteration.

    Returns
    -------
    Result
        ``residual_rms`` is in mm *per component*; sqrt(2) times it is the rms of the norm.

    Raises
    ------
    InputError
        If sizes differ, the mask is empty or the displacement is NaN inside it.
    """
    options = options or GaussNewtonOptions()
    clock = _Clock()
    start = ansatz.checked(start)
    ansatz = replace(ansatz, brightness=Brightness())  # of which a displacement says nothing
    target = np.asarray(displacement, dtype=np.float64)
    if target.shape != (*grid.shape, 2):
        raise InputError(
            f"expected a displacement of shape {(*grid.shape, 2)} like the grid, got {target.shape}"
        )
    inside = checked_mask(mask, "mask", grid)
    inside = np.ones(grid.shape, dtype=np.bool_) if inside is None else inside
    bad = inside & ~np.isfinite(target).all(axis=-1)
    if bad.any():
        raise InputError(f"expected a finite displacement inside the mask, got {where(bad)}")
    assembly = Assembly(ansatz, grid, inside)
    found = minimise(
        lambda a, with_matrix: assembly.displacement(a, target, with_matrix),
        step_length(ansatz, grid, inside, 1),
        start[: ansatz.size],
        options,
        options.tolerance_px,
        on_iteration=_reporter(progress, 0, 1, options),
    )
    clock.lap("iterate")
    return replace(ended(ansatz, grid, found), history=found.history, timings_s=clock.laps)


def _level_search(
    images: CheckedImages,
    ansatz: Ansatz,
    level: Level,
    finest: bool,
    order: int,
    options: CorrelationOptions,
    report: Callable[[int], None],
) -> LevelSearch:
    """Prepare a level of the images, and what to look for there.

    Coarse levels see images that are lit alike: what the brightness could absorb there is much
    of the blurred speckle itself.
    """
    levelled = ansatz.brightness.size > 0 and not finest
    pair = prepare(
        images.f, images.g, images.grid, images.f_mask, images.g_mask, level, options.edge_px,
        order if level == FULL else min(order, 5), levelled,
    )  # fmt: skip
    coarse_px = options.gauss_newton.coarse_tolerance_px * level.factor
    return LevelSearch(
        pair,
        ansatz if finest else replace(ansatz, brightness=Brightness()),
        level.factor,
        0.0 if finest else _LEAST,
        options.gauss_newton.tolerance_px if finest else coarse_px,
        coarse_px,
        options.gauss_newton,
        report,
    )


def _useful(levels: tuple[Level, ...], ansatz: Ansatz, grid: PixelGrid) -> tuple[Level, ...]:
    """Select the levels that keep the modes visible and enough pixels; always the last one."""
    shortest = min((mode.half_wavelength for mode in ansatz.modes), default=np.inf)
    quarter_px = 0.25 * shortest / grid.pixel_size

    def keeps(level: Level) -> bool:
        blur_px = level.factor * level.blur
        return blur_px <= quarter_px and min(grid.shape) // level.factor >= 32

    return (*(level for level in levels[:-1] if keeps(level)), levels[-1])


def _reporter(
    progress: Progress, level: int, levels: int, options: GaussNewtonOptions
) -> Callable[[int], None]:
    def report(number: int) -> None:
        progress(level + number / (options.max_iterations + 1), levels, "correlate")

    return report


def _lit_alike(ansatz: Ansatz, start: FloatArray, f: NDArray[Any], g: NDArray[Any]) -> FloatArray:
    """Start with a gain and an offset that give both images one mean and one contrast.

    Far from the solution, where the images don't match yet, a fit would sooner wipe out the
    contrast than find the displacement. A start that has gain or offset already is kept.
    """
    first = ansatz.phi_offset(len(ansatz.modes))
    if start[first:].any():
        return start
    start, names = start.copy(), ansatz.names
    gain = 1.0
    if "gain[0,0]" in names:
        gain = float(f.std(dtype=np.float64) / g.std(dtype=np.float64))
        start[names.index("gain[0,0]")] = gain - 1.0
    if "offset[0,0]" in names:
        difference = f.mean(dtype=np.float64) - gain * g.mean(dtype=np.float64)
        start[names.index("offset[0,0]")] = float(difference)
    return start


class _Clock:
    """Wall-clock seconds of one stage after another."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = now - self._last
        self._last = now
