"""Integrated digital image correlation, and the best fit of an ansatz to a known displacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.result import Result, determined_part
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.assembly import Assembly, residual
from modeharvest.idic.solver.final_smoothing import (
    FinalSmoothing,
    smoothed_pair,
    speckle_size,
    spline_order,
)
from modeharvest.idic.solver.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    minimise,
)
from modeharvest.idic.solver.level_search import LevelSearch, step_length
from modeharvest.idic.solver.noise import NoiseTransfer, spline_autocorrelation
from modeharvest.idic.solver.pyramid import FULL, Level, level_pair
from modeharvest.idic.solver.residual_test import (
    MOST_DECORRELATED,
    autocorrelation,
    decorrelated_fraction,
    lags_for,
)
from modeharvest.idic.solver.weighting import (
    Gradient,
    Propagation,
    Weighting,
    best_blur,
    instrument,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair, Truth, checked_mask, location_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.util.scaled_eigen import ScaledEigen

WITHOUT_RESULT = (Outcome.OUTSIDE_IMAGE, Outcome.SINGULAR)
"""Outcomes without unknowns that could be assessed."""
ASTRAY = (*WITHOUT_RESULT, Outcome.LOCAL_MINIMUM)
"""Outcomes whose unknowns are neither a result nor an initial guess."""
_FINEST_PX = 4.0
"""Finer speckle is aliased by the pixels: the gradient that weighs the residual is filtered."""


def correlate(
    pair: ImagePair, ansatz: Ansatz, *, strain: float | None = None, guess: ArrayLike | None = None,
    options: CorrelationOptions | None = None, progress: Progress = silent,
) -> Result:  # fmt: skip
    """Find the unknowns that make the deformed image match the reference.

    Minimises 1/2 sum (f(x) - g(x + u(x, a)))^2 over the pixels of the reference that show material:
    the paper's Eqs. (2), (3) and (4).

    Raises InputError if both strain and guess are given, or the guess doesn't fit the ansatz.

    pair : The image pair. Without a mask every pixel counts; without a deformed mask g is used
        unchanged.
    ansatz : The kinematics.
    strain : Nominal compression along x of the initial guess [-], see
        :meth:`Ansatz.initial_guess`; by default the pair's, or 0 where that isn't known.
    guess : (size,) initial unknowns, instead of a strain.
    options, progress : How to correlate; progress listener.
    """
    options, pair = options or CorrelationOptions(), pair.without_extremes()
    course, levels = _Course(options, progress), options.levels
    a = _with_gain_and_offset(ansatz, _initial_guess(pair, ansatz, strain, guess), pair)
    smoothing: FinalSmoothing | None = None
    history: tuple[Iteration, ...] = ()
    if options.final_smoothing_px is None and len(levels) > 1:
        coarse = _useful(levels[:-1], ansatz, pair.grid)
        course.count = len(coarse) + 1
        rough = course.through(coarse, pair, ansatz, a, options.order or 5)
        found = make_result(rough.search.ansatz, rough.search.pair.grid, rough.found)
        binned = found.grid.pixel_size / pair.grid.pixel_size
        smoothing = FinalSmoothing.of(pair, binned * found.model_error_px)
        a, history, levels = rough.unknowns, rough.found.history, levels[-1:]
    else:
        levels = _useful(levels, ansatz, pair.grid)
        course.count = len(levels)
        if options.final_smoothing_px:
            smoothing = FinalSmoothing.given(pair, options.final_smoothing_px)
    if smoothing is not None and smoothing.blur_px > 0.0:
        pair = smoothed_pair(pair, smoothing.blur_px)
        ansatz = replace(ansatz, brightness=Brightness())  # removed by local normalisation
    size_px = speckle_size(pair.reference, pair.mask)
    order = options.order or spline_order(size_px)
    reached = course.through(levels, pair, ansatz, a[: ansatz.size], order)
    result, reweighted = _assessed(reached, pair, size_px, course)
    progress(course.count, course.count, "correlate")
    history = (*history, *reached.found.history, *reweighted)
    return replace(result, final_smoothing=smoothing, history=history)


def refitted_result(
    pair: ImagePair, ansatz: Ansatz, unknowns: FloatArray, options: CorrelationOptions
) -> Result:
    """Make a result at given unknowns (n,) without iterating: the residual and covariance there.

    Gain and offset, if unknowns that are all 0, are set to equalise the images' mean and contrast.
    """
    a = _with_gain_and_offset(ansatz, unknowns, pair)
    size_px = speckle_size(pair.reference, pair.mask)
    level = level_pair(pair, FULL, options.edge_px, options.order or spline_order(size_px))
    search = LevelSearch(level, ansatz, FULL, True, options.gauss_newton, lambda number: None)
    used = search.valid_assembly(a)
    there = search.equations(used, a, True)
    found = Minimum(a, there, Outcome.REFITTED, (), there.matrix)
    result = _result(_Reached(search, found, used, a), found, size_px)
    return replace(result, outcome=found.outcome)


def best_fit(
    truth: Truth, result: Result, *, guesses: Sequence[FloatArray] = (), progress: Progress = silent
) -> Result:
    """Fit a result's ansatz to the true displacement: the best that the measurement could find.

    The fit starts from the result's unknowns and from each of ``guesses``, (n,) unknowns; the best
    minimum is kept. It is selected and approached on some tens of thousands of pixels: the ansatz
    is smooth, and its minima are far apart. Pixels with a NaN displacement don't count.
    """
    grid, ansatz, displacement = result.grid, result.ansatz, truth.displacement
    mask = np.isfinite(displacement[..., 0])
    every = max(1, int(np.sqrt(mask.sum() / _ENOUGH)))
    # The subset is centred in the image: a symmetric field stays symmetric.
    top, left = ((size - 1) % every // 2 for size in grid.shape)
    few = np.s_[top::every, left::every]
    rows, cols = mask[few].shape
    (x,), (y,) = grid.to_mm([top], [left])
    coarse = PixelGrid(rows, cols, every * grid.pixel_size, x, y)
    reached = min(
        (
            fit_displacement(displacement[few], coarse, ansatz, a, mask[few], _CLOSE)
            for a in (result.unknowns, *guesses)
        ),
        key=lambda fit: fit.residual_rms,
    )
    begin = np.append(reached.unknowns, result.unknowns[reached.unknowns.size :])
    return fit_displacement(displacement, grid, ansatz, begin, mask, _CLOSE, progress)


_ENOUGH = 40_000
"""Pixels of material that suffice to tell one minimum of the best fit from another."""
_CLOSE = GaussNewtonOptions(tolerance_px=1e-5)
"""A tenth of a correlation's tolerance: correlations are compared with the best fit."""


