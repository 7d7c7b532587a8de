"""Integrated digital image correlation: two images in, the unknowns of an ansatz out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.agreement import TRAPPED, autocorrelation, unmatched
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    ScaledEigen,
    StepLength,
    minimise,
)
from modeharvest.idic.inputs import checked_image, checked_mask, require_contrast, seen, where
from modeharvest.idic.normal_equations import Assembly, NormalEquations
from modeharvest.idic.pyramid import COARSE_TO_FINE, Level, Pair, prepare
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.progress import Progress, silent

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_BAND = 64
"""Rows that are looked at in one go."""
_WITHOUT_RESULT = (Outcome.LEFT_IMAGE, Outcome.SINGULAR)
_ROUNDS, _SETTLED = 5, 1e-2
"""The pixels used are chosen anew at most 5 times, until less than 1 % of them change."""


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
        Of the spline that samples the deformed image: 5 or 3.
    gauss_newton
        Tolerances and limits.
    """

    levels: tuple[Level, ...] = COARSE_TO_FINE
    edge_px: int = 2
    order: int = 5
    gauss_newton: GaussNewtonOptions = field(default_factory=GaussNewtonOptions)

    def __post_init__(self) -> None:
        if not self.levels:
            raise InputError("expected at least one level from coarse to fine, got none")
        if self.edge_px < 0 or self.order not in (3, 5):
            raise InputError(
                f"expected edge_px >= 0 and order 3 or 5, got {self.edge_px} and {self.order}"
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
    f, g = checked_image(reference, "reference", grid), checked_image(deformed, "deformed", grid)
    f_mask, g_mask = (
        checked_mask(mask, "mask", grid),
        checked_mask(deformed_mask, "deformed mask", grid),
    )
    require_contrast(seen(f, f_mask), "reference")
    require_contrast(seen(g, g_mask), "deformed")
    a = before = _lit_alike(ansatz, ansatz.checked(start), seen(f, f_mask), seen(g, g_mask))
    kinematics = replace(ansatz, brightness=Brightness())
    has_brightness = ansatz.brightness.size > 0
    levels = _useful(options.levels, ansatz, grid)
    history: tuple[Iteration, ...] = ()
    for k, level in enumerate(levels):
        finest = k == len(levels) - 1
        # Coarse levels see images that are lit alike: what the brightness could absorb there is
        # much of the blurred speckle itself.
        levelled = has_brightness and not finest
        pair = prepare(f, g, grid, f_mask, g_mask, level, options.edge_px, options.order, levelled)
        clock.lap(f"prepare level {level.factor}")
        model = ansatz if finest else kinematics
        before = _better(pair, model, a[: model.size], before[: model.size])
        found = _minimise_pair(
            pair, model, before, level.factor, finest, options.gauss_newton,
            _reporter(progress, k, len(levels), options.gauss_newton),
        )  # fmt: skip
        clock.lap(f"iterate level {level.factor}")
        history += found.history
        a, before = (np.concatenate([x, a[x.size :]]) for x in (found.unknowns, before))
        if found.outcome in _WITHOUT_RESULT:
            break
    residual = _residual(pair, model, found.unknowns)
    lost = unmatched(pair.reference, residual)
    if lost > TRAPPED and found.outcome not in _WITHOUT_RESULT:
        found = replace(found, outcome=Outcome.TRAPPED)
    correlation = autocorrelation(residual)
    clock.lap("judge the residual")
    progress(len(levels), len(levels), "correlate")
    result = _result(model, grid, found, history, clock.laps)
    return replace(result, residual_correlation=correlation, unmatched=lost)


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
        _step_length(ansatz, grid, inside, 1),
        start[: ansatz.size],
        options,
        options.tolerance_px,
        on_iteration=_reporter(progress, 0, 1, options),
    )
    clock.lap("iterate")
    return _result(ansatz, grid, found, found.history, clock.laps)


def _minimise_pair(
    pair: Pair,
    ansatz: Ansatz,
    start: FloatArray,
    factor: int,
    finest: bool,
    options: GaussNewtonOptions,
    on_iteration: Callable[[int], None],
) -> Minimum:
    tolerance = options.tolerance_px if finest else options.coarse_tolerance_px * factor
    history: tuple[Iteration, ...] = ()
    landed = _landed(pair, ansatz, start)
    for _ in range(_ROUNDS):
        assembly = Assembly(ansatz, pair.grid, landed)
        found = minimise(
            partial(_images, assembly, pair),
            _step_length(ansatz, pair.grid, landed, factor),
            start,
            options,
            tolerance,
            factor,
            on_iteration,
        )
        history += found.history
        previous, landed = landed, _landed(pair, ansatz, found.unknowns)
        if (landed != previous).sum() <= _SETTLED * landed.sum():
            break
        start = found.unknowns
    return replace(found, history=history)


