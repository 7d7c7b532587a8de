"""Which gradient weighs the residual: the root is the truth, and noise no longer spoils it."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import cache

import manufactured
import numpy as np
import pytest
from manufactured import PIXEL
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box, Brightness
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.assembly import Assembly, warped_back
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Minimum, Outcome
from modeharvest.idic.solver.level_search import step_length
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL, level_pair
from modeharvest.idic.solver.weighting import Gradient, Weighting, best_blur, instrument, root
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

GRID = PixelGrid.centred(150, 140, PIXEL)
ANSATZ = Ansatz(Box.centred(1.4, 1.5), v0_degree=2)
MASK: NDArray[np.bool_] = np.pad(np.ones((110, 100), dtype=np.bool_), 20)
FINEST = CorrelationOptions(levels=(FULL,))
LEAST_SQUARES = replace(FINEST, gradient="deformed", gradient_blur_px=0.0)
NOISE, PAIRS = 0.02, 40


@cache
def truth() -> FloatArray:
    """A few per cent of strain and of rotation."""
    rng = np.random.default_rng(0)
    return np.asarray(ANSATZ.initial_guess(0.03) + 0.01 * rng.normal(size=ANSATZ.size))


@cache
def pair(seed: int = 3) -> tuple[FloatArray, FloatArray]:
    return manufactured.image_pair(manufactured.speckle(seed, GRID), ANSATZ, truth(), GRID)


def test_the_deformed_image_itself_as_the_instrument_changes_nothing() -> None:
    f, g = (image.astype(np.float32) for image in pair())
    spline, used = SplineImage.of(g), Assembly(ANSATZ, GRID, MASK)
    a = ANSATZ.initial_guess(0.028)
    given = warped_back(used, a, f, spline)
    own, same = used.images(a, f, spline), used.images(a, f, spline, instrument=given)
    # float32 slopes, of which 10^4 are summed.
    np.testing.assert_allclose(same.matrix, own.matrix, rtol=1e-5, atol=1e-7 * own.matrix.max())
    np.testing.assert_allclose(same.gradient, own.gradient, atol=1e-6 * abs(own.gradient).max())
    assert same.cost == own.cost


def steps_to_the_truth(weighting: Weighting) -> int:
    """Go to the root from unknowns that are 0.3 px off; returns in how many steps."""
    f, g = pair()
    images = ImagePair(f, g, GRID, MASK)
    level = level_pair(images, FULL, edge_px=2, order=5)
    used = Assembly(ANSATZ, GRID, level.mask)
    a = truth() + 0.002 * np.random.default_rng(4).normal(size=ANSATZ.size)
    length = step_length(ANSATZ, GRID, level.mask, 1)
    assert length(a, truth()) > 0.2
    here = used.images(a, level.reference, level.deformed)
    given = instrument(weighting, images, level, used, a)
    found = root(
        lambda a: used.images(a, level.reference, level.deformed, False, given),
        here.matrix,
        length,
        Minimum(a, here, Outcome.CONVERGED, (), here.matrix),
        GaussNewtonOptions(tolerance_px=1e-6),
    )
    assert found.outcome is Outcome.CONVERGED
    # float32 images, and a spline that is off by 8e-7 of full scale.
    assert length(found.unknowns, truth()) < 1e-5
    return len(found.history)


@pytest.mark.parametrize("gradient", list(Gradient))
@pytest.mark.parametrize("blur_px", [0.0, 1.5])
def test_exact_images_have_their_root_at_the_truth(gradient: Gradient, blur_px: float) -> None:
    assert steps_to_the_truth(Weighting(gradient, blur_px)) < 15


def test_the_reference_s_gradient_pushed_forward_is_the_deformed_image_s() -> None:
    f, g = pair()
    images = ImagePair(f, g, GRID, MASK)
    level = level_pair(images, FULL, edge_px=2, order=5)
    used = Assembly(ANSATZ, GRID, level.mask)
    of_f, of_g = (instrument(Weighting(gradient), images, level, used, truth())[:2, level.mask]
                  for gradient in (Gradient.REFERENCE, Gradient.DEFORMED))  # fmt: skip
    # Slopes of float32 splines of a speckle blurred by 3 px.
    assert abs(of_f - of_g).max() < 1e-4 * abs(of_g).max()
    plain = instrument(Weighting(Gradient.REFERENCE), images, level, used, np.zeros(ANSATZ.size))
    assert abs(plain[:2, level.mask] - of_g).max() > 0.03 * abs(of_g).max()


@pytest.mark.parametrize("size_px", [2.0, 3.0, 4.0])
def test_a_low_pass_filter_leaves_nothing_at_the_nyquist_limit(size_px: float) -> None:
    """Slopes of waves along x at the pixels, filtered and not; and of noise."""
    filtered = Weighting(Gradient.REFERENCE, 0.0, size_px, low_pass=True)

    def slopes(image: FloatArray, weighting: Weighting = filtered) -> FloatArray:
        images = ImagePair(image, image, GRID, MASK)
        level = level_pair(images, FULL, edge_px=2, order=11)
        used = Assembly(ANSATZ, GRID, level.mask)
        inside = ndimage.binary_erosion(MASK, iterations=12)  # the spline's ends are elsewhere
        return instrument(weighting, images, level, used, np.zeros(ANSATZ.size))[0][inside] * PIXEL

    col = np.arange(GRID.shape[1])
    for k in (0.02, 0.1, 0.25, 0.375):
        wave = np.tile(np.sin(2 * np.pi * k * col), (GRID.shape[0], 1))
        whole = np.std(slopes(wave, Weighting(Gradient.REFERENCE)))
        assert whole == pytest.approx(np.sqrt(0.5) * 2 * np.pi * k, rel=0.03)
        passed = float(filtered.passed(np.array(k)))
        assert np.std(slopes(wave)) == pytest.approx(whole * passed, rel=0.01, abs=1e-3)
    assert np.std(slopes(np.tile(np.cos(np.pi * col), (GRID.shape[0], 1)))) < 1e-3
    noise = np.random.default_rng(3).normal(size=GRID.shape)
    assert np.var(slopes(noise)) == pytest.approx(filtered.slope_noise(11), rel=0.1)


def test_what_alternates_from_pixel_to_pixel_is_not_weighed_at_the_edges_of_the_mask() -> None:
    """Aliasing does; inside, the filter's slopes have nothing in common with it.

    A sum that ends all at once takes half of its last pixel's share of it, whatever the filter:
    chi squared of the unknowns was 1.055 for that, at 0.2 % of noise on speckle of 3 px.
    """
    mask, filtered = MASK.copy(), Weighting(Gradient.REFERENCE, 0.0, 3.0, low_pass=True)
    mask[60:90, 50:80] = False
    f, _ = pair()
    level = level_pair(ImagePair(f, f, GRID, mask), FULL, edge_px=2, order=11)
    used = Assembly(ANSATZ, GRID, level.mask)
    h = instrument(filtered, ImagePair(f, f, GRID, mask), level, used, np.zeros(ANSATZ.size))[:2]
    row, col = np.indices(GRID.shape)
    for alternating in ((-1.0) ** row, (-1.0) ** col, (-1.0) ** (row + col)):
        found = (h * alternating)[:, level.mask].sum(axis=1)
        assert (found**2 < 5e-3 * np.square(h[:, level.mask]).sum(axis=1)).all()


def test_half_of_a_wave_is_left_where_its_aliased_part_is_a_hundredth_of_it() -> None:
    """By the power spectrum of a speckle whose autocorrelation is 3 px wide, a Gaussian."""
    L = 3.0 / np.sqrt(8.0 * np.log(2.0))
    k = np.linspace(0.0, 0.5, 501)
    amplitude = np.exp(-((np.pi * L) ** 2) * ((1.0 - k) ** 2 - k**2))
    passed = Weighting(Gradient.REFERENCE, 0.0, 3.0, low_pass=True).passed(k)
    np.testing.assert_allclose(passed, 1.0 / (1.0 + (amplitude / 0.01) ** 2), rtol=1e-12)


def test_noise_free_images_keep_the_least_squares_minimum() -> None:
    found = correlate(ImagePair(*pair(), GRID, MASK), ANSATZ, guess=truth(), options=FINEST)
    assert found.weighting.is_least_squares
    assert "deformed image's gradient." in found.weighting.text


def test_a_displacement_left_over_keeps_the_least_squares_minimum() -> None:
    """There is noise, but what the ansatz lacks is more."""
    low = replace(ANSATZ, v0_degree=1)
    noise = NOISE * np.random.default_rng(1).normal(size=(2, *GRID.shape))
    f, g = pair()
    found = correlate(
        ImagePair(f + noise[0], g + noise[1], GRID, MASK),
        low,
        guess=low.initial_guess(0.03),
        options=FINEST,
    )
    assert not found.residual_test().is_white
    assert found.weighting.is_least_squares


@cache
def noise_free_inverse(seed: int) -> FloatArray:
    """(n, n) M^-1 of the images without noise."""
    images = ImagePair(*pair(seed), GRID, MASK)
    return correlate(images, ANSATZ, guess=truth(), options=LEAST_SQUARES).inverse


@cache
def monte_carlo(options: CorrelationOptions) -> tuple[FloatArray, FloatArray, list[Result]]:
    """(pairs, 2, n) errors under n and -n, (pairs, n, n) covariances at the bound, results.

    The bound is s^2 (1 + 1/det F) M^-1 with M of the noise-free images.
    """
    h = 1e-6
    u = [ANSATZ.displacement(truth(), GRID.x + dx, GRID.y + dy)
         for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h))]  # fmt: skip
    F = np.stack([(u[0] - u[1]), (u[2] - u[3])], axis=-1) / (2 * h) + np.eye(2)
    weight = 1.0 + (1.0 / np.linalg.det(F[MASK])).mean()
    errors, bounds, results = [], [], []
    for seed in range(PAIRS):
        f, g = pair(seed)
        noise = NOISE * np.random.default_rng([seed, 7]).normal(size=(2, *GRID.shape))
        found = [
            correlate(ImagePair(f + s * noise[0], g + s * noise[1], GRID, MASK), ANSATZ,
                      guess=truth(), options=options)
            for s in (1, -1)
        ]  # fmt: skip
        errors.append([r.unknowns - truth() for r in found])
        bounds.append(NOISE**2 * weight * noise_free_inverse(seed))
        results += found
    return np.array(errors), np.array(bounds), results


def square_slope() -> float:
    """Mean square of the speckle's slope along an axis [1/px^2]."""
    slopes = SplineImage.of(pair(0)[0]).sample(*np.nonzero(MASK))[1:]
    return float(np.mean(np.square(slopes)))


