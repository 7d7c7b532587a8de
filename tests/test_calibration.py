"""Distortion from photographs of a shifted target: the truth is found, and the error bars hold.

The photographs are exact: an analytic speckle, through the exact inverse of the lens.
"""

from __future__ import annotations

import numpy as np
import pytest
from affine_aside import affine_aside
from calibration_set import photographs, random_lens
from numpy.typing import NDArray
from scipy import ndimage
from undistortion_noise import undistorted_noise

from modeharvest.imaging.distortion.calibrate import Calibration, CalibrationOptions, calibrate
from modeharvest.imaging.distortion.fit import sampled_noise
from modeharvest.imaging.distortion.lens import PolynomialDistortion, undistorted
from modeharvest.imaging.spline import SplineImage
from modeharvest.runs.photographs.prepare import calibration_text
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SHAPE = (240, 300)
SHIFTS = np.array([[0, 0], [33.3, 4.1], [-31.7, 8.2], [2.6, 38.4], [-5.1, -41.8]])
ANGLES = np.array([0.0, 1e-3, -5e-4, 2e-3, 0.0])
LENS = random_lens(SHAPE, 3, 4.0)
NOISE = 0.01
OPTIONS = CalibrationOptions(degrees=(2, 3, 4), points=20_000)


@pytest.fixture(scope="module")
def found() -> Calibration:
    """Shifts unknown, the target turned a little between photographs."""
    return calibrate(photographs(LENS, SHAPE, SHIFTS, ANGLES, NOISE), options=OPTIONS)


def test_the_lens_is_found_as_well_as_its_error_bars_say(found: Calibration) -> None:
    aside = affine_aside(found.distortion, LENS, SHAPE)
    chosen = next(t for t in found.trials if t.bic == 0.0)
    # 14 coefficients' errors squared over what is predicted: chi squared / 14 has a standard
    # deviation of 0.4, so the root of it lies within 0.3 and 1.7 in all but some cases in 1e4.
    assert 0.3 < aside.rms_px / chosen.sd_px < 1.7
    assert chosen.sd_px < 0.01


def test_the_degree_is_that_of_the_lens(found: Calibration) -> None:
    # A degree too low leaves some 0.1 px, ten times the noise; one too high gains nothing.
    assert found.distortion.degree == 3
    assert [t.degree for t in found.trials] == [2, 3, 4]
    assert found.trials[0].residual_rms > 1.5 * found.trials[1].residual_rms


def test_shifts_and_turns_are_found_within_their_error_bars(found: Calibration) -> None:
    # The affine gauge turns a shift t into A^-1 t.
    aside = affine_aside(found.distortion, LENS, SHAPE)
    expected = np.linalg.solve(aside.matrix, SHIFTS.T).T
    assert np.abs(found.shifts - expected).max() < 6 * found.shifts_sd.max()
    assert np.abs(found.angles - ANGLES).max() < 6 * found.angles_sd.max()
    assert found.shifts_sd.max() < 0.01


def test_the_noise_is_found(found: Calibration) -> None:
    # Of 60 000 values, correlated over some px: 1 to 2 %.
    assert found.noise_sd == pytest.approx(NOISE, rel=0.05)


def test_standard_deviations_are_larger_in_corners(found: Calibration) -> None:
    row, col = np.array([0.0, 120.0])[:, None], np.array([0.0, 150.0])[None, :]
    for sd in found.sd(row, col):
        assert sd[0, 0] > sd[1, 1] > 0.0


def test_what_cannot_be_observed_is_reported(found: Calibration) -> None:
    assert any("affine part of S can't be observed" in s for s in calibration_text(found))
    assert not found.distortion.coefficients[:, :3].any()


def test_known_shifts_show_the_affine_part() -> None:
    lens = random_lens(SHAPE, 3, 4.0, affine=1.0)
    images = photographs(lens, SHAPE, SHIFTS, noise=NOISE)
    found = calibrate(images, SHIFTS, CalibrationOptions(degrees=(3,), points=20_000))
    row, col = np.arange(0.0, 240.0, 8)[:, None], np.arange(0.0, 300.0, 8)[None, :]
    # The constant part moves with the origin: a shift of the ideal frame remains open.
    aside = affine_aside(found.distortion, lens, SHAPE)
    np.testing.assert_allclose(aside.matrix, np.eye(2), atol=1e-4)
    assert abs(lens.coefficients[:, 1:3]).max() > 0.1
    sd = np.sqrt(np.mean(np.square(found.sd(row, col))))
    difference = np.stack(found.distortion.shift(row, col)) - np.stack(lens.shift(row, col))
    assert np.sqrt(np.mean(difference**2)) < 3 * sd
    assert any("relative to the stage" in s for s in calibration_text(found))


