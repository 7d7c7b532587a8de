"""One level of a correlation: which pixels lead, which count, and what must not matter."""

from __future__ import annotations

from collections.abc import Iterator

import manufactured
import numba
import numpy as np
import pytest
from filling_mode import EVERYWHERE, MASK, STRAIN, case, error_px, rms_px
from manufactured import DOMAIN, GRID, PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import FourierMode, square_family
from modeharvest.idic.result import Result
from modeharvest.idic.solver import level_search
from modeharvest.idic.solver.assembly import Assembly, residual, valid_pixels
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.solver.level_search import step_length
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage

FloatArray = NDArray[np.float64]


@pytest.fixture
def threads() -> Iterator[int]:
    """How many threads there may be; whatever a test sets is undone."""
    before = numba.get_num_threads()
    yield numba.config.NUMBA_NUM_THREADS
    numba.set_num_threads(before)


def simple() -> tuple[Ansatz, FloatArray, FloatArray, FloatArray]:
    """Few unknowns, so that the image has plenty of pixels; noisy, so that it matters which."""
    mode = FourierMode.scaled(square_family("junction"), 1.0, EVERYWHERE)
    ansatz = Ansatz(DOMAIN, (mode,), v0_degree=1, v_degree=0)
    a = ansatz.initial_guess(STRAIN, 1.3)
    a[ansatz.phi_slice(0)] += 0.02
    f, g = manufactured.image_pair(manufactured.speckle(), ansatz, a)
    noise = 0.02 * np.random.default_rng(0).normal(size=(2, *GRID.shape))
    return ansatz, ansatz.initial_guess(STRAIN, 1.0), f + noise[0], g + noise[1]


def found() -> Result:
    ansatz, start, f, g = simple()
    return correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)


def test_few_rows_lead_to_the_minimum_of_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    led = found()
    fewest = min(step.pixels for step in led.history if step.factor == 1)
    assert fewest < 0.3 * led.pixels
    assert led.history[-1].pixels == led.pixels
    monkeypatch.setattr(level_search, "_PLENTY", 10**9)
    plain = found()
    assert min(step.pixels for step in plain.history if step.factor == 1) == plain.pixels
    # Both stop within their last step, of less than 1e-4 px, of one minimum.
    assert rms_px(led.displacement(), plain.displacement()) < 1e-4
    assert led.outcome is plain.outcome is Outcome.CONVERGED


def test_on_coarse_levels_few_rows_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = found()
    monkeypatch.setattr(level_search, "_PLENTY", 100)
    led = found()
    most = {k: max(step.pixels for step in led.history if step.factor == k) for k in (2, 1)}
    assert most[2] < 0.3 * most[1] / 4
    assert led.pixels == led.history[-1].pixels == plain.pixels
    # Both stop within their last step, of less than 1e-4 px, of one minimum.
    assert rms_px(led.displacement(), plain.displacement()) < 1e-4


def test_a_whole_correlation_does_not_depend_on_the_number_of_threads(threads: int) -> None:
    if threads < 2:
        pytest.skip("needs two threads; one core here")
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(found())
    one, two = results
    np.testing.assert_array_equal(one.unknowns, two.unknowns)
    np.testing.assert_array_equal(one.inverse, two.inverse)
    assert one.residual_correlation == two.residual_correlation
    assert one.decorrelated_fraction == two.decorrelated_fraction


@pytest.mark.parametrize("unit_cell", [1.2, 1.4])
def test_on_two_cells_the_coarse_levels_do_not_wander(unit_cell: float) -> None:
    """So few cells leave a condition number of 10^5, and a blur would lead along the valley.

    Without leaving such directions to the finest level it takes 45 steps on the coarsest, of
    the 50 that are allowed.
    """
    ansatz, truth, f, g = case(unit_cell)
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))
    assert result.condition_number > 5e4
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5
    assert max(sum(step.factor == k for step in result.history) for k in (8, 4, 2, 1)) < 20


