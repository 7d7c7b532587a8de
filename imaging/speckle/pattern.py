"""A speckle pattern known exactly at any point: one layer, or dots of ink on it.

A layer is a stationary Gaussian random field (M. Grigoriu, Stochastic Calculus, Birkhäuser 2002,
section 5.3.1.2) with a radially symmetric normal spectral density, thresholded and blurred by a
Gaussian. The samples blurred by the *continuous* Gaussian are a trigonometric polynomial

    I(row, col) = sum_k  c_k exp(2 pi i (k_row row / rows + k_col col / cols)),

because the Gaussian's transfer function at the samples' Nyquist frequency is 3e-9 or less: for
blurs of less than 2 px the samples are finer than pixels. An inverse FFT gives I at whole pixels, a
non-uniform FFT (Barnett, Magland & af Klinteberg, SIAM J. Sci. Comput. 41 (2019) C479,
doi:10.1137/18M120885X) at any other point, both to rounding. Where millions of points are needed, a
B-spline of its waves is twenty times faster, with a proved error bound.

A second layer models ink that an air brush leaves on a powdered surface, as on the specimen of the
paper's section "Real Experiments". The ink has an independent field i, 0 ... 1, and darkens the
layer p below: I = p (1 - darkness i). Both factors, and hence their product, are trigonometric
polynomials; the factors are evaluated separately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import finufft
import numba
import numpy as np
import scipy.fft
from numpy.typing import ArrayLike
from scipy.special import ndtri

from modeharvest.imaging.speckle.periodic_spline import PeriodicSpline
from modeharvest.util.arrays import ComplexArray, FloatArray
from modeharvest.util.errors import InputError, require_within

TOLERANCE = 2.0**-24
"""Proved error bound between pixels [fraction of full scale]: the rounding of float32."""
NARROWEST = 2.0
"""Least blur b [samples]: the transfer function at Nyquist is exp(-pi^2 b^2 / 2) = 3e-9."""


def gaussian_field(
    standard_deviation: float, seed: int | Sequence[int], period: tuple[int, int]
) -> FloatArray:
    """One realisation of the Gaussian field, periodic with ``period`` (rows, cols) [samples].

    White noise is filtered by the square root of the spectral density, whose standard deviation is
    given [cycles/sample]. The sample mean is 0; the expected variance is 1, the expected median 0.
    """
    noise = np.random.default_rng(seed).standard_normal(period)
    amplitude = np.exp(-_squared_frequency(period) / (4.0 * standard_deviation**2))
    amplitude[0, 0] = 0.0
    multiplicity = np.full(amplitude.shape[1], 2.0)
    multiplicity[0] = 1.0
    if period[1] % 2 == 0:
        multiplicity[-1] = 1.0
    amplitude /= math.sqrt(float((amplitude**2 @ multiplicity).sum()) / math.prod(period))
    spectrum = scipy.fft.rfft2(noise)
    spectrum *= amplitude
    return np.asarray(scipy.fft.irfft2(spectrum, s=period), dtype=np.float64)


@dataclass(frozen=True)
class BinaryField:
    """Parameters of a layer: a thresholded Gaussian field with two phases, and its blur."""

    cycles_per_px: float
    """Standard deviation of the Gaussian field's spectral density [cycles/px]."""
    blur_px: float
    """Standard deviation of the Gaussian blur [px]."""
    levels: tuple[float, float]
    """Values outside and inside the second phase, before the blur."""
    coverage: float
    """Area fraction of the second phase [-]."""
    seed: int | tuple[int, ...]

    @property
    def finer(self) -> int:
        """Samples per pixel, along either axis, needed to represent the pattern."""
        return max(1, math.ceil(NARROWEST / self.blur_px))


