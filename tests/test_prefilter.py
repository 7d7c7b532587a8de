"""The compiled line filters against scipy's, for every size and any number of threads."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.solver.pyramid import binned, blurred, eroded
from modeharvest.imaging.spline import spline_coefficients

SIZES = st.tuples(st.integers(2, 70), st.integers(2, 70))
SEEDS = st.integers(0, 10**6)


@pytest.mark.parametrize("order", [3, 5])
@given(shape=SIZES, seed=SEEDS, pad=st.integers(1, 4))
def test_coefficients_are_scipys(order: int, shape: tuple[int, int], seed: int, pad: int) -> None:
    image = np.random.default_rng(seed).normal(size=shape)
    filtered = ndimage.spline_filter(image, order=order, mode="mirror")
    expected = np.pad(filtered, pad, mode="reflect")
    # Both recursions round some dozen times; coefficients of white noise are up to about 100.
    np.testing.assert_allclose(spline_coefficients(image, order, pad), expected, atol=1e-12)


@given(shape=SIZES, seed=SEEDS, sigma=st.sampled_from([0.7, 1.5, 3.0, 9.0]))
def test_the_blur_is_scipys(shape: tuple[int, int], seed: int, sigma: float) -> None:
    image = np.random.default_rng(seed).uniform(size=shape).astype(np.float32)
    expected = ndimage.gaussian_filter(image.astype(float), sigma, mode="nearest")
    np.testing.assert_allclose(blurred(image, sigma), expected, atol=1e-6)  # float32


@given(shape=SIZES, seed=SEEDS, factor=st.integers(1, 9))
def test_binning_is_the_mean_of_blocks(shape: tuple[int, int], seed: int, factor: int) -> None:
    rng = np.random.default_rng(seed)
    image, weight = rng.uniform(size=shape).astype(np.float32), rng.random(shape) < 0.7
    rows, cols = shape[0] // factor, shape[1] // factor

    def blocks(a: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = a[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor)
        return np.asarray(whole.mean(axis=(1, 3)))

    mean, share = binned(image, weight, factor)
    np.testing.assert_allclose(mean, blocks(np.where(weight, image, 0.0)), atol=1e-6)  # float32
    np.testing.assert_allclose(share, blocks(weight.astype(float)), atol=1e-6)


@given(shape=SIZES, seed=SEEDS, distance=st.integers(0, 5))
def test_erosion_by_its_definition(shape: tuple[int, int], seed: int, distance: int) -> None:
    """What stays has nothing but material within the distance, along rows and columns alike."""
    mask = np.random.default_rng(seed).random(shape) < 0.97
    if mask.all():
        mask[0, 0] = False
    square = np.ones((2 * distance + 1,) * 2, dtype=bool)
    expected = ndimage.binary_erosion(mask, square, border_value=True)
    np.testing.assert_array_equal(eroded(mask, distance), expected)


@pytest.fixture
def keep_threads() -> Iterator[None]:
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("keep_threads")
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_one_and_two_threads_agree_to_the_bit() -> None:
    image = np.random.default_rng(5).uniform(size=(203, 165)).astype(np.float32)
    weight = image < 0.8
    found = []
    for threads in (1, 2):
        numba.set_num_threads(threads)
        found.append((spline_coefficients(image, 5, 3), blurred(image, 3.0),
                      *binned(image, weight, 3)))  # fmt: skip
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)