def fit_displacement(
    displacement: ArrayLike,
    grid: PixelGrid,
    ansatz: Ansatz,
    guess: ArrayLike,
    mask: ArrayLike | None = None,
    options: GaussNewtonOptions | None = None,
    progress: Progress = silent,
) -> Result:
    """Fit an ansatz to a known displacement by least squares: the best that IDIC could find.

    Minimises 1/2 sum ||u(x) - u(x, a)||^2 over the pixels with the solver of the correlation.

    Its ``residual_rms`` is in mm *per component*; sqrt(2) times it is the rms of the norm.
    InputError if sizes differ, the mask is empty or the displacement is NaN inside it.

    displacement : (rows, cols, 2) u at the reference pixels [mm]; may be NaN outside the mask.
    grid, ansatz, guess : The pixels, the kinematics, and (size,) initial unknowns.
    mask : (rows, cols) True where the displacement counts; everywhere by default.
    options, progress : Tolerances and limits; progress listener.
    """
    options = options or GaussNewtonOptions()
    course = _Course(CorrelationOptions(gauss_newton=options), progress)
    guess = ansatz.checked(guess)
    ansatz = replace(ansatz, brightness=Brightness())  # not observable in a displacement
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
        guess[: ansatz.size],
        options,
        on_iteration=course.report,
    )
    return replace(make_result(ansatz, grid, found), history=found.history)


