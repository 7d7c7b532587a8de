"""Integrated digital image correlation; and the best fit of an ansatz to a known field."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.pair import CheckedImages
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.slow_fields import Brightness
from modeharvest.idic.solver.assembly import Assembly, residual
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    minimise,
)
from modeharvest.idic.solver.level_search import LevelSearch, step_length
from modeharvest.idic.solver.pyramid import FULL, Level, LevelPair, level_pair
from modeharvest.idic.solver.weighting import (
    LEAST_BLUR_PX,
    Gradient,
    Propagation,
    Weighting,
    best_blur,
    instrument,
)
from modeharvest.idic.uncertainty.noise import NoiseTransfer
from modeharvest.idic.uncertainty.residual_test import (
    MOST_DECORRELATED,
    autocorrelation,
    decorrelated_fraction,
    lags_for,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import checked_mask, location_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.util.scaled_eigen import ScaledEigen

_FINE_PX = 6.5
"""Speckles narrower than this want a spline of order 11."""
_EIGENVALUE_CUTOFF = 1e-3
"""On coarse levels, directions with an eigenvalue below this share of the largest one wait for
the finest level: what a blur does to the images would send them into other valleys."""

"""Blur of a gradient, rim of the material: wider than any ligament that speckle is seen on."""


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
    width_px = speckle_size(images.f, images.f_mask)
    order = options.order or (5 if width_px >= _FINE_PX else 11)
    a = before = _initial_gain_and_offset(ansatz, ansatz.checked(start), *images.grey)
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
    result = assess(search.ansatz, search.pair, found, assembly, width_px)
    clock.lap("judge the residual")
    gradient = None if options.gradient is None else Gradient(options.gradient)
    weighting = weighting_for(result, width_px, gradient, options.gradient_blur_px)
    without = (*WITHOUT_RESULT, Outcome.LOCAL_MINIMUM)
    if level == FULL and result.outcome not in without and not weighting.is_least_squares:
        weights = instrument(weighting, images, search.pair, assembly, found.unknowns)
        found, how = search.reweighed(found, assembly, weights)
        history += found.history
        weighted = (weighting, how) if found.outcome is Outcome.CONVERGED else ()
        result = assess(search.ansatz, search.pair, found, assembly, width_px, *weighted)
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
        raise InputError(f"expected a finite displacement inside the mask, got {location_of(bad)}")
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
    return replace(make_result(ansatz, grid, found), history=found.history, timings_s=clock.laps)


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
    pair = level_pair(
        images.f, images.g, images.grid, images.f_mask, images.g_mask, level, options.edge_px,
        order if level == FULL else min(order, 5), levelled,
    )  # fmt: skip
    coarse_px = options.gauss_newton.coarse_tolerance_px * level.factor
    return LevelSearch(
        pair,
        ansatz if finest else replace(ansatz, brightness=Brightness()),
        level.factor,
        0.0 if finest else _EIGENVALUE_CUTOFF,
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


def _initial_gain_and_offset(
    ansatz: Ansatz, start: FloatArray, f: NDArray[Any], g: NDArray[Any]
) -> FloatArray:
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


WITHOUT_RESULT = (Outcome.OUTSIDE_IMAGE, Outcome.SINGULAR)
"""Outcomes with nothing to judge."""


def make_result(
    ansatz: Ansatz, grid: PixelGrid, found: Minimum, how: Propagation | None = None
) -> Result:
    """Make a result of a minimum, or of a root; of the residual it knows its size alone."""
    matrix = found.equations.matrix
    eigen = ScaledEigen.of(matrix if how is None else how.slope)
    inverse, weight = eigen.inverse(), matrix if how is None else how.weight
    if how is not None:
        lost = np.isinf(np.diag(inverse))
        known = np.where(lost[:, None] | lost[None, :], 0.0, inverse)
        inverse = known @ weight @ known
        inverse[lost, lost] = np.inf
    constants = [ansatz.v0_slice(c).start for c in (0, 1)]
    per_px = grid.pixel_size**2 / max(1, found.equations.pixels)
    return Result(
        ansatz=ansatz,
        grid=grid,
        unknowns=found.unknowns.copy(),
        inverse=inverse,
        slope_square=float(np.mean(np.diag(matrix)[constants])) * per_px,
        weight_square=float(np.mean(np.diag(weight)[constants])) * per_px,
        residual_rms=float(np.sqrt(found.equations.mean_square)),
        pixels=found.equations.pixels,
        outside_image=found.equations.outside_image,
        outcome=found.outcome,
        condition_number=eigen.condition_number,
    )


def assess(
    ansatz: Ansatz,
    pair: LevelPair,
    found: Minimum,
    used: Assembly,
    width_px: float,
    weighting: Weighting | None = None,
    how: Propagation | None = None,
) -> Result:
    """Make a result of a minimum of a pair of images, and judge its residual.

    Parameters
    ----------
    ansatz, pair, found, used
        Kinematics and images of a level, where the iteration ended there, and its pixels.
    width_px
        Of the speckle [px].
    weighting, how
        What weighed the residual, and how its noise propagates; least squares by default.
    """
    left = residual(used, found.unknowns, pair.reference, pair.deformed)
    lost, lags_px = decorrelated_fraction(pair.reference, left), lags_for(width_px)
    if lost > MOST_DECORRELATED and found.outcome not in WITHOUT_RESULT:
        found = replace(found, outcome=Outcome.LOCAL_MINIMUM)
    order = pair.deformed.order
    return replace(
        make_result(ansatz, pair.grid, found, how),
        noise_transfer=NoiseTransfer.of(ansatz, found.unknowns, pair.grid, used.mask, order),
        order=order,
        residual_correlation=autocorrelation(left, lags_px),
        residual_lags_px=lags_px,
        decorrelated_fraction=lost,
        weighting=weighting or Weighting(width_px=width_px),
    )


def weighting_for(
    result: Result, width_px: float, gradient: Gradient | None, blur_px: float | None
) -> Weighting:
    """Choose what is to weigh the residual.

    Parameters
    ----------
    result
        The least-squares minimum.
    width_px
        Of the speckle [px].
    gradient, blur_px
        As specified; None is as the noise asks for, if the residual is noise, and otherwise the
        deformed image's gradient, and no blur.
    """
    is_noise = result.residual_test().is_white
    if gradient is None:
        gradient = Gradient.REFERENCE if is_noise else Gradient.DEFORMED
    if blur_px is None:
        blur_px = best_blur(result.noise_to_slope, width_px, result.order) if is_noise else 0.0
        if is_noise and width_px < _FINEST_PX:
            blur_px = max(blur_px, LEAST_BLUR_PX)
    return Weighting(gradient, blur_px, width_px)


_FINEST_PX = 4.0
"""Pixels that sample finer speckles than this fold some of their waves back; a blur keeps those
out of what weighs the residual."""
