"""Guards the sensor: its noise is the one it predicts, seeded, and nothing at all by default."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from modeharvest.imaging.sensor import Sensor, quantise
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SHAPE = (400, 500)
NOISY = Sensor(gain=0.8, offset=0.05, full_well=5_000.0, read_noise=0.004)


def flat(level: float) -> NDArray[np.float32]:
    return np.full(SHAPE, level, dtype=np.float32)


def fractions(levels: NDArray[Any], bits: int) -> FloatArray:
    return np.asarray(levels / (2**bits - 1), dtype=np.float64)


def assert_variance(error: FloatArray, expected: float) -> None:
    """Chi-square test of a zero-mean error's variance; 4 sigma, kurtosis of Poisson negligible."""
    n = error.size
    low, high = scipy.stats.chi2.interval(1 - 6e-5, n)
    assert low / n < float((error**2).mean()) / expected < high / n


def test_the_default_sensor_changes_nothing() -> None:
    image = Speckle(SpeckleSpec(), SHAPE).image().astype(np.float32)
    sensor = Sensor()
    assert sensor.aperture.is_point
    np.testing.assert_array_equal(sensor.mean(image), image)
    for bits in (8, 12, 16):
        levels, plain = sensor.expose(image, bits, "any"), quantise(image, bits)
        assert levels.dtype == plain.dtype
        np.testing.assert_array_equal(levels, plain)
        assert sensor.noise_variance(0.3, bits) == 1 / 12 / (2**bits - 1) ** 2


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("irradiance", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("read_noise", [0.004, 0.02])
@pytest.mark.parametrize("full_well", [0.0, 5_000.0])
def test_predicted_variance_is_the_realised_one(
    bits: int, irradiance: float, read_noise: float, full_well: float
) -> None:
    """Uniform grey levels, with noise of one level or more so that rounding is white."""
    sensor = replace(NOISY, read_noise=read_noise, full_well=full_well)
    mean = sensor.mean(flat(irradiance))
    np.testing.assert_allclose(mean, 0.8 * irradiance + 0.05, rtol=1e-6)
    levels = sensor.expose(flat(irradiance), bits, "flat")
    error = fractions(levels, bits) - mean
    predicted = float(sensor.noise_variance(mean[0, 0], bits))
    assert_variance(error, predicted)
    assert abs(error.mean()) < 4 * math.sqrt(predicted / error.size)


def test_predicted_variance_over_a_whole_picture() -> None:
    """Where grey levels differ from pixel to pixel, the normalised error has variance 1."""
    irradiance = Speckle(SpeckleSpec(), SHAPE).image().astype(np.float32)
    mean = NOISY.mean(irradiance)
    error = fractions(NOISY.expose(irradiance, 8, "speckle"), 8) - mean
    assert_variance(error / np.sqrt(NOISY.noise_variance(mean, 8)), 1.0)


def test_shot_noise_is_of_poisson() -> None:
    """Few electrons: whole numbers of them, equal mean and variance, skewed to the right."""
    sensor = Sensor(full_well=20.0)
    electrons = fractions(sensor.expose(flat(0.3), 16, "few"), 16) * 20.0
    # 16 bits tell electrons apart to 20 / 65535 / 2.
    np.testing.assert_allclose(electrons, np.rint(electrons), atol=20 / 65535)
    n = electrons.size
    assert abs(electrons.mean() - 6.0) < 4 * math.sqrt(6 / n)
    assert abs(electrons.var() - 6.0) < 4 * math.sqrt((6 + 2 * 36) / n)
    assert abs(scipy.stats.skew(electrons.ravel()) - 1 / math.sqrt(6)) < 4 * math.sqrt(6 / n)


@pytest.mark.parametrize("bits", [8, 12])
def test_rounding_errors_are_uniform(bits: int) -> None:
    """Speckle runs through many levels: all fractions of a level are equally likely."""
    image = Speckle(SpeckleSpec(), SHAPE).image().astype(np.float32)
    steps = (2**bits - 1) * (fractions(Sensor().expose(image, bits, "x"), bits) - image)
    # Neighbouring pixels are correlated; every 20th, twice the speckle's length, is not.
    some = steps[::20, ::20].ravel()
    assert scipy.stats.kstest(some, scipy.stats.uniform(-0.5, 1.0).cdf).pvalue > 1e-3
    assert np.abs(steps).max() <= 0.5 + 2**bits * 6e-8  # float32 images
    assert abs(12 * (steps**2).mean() - 1) < 0.02


def test_saturation_is_the_tail_of_the_noise() -> None:
    """As many pixels at the highest level as a normal distribution has beyond it."""
    sensor = Sensor(read_noise=0.02, saturation=0.8)
    levels = sensor.expose(flat(0.78), 8, "bright")
    top = round(0.8 * 255)
    assert levels.max() == top
    count = sensor.saturated(levels, 8)
    # The level 204 takes all from 203.5 up.
    share = scipy.stats.norm.sf((203.5 / 255 - 0.78) / 0.02)
    assert abs(count / levels.size - share) < 4 * math.sqrt(share * (1 - share) / levels.size)


def test_gain_saturates_a_bright_picture() -> None:
    image = Speckle(SpeckleSpec(), SHAPE).image().astype(np.float32)
    sensor = Sensor(gain=1.5, offset=-0.1)
    levels = sensor.expose(image, 8, "x")
    assert sensor.saturated(levels, 8) == np.count_nonzero(1.5 * image - 0.1 >= 254.5 / 255)
    assert sensor.mean(image).max() > 1.0  # the mean isn't cut off
    assert Sensor().saturated(Sensor().expose(flat(0.5), 8, "x"), 8) == 0


def test_same_seed_same_noise_and_other_seeds_or_names_others() -> None:
    gray = flat(0.5)

    def noise(sensor: Sensor, name: str = "reference") -> FloatArray:
        return sensor.expose(gray, 16, name).astype(np.float64).ravel()

    shot, read = Sensor(full_well=1_000.0), Sensor(read_noise=0.01)
    np.testing.assert_array_equal(noise(shot), noise(shot))
    np.testing.assert_array_equal(noise(read), noise(replace(read, shot_seed=5)))
    np.testing.assert_array_equal(noise(shot), noise(replace(shot, read_seed=5)))
    streams = [
        noise(shot),
        noise(read),
        noise(replace(shot, shot_seed=1)),
        noise(replace(read, read_seed=1)),
        noise(shot, "deformed_0780"),
        noise(read, "deformed_0780"),
    ]
    correlation = np.corrcoef(streams) - np.eye(len(streams))
    assert np.abs(correlation).max() < 4.5 / math.sqrt(gray.size)  # 15 pairs


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"fill_factor": 1.1}, "fill factor of 0 to 1, got 1.1"),
        ({"psf_px": -1.0}, r"point spread \[px\] of 0 to 2"),
        ({"psf_px": math.nan}, r"point spread \[px\] of 0 to 2"),
        ({"gain": 0.0}, "gain above 0"),
        ({"gain": math.inf}, "gain above 0"),
        ({"offset": 2.0}, "offset above -1 and at most 1"),
        ({"full_well": 0.5}, "full well of 1 to 1e12 electrons"),
        ({"full_well": -1.0}, "full well"),
        ({"read_noise": 2.0}, "read noise of 0 to 1"),
        ({"saturation": 0.0}, "saturation above 0"),
        ({"shot_seed": -1}, "seeds of 0 or more"),
        ({"read_seed": -1}, "seeds of 0 or more"),
    ],
)
def test_refuses_impossible_sensors(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Sensor(**bad)
