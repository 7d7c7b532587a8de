"""A speckle pattern that is known exactly everywhere, not only at whole pixels.

A stationary Gaussian random field [1]_ with a radially symmetric normal spectral density is
thresholded at its median and blurred by a Gaussian. The thresholded samples blurred by the
*continuous* Gaussian are a trigonometric polynomial

    I(row, col) = sum_k  c_k exp(2 pi i (k_row row / rows + k_col col / cols)),

because the Gaussian's transfer function at the Nyquist frequency is 5e-20 for the default
3 px. An inverse FFT gives it at whole pixels, a non-uniform FFT [2]_ at any other point, both
to rounding. Where millions of points are wanted, a B-spline of its waves is twenty times
faster; unlike an interpolated image it comes with a proof of how far it may be off.

References
----------
.. [1] M. Grigoriu, Stochastic Calculus, Birkhäuser 2002, section 5.3.1.2.
.. [2] A. H. Barnett, J. Magland, L. af Klinteberg, SIAM J. Sci. Comput. 41 (2019) C479,
   doi:10.1137/18M120885X.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import finufft
import numba
import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.periodic_spline import PeriodicSpline

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SpectralUnit = Literal["cycles/px", "rad/px"]
_CYCLES: dict[str, float] = {"cycles/px": 1.0, "rad/px": 1.0 / (2.0 * math.pi)}
TOLERANCE = 2.0**-24
"""Proved bound of the error between pixels [fraction of full scale]: float32's own rounding."""
_NARROWEST_BLUR_PX = 2.0  # transfer function at Nyquist: exp(-pi^2 b^2 / 2) = 3e-9