def chi_square(errors: FloatArray, bounds: FloatArray) -> float:
    """Mean square of standardised errors; the two of a pair have theirs in common."""
    weighted = np.linalg.solve(bounds[:, None], errors[..., None])[..., 0]
    return float((errors * weighted).sum(axis=-1).mean() / ANSATZ.size)


def test_at_2_percent_of_noise_the_errors_are_at_the_bound() -> None:
    errors, bounds, results = monte_carlo(FINEST)
    assert {r.outcome for r in results} == {Outcome.CONVERGED}
    assert all(r.weighting.gradient is Gradient.REFERENCE for r in results)
    assert all(r.weighting.blur_px > 0.6 for r in results)
    # n and -n are one draw: chi squared over n * PAIRS = 480 degrees of freedom has a standard
    # deviation of sqrt(2/480) = 6.5 %; four of them leave 1 in 10^4. Least squares has 1.4.
    assert chi_square(errors, bounds) == pytest.approx(1.0, abs=4 * np.sqrt(2 / bounds[:, 0].size))
    bare = chi_square(*monte_carlo(LEAST_SQUARES)[:2])
    # On the same noise: the difference scatters far less than either.
    share = results[0].noise_transfer.slope * NOISE**2 / square_slope()
    assert 0.25 * share < bare - chi_square(errors, bounds) < share


