"""Guards the photographs of a calibration: one flat target, moved rigidly, through a lens."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.imaging.distortion.lens import CameraDistortion, PolynomialDistortion, ideal_points
from modeharvest.imaging.distortion.target import CalibrationTarget, photograph_target
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle.pattern import Ink, Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SHAPE = (160, 200)
PERFECT = PolynomialDistortion(SHAPE, np.zeros((2, 1)))
LENS = CameraDistortion(260.0, 260.0, 90.0, 85.0, k1=-0.2, k2=0.05, p1=0.01, p2=-0.02)
SPECKLE = SpeckleSpec(seed=3, ink=Ink(seed=4))
TARGET = CalibrationTarget(((0, 0), (7, 0), (0, 5), (-11, 4)), stage_sd_px=0.0, seed=1)


def photographs(
    target: CalibrationTarget, lens: Any = PERFECT, sensor: Sensor | None = None, bits: int = 16
) -> list[FloatArray]:
    """Grey levels as fractions of full scale."""
    shots = photograph_target(target, SPECKLE, ideal_points(lens, SHAPE), sensor or Sensor(), bits)
    return [levels / (2.0**bits - 1.0) for _, levels in shots]


def test_without_a_lens_photographs_are_shifts_of_each_other() -> None:
    """By whole pixels, along (columns, rows): what lies beyond the edge comes in."""
    first, *others = photographs(TARGET)
    for shot, (right, down) in zip(others, TARGET.shifts_px[1:], strict=True):
        inner = (slice(20, -20), slice(20, -20))
        moved = np.roll(first, (int(down), int(right)), axis=(0, 1))
        np.testing.assert_allclose(shot[inner], moved[inner], rtol=0, atol=1.01 / (2**16 - 1))


def test_through_a_lens_they_are_shifts_up_to_the_distortion() -> None:
    """What the first shows at phi_S(x) appears at phi_S(x + t) in the others.

    The pixels' intensities against the target's own pattern, evaluated exactly there.
    """
    points = ideal_points(LENS, SHAPE)
    pattern = Speckle(
        replace(SPECKLE, seed=TARGET.seed, ink=replace(SPECKLE.ink, seed=TARGET.seed)), SHAPE
    )
    at = (slice(None, None, 7), slice(None, None, 9))
    for shot, (down, right) in zip(photographs(TARGET, LENS), TARGET.true_shifts, strict=True):
        exact = pattern.exact(points[0][at] - down, points[1][at] - right)
        np.testing.assert_allclose(shot[at], exact, rtol=0, atol=0.51 / (2**16 - 1))
    straight, bent = photographs(TARGET)[0], photographs(TARGET, LENS)[0]
    assert np.abs(straight - bent).max() > 0.3


def test_the_stage_errs_by_its_seed_and_spread() -> None:
    many = CalibrationTarget(tuple((float(k), -2.0 * k) for k in range(400)), 0.3, seed=8)
    error = many.true_shifts - np.array(many.shifts_px)[:, ::-1]
    assert abs(error.std() / 0.3 - 1.0) < 4.0 / np.sqrt(2 * error.size)
    np.testing.assert_array_equal(many.true_shifts, replace(many).true_shifts)
    assert np.abs(many.true_shifts - replace(many, seed=9).true_shifts).max() > 0.1
    np.testing.assert_array_equal(TARGET.true_shifts, np.array(TARGET.shifts_px)[:, ::-1])


def test_every_photograph_has_noise_and_light_of_its_own() -> None:
    still = replace(TARGET, shifts_px=((0.0, 0.0),) * 2)
    quiet = photographs(still)
    np.testing.assert_array_equal(quiet[0], quiet[1])
    first, second = photographs(still, sensor=Sensor(read_noise=0.01))
    assert np.std(first - second) == pytest.approx(np.sqrt(2) * 0.01, rel=0.02)  # of 32 000 px
    bright, dim = photographs(still, sensor=Sensor(flicker=0.1))
    assert abs(bright.mean() / dim.mean() - 1.0) > 0.01


def test_the_target_is_not_the_specimen() -> None:
    specimen = Speckle(SPECKLE, SHAPE).image()
    assert abs(np.corrcoef(specimen.ravel(), photographs(TARGET)[0].ravel())[0, 1]) < 0.1
    own = replace(TARGET, speckle=SpeckleSpec(dark=0.4, bright=0.6))
    assert 0.39 < photographs(own)[0].min() < photographs(own)[0].max() < 0.61


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shifts_px": ()}, "finite shifts"),
        ({"shifts_px": ((0.0, np.nan),)}, "finite shifts"),
        ({"stage_sd_px": -1.0}, "stage_sd_px"),
        ({"seed": -1}, "seed"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"calibration: .*{message}"):
        CalibrationTarget(**changes)
