"""What noise in the deformed image does to the covariance that a result tells."""

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
from modeharvest.idic.correlate import CorrelationOptions, correlate, fit_displacement
from modeharvest.idic.pyramid import Level
from modeharvest.idic.result import Result
from modeharvest.idic.weighting import SLOPE_NOISE
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import SplineImage

GRID = PixelGrid.centred(240, 220, PIXEL)
ANSATZ = Ansatz(Box.centred(2.2, 2.4), v0_degree=2)
MASK: NDArray[np.bool_] = np.pad(np.ones((200, 180), dtype=np.bool_), 20)
FINE = CorrelationOptions(levels=(Level(1, 0.0),), gradient_blur_px=0.0)


@cache
def truth() -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    return np.asarray(ANSATZ.start(0.01) + 0.003 * rng.normal(size=ANSATZ.size))


@cache
def pair() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return manufactured.image_pair(manufactured.speckle(3, GRID), ANSATZ, truth(), GRID)


@cache
def correlated(in_f: float, in_g: float) -> Result:
    f, g = pair()
    noise = np.random.default_rng(1).normal(size=(2, *GRID.shape))
    f, g = f + in_f * noise[0], g + in_g * noise[1]
    return correlate(f, g, GRID, ANSATZ, truth(), MASK, options=FINE)


def test_slope_of_a_spline_through_noise() -> None:
    rng = np.random.default_rng(1)
    image = rng.normal(size=(400, 400))
    _, d_row, d_col = SplineImage.of(image, 5, np.float64).sample(
        *rng.uniform(5, 394, (2, 200_000))
    )
    # 160 000 pixels: the variance scatters by sqrt(2/160 000) = 0.35 %, and slopes are correlated.
    assert 0.5 * (d_row.var() + d_col.var()) == pytest.approx(SLOPE_NOISE, rel=0.02)


@pytest.mark.parametrize("sd", [0.005, 0.01, 0.02])
def test_noise_in_the_gradient_is_taken_back(sd: float) -> None:
    """M of the noise-free images, and the part of second order: of q s^2/G^2 once and a half."""
    clean = 2 * sd**2 * correlated(0, 0).inverse
    noisy = correlated(sd, sd)
    plain = 2 * sd**2 * noisy.inverse
    gained = np.trace(np.linalg.solve(plain, clean)) / ANSATZ.size - 1
    # G^2 of the noise-free image, at its pixels.
    _, d_row, d_col = SplineImage.of(pair()[1]).sample(*np.nonzero(MASK))
    expected = SLOPE_NOISE * sd**2 / (0.5 * (d_row**2 + d_col**2).mean())
    assert gained == pytest.approx(expected, rel=0.1)
    told = np.trace(np.linalg.solve(clean, noisy.covariance(sd))) / ANSATZ.size
    # 6 %: pixels land where they land, not evenly between pixels, and errors add up at 2 %.
    assert told == pytest.approx(1 + 0.5 * gained, rel=0.06)


def test_a_residual_that_is_noise_tells_as_much() -> None:
    sd, noisy = 0.01, correlated(0.01, 0.01)
    assert noisy.agreement().is_white
    np.testing.assert_allclose(noisy.covariance(), noisy.covariance(noisy.noise_sd))
    # What the spline swallows of the noise in g is missing in the residual.
    assert 0.9 * sd < noisy.noise_sd < sd


def test_a_residual_that_is_no_noise_has_not_been_in_the_gradient() -> None:
    noisy = replace(correlated(0.01, 0.01), residual_correlation=0.3)
    np.testing.assert_allclose(noisy.covariance(), 2 * noisy.noise_sd**2 * noisy.inverse)


def test_noise_in_the_reference_only_leaves_the_gradient_alone() -> None:
    found = correlated(0.01, 0.0)
    np.testing.assert_allclose(found.covariance(0.01, 1), 0.01**2 * found.inverse)
    np.testing.assert_allclose(found.inverse, correlated(0, 0).inverse, rtol=0.01, atol=1e-9)


def test_a_fit_to_a_displacement_has_no_gradient() -> None:
    u = ANSATZ.displacement(truth(), GRID.x, GRID.y)
    fit = fit_displacement(u, GRID, ANSATZ, ANSATZ.start(0.01), MASK)
    np.testing.assert_array_equal(fit.covariance(0.001), 2 * 0.001**2 * fit.inverse)


def test_noise_as_large_as_all_contrast_is_finite() -> None:
    found = correlated(0.01, 0.01)
    bold = found.covariance(10.0) / (2 * 10.0**2)
    np.testing.assert_allclose(bold, 15 * found.inverse)  # (1 + 4)(1 + 2)


def test_undetermined_unknowns_stay_so() -> None:
    found = correlated(0.01, 0.01)
    inverse = found.inverse.copy()
    inverse[3, :] = inverse[:, 3] = 0.0
    inverse[3, 3] = np.inf
    covariance = replace(found, inverse=inverse).covariance(0.01)
    assert np.isinf(covariance[3, 3])
    assert np.isfinite(np.delete(np.diag(covariance), 3)).all()