def test_what_is_of_second_order_in_the_noise_is_small() -> None:
    """What n and -n have in common is where a bias would be."""
    common = [chi_square(monte_carlo(how)[0].mean(axis=1, keepdims=True), monte_carlo(how)[1])
              for how in (FINEST, LEAST_SQUARES)]  # fmt: skip
    # Its least-squares part is q s^2/(2 G^2) = 0.4 of the variance; a blur of 1 px leaves 1/30.
    assert common[0] < 0.1 * common[1]


def test_results_tell_the_errors_they_have() -> None:
    _, bounds, results = monte_carlo(FINEST)
    predicted = np.array([r.covariance(NOISE) for r in results])
    share = (
        np.trace(np.linalg.solve(np.repeat(bounds, 2, axis=0), predicted).mean(axis=0))
        / ANSATZ.size
    )
    # 2 % is what the blur costs.
    assert share == pytest.approx(1.01, abs=0.02)


def test_noise_does_not_make_a_gain_too_small() -> None:
    ansatz = replace(ANSATZ, brightness=Brightness(gain_degree=0, offset_degree=0))
    truth_of_all, number = np.append(truth(), [0.0, 0.0]), ansatz.names.index("gain[0,0]")
    means = []
    for options in (FINEST, LEAST_SQUARES):
        gains, sds = [], []
        for seed in range(16):
            noise = NOISE * np.random.default_rng([seed, 8]).normal(size=(2, *GRID.shape))
            f, g = (image + n for image, n in zip(pair(seed), noise, strict=True))
            found = correlate(
                ImagePair(f, g, GRID, MASK), ansatz, guess=truth_of_all, options=options
            )
            gains.append(found.unknowns[number])
            sds.append(found.standard_errors(NOISE)[number])
        means.append(np.mean(gains) / (np.mean(sds) / np.sqrt(len(gains))))
    with_instrument, least_squares = means
    # Errors in the variable g take s^2/V of a gain of 1: 0.01 here, and its sd is 0.002.
    assert abs(with_instrument) < 4.0
    assert least_squares < -10.0


