"""Where a correlation may start, what a bad start does, and every way it can end."""

from __future__ import annotations

import manufactured
import numpy as np
import pytest
from filling_mode import EVERYWHERE, MASK, STRAIN, case, disturbed, error_px, rms_px, square
from manufactured import DOMAIN, GRID, PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import FourierMode, free_family, square_family
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Outcome
from modeharvest.idic.solver.pyramid import Level, eroded
from modeharvest.idic.spectra.pattern import mode_equivalent
from modeharvest.imaging.pair import ImagePair

FloatArray = NDArray[np.float64]


def square_and_wave() -> Ansatz:
    """Two modes of different lengths, of low degrees for the small image."""
    first = FourierMode.scaled(square_family("junction"), 1.0, EVERYWHERE)
    second = FourierMode.scaled(free_family([[0.3, 1.0, 1.2, 0.4, 0.1]]), 0.8, EVERYWHERE)
    return Ansatz(DOMAIN, (first, second), v0_degree=4, v_degree=3)


def test_the_standard_start_finds_the_truth() -> None:
    ansatz, truth, f, g = case()
    start = ansatz.initial_guess(STRAIN, 1.0)
    u = ansatz.displacement(truth, GRID.x, GRID.y)
    assert rms_px(u, ansatz.displacement(start, GRID.x, GRID.y)) > 1.5
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5
    # float32 pixels are rounded by 3e-8 and a quintic amplifies that by up to 56.
    assert result.residual_rms < 2e-6
    assert abs(result.residual(ImagePair(f, g, GRID))[MASK]).max() < 1e-4
    assert result.pixels == eroded(MASK, CorrelationOptions().edge_px).sum()
    assert result.outside_image == 0
    # Unknowns, too: those of the mode to the displacement's error over v1 max||phi|| = 6 px.
    np.testing.assert_allclose(result.mode_parameters(), truth[-7:], atol=1e-5)


@pytest.mark.parametrize("cells", [0.2, 0.5, 0.8])
def test_a_wave_shifted_by_part_of_a_cell_slides_back(cells: float) -> None:
    ansatz, truth, f, g = case()
    start = ansatz.initial_guess(STRAIN, 1.0)
    start[ansatz.phi_slice(0)][5] += cells
    assert error_px(correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start), truth) < 1e-5


@pytest.mark.parametrize("phases", [[1, 1, 1, 1, -1, 0, 0], [1, -1, -1, -1, 1, 0, 0]])
def test_the_wrong_phase_finds_the_truth(phases: list[float]) -> None:
    """One wave a whole cell off: the mode of a hole's centre taken for a junction's."""
    ansatz, truth, f, g = case(0.6)
    start = ansatz.initial_guess(STRAIN, 1.0)
    start[ansatz.phi_slice(0)] = phases
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5
    mode, _ = mode_equivalent(result.mode_parameters(), 0.6)
    expected, _ = mode_equivalent(truth[-7:], 0.6)
    np.testing.assert_allclose(mode, expected, atol=1e-5)


@pytest.mark.parametrize("amplitude", [-1.0, 0.3, 2.0])
@pytest.mark.parametrize("strain", [0.05, 0.1])
def test_amplitude_and_sign_of_the_start_do_not_matter(amplitude: float, strain: float) -> None:
    ansatz, truth, f, g = case()
    result = correlate(
        ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(strain, amplitude)
    )
    assert error_px(result, truth) < 1e-5


@pytest.mark.parametrize("seed", range(6))
def test_every_mode_parameter_10_percent_off(seed: int) -> None:
    ansatz, truth, f, g = case()
    start = ansatz.initial_guess(STRAIN, 1.0)
    off = 0.1 * np.random.default_rng(seed).choice([-1.0, 1.0], 7)
    start[ansatz.phi_slice(0)] += off  # the phases by 10 % of the unit cell, 1 mm
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5


@pytest.mark.parametrize("seed", [1, 2])
def test_two_modes(seed: int) -> None:
    ansatz = square_and_wave()
    truth = disturbed(ansatz, 1.2, seed)
    f, g = manufactured.image_pair(manufactured.speckle(), ansatz, truth)
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5
    np.testing.assert_allclose(result.mode_parameters(1), truth[-4:], atol=1e-5)


