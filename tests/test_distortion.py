"""Optical distortions: their inverse, their derivatives, and images that are freed from them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.imaging.distortion.lens import (
    CameraDistortion,
    Distortion,
    PolynomialDistortion,
    SampledDistortion,
    undistorted,
    undistorted_mask,
)
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SHAPE = (220, 300)


def polynomial(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> PolynomialDistortion:
    """Of a random degree, a few px large; T_k is weighed by its largest slope k^2."""
    i, j = np.array(PolynomialDistortion.orders(int(rng.integers(0, 7)))).T
    return PolynomialDistortion(shape, rng.uniform(-4, 4, (2, i.size)) / (1 + i**2 + j**2))


def camera(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> CameraDistortion:
    """With all coefficients, r up to 0.2 within the image."""
    rows, cols = shape
    focal = max(shape) * rng.uniform(3.0, 5.0, 2)
    centre = 0.5 * np.array([cols, rows]) + rng.uniform(-20, 20, 2)
    small = rng.uniform(-0.5, 0.5, 8) * [1, 1, 0.02, 0.02, 1, 1, 1, 1]
    return CameraDistortion(*focal, *centre, *small)


def sampled(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> SampledDistortion:
    """Uneven lines, smooth values."""
    lines = [np.sort(rng.uniform(5, n - 6, 9)) + 3.0 * np.arange(9) for n in shape]
    rows, cols = (np.linspace(a[0], a[-1], 9) * 0.9 + 0.1 * a for a in lines)
    values = polynomial(rng, shape).shift(rows[:, None], cols[None, :])
    return SampledDistortion(rows, cols, np.stack(values))


KINDS: list[Callable[[np.random.Generator], Distortion]] = [polynomial, camera, sampled]


def positions(rng: np.random.Generator, margin: float = 0.0) -> FloatArray:
    """(2, 200) positions on the image, and ``margin`` px beyond it."""
    top = np.array(SHAPE)[:, None] - 1.0
    return rng.uniform(-margin, top + margin, (2, 200))


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000))
def test_the_inverse_is_exact(kind: Callable[..., Distortion], seed: int) -> None:
    rng = np.random.default_rng(seed)
    distortion, at = kind(rng), positions(rng)
    (rr, rc), (cr, cc) = distortion.gradient(*at)
    assume(((1 + rr) * (1 + cc) - rc * cr > 0.3).all())  # else it folds, or nearly
    back = distortion.ideal(*distortion.observed(*at))
    assert np.abs(np.stack(back) - at).max() < 1e-10  # the requirement; rounding is 1e-13


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000))
def test_gradients_are_derivatives(kind: Callable[..., Distortion], seed: int) -> None:
    rng = np.random.default_rng(seed)
    distortion = kind(rng)
    row, col = positions(rng, margin=8.0)
    h = 1e-4
    ahead, behind = distortion.shift(row + h, col), distortion.shift(row - h, col)
    right, left = distortion.shift(row, col + h), distortion.shift(row, col - h)
    differences = np.array(
        [[(ahead[i] - behind[i]) / (2 * h), (right[i] - left[i]) / (2 * h)] for i in (0, 1)]
    )
    # Rounding of a shift of 10 px over h is 1e-11, the second-order term h^2 S''' is smaller;
    # at a spline's knot S''' jumps.
    np.testing.assert_allclose(distortion.gradient(row, col), differences, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_an_open_grid_is_only_faster(kind: Callable[..., Distortion]) -> None:
    distortion = kind(np.random.default_rng(3))
    row, col = np.arange(-5.0, 40.0), np.arange(-7.0, 320.0)
    dense = np.meshgrid(row, col, indexing="ij")
    for method in ("shift", "gradient", "observed"):
        fast = np.asarray(getattr(distortion, method)(row[:, None], col[None, :]))
        np.testing.assert_allclose(fast, getattr(distortion, method)(*dense), atol=1e-12)
    one = np.asarray(distortion.shift(row[4], col[9]))
    np.testing.assert_allclose(one, np.asarray(distortion.shift(*dense))[:, 4, 9], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_undistorting_the_exactly_distorted_pattern_gives_the_pattern(
    kind: Callable[..., Distortion],
) -> None:
    # The speckle is known anywhere: what the lens shows at p is the scene at the ideal position
    # of p. A quintic spline of a speckle blurred by 3 px is off by 8e-7 of full scale, a cubic
    # by 6e-5 (facts of imaging/interpolation.py); S compresses the speckle a little.
    distortion = kind(np.random.default_rng(2))
    speckle = Speckle(SpeckleSpec(seed=1), SHAPE)
    observed = speckle(*distortion.ideal(*np.indices(SHAPE, dtype=np.float64)))
    whole = undistorted_mask(np.ones(SHAPE, np.bool_), distortion)
    whole[:24], whole[-24:], whole[:, :24], whole[:, -24:] = 0, 0, 0, 0  # the border's ringing
    assert whole.sum() > 0.6 * whole.size
    for order, off in ((5, 5e-6), (3, 3e-4)):
        error = undistorted(observed, distortion, order) - speckle.image()
        assert np.abs(error[whole]).max() < off


def test_no_distortion_changes_nothing() -> None:
    image = np.random.default_rng(0).uniform(size=(40, 50)).astype(np.float32)
    none = PolynomialDistortion(image.shape, np.zeros((2, 1)))
    np.testing.assert_allclose(undistorted(image, none), image, atol=2e-6)  # float32 splines
    np.testing.assert_array_equal(undistorted_mask(image > 0.5, none), image > 0.5)


def test_a_shift_by_whole_pixels_moves_image_and_mask() -> None:
    image = np.random.default_rng(0).uniform(size=(40, 50)).astype(np.float32)
    moved = PolynomialDistortion(image.shape, np.array([[3.0], [-2.0]]))  # down 3, left 2
    expected = image[3:, :-2]
    np.testing.assert_allclose(undistorted(image, moved)[:-3, 2:], expected, atol=2e-6)
    mask = undistorted_mask(image > 0.5, moved)
    np.testing.assert_array_equal(mask[:-3, 2:], expected > 0.5)
    assert not mask[-3:].any()  # never photographed
    assert not mask[:, :2].any()


def test_the_camera_is_opencvs() -> None:
    # OpenCV's formula of projectPoints, by hand for one point: x = 0.1, y = -0.2, r^2 = 0.05.
    k1, k2, p1, p2, k3, k4, k5, k6 = 0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6
    lens = CameraDistortion(1000, 2000, 320, 240, k1, k2, p1, p2, k3, k4, k5, k6)
    s = 0.05
    q = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    x = 0.1 * q + 2 * p1 * 0.1 * -0.2 + p2 * (s + 2 * 0.1**2)
    y = -0.2 * q + p1 * (s + 2 * 0.2**2) + 2 * p2 * 0.1 * -0.2
    row, col = lens.observed(240 - 0.2 * 2000, 320 + 0.1 * 1000)
    assert col == pytest.approx(320 + 1000 * x, abs=1e-12 * 1000)
    assert row == pytest.approx(240 + 2000 * y, abs=1e-12 * 1000)


def test_a_folding_distortion_has_no_inverse() -> None:
    # S = -0.6 (n - 1)/2 T_2(xi): its slope reaches -2.4 at the right edge, below -1.
    fold = np.zeros((2, 6))
    fold[1, 3] = -0.6 * 0.5 * (SHAPE[1] - 1)
    with pytest.raises(InputError, match="folds at row"):
        PolynomialDistortion(SHAPE, fold).ideal([100.0], [290.0])


def test_positions_that_are_not_numbers_stay_so() -> None:
    lens = camera(np.random.default_rng(0))
    row, col = lens.ideal([10.0, np.nan], [20.0, 30.0])
    assert np.isfinite([row[0], col[0]]).all()
    assert np.isnan([row[1], col[1]]).all()


def test_what_cannot_be_used_is_refused_in_a_line() -> None:
    with pytest.raises(InputError, match="n = 1, 3, 6, 10"):
        PolynomialDistortion(SHAPE, np.zeros((2, 4)))
    with pytest.raises(InputError, match="finite coefficients"):
        PolynomialDistortion(SHAPE, np.full((2, 3), np.nan))
    with pytest.raises(InputError, match="focal lengths above 0"):
        CameraDistortion(-1.0, 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="at least 4 ascending"):
        SampledDistortion(np.arange(3.0), np.arange(5.0), np.zeros((2, 3, 5)))
    with pytest.raises(InputError, match="expected a field of shape"):
        SampledDistortion(np.arange(4.0), np.arange(5.0), np.zeros((2, 5, 4)))