def test_brightness_and_contrast_may_change() -> None:
    images = photographs(LENS, SHAPE, SHIFTS[:4])
    light = [(1.0, 0.0), (0.8, 0.1), (1.1, 0.2), (0.9, -0.1)]
    dimmed = [gain * image + offset for image, (gain, offset) in zip(images, light, strict=True)]
    options = CalibrationOptions(degrees=(3,), points=20_000, rotations=False)
    found = calibrate(dimmed, options=options)
    # Without noise only the splines' errors remain.
    assert affine_aside(found.distortion, LENS, SHAPE).rms_px < 1e-4


def test_the_gauge_is_a_change_of_the_ideal_frame() -> None:
    # phi(A x) differs from phi by A alone, however large S is.
    lens, matrix, offset = LENS, np.array([[1.01, 0.004], [-0.002, 0.98]]), np.array([3.0, -2.0])

    class Turned(PolynomialDistortion):
        def shift(self, row, col):  # type: ignore[no-untyped-def]
            at = np.einsum("ij,j...->i...", matrix, np.stack([row, col])) + offset[:, None]
            seen = lens.observed(*at)
            return seen[0] - row, seen[1] - col

    aside = affine_aside(Turned(SHAPE, lens.coefficients), lens, SHAPE)
    assert aside.largest_px < 1e-9
    np.testing.assert_allclose(aside.matrix, matrix, atol=1e-11)
    np.testing.assert_allclose(aside.offset, offset, atol=1e-9)


@pytest.mark.parametrize(("blur", "stride"), [(0.0, 1.0), (1.0, 1.7), (1.0, 5.0)])
def test_the_noise_of_samples_is_predicted(blur: float, stride: float) -> None:
    one, many = sampled_noise(blur, 5, stride)
    rng = np.random.default_rng(0)
    at = 40.0 + np.arange(40) * stride
    values, means = [], []
    for _ in range(60):
        noise = rng.normal(size=(320, 320))
        blurred = ndimage.gaussian_filter(noise, blur) if blur else noise
        for _ in range(6):
            row, col = np.meshgrid(*(at + rng.uniform(0, 1, 2)[:, None]), indexing="ij")
            sample = SplineImage.of(blurred, 5, np.float64).sample(row, col)[0]
            # A slow field: one wave over the grid, squared weight 1/2 on average.
            values.append(np.mean(sample**2))
            means.append(np.mean(sample * np.cos(2 * np.pi * np.arange(40) / 40)))
    assert np.mean(values) == pytest.approx(one, rel=0.03)
    # 60 independent realisations (with six positions each): chi squared of 60, sd 18 %.
    assert np.mean(np.square(means)) * 2 * 40**2 == pytest.approx(many, rel=0.6)


@pytest.mark.parametrize("order", [3, 5])
def test_the_noise_of_undistorted_images_is_predicted(order: int) -> None:
    lens = random_lens(SHAPE, 4, 6.0, affine=1.0)
    once, twice = undistorted_noise(order)
    noise = [np.random.default_rng(seed).normal(size=SHAPE) for seed in range(8)]
    freed = [undistorted(image, lens, order)[20:-20, 20:-20] for image in noise]
    # 8 x 52 000 values, correlated over a px or two: 0.5 %; positions between pixels are not
    # quite even: another percent.
    assert np.mean(np.square(freed)) == pytest.approx(once, rel=0.02)
    again = [undistorted(image, lens, order)[20:-20, 20:-20] for image in freed]
    assert np.mean(np.square(again)) == pytest.approx(twice, rel=0.03)


def test_sets_that_cannot_be_used_are_refused_in_a_line() -> None:
    images = photographs(LENS, SHAPE, SHIFTS)
    with pytest.raises(InputError, match="without enough shifts"):
        calibrate(images[:2])
    line = photographs(LENS, SHAPE, [[0, 0], [0, 30], [0, -35], [0.3, 15]])
    with pytest.raises(InputError, match="without enough shifts"):
        calibrate(line, options=OPTIONS)
    with pytest.raises(InputError, match="without enough shifts"):
        calibrate([images[0]] * 3, options=OPTIONS)
    with pytest.raises(InputError, match="of one size"):
        calibrate([*images[:2], images[2][:-1]])
    with pytest.raises(InputError, match="constant grey level"):
        calibrate([*images[:2], np.ones(SHAPE)])
    with pytest.raises(InputError, match="finite grey levels"):
        calibrate([*images[:2], np.full(SHAPE, np.nan)])
    with pytest.raises(InputError, match="expected 5 finite shifts"):
        calibrate(images, SHIFTS[:3])
    other = photographs(LENS, SHAPE, SHIFTS[:1], seed=9)
    with pytest.raises(InputError, match="number 5 whose grey levels"):
        calibrate([*images[:4], *other], options=OPTIONS)
