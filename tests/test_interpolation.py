"""Spline sampling: exact where a spline is exact, convergent elsewhere, consistent gradient."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from modeharvest.imaging.spline import ORDERS, SplineImage, lane_weights
from modeharvest.util.errors import InputError


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(30, 41))


def weights_at(order: int, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights and their derivatives; the last lanes are no taps."""
    powers = lane_weights(order)
    slopes = np.arange(1, order + 1)[:, None] * powers[1:]
    return t ** np.arange(order + 1) @ powers, t ** np.arange(order) @ slopes


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("t", [0.0, 0.3, 0.77, 1.0])
def test_weights_reproduce_lines(order: int, t: float) -> None:
    w, d = weights_at(order, t)
    first = -(order - 1) // 2
    taps = first + np.arange(len(w))
    assert w.sum() == pytest.approx(1.0, abs=1e-15)
    assert d.sum() == pytest.approx(0.0, abs=1e-15)
    assert w @ taps == pytest.approx(t, abs=1e-15)  # B-splines of any order reproduce lines
    assert d @ taps == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("order", [3, 5])
def test_against_scipy(noise: np.ndarray, order: int) -> None:
    rng = np.random.default_rng(1)
    row, col = rng.uniform(0, 29, 500), rng.uniform(0, 40, 500)
    expected = ndimage.map_coordinates(noise, [row, col], order=order, mode="mirror")
    value, _, _ = SplineImage.of(noise, order, np.float64).sample(row, col)
    np.testing.assert_allclose(value, expected, atol=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_passes_through_the_pixels_up_to_the_border(noise: np.ndarray, order: int) -> None:
    row, col = np.indices(noise.shape)
    value, _, _ = SplineImage.of(noise, order, np.float64).sample(row, col)
    np.testing.assert_allclose(value, noise, atol=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_gradient_against_differences(noise: np.ndarray, order: int) -> None:
    spline = SplineImage.of(noise, order, np.float64)
    rng = np.random.default_rng(2)
    row, col = rng.uniform(1, 28, 300), rng.uniform(1, 39, 300)
    h = 1e-5
    _, d_row, d_col = spline.sample(row, col)
    rows = (spline.sample(row + h, col)[0] - spline.sample(row - h, col)[0]) / (2 * h)
    cols = (spline.sample(row, col + h)[0] - spline.sample(row, col - h)[0]) / (2 * h)
    # Rounding 1e-16/h and the jumps of the cubic's third derivative, h^2 times about 10.
    np.testing.assert_allclose(d_row, rows, atol=1e-8)
    np.testing.assert_allclose(d_col, cols, atol=1e-8)


@pytest.mark.parametrize(("order", "rate"), [(3, 4), (5, 6), (11, 12)])
def test_order_of_convergence(order: int, rate: int) -> None:
    errors = []
    for n in (32, 64) if order < 11 else (14, 28):  # before rounding is all there is
        # A whole number of half periods is smooth under the mirror at the border.
        image = np.cos(3 * np.pi * np.arange(n + 1) / n)[:, None] * np.ones((1, 8))
        row = np.linspace(0, n, 301)
        value, _, _ = SplineImage.of(image, order, np.float64).sample(row, np.full(301, 3.5))
        errors.append(abs(value - np.cos(3 * np.pi * row / n)).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(rate, abs=0.3)


def test_float32_storage_costs_single_precision(noise: np.ndarray) -> None:
    row, col = np.full(100, 7.3), np.linspace(0, 40, 100)
    single = SplineImage.of(noise).sample(row, col)[0]
    double = SplineImage.of(noise, dtype=np.float64).sample(row, col)[0]
    # A quintic's coefficients are up to (15/2)^2 = 56 times the image's grey levels.
    assert 0 < abs(single - double).max() < 56 * 4 * 6e-8


def test_outside_is_nan(noise: np.ndarray) -> None:
    value, _, _ = SplineImage.of(noise).sample([-0.01, 29.01, 5.0, np.nan], [3.0, 3.0, 40.01, 3.0])
    assert np.isnan(value).all()


def test_bad_input(noise: np.ndarray) -> None:
    with pytest.raises(InputError, match="order 3, 5 or 11, got 4"):
        SplineImage.of(noise, 4)
    with pytest.raises(InputError, match="2 x 2 px"):
        SplineImage.of(noise[0])
    with pytest.raises(InputError, match="padded"):
        SplineImage(np.zeros((4, 4)), 3)
