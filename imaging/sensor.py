"""A camera's sensor: its aperture, its response and its noise.

The output of a pixel that receives the irradiance I (averaged over its aperture; 1 is white) is

    y = gain * Poisson(full_well * I) / full_well + offset + read_noise * N(0, 1),

clipped at 0 and at ``saturation`` and rounded to one of 2^bits levels: the linear model of EMVA
Standard 1288 (Release 4.0 Linear, European Machine Vision Association 2021). All grey levels are
fractions of full scale. Before clipping, a grey level with mean y has the variance

    sigma^2(y) = read_noise^2 + gain (y - offset) / full_well + q^2 / 12,   q = 1 / (2^bits - 1).

By default, pixels sample points instead of areas, without noise, with gain 1 and offset 0.

A pixel at x averages over its sensitive area and the lens's blur, ``integral h(t) I(x + t) dt``,
with h the indicator of a centred square convolved with a Gaussian. In Fourier space h is
``sinc(a f_row) sinc(a f_col) exp(-2 pi^2 s^2 |f|^2)``, which is exact for the reference image's
pattern. A deformed pattern is no sum of plane waves: there the average is a Gauss rule with weight
h, or the mean of equally weighted points where I jumps at the edge of the material.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh_tridiagonal
from scipy.special import ndtr

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within


def quantise(image: NDArray[Any], bits: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Grey levels as a camera stores them: clipped to 0 ... 1, times 2^bits - 1, rounded.

    The type is uint8 for up to 8 bits, uint16 for up to 16; InputError for other bits.
    """
    if not 1 <= bits <= 16:
        raise InputError(f"expected 1 to 16 bits, got {bits}")
    levels = np.rint(np.clip(image, 0.0, 1.0) * (2**bits - 1))
    dtype: Any = np.uint8 if bits <= 8 else np.uint16
    return np.asarray(levels, dtype)


EDGE_POINTS = 233  # a Fibonacci number
_GOLDEN = 0.5 * (1.0 + math.sqrt(5.0))
_FINE = 64  # nodes for each of the two convolved parts of h
_THIN = 1e-6  # px: width below which h is treated as a point
_TAIL = 5.0  # standard deviations of the blur; a fraction of 6e-7 lies beyond


@dataclass(frozen=True)
class Aperture:
    """The weight h with which a pixel averages light; InputError if a value is out of range."""

    fill_factor: float = 0.0
    """Sensitive fraction of the pixel's area, 0 to 1 [-], a centred square; 0 is a point."""
    psf_px: float = 0.0
    """Standard deviation of the lens's Gaussian point spread, 0 to 2 [px]; 0: perfect lens."""

    def __post_init__(self) -> None:
        require_within("sensor: expected a fill factor", self.fill_factor, 0.0, 1.0)
        require_within("sensor: expected a point spread [px]", self.psf_px, 0.0, 2.0)

    @property
    def is_point(self) -> bool:
        """Whether pixels sample single points, without averaging."""
        return self.fill_factor == 0.0 and self.psf_px == 0.0

    @property
    def side_px(self) -> float:
        """Side of the sensitive square [px]."""
        return math.sqrt(self.fill_factor)

    @property
    def reach_px(self) -> int:
        """Distance, along rows or columns, beyond which the weight is negligible [px]."""
        return math.ceil(0.5 * self.side_px + _TAIL * self.psf_px)

    def transfer(self, f: ArrayLike) -> FloatArray:
        """Fourier transform of h along one axis at frequencies f [cycles/px]."""
        f = np.asarray(f, dtype=np.float64)
        blur = np.exp(-2.0 * (math.pi * self.psf_px * f) ** 2)
        return np.asarray(np.sinc(self.side_px * f) * blur)

    def rule(self, points: int) -> tuple[FloatArray, FloatArray]:
        """Gauss rule for the weight h along one axis: (nodes [px], weights), each (points,).

        For a perfect lens this is the Gauss-Legendre rule, for a fill factor of 0 Gauss-Hermite.
        """
        x, v = np.polynomial.legendre.leggauss(_FINE)
        y, w = np.polynomial.hermite_e.hermegauss(_FINE)
        nodes = (0.5 * self.side_px * x[:, None] + self.psf_px * y).ravel()
        weights = np.outer(v / v.sum(), w / w.sum()).ravel()
        before, polynomial = np.zeros_like(nodes), np.ones_like(nodes)
        beta = np.zeros(points)
        for k in range(1, points):  # Stieltjes' recurrence; the weight is even
            polynomial, before = nodes * polynomial - beta[k - 1] * before, polynomial
            beta[k] = math.sqrt(weights @ polynomial**2)
            polynomial /= beta[k]
        found, vectors = eigh_tridiagonal(np.zeros(points), beta[1:])
        return found, vectors[0] ** 2

    def scattered(self, points: int = EDGE_POINTS) -> FloatArray:
        """(points, 2) offsets (row, col) [px] of equal weight that sample h evenly.

        A Fibonacci lattice mapped by the inverse cumulative distribution of h. No two points
        share a row or a column, so an edge along the pixels is resolved as finely as any other.
        The error of the fraction of a pixel cut off by a straight edge is 0.0047 rms (233 points).
        """
        a, s = max(self.side_px, _THIN), max(self.psf_px, _THIN)
        t = np.linspace(-1.0, 1.0, 20_001) * (0.5 * a + 6.0 * s)
        high, low = (t + 0.5 * a) / s, (t - 0.5 * a) / s
        # Integral of the normal cumulative distribution: z ndtr(z) + exp(-z^2 / 2) / ...
        bell = (np.exp(-0.5 * high**2) - np.exp(-0.5 * low**2)) / math.sqrt(2.0 * math.pi)
        upto = s / a * (high * ndtr(high) - low * ndtr(low) + bell)
        k = np.arange(points)
        unit = np.stack([k, k * round(points / _GOLDEN) % points], axis=1) + 0.5
        return np.asarray(np.interp(unit / points, upto, t))


