"""What noise in the images does to the residual, to its gradient and to the covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import manufactured
import numpy as np
import pytest
from manufactured import PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.noise import (
    ImageNoise,
    NoiseTransfer,
    slope_noise,
    spline_autocorrelation,
)
from modeharvest.idic.solver.pyramid import Level, blurred
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage

GRID = PixelGrid.centred(240, 220, PIXEL)
ANSATZ = Ansatz(Box.centred(2.2, 2.4), v0_degree=2)
MASK: NDArray[np.bool_] = np.pad(np.ones((200, 180), dtype=np.bool_), 20)
FINE = CorrelationOptions(levels=(Level(1, 0.0),), gradient="deformed", gradient_blur_px=0.0)


@cache
def truth() -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    return np.asarray(ANSATZ.initial_guess(0.01) + 0.003 * rng.normal(size=ANSATZ.size))


@cache
def pair() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return manufactured.image_pair(manufactured.speckle(3, GRID), ANSATZ, truth(), GRID)


@cache
def correlated(in_f: float, in_g: float) -> Result:
    f, g = pair()
    noise = np.random.default_rng(1).normal(size=(2, *GRID.shape))
    f, g = f + in_f * noise[0], g + in_g * noise[1]
    return correlate(ImagePair(f, g, GRID, MASK), ANSATZ, guess=truth(), options=FINE)


@pytest.mark.parametrize("order", [3, 5, 11])
@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (0.5, 0.0), (0.25, 0.4)])
def test_what_a_spline_makes_of_noise_between_pixels(
    order: int, shift_px: tuple[float, float]
) -> None:
    image = np.random.default_rng(1).normal(size=(500, 500))
    row, col = np.mgrid[12:487, 12:487]
    value, d_row, d_col = SplineImage.of(image, order, np.float64).sample(
        row - shift_px[1], col + shift_px[0]
    )
    grid = PixelGrid.centred(500, 500, PIXEL)
    ansatz = Ansatz(Box.centred(5.0, 5.0), v0_degree=1)
    a = ansatz.initial_guess(0.0)
    a[[ansatz.v0_slice(c).start for c in (0, 1)]] = np.array(shift_px) * PIXEL
    found = NoiseTransfer.of(ansatz, a, grid, np.ones(grid.shape, dtype=np.bool_), order)
    # 225 625 pixels: a variance scatters by sqrt(2/225 625) = 0.3 %, twice that correlated ones'.
    assert found.value == pytest.approx(value.var(), rel=0.02)
    assert found.slope == pytest.approx(0.5 * (d_row.var() + d_col.var()), rel=0.02)
    assert found.density == pytest.approx(1.0)
    lags = (1, 2, 3, 4, 30)
    made = spline_autocorrelation(ansatz, a, grid, np.ones(grid.shape, np.bool_), order, lags)
    for along, noise in zip(made, (value, value.T), strict=True):
        measured = [np.mean(noise[lag:] * noise[:-lag]) / value.var() for lag in lags]
        assert along == pytest.approx(measured, abs=4 / 475)


def test_the_slope_of_blurred_noise() -> None:
    image = np.random.default_rng(2).normal(size=(500, 500)).astype(np.float32)
    for blur_px in (0.6, 1.0, 2.0):
        slopes = SplineImage.of(blurred(image, blur_px)).sample(*np.mgrid[12:487, 12:487])[1:]
        # Below 1 px a sampled Gaussian is a little wider than it should be.
        assert slope_noise(5, blur_px) == pytest.approx(np.var(slopes), rel=0.06)
    assert slope_noise(5, 0.0) == pytest.approx(
        np.var(SplineImage.of(image).sample(*np.mgrid[12:487, 12:487])[1]), rel=0.02
    )


@pytest.mark.parametrize("sd", [0.005, 0.01, 0.02])
def test_noise_in_the_gradient_is_taken_back(sd: float) -> None:
    """M of the noise-free images, and the part of second order: of q s^2/G^2 once and a half."""
    clean = 2 * sd**2 * correlated(0, 0).inverse
    noisy = correlated(sd, sd)
    plain = 2 * sd**2 * noisy.inverse
    gained = np.trace(np.linalg.solve(plain, clean)) / ANSATZ.size - 1
    # G^2 of the noise-free image, at its pixels.
    _, d_row, d_col = SplineImage.of(pair()[1]).sample(*np.nonzero(MASK))
    expected = noisy.noise_transfer.slope * sd**2 / (0.5 * (d_row**2 + d_col**2).mean())
    assert gained == pytest.approx(expected, rel=0.1)
    predicted = np.trace(np.linalg.solve(clean, noisy.covariance(sd))) / ANSATZ.size
    # 1/det F; and 3 %, because x and y differ in where between pixels they land.
    assert predicted == pytest.approx(1 + 0.5 * gained, rel=0.03)


def test_a_residual_that_is_noise_tells_as_much() -> None:
    sd, noisy = 0.01, correlated(0.01, 0.01)
    assert noisy.residual_test().is_white
    np.testing.assert_allclose(noisy.covariance(), noisy.covariance(noisy.noise_sd))
    # 36 000 px: 0.4 %, though not all of them independent.
    assert noisy.noise_sd == pytest.approx(sd, rel=0.015)


def test_a_residual_that_is_no_noise_has_not_been_in_the_gradient() -> None:
    noisy = replace(correlated(0.01, 0.01), residual_correlation=0.3)
    both = 1.0 + noisy.noise_transfer.density
    np.testing.assert_allclose(noisy.covariance(), both * noisy.noise_sd**2 * noisy.inverse)


def test_noise_in_the_reference_only_leaves_the_gradient_alone() -> None:
    found = correlated(0.01, 0.0)
    only = ImageNoise(0.01, 0.0)
    np.testing.assert_allclose(found.covariance(only), 0.01**2 * found.inverse)
    np.testing.assert_allclose(found.inverse, correlated(0, 0).inverse, rtol=0.01, atol=1e-9)


def test_a_fit_to_a_displacement_has_no_gradient() -> None:
    u = ANSATZ.displacement(truth(), GRID.x, GRID.y)
    fit = fit_displacement(u, GRID, ANSATZ, ANSATZ.initial_guess(0.01), MASK)
    np.testing.assert_array_equal(fit.covariance(0.001), 2 * 0.001**2 * fit.inverse)


def test_noise_as_large_as_all_contrast_is_finite() -> None:
    found = correlated(0.01, 0.01)
    density = found.noise_transfer.density
    # No more than 0.8 of a slope is taken for noise: 1/(1 - 0.8)^2, less what is g's own.
    bold = found.covariance(10.0) / 10.0**2
    np.testing.assert_allclose(bold, 25 * (1 + density - 0.8 * density) * found.inverse)


def test_undetermined_unknowns_stay_so() -> None:
    found = correlated(0.01, 0.01)
    inverse = found.inverse.copy()
    inverse[3, :] = inverse[:, 3] = 0.0
    inverse[3, 3] = np.inf
    covariance = replace(found, inverse=inverse).covariance(0.01)
    assert np.isinf(covariance[3, 3])
    assert np.isfinite(np.delete(np.diag(covariance), 3)).all()