@pytest.mark.parametrize("gradient", ["deformed", "reference"])
def test_weighing_anew_takes_little_memory(gradient: str) -> None:
    image = gaussian_speckle(10.0, 2)
    f, g = ((image + 0.05 * noise * image.std()).astype(np.float32)
            for noise in np.random.default_rng(5).normal(size=(2, *image.shape)))  # fmt: skip
    grid, everywhere = PixelGrid.centred(*image.shape, PIXEL), np.ones(image.shape, dtype=np.bool_)
    options = replace(CorrelationOptions(), gradient=gradient)
    tracemalloc.start()
    found = correlate(
        ImagePair(f, g, grid, everywhere, everywhere),
        ANSATZ,
        guess=ANSATZ.initial_guess(0.0),
        options=options,
    )
    peak = tracemalloc.get_traced_memory()[1] / f.nbytes
    tracemalloc.stop()
    assert found.weighting.blur_px > 0.0
    assert peak < 12.0  # float32 images, the bound of a whole correlation


def gaussian_speckle(width_px: float, seed: int) -> FloatArray:
    """A field whose autocorrelation is a Gaussian of that full width at half maximum."""
    noise = np.random.default_rng(seed).normal(size=(512, 512))
    sd = width_px / np.sqrt(8 * np.log(2)) / np.sqrt(2)
    return np.asarray(ndimage.gaussian_filter(noise, sd, mode="wrap"))