class Layer:
    """One realisation of a blurred binary field, known exactly at and between pixels.

    field : phases and blur.
    shape : (rows, cols) of the image to cover [px]. The periods are the next larger sizes that
        suit an FFT; the realisation depends on them, hence on ``shape``.
    period, samples : (rows, cols) of the period [px]; number of samples in it.
    """

    def __init__(self, field: BinaryField, shape: tuple[int, int]) -> None:
        self.field, self.shape = field, shape
        rows, cols = (int(scipy.fft.next_fast_len(n, real=True)) for n in shape)
        self.period, self.samples = (rows, cols), (field.finer * rows, field.finer * cols)
        blur = field.finer * field.blur_px
        transfer = np.exp(-2.0 * (math.pi * blur) ** 2 * _squared_frequency(self.samples))
        self._spectrum: ComplexArray = scipy.fft.rfft2(self.binary())
        self._spectrum *= transfer / math.prod(self.samples)

    def binary(self) -> FloatArray:
        """(rows, cols) samples of the two levels, before the blur."""
        field = self.field
        values = gaussian_field(field.cycles_per_px / field.finer, field.seed, self.samples)
        outside, inside = field.levels
        return np.where(values > -ndtri(field.coverage), inside, outside)

    def image(self, transfer: Callable[[ArrayLike], FloatArray] | None = None) -> FloatArray:
        """(rows, cols) exact values at whole pixels, optionally filtered, as by an aperture.

        ``transfer`` maps frequencies along an axis [cycles/px] to factors; a plane wave is
        multiplied by the factors of its row and its column frequency.
        """
        spectrum = self._spectrum * math.prod(self.samples)
        finer = self.field.finer
        if transfer is not None:
            spectrum *= transfer(finer * np.fft.fftfreq(self.samples[0]))[:, None]
            spectrum *= transfer(finer * np.fft.rfftfreq(self.samples[1]))
        whole = scipy.fft.irfft2(spectrum, s=self.samples)[::finer, ::finer]
        return np.ascontiguousarray(whole[: self.shape[0], : self.shape[1]])

    def __call__(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """Values at image positions (row, col) [px], with an error of at most ``spline.bound``."""
        finer = self.field.finer
        if finer == 1:
            return self.spline(row, col)
        return self.spline(np.multiply(finer, row), np.multiply(finer, col))

    @cached_property
    def spline(self) -> PeriodicSpline:
        """The pattern as a spline of positions in samples, made at first use."""
        return PeriodicSpline.of(self._spectrum, self.samples, TOLERANCE)

    def exact(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """Exact values at positions (row, col) [px]; ``eps``: the FFT's relative precision."""
        return np.asarray(self._evaluate(row, col, eps, gradient=False)[0])

    def gradient(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """(2, ...) exact derivatives along (row, col) at image positions (row, col) [1/px]."""
        return self._evaluate(row, col, eps, gradient=True)

    def _evaluate(
        self, row: ArrayLike, col: ArrayLike, eps: float, *, gradient: bool
    ) -> FloatArray:
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        scale = 2.0 * math.pi / np.asarray(self.period)
        row_angle, col_angle = scale[0] * row.ravel(), scale[1] * col.ravel()
        modes, k_row, k_col = self._modes(eps)
        along_row, along_col = 1j * scale[0] * k_row[:, None], 1j * scale[1] * k_col[None, :]
        modes = np.stack([along_row * modes, along_col * modes]) if gradient else modes[None]
        if row_angle.size == 0:
            return np.zeros((len(modes), *row.shape))
        values = finufft.nufft2d2(
            row_angle, col_angle, modes, eps=eps, isign=1,
            nthreads=numba.get_num_threads(), showwarn=0,
        )  # fmt: skip
        # The library's columns run from -n/2, ours from 0; the shift theorem corrects for it.
        shift = k_col.size // 2
        values = values.reshape(len(modes), -1) * np.exp(1j * shift * col_angle)
        return np.ascontiguousarray(values.real).reshape(len(modes), *row.shape)

    def _modes(self, eps: float) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Select the non-negligible Fourier modes of a real image: k_row centred, k_col >= 0.

        The sum of the omitted absolute values is at most ``eps`` of the image's mean.
        """
        rows = self.samples[0]
        size = np.abs(self._spectrum)
        allowed = 0.25 * eps * size[0, 0]
        by_row = size.sum(axis=1)
        by_row = by_row[: rows // 2 + 1] + np.roll(by_row[::-1], 1)[: rows // 2 + 1]
        row_cut, col_cut = _cut(by_row, allowed), _cut(size.sum(axis=0), allowed)
        row_cut = min(row_cut, (rows - 1) // 2)
        k_row = np.arange(-row_cut, row_cut + 1)
        modes = self._spectrum[k_row, : col_cut + 1]
        modes[:, 1:] *= 2.0
        return modes, k_row.astype(np.float64), np.arange(col_cut + 1, dtype=np.float64)


def _squared_frequency(period: tuple[int, int]) -> FloatArray:
    """|f|^2 [cycles^2/px^2] in the layout of a real FFT."""
    f_row, f_col = np.fft.fftfreq(period[0]), np.fft.rfftfreq(period[1])
    return np.asarray(f_row[:, None] ** 2 + f_col[None, :] ** 2)


def _cut(size: FloatArray, allowed: float) -> int:
    """Find the last index to keep so that the later values sum to at most ``allowed``."""
    tail = np.cumsum(size[::-1])[::-1]
    return max(1, int(np.count_nonzero(tail > allowed)) - 1)


SpectralUnit = Literal["cycles/px", "rad/px"]
_CYCLES: dict[str, float] = {"cycles/px": 1.0, "rad/px": 1.0 / (2.0 * math.pi)}
_NARROWEST_BLUR_PX = 0.75  # needs 3 x 3 samples per pixel
_WIDEST_BLUR_PX = 100.0  # a wider blur would remove all speckle
_LOWEST_FREQUENCY = 1e-4  # cycles/px: speckle of thousands of pixels
_WIDEST_FREQUENCY = 0.125  # cycles/sample: Nyquist is 4 standard deviations away


@dataclass(frozen=True)
class Ink:
    """Dots of ink on the first layer, an independent field; InputError if out of range."""

    standard_deviation: float = 0.05
    """Standard deviation of the Gaussian field's spectral density [cycles/px]."""
    blur_px: float = 1.5
    """Standard deviation of the Gaussian blur [px]."""
    coverage: float = 0.4
    """Fraction of the area covered with ink [-]."""
    darkness: float = 0.8
    """Fraction of the light absorbed by ink [-]."""
    seed: int = 0
    """Seed of the random numbers, independent of those of the layer below."""

    def __post_init__(self) -> None:
        _require_band_limited(self.standard_deviation, self.blur_px, "ink")
        if not 0.0 < self.coverage < 1.0:
            raise InputError(f"ink: expected a coverage between 0 and 1, got {self.coverage}")
        require_within("ink: expected a darkness", self.darkness, 0.0, 1.0, above=True)
        require_within("ink: expected a seed", self.seed, 0)

    @property
    def binary_field(self) -> BinaryField:
        """Parameters of the ink layer."""
        spread, seed = self.standard_deviation, (self.seed, 1)
        return BinaryField(spread, self.blur_px, (0.0, 1.0), self.coverage, seed)


@dataclass(frozen=True)
class SpeckleSpec:
    """Parameters of the speckle pattern; InputError if a value is out of range."""

    standard_deviation: float = 1.0 / 20.0
    """Standard deviation of the spectral density of the Gaussian field [``unit``]."""
    unit: SpectralUnit = "cycles/px"
    """Either "cycles/px" (correlation length 3.2 px, mean chord about 10 px) or "rad/px" (2 pi
    times coarser); the paper doesn't specify it."""
    blur_px: float = 3.0
    """Standard deviation of the Gaussian blur [px], at least 0.75."""
    dark: float = 0.2
    bright: float = 1.0
    """Grey levels of the two phases before the blur, as fractions of full scale [-]."""
    seed: int = 0
    """Seed of the random numbers."""
    ink: Ink | None = None
    """A second layer, of ink; none by default."""

    def __post_init__(self) -> None:
        if self.unit not in _CYCLES:
            raise InputError(f"speckle: expected a unit among {list(_CYCLES)}, got {self.unit!r}")
        _require_band_limited(self.cycles_per_px, self.blur_px, "speckle")
        if not 0.0 <= self.dark <= self.bright <= 1.0:
            got = f"dark {self.dark}, bright {self.bright}"
            raise InputError(f"speckle: expected grey levels 0 <= dark <= bright <= 1, got {got}")
        require_within("speckle: expected a seed", self.seed, 0)

    @property
    def cycles_per_px(self) -> float:
        """The spectral standard deviation in cycles/px."""
        return self.standard_deviation * _CYCLES[self.unit]

    @property
    def binary_field(self) -> BinaryField:
        """Parameters of the pattern, or of the layer under the ink: half dark, half bright."""
        levels = self.dark, self.bright
        return BinaryField(self.cycles_per_px, self.blur_px, levels, 0.5, self.seed)


def _require_band_limited(cycles_per_px: float, blur_px: float, what: str) -> None:
    require_within(f"{what}: expected a blur [px]", blur_px, _NARROWEST_BLUR_PX, _WIDEST_BLUR_PX)
    widest = _WIDEST_FREQUENCY * BinaryField(cycles_per_px, blur_px, (0.0, 1.0), 0.5, 0).finer
    spread = f"{what}: expected, with a blur of {blur_px} px, a spectral standard deviation"
    require_within(f"{spread} [cycles/px]", cycles_per_px, _LOWEST_FREQUENCY, widest)


class Speckle:
    """One speckle pattern, with exact intensities at and between pixels.

    ``shape``: (rows, cols) of the image to cover [px], see :class:`Layer`. ``period``: (rows, cols)
    after which the pattern repeats [px].
    """

    def __init__(self, spec: SpeckleSpec, shape: tuple[int, int]) -> None:
        if min(shape) < 8:
            raise InputError(f"speckle: expected an image of at least 8 x 8 px, got {shape}")
        self.spec, self.shape = spec, shape
        self._base = Layer(spec.binary_field, shape)
        self._ink = None if spec.ink is None else Layer(spec.ink.binary_field, shape)
        self._darkness = 0.0 if spec.ink is None else spec.ink.darkness
        self.period: tuple[int, int] = self._base.period

    def image(self, transfer: Callable[[ArrayLike], FloatArray] | None = None) -> FloatArray:
        """(rows, cols) exact intensities at whole pixels [fraction of full scale].

        ``transfer``: see :meth:`Layer.image`; InputError with ink, as the pattern is a product.
        """
        if transfer is not None and self._ink is not None:
            raise InputError("speckle: expected one layer where pixels average, got two")
        return self._product(lambda layer: layer.image(transfer))

    def __call__(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """Intensities at image positions (row, col) [px], of their shape; NaN at NaN positions.

        The error is at most ``bound``, 6e-8 of full scale per layer; typically below 1 % of it.
        """
        return self._product(lambda layer: layer(row, col))

    def _product(self, value: Callable[[Layer], FloatArray]) -> FloatArray:
        """``value`` of the base layer, darkened by ``value`` of the ink."""
        base = value(self._base)
        return base if self._ink is None else base * (1.0 - self._darkness * value(self._ink))

    @property
    def spline(self) -> PeriodicSpline:
        """The base layer as a spline of positions in samples, made at first use."""
        return self._base.spline

    @property
    def bound(self) -> float:
        """Proved error bound of calls [fraction of full scale]."""
        ink = 0.0 if self._ink is None else self._darkness * self._ink.spline.bound
        return self.spline.bound + ink + ink * self.spline.bound

    def exact(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """Exact intensities at positions (row, col) [px]; ``eps``: the FFT's relative precision."""
        return self._product(lambda layer: layer.exact(row, col, eps))

    def gradient(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """(2, ...) exact derivatives along (row, col) at image positions (row, col) [1/px]."""
        slope = self._base.gradient(row, col, eps)
        if self._ink is None:
            return slope
        light = 1.0 - self._darkness * self._ink.exact(row, col, eps)
        shade = self._darkness * self._ink.gradient(row, col, eps)
        return np.asarray(light * slope - self._base.exact(row, col, eps) * shade)