@dataclass(frozen=True)
class Sensor:
    """Conversion of light into grey levels; InputError if a value is out of range."""

    fill_factor: float = 0.0
    psf_px: float = 0.0
    """Fill factor and point spread, as for :class:`Aperture`."""
    gain: float = 1.0
    """Factor from irradiance to grey level [-]."""
    offset: float = 0.0
    """Grey level without light [fraction of full scale]."""
    full_well: float = 0.0
    """Electrons at irradiance 1 [-]; fewer electrons give more shot noise; 0: no shot noise."""
    read_noise: float = 0.0
    """Standard deviation of the read noise [fraction of full scale]."""
    saturation: float = 1.0
    """Largest grey level, at which the sensor clips [fraction of full scale]."""
    shot_seed: int = 0
    read_seed: int = 0
    """Seeds of shot noise and read noise; every image of a set has independent noise."""
    flicker: float = 0.0
    """Relative standard deviation of the illumination between images [-]; uniform in each image."""
    flicker_seed: int = 0
    """Seed of the flicker; every image of a set has an independent value."""

    def __post_init__(self) -> None:
        _ = self.aperture  # validates fill factor and point spread
        require_within("sensor: expected a gain", self.gain, 0.0, above=True)
        require_within("sensor: expected an offset", self.offset, -1.0, 1.0, above=True)
        if not (self.full_well == 0.0 or 1.0 <= self.full_well <= 1e12):
            what = "a full well of 1 to 1e12 electrons, or 0 for no shot noise"
            raise InputError(f"sensor: expected {what}, got {self.full_well}")
        require_within("sensor: expected a read noise", self.read_noise, 0.0, 1.0)
        require_within("sensor: expected a saturation", self.saturation, 0.0, 1.0, above=True)
        require_within("sensor: expected a flicker", self.flicker, 0.0, 0.2)
        for seed in (self.shot_seed, self.read_seed, self.flicker_seed):
            require_within("sensor: expected seeds", seed, 0)

    @property
    def aperture(self) -> Aperture:
        """The weight with which a pixel averages light."""
        return Aperture(self.fill_factor, self.psf_px)

    def illumination(self, name: str) -> float:
        """Flicker factor on the irradiance of the image ``name``: log-normal with median 1 [-]."""
        draw = stream(self.flicker_seed, "flicker", name).standard_normal()
        return float(np.exp(self.flicker * draw))

    def mean(self, irradiance: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels without noise, clipping and rounding [fraction of full scale]."""
        return np.asarray(self.gain * irradiance + self.offset, dtype=np.float32)

    def expose(
        self, irradiance: NDArray[np.float32], bits: int, name: str
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """One exposure of the pixels' irradiance (rows, cols): noise, clipping and rounding.

        The seeds and the image's ``name`` determine the noise, which differs between images.
        """
        return quantise(np.minimum(self.noisy(irradiance, name), self.saturation), bits)

    def noisy(self, irradiance: NDArray[np.float32], name: str) -> NDArray[np.floating]:
        """Grey levels with noise, before clipping and rounding [fraction of full scale]."""
        grey: NDArray[np.floating] = self.mean(irradiance)
        if self.full_well > 0.0:
            electrons = self.full_well * np.maximum(irradiance.astype(np.float64), 0.0)
            shots = stream(self.shot_seed, "shot", name).poisson(electrons)
            grey = self.gain * shots / self.full_well + self.offset
        if self.read_noise > 0.0:
            draw = stream(self.read_seed, "read", name)
            grey = grey + self.read_noise * draw.standard_normal(grey.shape)
        return grey

    def noise_variance(self, grey: ArrayLike, bits: int) -> FloatArray:
        """Predicted variance of a grey level with mean ``grey`` [fraction of full scale, squared].

        Clipping, which lowers the variance, is neglected; rounding counts as white noise.
        """
        constant, slope = self.noise_model(bits)
        above = np.maximum(np.asarray(grey, dtype=np.float64) - self.offset, 0.0)
        return np.asarray(constant + slope * above)

    def noise_model(self, bits: int) -> tuple[float, float]:
        """(constant, slope) of the variance: constant + slope * (grey - offset)."""
        rounding = 1.0 / (12.0 * (2**bits - 1) ** 2)
        slope = self.gain / self.full_well if self.full_well > 0.0 else 0.0
        return self.read_noise**2 + rounding, slope

    def saturated(self, levels: NDArray[np.uint8] | NDArray[np.uint16], bits: int) -> int:
        """Number of pixels of an exposure at its highest level."""
        top = quantise(np.array(self.saturation), bits)
        return int(np.count_nonzero(levels >= top))


def stream(seed: int, kind: str, name: str) -> np.random.Generator:
    """Random generator for one kind of noise in the image with a given name."""
    return np.random.default_rng([seed, zlib.crc32(f"{kind} noise of {name}".encode())])