@pytest.mark.parametrize("width_px", [6.0, 12.0])
@pytest.mark.parametrize("blur_px", [0.8, 1.5])
def test_the_excess_is_that_of_sums_over_an_image(width_px: float, blur_px: float) -> None:
    """Variance of h'r/(h'J) with h from a blurred noisy image, against that with the true slope."""
    clean, s = gaussian_speckle(width_px, 0), 0.1
    clean /= clean.std()
    noise = s * np.random.default_rng(1).normal(size=clean.shape)

    def slope(image: FloatArray) -> FloatArray:
        return np.asarray(ndimage.gaussian_filter(image, blur_px, order=(0, 1), mode="wrap"))

    G = np.fft.ifft(2j * np.pi * np.fft.fftfreq(512) * np.fft.fft(clean, axis=1), axis=1).real
    h, spoilt = slope(clean), slope(noise)
    # Noise in g, of which h is independent, sees all of h; noise in f only its true part.
    variance = (h**2).sum() + 0.5 * (spoilt**2).sum()
    expected = variance * (G**2).sum() / (h * G).sum() ** 2 - 1
    # 512 px hold (512/12)^2 speckles: sums are good to 2 %, their ratios to a tenth of that.
    found = Weighting(Gradient.REFERENCE, blur_px, width_px).excess(s**2 / (G**2).mean())
    assert found == pytest.approx(expected, rel=0.1, abs=2e-3)


@pytest.mark.parametrize("width_px", [3.0, 6.0, 12.0])
@pytest.mark.parametrize("noise", [0.02, 0.3, 1.2])
def test_the_best_blur_is_the_best(width_px: float, noise: float) -> None:
    def excess_of(blur_px: float) -> float:
        return Weighting(Gradient.REFERENCE, blur_px, width_px).excess(noise)

    best = best_blur(noise, width_px)
    excess = excess_of(best)
    assert excess <= excess_of(0.0)
    if best > 0.65:  # else it is the smallest there is
        around = [excess_of(k * best) for k in (0.9, 1.1)]
        assert excess < min(around)


