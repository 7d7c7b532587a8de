"""A camera's sensor: what it averages, how it answers, and how it errs.

A pixel that receives the irradiance I (its aperture's average; 1 is white) puts out

    y = gain * Poisson(full_well * I) / full_well + offset + read_noise * N(0, 1),

cut off at 0 and at ``saturation`` and rounded to one of 2^bits levels: the linear model of
EMVA 1288 [1]_. All grey levels are fractions of full scale. Before the cut-off the variance of
a grey level whose mean is y is

    sigma^2(y) = read_noise^2 + gain (y - offset) / full_well + q^2 / 12,   q = 1 / (2^bits - 1).

Everything is off by default: points instead of areas, no noise, gain 1 and offset 0.

References
----------
.. [1] EMVA Standard 1288, Release 4.0 Linear, European Machine Vision Association 2021.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.aperture import Aperture
from modeharvest.imaging.io import quantise

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """How a sensor turns light into grey levels.

    Parameters
    ----------
    fill_factor
        Sensitive part of a pixel's area [-], a centred square: 1 is the whole pixel; 0, the
        default, a point.
    psf_px
        Standard deviation of the lens's Gaussian point spread [px], 0 to 2.
    gain
        Factor from irradiance to grey level [-].
    offset
        Grey level of the dark [fraction of full scale].
    full_well
        Electrons that an irradiance of 1 frees [-]: the fewer, the more shot noise; 0: none.
    read_noise
        Standard deviation of the read noise [fraction of full scale].
    saturation
        Grey level that is never exceeded [fraction of full scale].
    flicker
        Relative standard deviation of the light from image to image [-], even over an image.
    shot_seed, read_seed, flicker_seed
        Seeds of the noises; every image of a set has streams of its own.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    fill_factor: float = 0.0
    psf_px: float = 0.0
    gain: float = 1.0
    offset: float = 0.0
    full_well: float = 0.0
    read_noise: float = 0.0
    saturation: float = 1.0
    shot_seed: int = 0
    read_seed: int = 0
    flicker: float = 0.0
    flicker_seed: int = 0

    def __post_init__(self) -> None:
        _ = self.aperture  # checks fill factor and point spread
        if not (self.gain > 0.0 and math.isfinite(self.gain)):
            raise InputError(f"sensor: expected a gain above 0, got {self.gain}")
        if not -1.0 < self.offset < 1.0:
            raise InputError(f"sensor: expected an offset between -1 and 1, got {self.offset}")
        if not (self.full_well == 0.0 or 1.0 <= self.full_well <= 1e12):
            raise InputError(
                "sensor: expected a full well of 1 to 1e12 electrons, or 0 for no shot noise, got "
                f"{self.full_well}"
            )
        if not 0.0 <= self.read_noise < 1.0:
            raise InputError(
                "sensor: expected a read noise of 0 to 1 of full scale (1 of 8 bits' grey levels "
                f"is 0.0039), got {self.read_noise}"
            )
        if not 0.0 < self.saturation <= 1.0:
            raise InputError(
                f"sensor: expected saturation above 0 and at most 1 (white), got {self.saturation}"
            )
        if not 0.0 <= self.flicker <= 0.2:
            raise InputError(
                f"sensor: expected a flicker of 0 to 0.2 (20 %) of the light, got {self.flicker}"
            )
        for seed in (self.shot_seed, self.read_seed, self.flicker_seed):
            if seed < 0:
                raise InputError(f"sensor: expected seeds of 0 or more, got {seed}")

    @property
    def aperture(self) -> Aperture:
        """What a pixel averages."""
        return Aperture(self.fill_factor, self.psf_px)

    def light(self, name: str) -> float:
        """Factor on an image's irradiance, 1 on average, by its name in its set."""
        if self.flicker == 0.0:
            return 1.0
        draw = _stream(self.flicker_seed, "flicker", name).standard_normal()
        return float(np.exp(self.flicker * draw))

    def mean(self, irradiance: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels without noise, cut-off and rounding [fraction of full scale]."""
        return np.asarray(self.gain * irradiance + self.offset, dtype=np.float32)

    def expose(
        self, irradiance: NDArray[np.float32], bits: int, name: str
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """One exposure: noise, cut-off and rounding to 2^bits levels.

        Parameters
        ----------
        irradiance
            (rows, cols) averages over the pixels [fraction of full scale].
        bits
            1 to 16; up to 8 give uint8, up to 16 uint16.
        name
            The image's name in its set: with the seeds it decides the noise, so that no two
            images share theirs.
        """
        grey: NDArray[np.floating] = self.mean(irradiance)
        if self.full_well > 0.0:
            electrons = self.full_well * np.maximum(irradiance.astype(np.float64), 0.0)
            shots = _stream(self.shot_seed, "shot", name).poisson(electrons)
            grey = self.gain * shots / self.full_well + self.offset
        if self.read_noise > 0.0:
            draw = _stream(self.read_seed, "read", name)
            grey = grey + self.read_noise * draw.standard_normal(grey.shape)
        return quantise(np.minimum(grey, self.saturation), bits)

    def noise_variance(self, grey: ArrayLike, bits: int) -> FloatArray:
        """Predicted variance of a camera's grey level of that mean, both as fractions.

        The cut-off, which lowers it, is left out; rounding counts as white noise.
        """
        constant, slope = self.noise_model(bits)
        lit = np.maximum(np.asarray(grey, dtype=np.float64) - self.offset, 0.0)
        return np.asarray(constant + slope * lit)

    def noise_model(self, bits: int) -> tuple[float, float]:
        """(constant, slope) of the variance: constant + slope * (grey - offset)."""
        rounding = 1.0 / (12.0 * (2**bits - 1) ** 2)
        slope = self.gain / self.full_well if self.full_well > 0.0 else 0.0
        return self.read_noise**2 + rounding, slope

    def saturated(self, levels: NDArray[np.uint8] | NDArray[np.uint16], bits: int) -> int:
        """Count the pixels of an exposure at its highest level."""
        top = quantise(np.array(self.saturation), bits)
        return int(np.count_nonzero(levels >= top))


def _stream(seed: int, kind: str, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(f"{kind} noise of {name}".encode())])
