"""Whole correlations: manufactured truth, noise, invariances, and what can go wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import manufactured
import numpy as np
import pytest
from manufactured import GRID, PIXEL, CosinePattern
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.modes import square_family
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Outcome
from modeharvest.idic.solver.pyramid import Level, eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
Images = tuple[FloatArray, FloatArray]

MASK = manufactured.smooth_mask(manufactured.one_mode())
FINE_ONLY = CorrelationOptions(levels=(Level(1, 0.0),))


def truth(ansatz: Ansatz) -> FloatArray:
    """A compression of 3 %, a pattern of 3 px and everything else disturbed a little."""
    return manufactured.random_unknowns(ansatz, 3, 0.004)


def near(ansatz: Ansatz) -> FloatArray:
    """A start within reach of the truth."""
    return ansatz.initial_guess(0.03, 0.8)


def rms_px(u: FloatArray, v: FloatArray, mask: NDArray[np.bool_] = MASK) -> float:
    """Rms norm of the difference of two displacements over the mask [px]."""
    return float(np.sqrt(((u - v)[mask] ** 2).sum(axis=-1).mean()) / PIXEL)


@pytest.fixture(scope="module")
def ansatz() -> Ansatz:
    return manufactured.one_mode()


@pytest.fixture(scope="module")
def images(ansatz: Ansatz) -> Images:
    return manufactured.image_pair(CosinePattern.random(), ansatz, truth(ansatz))


@pytest.fixture(scope="module")
def noisy(images: Images) -> Images:
    """Add noise, so that the residual does not vanish and the minimum is not the truth."""
    rng = np.random.default_rng(8)
    f, g = images
    return f + 0.1 * rng.normal(size=f.shape), g + 0.1 * rng.normal(size=g.shape)


@pytest.fixture(scope="module")
def found(images: Images, ansatz: Ansatz) -> Result:
    return correlate(ImagePair(*images, GRID, MASK), ansatz, guess=ansatz.initial_guess(0.03))


def test_manufactured_ansatz_is_recovered(found: Result, ansatz: Ansatz) -> None:
    true = ansatz.displacement(truth(ansatz), GRID.x, GRID.y)
    start = ansatz.displacement(ansatz.initial_guess(0.03), GRID.x, GRID.y)
    assert rms_px(start, true) > 1.0  # there was something to find
    assert found.outcome is Outcome.CONVERGED
    assert found.outside_image == 0
    assert rms_px(found.displacement(), true) < 1e-5
    np.testing.assert_allclose(found.mode_parameters(), truth(ansatz)[-7:], atol=1e-4)
    assert found.residual_rms < 1e-5


def test_two_modes_are_recovered() -> None:
    ansatz = manufactured.two_modes()
    a = truth(ansatz)
    f, g = manufactured.image_pair(CosinePattern.random(1), ansatz, a)
    mask = manufactured.inner_mask()
    found = correlate(ImagePair(f, g, GRID, mask), ansatz, guess=near(ansatz))
    assert found.outcome is Outcome.CONVERGED
    true = ansatz.displacement(a, GRID.x, GRID.y)
    # The kinks of two tapers are too dense to be left out: the spline is off by up to 1e-3 of
    # the grey levels in the few pixels next to them.
    assert rms_px(found.displacement(), true, mask) < 3e-4


def test_history_and_sums_are_consistent(found: Result, images: Images) -> None:
    assert [s.factor for s in found.history] == sorted(s.factor for s in found.history)[::-1]
    assert found.history[-1].step_px <= GaussNewtonOptions().tolerance_px
    assert found.iterations == sum(s.factor == 1 for s in found.history)
    assert found.pixels == eroded(MASK, CorrelationOptions().edge_px).sum()
    residual = found.residual(ImagePair(*images, GRID))[eroded(MASK, 3)]
    # The kernel's own f and g are stored in float32: 6e-8 of the grey levels each.
    assert np.sqrt((residual**2).mean()) == pytest.approx(found.residual_rms, abs=3e-7)
    assert found.undetermined == ()
    assert 1 < found.condition_number < 1e6


def test_result_survives_a_file(found: Result, tmp_path: Path) -> None:
    found.write(tmp_path / "result.json")
    again = Result.read(tmp_path / "result.json")
    np.testing.assert_array_equal(again.unknowns, found.unknowns)
    np.testing.assert_array_equal(again.inverse, found.inverse)
    np.testing.assert_array_equal(again.displacement(), found.displacement())
    assert again.history == found.history
    assert again.outcome is found.outcome
    lost = found.inverse.copy()
    lost[5, 5] = np.inf
    replace(found, inverse=lost, condition_number=np.inf).write(tmp_path / "lost.json")
    assert Result.read(tmp_path / "lost.json").undetermined == (found.names[5],)


def test_damaged_result_file(found: Result, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    found.write(path)
    path.write_text(path.read_text()[:-300])
    with pytest.raises(InputError, match="JSON"):
        Result.read(path)
    path.write_text('{"format": "modeharvest-result-5"}')
    with pytest.raises(InputError, match="complete"):
        Result.read(path)
    path.write_text('{"format": "other"}')
    with pytest.raises(InputError, match="modeharvest-result-5"):
        Result.read(path)


def test_covariance_against_monte_carlo(images: Images, ansatz: Ansatz) -> None:
    f, g = images
    rng, sd, runs = np.random.default_rng(5), 0.005, 40
    options = replace(FINE_ONLY, order=5)
    errors = []
    for _ in range(runs):
        noise = sd * rng.normal(size=(2, *f.shape))
        found = correlate(
            ImagePair(f + noise[0], g + noise[1], GRID, MASK),
            ansatz,
            guess=truth(ansatz),
            options=options,
        )
        errors.append(found.unknowns - truth(ansatz))
    covariance = found.covariance(sd)
    squares = [e @ np.linalg.solve(covariance, e) for e in errors]
    # Mahalanobis squares: chi^2 with 77 x 40 degrees of freedom, so 1 +- sqrt(2/3080) = 2.5 %;
    # four of those, and 3 % for what the blur of the gradient costs.
    assert np.mean(squares) / ansatz.size == pytest.approx(1.0, abs=0.13)
    # One unknown's sample variance has a relative sd of sqrt(2/40) = 22 %; 77 of them spread
    # no farther than about 4 sd.
    ratio = np.mean(np.square(errors), axis=0) / np.diag(covariance)
    assert 0.3 < ratio.min() < ratio.max() < 2.0
    # The residual is nothing but that noise: 64 000 px scatter by 0.3 %.
    assert found.noise_sd == pytest.approx(sd, rel=0.015)


def test_grey_levels_do_not_matter(noisy: Images, ansatz: Ansatz) -> None:
    f, g = noisy
    start = truth(ansatz)
    plain = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=start, options=FINE_ONLY)
    scaled = correlate(
        ImagePair(60 * f + 128, 60 * g + 128, GRID, MASK), ansatz, guess=start, options=FINE_ONLY
    )
    # float32 keeps 128 + 60 f to 1e-5, i.e. f to 2e-7: far below the tolerance of 1e-4 px.
    assert rms_px(plain.displacement(), scaled.displacement()) < 1e-5
    assert scaled.residual_rms == pytest.approx(60 * plain.residual_rms, rel=1e-5)


def test_mirror_of_both_images(noisy: Images, ansatz: Ansatz) -> None:
    f, g = noisy
    plain = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=near(ansatz))
    mirrored = correlate(
        ImagePair(f[:, ::-1], g[:, ::-1], GRID, MASK[:, ::-1]), ansatz, guess=near(ansatz)
    )
    back = mirrored.displacement()[:, ::-1] * [-1, 1]
    assert rms_px(back, plain.displacement()) < 2e-4  # twice the tolerance of the iteration
    assert mirrored.residual_rms == pytest.approx(plain.residual_rms, rel=1e-6)


def test_transpose_of_both_images(noisy: Images, ansatz: Ansatz) -> None:
    # New column = old row: x' = -y and y' = -x.
    f, g = noisy
    domain, cellular = manufactured.DOMAIN, manufactured.CELLULAR
    box, part = (Box(b.y_min, b.y_max, b.x_min, b.x_max) for b in (domain, cellular))
    turned = Ansatz.on(box, [(square_family(), part)], manufactured.UNIT_CELL)
    start = turned.initial_guess(0.0, 0.8)
    start[turned.v0_slice(1)][2] = -0.03 * turned.domain.half[1]  # now compressed along y
    grid = PixelGrid.centred(GRID.cols, GRID.rows, PIXEL)
    plain = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=near(ansatz))
    other = correlate(ImagePair(f.T, g.T, grid, MASK.T), turned, guess=start)
    back = -np.swapaxes(other.displacement(), 0, 1)[..., ::-1]
    assert rms_px(back, plain.displacement()) < 2e-4


def test_best_fit_of_a_displacement_in_the_ansatz_is_exact(ansatz: Ansatz) -> None:
    a = truth(ansatz)
    u = ansatz.displacement(a, GRID.x, GRID.y)
    u[~MASK] = np.nan
    fit = fit_displacement(u, GRID, ansatz, ansatz.initial_guess(0.03), MASK)
    assert fit.outcome is Outcome.CONVERGED
    assert fit.residual_rms < 1e-9
    np.testing.assert_allclose(fit.unknowns, a, atol=1e-7)


def test_best_fit_is_orthogonal_to_the_ansatz(ansatz: Ansatz) -> None:
    # A least-squares fit leaves nothing that a polynomial of v0 could still take away.
    x, y = np.meshgrid(GRID.x, GRID.y)
    u = ansatz.displacement(truth(ansatz), GRID.x, GRID.y)
    u[..., 0] += 0.01 * np.sin(9 * x + 4 * y)
    fit = fit_displacement(u, GRID, ansatz, truth(ansatz), MASK, GaussNewtonOptions(1e-7))
    rest = (u - fit.displacement())[MASK]
    assert fit.residual_rms == pytest.approx(np.sqrt((rest**2).mean()), rel=1e-9)
    basis = ansatz.v0_space.basis(x[MASK], y[MASK])
    cosines = basis.T @ rest / np.linalg.norm(basis, axis=0)[:, None] / np.linalg.norm(rest)
    assert abs(cosines).max() < 1e-6


def test_holes_are_kept_out_of_blur_and_sampling(images: Images, ansatz: Ansatz) -> None:
    # Discs of another grey level in both images, moving with the material, masks given.
    true = ansatz.displacement(truth(ansatz), GRID.x, GRID.y)
    x, y = np.meshgrid(GRID.x, GRID.y)
    origin = manufactured.reference_points(ansatz, truth(ansatz))

    def solid(px: FloatArray, py: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(np.hypot((px % 1.0) - 0.5, (py % 1.0) - 0.5) > 0.3)

    mask, g_mask = solid(x, y) & MASK, solid(origin[..., 0], origin[..., 1])
    f, g = (np.where(m, im, -9.0) for m, im in zip((mask, g_mask), images, strict=True))
    found = correlate(ImagePair(f, g, GRID, mask, g_mask), ansatz, guess=ansatz.initial_guess(0.03))
    assert found.outcome is Outcome.CONVERGED
    # Grey level -9 is 13 sd away. 3 px from a hole's edge the smooth continuation behind it
    # still rings by about 0.43^3 of a misfit below 1 sd, for one pixel in ten.
    assert rms_px(found.displacement(), true, mask) < 0.02
    some = replace(FINE_ONLY, gauss_newton=GaussNewtonOptions(max_iterations=20))
    naive = correlate(ImagePair(f, g, GRID), ansatz, guess=truth(ansatz), options=some)
    assert rms_px(naive.displacement(), true, mask) > rms_px(found.displacement(), true, mask)


def test_start_far_outside_the_image_is_an_outcome(images: Images, ansatz: Ansatz) -> None:
    start = ansatz.initial_guess()
    start[0] = 2.0  # 200 of 320 px
    found = correlate(ImagePair(*images, GRID, MASK), ansatz, guess=start)
    assert found.outcome is Outcome.OUTSIDE_IMAGE
    np.testing.assert_array_equal(found.unknowns, start)


def spoiled(image: FloatArray) -> FloatArray:
    image = image.copy()
    image[7, 9] = image[8, 1] = np.nan
    return image


def test_bad_input_is_named(images: Images, ansatz: Ansatz) -> None:
    f, g = images
    start = ansatz.initial_guess()
    with pytest.raises(InputError, match=r"deformed image of 360 x 320.*\(359, 320\)"):
        correlate(ImagePair(f, g[1:], GRID), ansatz, guess=start)
    with pytest.raises(InputError, match=r"reference image, got NaN.*2 px.*row 7, column 9"):
        correlate(ImagePair(spoiled(f), g, GRID), ansatz, guess=start)
    with pytest.raises(InputError, match="mask of 360 x 320"):
        correlate(ImagePair(f, g, GRID, MASK[1:]), ansatz, guess=start)
    with pytest.raises(InputError, match="deformed mask, got one that is False everywhere"):
        correlate(ImagePair(f, g, GRID, MASK, np.zeros_like(MASK)), ansatz, guess=start)
    with pytest.raises(InputError, match="constant grey level"):
        correlate(ImagePair(f, np.full(GRID.shape, 3.0), GRID), ansatz, guess=start)
    with pytest.raises(InputError, match="expected 77 unknowns"):
        correlate(ImagePair(f, g, GRID), ansatz, guess=np.zeros(5))
    u = np.zeros((*GRID.shape, 2))
    with pytest.raises(InputError, match="displacement of shape"):
        fit_displacement(u[1:], GRID, ansatz, start)
    u[180, 160] = np.nan
    with pytest.raises(InputError, match="1 px, the first at row 180, column 160"):
        fit_displacement(u, GRID, ansatz, start, MASK)
    with pytest.raises(InputError, match="at least one level"):
        CorrelationOptions(levels=())
    with pytest.raises(InputError, match="order"):
        CorrelationOptions(order=4)
    with pytest.raises(InputError, match="binning"):
        Level(0, 3.0)
