"""Noise: the bound of quantisation, covariance against Monte Carlo, and what must not matter."""

from __future__ import annotations

from functools import cache

import manufactured
import numpy as np
import pytest
from filling_mode import EVERYWHERE, MASK, STRAIN, case, disturbed, error_px, rms_px
from manufactured import DOMAIN, GRID, PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Outcome
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair

FloatArray = NDArray[np.float64]

TIGHT = CorrelationOptions(gauss_newton=GaussNewtonOptions(tolerance_px=1e-7, max_iterations=200))


def test_a_kink_where_the_taper_ends_costs_little() -> None:
    ansatz = manufactured.one_mode()
    truth = disturbed(ansatz, 1.5)
    f, g = manufactured.image_pair(manufactured.speckle(), ansatz, truth)
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, truth) < 1e-3


def test_cubic_and_quintic_agree_to_the_error_of_the_cubic() -> None:
    ansatz, truth, f, g = case()
    cubic = correlate(
        ImagePair(f, g, GRID, MASK), ansatz, guess=truth, options=CorrelationOptions(order=3)
    )
    # A cubic is off by 6e-5 of full scale on this speckle, whose gradient is 0.05 per px rms.
    assert 1e-6 < error_px(cubic, truth) < 2e-3


def test_8_bit_images_are_as_good_as_quantisation_allows() -> None:
    ansatz, truth, f, g = case()
    f8, g8 = np.round(255 * f), np.round(255 * g)
    result = correlate(
        ImagePair(f8, g8, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0)
    )
    assert result.outcome is Outcome.CONVERGED
    # Mean square error of the displacement: a quadratic form of Gaussian unknowns, with mean
    # tr(K) and variance 2 tr(K^2); 4 standard deviations leave 1 in 10^4.
    S = ansatz.sensitivities(truth, GRID.x[None, ::8], GRID.y[::8, None])[MASK[::8, ::8]]
    A = np.einsum("pcn,pcm->nm", S, S) / len(S) / PIXEL**2
    K = result.covariance(1 / np.sqrt(12)) @ A
    mean, sd = np.trace(K), np.sqrt(2 * np.trace(K @ K))
    assert abs(error_px(result, truth) ** 2 - mean) < 4 * sd
    # The plateaus of the speckle (51 and 255) are whole grey levels, with no rounding at all.
    assert 0.7 / np.sqrt(12) < result.noise_sd < 1.0 / np.sqrt(12)


SMALL = PixelGrid.centred(150, 140, PIXEL)
NOISE, SEEDS = 0.002, 60


@pytest.mark.parametrize(("in_f", "in_g"), [(1, 1), (0, 1), (1, 0)])
def test_covariance_against_monte_carlo(in_f: int, in_g: int) -> None:
    mode = FourierMode.scaled(square_family("junction"), 0.6, EVERYWHERE)
    ansatz = Ansatz(DOMAIN, (mode,), v0_degree=2, v_degree=1)
    truth = disturbed(ansatz, 1.0)
    f, g = manufactured.image_pair(manufactured.speckle(2, SMALL), ansatz, truth, SMALL)
    options = CorrelationOptions(levels=(Level(1, 0.0),))
    mask = np.pad(np.ones((110, 100), dtype=np.bool_), 20)
    clean = correlate(ImagePair(f, g, SMALL, mask), ansatz, guess=truth, options=options)
    covariance = clean.covariance(ImageNoise(in_f * NOISE, in_g * NOISE))
    rng = np.random.default_rng(7)
    found, sds = [], []
    for _ in range(SEEDS):
        noise = NOISE * rng.normal(size=(2, *SMALL.shape))
        result = correlate(
            ImagePair(f + in_f * noise[0], g + in_g * noise[1], SMALL, mask),
            ansatz,
            guess=truth,
            options=options,
        )
        found.append(result.unknowns - clean.unknowns)
        sds.append(result.noise_sd)
    deviation, n = np.array(found), ansatz.size
    # Per area, the noise of g has det F times fewer pixels than the reference's pixels that
    # sample it, so its share of the variance is larger by 1/det F, 5 % here: the result knows.
    h = 1e-5
    Fx = (
        ansatz.displacement(truth, SMALL.x + h, SMALL.y)
        - ansatz.displacement(truth, SMALL.x - h, SMALL.y)
    ) / (2 * h)
    Fy = (
        ansatz.displacement(truth, SMALL.x, SMALL.y + h)
        - ansatz.displacement(truth, SMALL.x, SMALL.y - h)
    ) / (2 * h)
    det = (1 + Fx[..., 0]) * (1 + Fy[..., 1]) - Fx[..., 1] * Fy[..., 0]
    assert clean.noise_transfer.density == pytest.approx((1 / det[mask]).mean(), abs=2e-3)
    # The sum of all squared Mahalanobis distances is chi squared with 60 n degrees of freedom;
    # its relative standard deviation is sqrt(2/60n) = 4 %: 4 of them leave 1 in 10^4.
    distances = np.einsum("sn,nm,sm->s", deviation, np.linalg.inv(covariance), deviation)
    assert distances.sum() / (SEEDS * n) == pytest.approx(1.0, abs=0.16)
    # And each unknown on its own: chi squared with 60 degrees of freedom, 0.1 % over all.
    ratio = (deviation**2).mean(axis=0) / np.diag(covariance)
    assert ratio.min() > 0.35
    assert ratio.max() < 2.0
    # noise_sd divides the residual between both images, knowing what the spline takes of g's.
    passed = clean.noise_transfer.value
    expected = NOISE * np.sqrt((in_f + passed * in_g) / (1.0 + passed))
    # 60 times 11 000 px: 0.1 %, but the spline's noise is correlated between pixels.
    assert np.mean(sds) == pytest.approx(expected, rel=0.01)


