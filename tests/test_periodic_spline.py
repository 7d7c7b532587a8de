"""Guards the fast evaluation of a pattern: never farther off than it says, anywhere."""

from collections.abc import Iterator

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.imaging.speckle.pattern import TOLERANCE, Speckle, SpeckleSpec
from modeharvest.imaging.speckle.periodic_spline import PeriodicSpline

FloatArray = NDArray[np.float64]
ROUNDING = 1e-14  # sums of 64 products of numbers below 1, and the FFT's own


def summed(
    spectrum: NDArray[np.complex128], cols: int, row: FloatArray, col: FloatArray
) -> FloatArray:
    """Sum the waves of a real FFT's spectrum one by one, without a fast transform."""
    rows = len(spectrum)
    twice = np.where(np.arange(spectrum.shape[1]) == 0, 1.0, 2.0)
    along_row = np.exp(2j * np.pi * np.outer(row, np.fft.fftfreq(rows)))
    along_col = np.exp(2j * np.pi * np.outer(col, np.arange(spectrum.shape[1])) / cols) * twice
    waves = np.einsum("pr,rc,pc->p", along_row, spectrum, along_col, optimize=True)
    return np.asarray(waves.real)


def points(rows: int, cols: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(4)
    return rng.uniform(-1.5 * rows, 2.5 * rows, 300), rng.uniform(-1.5 * cols, 2.5 * cols, 300)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    period=st.tuples(st.integers(8, 40), st.integers(8, 40)),
    share=st.tuples(st.floats(-0.999, 0.999), st.floats(0, 0.999)),
    tolerance=st.sampled_from([1e-2, 1e-5, 1e-9]),
)
def test_a_single_wave_is_off_by_at_most_the_bound_and_not_by_much_less(
    period: tuple[int, int], share: tuple[float, float], tolerance: float
) -> None:
    """Any wave below Nyquist: the bound holds, and the largest error is no tenth of it."""
    rows, cols = period
    k = int(share[0] * (rows - 1) / 2), int(share[1] * (cols - 1) / 2)
    spectrum = np.zeros((rows, cols // 2 + 1), dtype=np.complex128)
    spectrum[k] = 0.5
    spline = PeriodicSpline.of(spectrum, period, tolerance)
    at = points(rows, cols)
    error = np.abs(spline(*at) - summed(spectrum, cols, *at))
    assert error.max() <= spline.bound + ROUNDING
    if spline.bound > 1e-12:
        assert error.max() > 0.1 * spline.bound


@pytest.mark.parametrize("shape", [(120, 90), (75, 81), (64, 64)])
@pytest.mark.parametrize("blur", [2.0, 3.0, 6.0])
def test_the_pattern_is_off_by_less_than_what_is_proved(
    shape: tuple[int, int], blur: float
) -> None:
    speckle = Speckle(SpeckleSpec(seed=3, blur_px=blur, dark=0.0), shape)
    at = points(*speckle.period)
    error = np.abs(speckle(*at) - speckle.exact(*at, eps=1e-14))
    assert speckle.spline.bound <= TOLERANCE
    assert error.max() <= speckle.spline.bound


def test_finer_samples_only_where_needed() -> None:
    coarse, fine = (Speckle(SpeckleSpec(blur_px=b), (128, 128)).spline for b in (6.0, 2.0))
    assert coarse.coefficients.shape == (128 + 7, 128 + 7)
    assert fine.coefficients.shape[0] > 1.5 * 128


def test_shapes_are_kept_and_positions_without_a_value_have_none() -> None:
    speckle = Speckle(SpeckleSpec(), (64, 72))
    row, col = np.mgrid[3:9, 2:7] + 0.3
    assert speckle(row, col).shape == (6, 5)
    np.testing.assert_array_equal(speckle(row[:, :1], col[:1]), speckle(row, col))
    assert speckle(np.empty(0), np.empty(0)).shape == (0,)
    assert speckle(2.0, 3.0).shape == ()
    nowhere = [np.nan, np.inf, -np.inf, 1e300]
    assert np.isnan(speckle(nowhere, 1.0)).all()
    assert np.isnan(speckle(1.0, nowhere)).all()


@pytest.fixture
def restored_threads() -> Iterator[None]:
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("restored_threads")
def test_threads_do_not_change_a_bit() -> None:
    speckle = Speckle(SpeckleSpec(), (200, 220))
    at = points(200, 220)
    many = speckle(*at)
    numba.set_num_threads(1)
    np.testing.assert_array_equal(speckle(*at), many)