def _better(pair: Pair, ansatz: Ansatz, a: FloatArray, before: FloatArray) -> FloatArray:
    """Choose what fits this level better: the last level's unknowns, or those it began with.

    A speckle that is too fine for a coarse blur leaves no information there, and the level
    leads astray; this takes its steps back.
    """
    if np.array_equal(a, before):
        return a
    assembly = Assembly(ansatz, pair.grid, pair.mask)
    costs = [_images(assembly, pair, x, False).mean_square for x in (a, before)]
    return a if costs[0] <= costs[1] else before


def _images(assembly: Assembly, pair: Pair, a: FloatArray, with_matrix: bool) -> NormalEquations:
    return assembly.images(a, pair.reference, pair.deformed, with_matrix)


def _landed(pair: Pair, ansatz: Ansatz, a: FloatArray) -> BoolArray:
    """Keep the pixels that these unknowns map onto material of the deformed image.

    The set is frozen while the cost is minimised: pixels that came and went with every step
    would make the cost jump, and the iteration stagnate.
    """
    if pair.allowed is None:
        return pair.mask
    grid, landed = pair.grid, pair.mask.copy()
    for first in range(0, grid.rows, _BAND):  # in bands: whole images of u would be large
        band = slice(first, first + _BAND)
        row, col = np.nonzero(pair.mask[band])
        u = (ansatz.displacement(a, grid.x, grid.y[band]) / grid.pixel_size)[row, col]
        to_row = np.rint(first + row - u[:, 1]).astype(int)
        to_col = np.rint(col + u[:, 0]).astype(int)
        inside = (to_row >= 0) & (to_row < grid.rows) & (to_col >= 0) & (to_col < grid.cols)
        # A pixel off the image stays in: the iteration counts those and says so.
        to = pair.allowed[to_row[inside], to_col[inside]]
        landed[first + row[inside], col[inside]] = to
    return landed


def _residual(pair: Pair, ansatz: Ansatz, a: FloatArray) -> NDArray[np.float32]:
    """(rows, cols) f - g(x + u) at the pixels that count, NaN at the others."""
    grid, landed = pair.grid, _landed(pair, ansatz, a)
    residual = np.full(grid.shape, np.nan, dtype=np.float32)
    for first in range(0, grid.rows, _BAND):
        band = slice(first, first + _BAND)
        row, col = np.nonzero(landed[band])
        u = (ansatz.displacement(a, grid.x, grid.y[band]) / grid.pixel_size)[row, col]
        gain, offset = (b[row, col] for b in ansatz.gain_and_offset(a, grid.x, grid.y[band]))
        value, _, _ = pair.deformed.sample(first + row - u[:, 1], col + u[:, 0])
        residual[first + row, col] = pair.reference[first + row, col] - gain * value - offset
    return residual


def _result(
    ansatz: Ansatz,
    grid: PixelGrid,
    found: Minimum,
    history: tuple[Iteration, ...],
    timings_s: dict[str, float],
) -> Result:
    eigen = ScaledEigen.of(found.equations.matrix)
    return Result(
        ansatz=ansatz,
        grid=grid,
        unknowns=found.unknowns.copy(),
        inverse=eigen.inverse(),
        residual_rms=float(np.sqrt(found.equations.mean_square)),
        pixels=found.equations.pixels,
        left_image=found.equations.left_image,
        outcome=found.outcome,
        condition_number=eigen.condition_number,
        history=history,
        timings_s=timings_s,
    )


def _useful(levels: tuple[Level, ...], ansatz: Ansatz, grid: PixelGrid) -> tuple[Level, ...]:
    """Select the levels that keep the modes visible and enough pixels; always the last one."""
    shortest = min((mode.half_wavelength for mode in ansatz.modes), default=np.inf)
    quarter_px = 0.25 * shortest / grid.pixel_size

    def keeps(level: Level) -> bool:
        blur_px = level.factor * level.blur
        return blur_px <= quarter_px and min(grid.shape) // level.factor >= 32

    return (*(level for level in levels[:-1] if keeps(level)), levels[-1])


def _step_length(ansatz: Ansatz, grid: PixelGrid, mask: BoolArray, factor: int) -> StepLength:
    """Rms difference of two displacements over about 10^4 of the pixels [px of the full image]."""
    stride = max(1, int(np.sqrt(mask.sum() / 1e4)))
    some = mask[::stride, ::stride]
    if not some.any():
        stride, some = 1, mask
    x, y = grid.x[::stride], grid.y[::stride]
    per_px = factor / grid.pixel_size  # a binned px is factor px

    def length(a: FloatArray, b: FloatArray) -> float:
        change = ansatz.displacement(b, x, y) - ansatz.displacement(a, x, y)
        squares = (change[some] ** 2).sum(axis=-1)
        return float(np.sqrt(squares.mean()) * per_px) if squares.size else 0.0

    return length


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
