"""What a correlation says about itself: noise or not, what is determined, how exactly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import manufactured
import numpy as np
import pytest
from filling_mode import MASK, STRAIN, case
from manufactured import GRID
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.residual_test import (
    LAGS_PX,
    ResidualTest,
    autocorrelation,
    decorrelated_fraction,
    lags_for,
)
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.idic.uncertainty.identifiability import Identifiability, identifiability
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

NOISE = 0.02


@cache
def noisy(v0_degree: int = 5) -> Result:
    """White noise in both images; a v0 of lower degree than the truth's lacks a part of it."""
    ansatz, _, f, g = case()
    ansatz = replace(ansatz, v0_degree=v0_degree)
    noise = NOISE * np.random.default_rng(5).normal(size=(2, *GRID.shape))
    return correlate(
        ImagePair(f + noise[0], g + noise[1], GRID, MASK),
        ansatz,
        guess=ansatz.initial_guess(STRAIN, 1.0),
    )


def test_noise_is_recognised_and_chi_squared_is_one() -> None:
    test = noisy().residual_test(NOISE)
    assert test.is_white
    assert test.is_predicted
    assert test.chi_square == pytest.approx(1.0, abs=0.03)
    assert "is noise" in test.text


def test_a_wrong_noise_is_recognised() -> None:
    test = noisy().residual_test(1.3 * NOISE)
    assert test.is_white
    assert not test.is_predicted
    assert "not the given one" in test.text


def test_a_displacement_that_the_ansatz_lacks_is_recognised_without_knowing_the_noise() -> None:
    test = noisy(1).residual_test()
    assert not test.is_white
    assert "not noise" in test.text
    assert np.isnan(test.chi_square)


def test_autocorrelation_of_white_noise_and_of_a_wave() -> None:
    rng = np.random.default_rng(2)
    white = rng.normal(size=(300, 300))
    white[40:80] = np.nan
    assert autocorrelation(white) < 4 / 300
    # A wave of 24 px along the rows: cos(2 pi lag / 24) along it, 1 across.
    wave = np.cos(2 * np.pi * np.arange(2400) / 24)[:, None] * np.ones(480)
    lags = np.cos(2 * np.pi * np.array([4, 6, 8, 10, 12]) / 24)
    expected = np.sqrt(np.mean([*(lags**2), *np.ones(5)]))
    assert autocorrelation(wave) == pytest.approx(expected, rel=2e-3)
    assert autocorrelation(np.zeros((20, 20))) == 0.0


@pytest.mark.parametrize(
    ("spectrum", "blur_px", "width_px"), [(0.14, 0.8, 3.6), (0.1, 1.0, 5.0), (0.05, 3.0, 12.4)]
)
def test_noise_and_model_error_are_distinguished_whatever_the_speckle(
    spectrum: float, blur_px: float, width_px: float
) -> None:
    """Half a pixel of a wave that the ansatz lacks, or noise that leaves as large a residual."""
    shape = (256, 240)
    speckle = Speckle(SpeckleSpec(standard_deviation=spectrum, blur_px=blur_px, seed=1), shape)
    rows, cols = np.indices(shape).astype(float)
    f = speckle.image()
    width = speckle_size(f, np.ones(shape, dtype=np.bool_))
    assert width == pytest.approx(width_px, abs=0.6)
    lags = lags_for(width)
    assert max(lags) <= max(4, 1.1 * width)
    wave = 0.5 * np.sin(2 * np.pi * cols / 80)
    left_over = f - speckle(rows + wave, cols - wave)
    assert not ResidualTest(autocorrelation(left_over, lags), f.size, lags_px=lags).is_white
    rng = np.random.default_rng(3)
    noise = left_over.std() * rng.normal(size=(2, *shape))
    beside_noise = left_over + noise[0]
    assert not ResidualTest(autocorrelation(beside_noise, lags), f.size, lags_px=lags).is_white
    # What was once looked at for every speckle is beyond small ones.
    assert ResidualTest(autocorrelation(beside_noise), f.size).is_white == (width < 6.0)
    moved = SplineImage.of(noise[1]).sample(*(0.97 * np.stack([rows, cols]) + 3))[0]
    test = ResidualTest(autocorrelation(noise[0] - moved, lags), f.size, lags_px=lags)
    assert test.is_white, test.text


def test_lags_of_the_paper_s_speckle() -> None:
    assert lags_for(12.4) == LAGS_PX
    message = ResidualTest(0.5, 1000, lags_px=lags_for(4.0)).text
    assert "autocorrelation over 3 to 4 px" in message


def test_decorrelated_blocks_are_counted() -> None:
    rng = np.random.default_rng(4)
    f = np.repeat(np.repeat(rng.normal(size=(80, 80)), 4, axis=0), 4, axis=1)
    other = np.repeat(np.repeat(rng.normal(size=(80, 80)), 4, axis=0), 4, axis=1)
    g = 0.5 * f - 3.0 + 0.1 * other  # darker and flatter, but the same speckle
    assert decorrelated_fraction(f, f - g) == 0.0
    g[:, :64] = other[:, :64]  # a fifth of the columns: 64 of 320 px
    # Of 8 x 8 independent speckles a chance correlation has a standard deviation of 1/8.
    assert decorrelated_fraction(f, f - g) == pytest.approx(0.2, abs=0.02)
    g[:, :32] = np.nan
    assert decorrelated_fraction(f, f - g) == pytest.approx(1 / 9, abs=0.02)
    assert decorrelated_fraction(f, np.full_like(f, np.nan)) == 0.0