@cache
def noisy() -> tuple[Ansatz, FloatArray, FloatArray, Result]:
    """Ansatz, f, g and what a correlation to 1e-7 px finds in them."""
    ansatz, _, f, g = case()
    rng = np.random.default_rng(3)
    f, g = (image + 0.01 * rng.normal(size=image.shape) for image in (f, g))
    result = correlate(
        ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0), options=TIGHT
    )
    assert result.outcome is Outcome.CONVERGED
    assert error_px(result, case()[1]) > 1e-3
    return ansatz, f, g, result


SAME_PX = 1e-5
"""How well two correlations to 1e-7 px agree: float32 images, rounded differently."""


def test_pixel_size() -> None:
    """Everything in mm is 7 times larger, what is a number stays."""
    ansatz, f, g, expected = noisy()
    s, b, c = 7.0, DOMAIN, EVERYWHERE.cellular
    taper = Taper(Box(*(s * np.array([c.x_min, c.x_max, c.y_min, c.y_max]))), s * EVERYWHERE.width)
    mode = FourierMode.scaled(square_family("junction"), s, taper)
    large = Ansatz(Box(*(s * np.array([b.x_min, b.x_max, b.y_min, b.y_max]))), (mode,))
    grid = PixelGrid.centred(*GRID.shape, s * PIXEL)
    result = correlate(
        ImagePair(f, g, grid, MASK), large, guess=large.initial_guess(STRAIN, s), options=TIGHT
    )
    assert rms_px(result.displacement() / s, expected.displacement()) < SAME_PX
    in_mm = np.array([unit == "mm" for unit in ansatz.units])
    np.testing.assert_allclose(
        result.unknowns, np.where(in_mm, s, 1.0) * expected.unknowns, atol=1e-4
    )


def test_translation_of_the_frame() -> None:
    _, f, g, expected = noisy()
    dx, dy = 0.37, -1.2
    c, b = EVERYWHERE.cellular, DOMAIN
    taper = Taper(Box(c.x_min + dx, c.x_max + dx, c.y_min + dy, c.y_max + dy), EVERYWHERE.width)
    mode = FourierMode.scaled(square_family("junction"), 1.0, taper)
    moved = Ansatz(Box(b.x_min + dx, b.x_max + dx, b.y_min + dy, b.y_max + dy), (mode,))
    grid = PixelGrid(*GRID.shape, PIXEL, GRID.x0 + dx, GRID.y0 + dy)
    start = moved.initial_guess(STRAIN, 1.0)
    start[moved.phi_slice(0)][5:] = -(dx + dy), -(-dx + dy)
    result = correlate(ImagePair(f, g, grid, MASK), moved, guess=start, options=TIGHT)
    assert rms_px(result.displacement(), expected.displacement()) < SAME_PX