@dataclass(frozen=True)
class SpeckleSpec:
    """What the speckle looks like.

    Parameters
    ----------
    standard_deviation
        Standard deviation of the spectral density of the Gaussian field, in ``unit``.
    unit
        "cycles/px" (correlation length 3.2 px, mean chord about 10 px) or "rad/px"
        (2 pi times coarser); the paper leaves it open.
    blur_px
        Standard deviation of the Gaussian blur [px]; at least 2, below which the pattern would
        no longer be band-limited.
    dark, bright
        Grey levels of the two phases before the blur, as fractions of full scale [-].
    seed
        Seed of the random numbers.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    standard_deviation: float = 1.0 / 20.0
    unit: SpectralUnit = "cycles/px"
    blur_px: float = 3.0
    dark: float = 0.2
    bright: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.unit not in _CYCLES:
            raise InputError(f"speckle: expected a unit among {list(_CYCLES)}, got {self.unit!r}")
        if not 0.0 < self.cycles_per_px <= 0.125:
            raise InputError(
                "speckle: expected a spectral standard deviation above 0 and at most 0.125 "
                f"cycles/px (4 of them below Nyquist), got {self.standard_deviation} {self.unit}"
            )
        if not (self.blur_px >= _NARROWEST_BLUR_PX and math.isfinite(self.blur_px)):
            raise InputError(
                f"speckle: expected a blur of at least {_NARROWEST_BLUR_PX:g} px (else the image "
                f"isn't band-limited), got {self.blur_px} px"
            )
        if not 0.0 <= self.dark < self.bright <= 1.0:
            raise InputError(
                "speckle: expected grey levels 0 <= dark < bright <= 1, got "
                f"dark {self.dark}, bright {self.bright}"
            )
        if self.seed < 0:
            raise InputError(f"speckle: expected a seed of 0 or more, got {self.seed}")

    @property
    def cycles_per_px(self) -> float:
        """The spectral standard deviation in cycles/px."""
        return self.standard_deviation * _CYCLES[self.unit]


def gaussian_field(spec: SpeckleSpec, period: tuple[int, int]) -> FloatArray:
    """One realisation of the Gaussian field, periodic with ``period`` (rows, cols) [px].

    White noise is filtered by the square root of the spectral density. The sample's mean is
    zero; in expectation the variance is one and the median, the threshold, zero.
    """
    noise = np.random.default_rng(spec.seed).standard_normal(period)
    amplitude = np.exp(-_squared_frequency(period) / (4.0 * spec.cycles_per_px**2))
    amplitude[0, 0] = 0.0
    multiplicity = np.full(amplitude.shape[1], 2.0)
    multiplicity[0] = 1.0
    if period[1] % 2 == 0:
        multiplicity[-1] = 1.0
    amplitude /= math.sqrt(float((amplitude**2 @ multiplicity).sum()) / math.prod(period))
    spectrum = scipy.fft.rfft2(noise)
    spectrum *= amplitude
    return np.asarray(scipy.fft.irfft2(spectrum, s=period), dtype=np.float64)


class Speckle:
    """One speckle pattern: exact intensities at whole pixels and anywhere between.

    Parameters
    ----------
    spec
        What it looks like.
    shape
        (rows, cols) of the image it has to cover [px]. The pattern is periodic with the next
        sizes that suit an FFT; the realisation depends on them, hence on ``shape``.

    Attributes
    ----------
    period : (rows, cols) of the period [px].
    """

    def __init__(self, spec: SpeckleSpec, shape: tuple[int, int]) -> None:
        if min(shape) < 8:
            raise InputError(f"speckle: expected an image of at least 8 x 8 px, got {shape}")
        self.spec = spec
        self.shape = shape
        self.period: tuple[int, int] = (
            int(scipy.fft.next_fast_len(shape[0], real=True)),
            int(scipy.fft.next_fast_len(shape[1], real=True)),
        )
        transfer = np.exp(-2.0 * (math.pi * spec.blur_px) ** 2 * _squared_frequency(self.period))
        spectrum = scipy.fft.rfft2(self.binary())
        spectrum *= transfer / math.prod(self.period)
        self._spectrum: ComplexArray = spectrum

    def binary(self) -> FloatArray:
        """Return the two phases before the blur, over the period [fraction of full scale]."""
        bright = gaussian_field(self.spec, self.period) > 0.0
        return np.where(bright, self.spec.bright, self.spec.dark)

    def image(self, transfer: Callable[[ArrayLike], FloatArray] | None = None) -> FloatArray:
        """(rows, cols) exact intensities at whole pixels [fraction of full scale].

        ``transfer`` maps frequencies along an axis [cycles/px] to a factor; a plane wave is
        multiplied by those of its row and its column frequency (see Aperture.transfer).
        """
        spectrum = self._spectrum * math.prod(self.period)
        if transfer is not None:
            spectrum *= transfer(np.fft.fftfreq(self.period[0]))[:, None]
            spectrum *= transfer(np.fft.rfftfreq(self.period[1]))
        whole = scipy.fft.irfft2(spectrum, s=self.period)
        return np.ascontiguousarray(whole[: self.shape[0], : self.shape[1]])

    def __call__(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """Intensities at image positions (row, col) [px], of the positions' shape.

        They are off by at most ``spline.bound``, at most 6e-8 of full scale, and in fact by
        less than a hundredth of that; NaN where a position is.
        """
        return self.spline(row, col)

    @cached_property
    def spline(self) -> PeriodicSpline:
        """The pattern as a spline, made when first asked for."""
        return PeriodicSpline.of(self._spectrum, self.period, TOLERANCE)

    def exact(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """Exact intensities at image positions (row, col) [px], of the positions' shape.

        ``eps`` is the relative precision of the non-uniform FFT.
        """
        return np.asarray(self._evaluate(row, col, eps, gradient=False)[0])

    def gradient(self, row: ArrayLike, col: ArrayLike, eps: float = 1e-12) -> FloatArray:
        """(2, ...) exact derivatives along (row, col) at image positions (row, col) [1/px]."""
        return self._evaluate(row, col, eps, gradient=True)

    def _evaluate(
        self, row: ArrayLike, col: ArrayLike, eps: float, *, gradient: bool
    ) -> FloatArray:
        row, col = np.broadcast_arrays(
            np.asarray(row, dtype=np.float64), np.asarray(col, dtype=np.float64)
        )
        scale = 2.0 * math.pi / np.asarray(self.period)
        row_angle, col_angle = scale[0] * row.ravel(), scale[1] * col.ravel()
        modes, k_row, k_col = self._modes(eps)
        if gradient:
            modes = np.stack(
                [1j * scale[0] * k_row[:, None] * modes, 1j * scale[1] * k_col[None, :] * modes]
            )
        else:
            modes = modes[None]
        if row_angle.size == 0:
            return np.zeros((len(modes), *row.shape))
        values = finufft.nufft2d2(
            row_angle, col_angle, modes, eps=eps, isign=1,
            nthreads=numba.get_num_threads(), showwarn=0,
        )  # fmt: skip
        # The library's columns run from -n/2; ours from 0: a shift theorem makes up for it.
        shift = k_col.size // 2
        values = values.reshape(len(modes), -1) * np.exp(1j * shift * col_angle)
        return np.ascontiguousarray(values.real).reshape(len(modes), *row.shape)

    def _modes(self, eps: float) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Pick the non-negligible modes of a real image, wave numbers k_row centred, k_col >= 0.

        What is left out sums to at most ``eps`` of the image's mean in absolute value.
        """
        rows = self.period[0]
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
    """Find the last index to keep so that what follows sums to at most ``allowed``."""
    tail = np.cumsum(size[::-1])[::-1]
    return max(1, int(np.count_nonzero(tail > allowed)) - 1)