def test_a_in_a_local_minimum_iteration_says_so() -> None:
    ansatz, truth, f, g = case()
    start = ansatz.initial_guess(STRAIN, 1.0)
    start[ansatz.v0_slice(1)][0] += 0.25  # 25 px, two speckles and a half
    fine = CorrelationOptions(levels=(Level(1, 0.0),))
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start, options=fine)
    assert error_px(result, truth) > 5.0
    assert result.outcome is Outcome.LOCAL_MINIMUM
    found = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth, options=fine)
    assert found.outcome is Outcome.CONVERGED
    assert found.decorrelated_fraction == 0.0


def test_before_buckling_the_mode_stays_small() -> None:
    """Without a pattern its parameters mean nothing; the displacement must not suffer."""
    ansatz = square()
    truth = disturbed(ansatz, 1.0)
    truth[ansatz.v_slice(0)] = 0.0
    f, g = manufactured.image_pair(manufactured.speckle(), ansatz, truth)
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))
    assert error_px(result, truth) < 1e-3
    assert abs(result.fluctuation()[MASK]).max() < 0.01 * PIXEL
    assert np.isfinite(result.unknowns).all()


def test_a_start_without_the_mode_does_not_see_it() -> None:
    ansatz, truth, f, g = case()
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 0.0))
    # With v1 = 0 the first step leaves the mode's parameters alone, and makes v1 non-zero:
    # from then on they count. All is as if it had started with a small v1.
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-5


def test_stripes_say_nothing_about_the_motion_along_them() -> None:
    ansatz = Ansatz(DOMAIN, v0_degree=1)
    truth = np.array([0.02, -0.05, 0.0, 0.0, 0.0, 0.0])

    def stripes(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(np.sin(40 * x) + np.sin(27 * x) + 0 * y)

    f, g = manufactured.image_pair(stripes, ansatz, truth)
    start = np.zeros(6)
    start[3] = 0.013
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)
    assert result.undetermined == ("v0y[0,0]", "v0y[1,0]", "v0y[0,1]")
    assert result.condition_number == np.inf
    np.testing.assert_allclose(result.unknowns[:3], truth[:3], atol=1e-6)
    np.testing.assert_array_equal(result.unknowns[3:], start[3:])
    assert np.isinf(result.standard_errors()[3:]).all()


def test_no_pixel_lands_on_material() -> None:
    ansatz, _, f, g = case()
    mask, deformed_mask = (np.zeros(GRID.shape, dtype=np.bool_) for _ in range(2))
    mask[40:150], deformed_mask[250:340] = True, True
    options = CorrelationOptions(levels=(Level(1, 0.0),))
    start = ansatz.initial_guess(0.0, 0.1)
    result = correlate(
        ImagePair(f, g, GRID, mask, deformed_mask), ansatz, guess=start, options=options
    )
    assert result.outcome is Outcome.SINGULAR
    assert result.pixels == 0
    assert result.undetermined == ansatz.names
    np.testing.assert_array_equal(result.unknowns, start)


def test_a_start_off_the_image_is_not_iterated() -> None:
    ansatz, _, f, g = case()
    start = ansatz.initial_guess(STRAIN, 1.0)
    start[0] = 2.0  # 200 of 320 px to the right
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start)
    assert result.outcome is Outcome.OUTSIDE_IMAGE
    assert "outside the deformed image" in result.outcome.explanation
    assert result.outside_image > 0.2 * (result.pixels + result.outside_image)
    np.testing.assert_array_equal(result.unknowns, start)


def test_too_few_iterations_are_admitted() -> None:
    ansatz, _, f, g = case()
    options = CorrelationOptions(gauss_newton=GaussNewtonOptions(max_iterations=1))
    result = correlate(
        ImagePair(f, g, GRID, MASK),
        ansatz,
        guess=ansatz.initial_guess(STRAIN, 1.0),
        options=options,
    )
    assert result.outcome is Outcome.MAX_ITERATIONS
    assert "start closer, or allow more iterations" in result.outcome.explanation
    assert result.iterations == 1


def test_levels_that_would_blur_the_mode_away_are_skipped() -> None:
    """A unit cell of 60 px bears a blur of 15 px, which leaves out binning by 8 and 24 px."""
    for unit_cell, factors in ((1.0, {8, 4, 2, 1}), (0.6, {4, 2, 1})):
        ansatz, _, f, g = case(unit_cell)
        result = correlate(
            ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0)
        )
        assert {step.factor for step in result.history} == factors


def test_progress_goes_one_way_from_0_to_1() -> None:
    ansatz, truth, f, g = case()
    seen: list[float] = []

    def listen(done: float, total: float, what: str) -> None:
        assert what == "correlate"
        seen.append(done / total)

    correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth, progress=listen)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