def test_little_noise_needs_no_blur() -> None:
    assert best_blur(0.0, 12.0) == best_blur(0.006, 12.0) == 0.0
    assert best_blur(0.1, 12.0) > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gradient": "both"}, "gradient among"),
        ({"gradient_blur_px": -1.0}, "blur of it of 0 to 100 px"),
        ({"gradient_blur_px": float("nan")}, "blur of it of 0 to 100 px"),
    ],
)
def test_bad_options(change: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(CorrelationOptions(), **change)  # type: ignore[arg-type]


def test_bad_weighting() -> None:
    with pytest.raises(InputError, match="at least 0 px"):
        Weighting(blur_px=-0.1)
    with pytest.raises(InputError, match="known size for a low-pass filter"):
        Weighting(Gradient.REFERENCE, low_pass=True)  # its response was nan at half the sampling


SMALL = Ansatz(Box.centred(1.4, 1.5), v0_degree=1)


def shifted(shift_px: tuple[float, float], seed: int) -> tuple[FloatArray, FloatArray]:
    """A pair of exact images, the second one moved [px]."""
    pattern = manufactured.speckle(seed, GRID)
    x, y = np.meshgrid(GRID.x, GRID.y)
    return pattern(x, y), pattern(x - shift_px[0] * PIXEL, y - shift_px[1] * PIXEL)


def bias_of_a_shift(
    shift_px: tuple[float, float], in_f: float, in_g: float, options: CorrelationOptions
) -> FloatArray:
    """(2,) bias of the mean displacement along x and y, in standard errors."""
    truth = np.array(shift_px)
    errors, sds = [], []
    for seed in range(6):
        f, g = shifted(shift_px, seed)
        noise = np.random.default_rng([seed, 9]).normal(size=(2, *GRID.shape))
        for sign in (1, -1):
            noisy = ImagePair(f + sign * in_f * noise[0], g + sign * in_g * noise[1], GRID, MASK)
            found = correlate(noisy, SMALL, guess=np.zeros(SMALL.size), options=options)
            at = [SMALL.v0_slice(c).start for c in (0, 1)]
            errors.append(found.unknowns[at] / PIXEL - truth)
            sds.append(found.standard_errors(ImageNoise(in_f, in_g))[at] / PIXEL)
    return np.asarray(np.mean(errors, axis=0) / np.sqrt(np.mean(np.square(sds), axis=0)))


@pytest.mark.parametrize(
    ("shift_px", "in_f", "in_g"),
    [
        ((0.25, 0.0), 0.02, 0.02),
        ((0.1, 0.75), 0.02, 0.02),
        ((0.25, 0.3), 0.0, 0.02),
        ((0.25, 0.3), 0.02, 0.0),
    ],
)
def test_small_motions_have_no_bias(
    shift_px: tuple[float, float], in_f: float, in_g: float
) -> None:
    """Interpolated noise has a variance, and so a slope, that depends on where between pixels.

    benchmarks/small_motion.py looks at more of it.
    """
    assert abs(bias_of_a_shift(shift_px, in_f, in_g, FINEST)).max() < 0.2


def test_aliasing_is_kept_out_of_what_weighs_the_residual() -> None:
    """Speckle of 3 px under little noise: the residual isn't white, though there is no model error.

    What that does to the bias is a row of benchmarks/small_motion.py.
    """
    spec = SpeckleSpec(standard_deviation=0.2, blur_px=0.75)
    pattern, (rows, cols) = Speckle(spec, GRID.shape), GRID.shape
    col, row = np.meshgrid(np.arange(cols) - 0.25, np.arange(rows) - 0.0)
    noise = 0.002 * np.random.default_rng(0).normal(size=(2, *GRID.shape))
    images = ImagePair(pattern.image() + noise[0], pattern.exact(row, col) + noise[1], GRID, MASK)
    found = correlate(images, SMALL, guess=np.zeros(SMALL.size), options=FINEST)
    assert not found.residual_test().is_white
    assert found.weighting.speckle_size_px < 4.0
    assert found.weighting.gradient is Gradient.REFERENCE
    assert found.weighting.low_pass


def test_least_squares_has_one() -> None:
    along, across = bias_of_a_shift((0.25, 0.0), 0.0, 0.02, LEAST_SQUARES)
    assert along > 3.0
    assert abs(across) < 1.0


def test_pixels_at_the_border_do_not_keep_a_correlation_from_settling() -> None:
    """A row that lands on the image's last one came and went with every step."""
    f, g = shifted((0.25, 0.0), 0)
    for seed in range(6):
        noise = 0.01 * np.random.default_rng(seed).normal(size=(2, *GRID.shape))
        options = CorrelationOptions(gradient="reference")
        start = np.zeros(SMALL.size)
        found = correlate(
            ImagePair(f + noise[0], g + noise[1], GRID), SMALL, guess=start, options=options
        )
        assert found.outcome is Outcome.CONVERGED
        assert found.weighting.gradient is Gradient.REFERENCE


def test_a_root_that_is_not_found_is_predicted() -> None:
    """Weights that have nothing to do with the images lead nowhere."""
    f, g = pair()
    used = Assembly(ANSATZ, GRID, MASK)
    level = level_pair(ImagePair(f, g, GRID, MASK), FULL, edge_px=2, order=5)
    here = used.images(truth(), level.reference, level.deformed)
    noise = np.random.default_rng(1).normal(size=(3, *GRID.shape)).astype(np.float32)
    found = root(
        lambda a: used.images(a, level.reference, level.deformed, False, noise),
        1e-3 * here.matrix,
        step_length(ANSATZ, GRID, level.mask, 1),
        Minimum(truth() + 0.01, here, Outcome.CONVERGED, (), here.matrix),
        GaussNewtonOptions(max_iterations=5),
    )
    assert found.outcome is Outcome.UNWEIGHTED
    np.testing.assert_array_equal(found.unknowns, truth() + 0.01)
    assert "least-squares minimum" in found.outcome.explanation