def test_bad_noise() -> None:
    with pytest.raises(InputError, match="more than 0 grey levels"):
        ResidualTest.of(0.1, 0.0, 100, 3, noise_sd=0.0)


def test_standard_deviation_of_the_displacement_is_the_covariance_through_the_sensitivities() -> (
    None
):
    result = noisy()
    sd = field_errors(result, GRID.x[::40], GRID.y[::40], result.covariance(NOISE)).displacement
    S = result.ansatz.sensitivities(result.unknowns, GRID.x[None, ::40], GRID.y[::40, None])
    half = np.linalg.cholesky(result.covariance(NOISE))
    np.testing.assert_allclose(sd, np.linalg.norm(S @ half, axis=-1), rtol=1e-6)


def test_a_strong_mode_is_observable() -> None:
    result = noisy()
    seen = identifiability(result, MASK)
    assert seen.unobservable == ()
    assert seen.warnings == ()
    # Over 2.6 cells a polynomial of degree 5 follows the waves closely, one of degree 1 can't.
    low = identifiability(noisy(1), MASK)
    assert 0 < low.overlap[0] < 0.9 < seen.overlap[0] < 1
    u = result.fluctuation()[MASK] / GRID.pixel_size
    assert seen.amplitude_px[0] == pytest.approx(np.sqrt((u**2).mean()), rel=0.05)
    # The model error is the residual over the gradient of the noisy image, at any positions.
    g = case()[3] + NOISE * np.random.default_rng(5).normal(size=(2, *GRID.shape))[1]
    rows, cols = np.nonzero(MASK)
    moved = np.random.default_rng(6).uniform(-0.5, 0.5, size=(2, rows.size))
    _, d_row, d_col = SplineImage.of(g).sample(rows + moved[0], cols + moved[1])
    per_px = np.sqrt((d_row**2 + d_col**2).mean())
    assert seen.model_error_px == pytest.approx(result.residual_rms / per_px, rel=0.05)


def test_worst_combination_is_an_eigenvector_of_the_scaled_matrix() -> None:
    result = noisy()
    worst = identifiability(result, MASK).worst[0]
    assert worst.eigenvalue * result.condition_number < result.ansatz.size
    assert len(worst.terms) == 3
    assert all(name in result.names for name, _ in worst.terms)
    assert "eigenvalue" in str(worst)


def test_without_a_pattern_the_mode_is_reported_to_be_unobservable() -> None:
    """A smooth displacement that the ansatz lacks a part of, as before buckling."""
    ansatz = manufactured.one_mode()
    cubic = Ansatz(ansatz.domain, v0_degree=3)
    truth = cubic.initial_guess(0.03)
    truth += 0.004 * np.random.default_rng(3).normal(size=cubic.size)
    f, g = manufactured.image_pair(manufactured.speckle(), cubic, truth)
    low = replace(ansatz, v0_degree=1, v_degree=0)
    mask = manufactured.inner_mask(0.1)
    result = correlate(ImagePair(f, g, GRID, mask), low, guess=low.initial_guess(0.03, 0.1))
    seen = identifiability(result, mask)
    assert seen.unobservable == (0,)
    assert "phi1 is not observable" in seen.warnings[0]


def test_unknowns_without_information_are_named() -> None:
    ansatz = case()[0]
    a = ansatz.initial_guess(STRAIN, 0.0)  # v1 = 0: phi1 has no effect
    still = replace(noisy(), unknowns=a)
    inverse = still.inverse.copy()
    lost = np.arange(ansatz.size)[ansatz.phi_slice(0)]
    inverse[lost, :] = inverse[:, lost] = 0.0
    inverse[lost, lost] = np.inf
    still = replace(still, inverse=inverse)
    seen = identifiability(still, MASK)
    assert seen.undetermined == still.names[-7:]
    assert "nothing about 7 unknowns: phi1.a1" in seen.warnings[-1]
    errors = field_errors(still, GRID.x[::80], GRID.y[::80], still.covariance())
    assert np.isfinite(errors.displacement).all()  # v1 is 0 there


def test_mask_of_another_size() -> None:
    with pytest.raises(InputError, match="like the images"):
        identifiability(noisy(), np.zeros((3, 3), dtype=bool))


def test_a_mode_that_did_not_grow_beside_others_is_not_put_down_to_an_unbuckled_specimen() -> None:
    """Of three modes of triangular stacking one compression makes two grow."""
    weak, strong = (
        Identifiability(1.0, (), (), (), model_error_px=1.0, amplitude_px=sizes).warnings
        for sizes in ((0.1, 0.2, 0.1), (5.0, 0.2, 6.0))
    )
    assert ["before buckling" in text for text in weak] == 3 * [True]
    assert len(strong) == 1
    assert strong[0].startswith("phi2 is not observable")
    assert "(others are)" in strong[0]
    assert "before buckling" not in strong[0]