def _initial_guess(
    pair: ImagePair, ansatz: Ansatz, strain: float | None, guess: ArrayLike | None
) -> FloatArray:
    """Return the given unknowns, or those of a homogeneous strain."""
    if guess is None:
        known = pair.strain if strain is None else strain
        return ansatz.initial_guess(0.0 if np.isnan(known) else known)
    if strain is not None:
        raise InputError("expected a strain or a guess of all unknowns, got both")
    return ansatz.checked(guess)


@dataclass(frozen=True, eq=False)
class _Reached:
    """The minimum on a level with all iterations up to it, its pixels, and all unknowns."""

    search: LevelSearch
    found: Minimum
    used: Assembly
    unknowns: FloatArray


class _Course:
    """A running correlation: its options and its progress."""

    def __init__(self, options: CorrelationOptions, progress: Progress) -> None:
        self.options, self.progress = options, progress
        self.count, self.done = 1, 0

    def report(self, number: int) -> None:
        """Report an iteration to the progress listener."""
        most = self.options.gauss_newton.max_iterations + 1
        self.progress(self.done + number / most, self.count, "correlate")

    def through(
        self, levels: tuple[Level, ...], pair: ImagePair, ansatz: Ansatz, a: FloatArray, order: int
    ) -> _Reached:
        """Correlate level by level; the last one solves for all unknowns, to the full tolerance.

        If gain or offset are unknowns, coarse levels use locally normalised images without them:
        there, they could absorb much of the blurred speckle itself.
        """
        edge_px, before = self.options.edge_px, a
        history: tuple[Iteration, ...] = ()
        for level in levels:
            finest = level is levels[-1]
            own_order = order if level == FULL else min(order, 5)
            normalised = ansatz.brightness.size > 0 and not finest
            search = LevelSearch(
                level_pair(pair, level, edge_px, own_order, normalised=normalised),
                ansatz if finest else replace(ansatz, brightness=Brightness()),
                level,
                finest,
                self.options.gauss_newton,
                self.report,
            )
            n = search.ansatz.size
            before = np.append(search.lower_cost(a[:n], before[:n]), a[n:])
            found, used = search.minimum(before[:n])
            history += found.history
            a = np.append(found.unknowns, a[n:])
            self.done += 1
            if found.outcome in WITHOUT_RESULT:
                break
        return _Reached(search, replace(found, history=history), used, a)


def _useful(levels: tuple[Level, ...], ansatz: Ansatz, grid: PixelGrid) -> tuple[Level, ...]:
    """Select the levels that keep the modes visible and enough pixels; always the last one."""
    shortest = min((mode.half_wavelength for mode in ansatz.modes), default=np.inf)
    quarter_px = 0.25 * shortest / grid.pixel_size

    def keeps(level: Level) -> bool:
        blur_px = level.factor * level.blur
        return blur_px <= quarter_px and min(grid.shape) // level.factor >= 32

    return (*(level for level in levels[:-1] if keeps(level)), levels[-1])


def _with_gain_and_offset(ansatz: Ansatz, guess: FloatArray, pair: ImagePair) -> FloatArray:
    """Set an initial gain and offset that give both images the same mean and contrast.

    Far from the solution, where the images don't match yet, a fit would rather remove the contrast
    than find the displacement. A guess that contains gain or offset already is kept.
    """
    first = ansatz.phi_offset(len(ansatz.modes))
    if first == ansatz.size or guess[first:].any():
        return guess
    guess, names, (f, g) = guess.copy(), ansatz.names, pair.grey
    gain = 1.0
    if "gain[0,0]" in names:
        gain = float(f.std(dtype=np.float64) / g.std(dtype=np.float64))
        guess[names.index("gain[0,0]")] = gain - 1.0
    if "offset[0,0]" in names:
        difference = f.mean(dtype=np.float64) - gain * g.mean(dtype=np.float64)
        guess[names.index("offset[0,0]")] = float(difference)
    return guess