@pytest.mark.parametrize("thin", [1, 4])
def test_a_steps_length_is_that_of_the_whole_field(thin: int) -> None:
    ansatz, a, _, _ = case()
    mask = MASK.copy()
    mask[np.arange(GRID.rows) % thin != thin // 2] = False
    b = a + 1e-3 * np.random.default_rng(1).normal(size=a.size)
    x, y = GRID.x, GRID.y
    expected = rms_px(ansatz.displacement(a, x, y), ansatz.displacement(b, x, y))
    # A smooth field, sampled at some thousand pixels.
    got = step_length(ansatz, GRID, mask, 1)(a, b)
    assert got == pytest.approx(expected, rel=0.02)
    assert step_length(ansatz, GRID, mask, 4)(a, b) == pytest.approx(4 * got)
    assert step_length(ansatz, GRID, np.zeros_like(mask), 1)(a, b) == 0.0


def test_landing_and_residual_by_their_definitions() -> None:
    ansatz, a, f, g = case()
    f = f.astype(np.float32)
    spline, allowed = SplineImage.of(g), np.random.default_rng(3).random(GRID.shape) < 0.7
    assembly = Assembly(ansatz, GRID, MASK)
    row, col = np.nonzero(MASK)
    u = ansatz.displacement(a, GRID.x, GRID.y)[MASK] / PIXEL
    to_row, to_col = row - u[:, 1], col + u[:, 0]
    i, j = np.rint(to_row).astype(int), np.rint(to_col).astype(int)
    inside = (i >= 0) & (i < GRID.rows) & (j >= 0) & (j < GRID.cols)
    kept, outside = valid_pixels(assembly, a, f, spline, allowed)
    expected = np.zeros(row.size, dtype=bool)
    expected[inside] = allowed[i[inside], j[inside]]
    off = (to_row < 0) | (to_row > GRID.rows - 1) | (to_col < 0) | (to_col > GRID.cols - 1)
    assert outside == off.sum()
    np.testing.assert_array_equal(kept[MASK], expected)
    assert not kept[~MASK].any()
    left = residual(assembly, a, f, spline)
    assert np.isnan(left[~MASK]).all()
    by_hand = f[MASK] - spline.sample(to_row, to_col)[0]
    np.testing.assert_allclose(left[MASK], by_hand, atol=1e-6)  # kept as float32


@pytest.mark.parametrize("size", [64, 65, 96])
def test_the_smallest_images(size: int) -> None:
    """64 px hold a cubic displacement; 77 unknowns may err there, but make nothing worse."""
    grid = PixelGrid.centred(size, size, PIXEL)
    side = 0.5 * size * PIXEL
    box = Box(-side, side, -side, side)
    row, col = (slice(n // 2 - size // 2, n // 2 - size // 2 + size) for n in GRID.shape)
    slow = Ansatz(box, (), v0_degree=3)
    _, _, f, _ = case()
    a = slow.initial_guess(0.01)
    a[[0, 5, 11]] += 0.4 * PIXEL
    part = np.ascontiguousarray(f[row, col])
    u = slow.displacement(a, grid.x, grid.y) / PIXEL
    r, c = np.indices(grid.shape)
    spline = SplineImage.of(part)
    # f is g's spline at x + u, so that the truth is exact.
    warped = spline.sample(r - u[..., 1], c + u[..., 0])[0]
    inside = np.isfinite(warped)
    result = correlate(
        ImagePair(np.nan_to_num(warped), part, grid, inside), slow, guess=slow.initial_guess(0.0)
    )
    assert result.outcome is Outcome.CONVERGED
    assert rms_px(result.displacement(), u * PIXEL, inside) < 1e-4
    whole, shown = Ansatz.on(box, [(square_family(), box)], 0.4), np.nan_to_num(warped)
    start = whole.initial_guess(0.01, 0.1)
    result = correlate(ImagePair(shown, part, grid, inside), whole, guess=start)
    assert result.outcome in (Outcome.CONVERGED, Outcome.MAX_ITERATIONS)
    begun = residual(Assembly(whole, grid, inside), start, shown.astype(np.float32), spline)
    assert result.residual_rms < np.sqrt(np.nanmean(begun**2))
    assert np.isfinite(result.displacement()).all()