def make_result(
    ansatz: Ansatz, grid: PixelGrid, found: Minimum, how: Propagation | None = None
) -> Result:
    """Make a result from a minimum, or with ``how`` from a root; its residual test isn't set."""
    matrix = found.equations.matrix
    eigen = ScaledEigen.of(matrix if how is None else how.slope)
    inverse, weight = eigen.inverse(), matrix if how is None else how.weight
    if how is not None:
        known, lost = determined_part(inverse)
        inverse = known @ weight @ known
        inverse[lost, lost] = np.inf
    constants = [ansatz.v0_slice(c).start for c in (0, 1)]
    per_px = grid.pixel_size**2 / max(1, found.equations.pixels)
    return Result(
        ansatz=ansatz, grid=grid, unknowns=found.unknowns.copy(), inverse=inverse,
        slope_square=float(np.mean(np.diag(matrix)[constants])) * per_px,
        weight_square=float(np.mean(np.diag(weight)[constants])) * per_px,
        residual_rms=float(np.sqrt(found.equations.mean_square)), pixels=found.equations.pixels,
        outside_image=found.equations.outside_image, outcome=found.outcome,
        condition_number=eigen.condition_number,
    )  # fmt: skip


def _assessed(
    reached: _Reached, pair: ImagePair, size_px: float, course: _Course
) -> tuple[Result, tuple[Iteration, ...]]:
    """Test the residual, and solve again with another weighting gradient where that is due.

    Returns the result, and the additional iterations alone.
    """
    result = _result(reached, reached.found, size_px)
    weighting = _weighting(result, size_px, course.options)
    search, used, found = reached.search, reached.used, reached.found
    if search.level != FULL or result.outcome in ASTRAY or weighting.is_least_squares:
        return result, ()
    weights = instrument(weighting, pair, search.pair, used, found.unknowns)
    found, how = search.reweighed(found, used, weights)
    weighted = (weighting, how) if found.outcome is Outcome.CONVERGED else ()
    result = _result(reached, found, size_px, *weighted)
    return result, found.history


def _result(
    reached: _Reached,
    found: Minimum,
    size_px: float,
    weighting: Weighting | None = None,
    how: Propagation | None = None,
) -> Result:
    """Make a result with its residual test; by default with the weighting of least squares."""
    ansatz, pair, used = reached.search.ansatz, reached.search.pair, reached.used
    left = residual(used, found.unknowns, pair.reference, pair.deformed)
    lost, lags_px = decorrelated_fraction(pair.reference, left), lags_for(size_px)
    if lost > MOST_DECORRELATED and found.outcome not in WITHOUT_RESULT:
        found = replace(found, outcome=Outcome.LOCAL_MINIMUM)
    order = pair.deformed.order
    where = (ansatz, found.unknowns, pair.grid, used.mask, order)
    expected = spline_autocorrelation(*where, lags_px)
    return replace(
        make_result(ansatz, pair.grid, found, how), noise_transfer=NoiseTransfer.of(*where),
        order=order, residual_correlation=autocorrelation(left, lags_px, expected),
        residual_lags_px=lags_px, decorrelated_fraction=lost,
        weighting=weighting or Weighting(speckle_size_px=size_px),
    )  # fmt: skip


def _weighting(result: Result, size_px: float, options: CorrelationOptions) -> Weighting:
    """Choose the gradient that weighs the residual: as specified, or according to the noise.

    If the residual is noise, the reference's gradient with the blur that minimises the unknowns'
    variance; otherwise the deformed image's. For the finest speckle always the reference's: such
    speckle is aliased, in the residual and in the deformed image's gradient alike.
    """
    is_noise, is_aliased = result.residual_test().is_white, size_px < _FINEST_PX
    gradient, blur_px, low_pass = options.gradient, options.gradient_blur_px, False
    if gradient is None:
        gradient = "reference" if is_noise or is_aliased else "deformed"
    if blur_px is None:
        blur_px = best_blur(result.noise_to_slope, size_px, result.order) if is_noise else 0.0
        low_pass = is_aliased and not blur_px
    return Weighting(Gradient(gradient), blur_px, size_px, low_pass)
