"""A speckle pattern that is known exactly everywhere: one layer, or dots of ink on it.

The one layer is a thresholded and blurred Gaussian field (see ``layer``). The second is ink that an
air brush leaves on a powdered surface, as on the specimen of the paper's section "Real
Experiments": the ink's own field i, 0 ... 1, darkens what it lies on, I = p (1 - darkness i). Both
are trigonometric polynomials, hence their product is; it is evaluated factor by factor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.imaging.speckle.layer import BinaryField, Layer
from modeharvest.imaging.speckle.periodic_spline import PeriodicSpline
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within

SpectralUnit = Literal["cycles/px", "rad/px"]
_CYCLES: dict[str, float] = {"cycles/px": 1.0, "rad/px": 1.0 / (2.0 * math.pi)}
_NARROWEST_BLUR_PX = 0.75  # 3 x 3 samples a pixel
_WIDEST_BLUR_PX = 100.0  # beyond it no speckle is left
_LOWEST_FREQUENCY = 1e-4  # cycles/px: speckles of thousands of pixels
_WIDEST_FREQUENCY = 0.125  # cycles a sample: Nyquist is 4 standard deviations away


@dataclass(frozen=True)
class Ink:
    """Dots of ink on the first layer, from a field of their own; InputError if out of range."""

    standard_deviation: float = 0.05
    """Standard deviation of the Gaussian field's spectral density [cycles/px]."""
    blur_px: float = 1.5
    """Standard deviation of the Gaussian blur [px]."""
    coverage: float = 0.4
    """Share of the area under ink [-]."""
    darkness: float = 0.8
    """Share of the light that ink takes away [-]."""
    seed: int = 0
    """Of the random numbers; streams differ from those of the layer below."""

    def __post_init__(self) -> None:
        _require_band_limited(self.standard_deviation, self.blur_px, "ink")
        if not 0.0 < self.coverage < 1.0:
            raise InputError(f"ink: expected a coverage between 0 and 1, got {self.coverage}")
        require_within("ink: expected a darkness", self.darkness, 0.0, 1.0, above=True)
        require_within("ink: expected a seed", self.seed, 0)

    @property
    def binary_field(self) -> BinaryField:
        """What the layer is made of."""
        spread, seed = self.standard_deviation, (self.seed, 1)
        return BinaryField(spread, self.blur_px, (0.0, 1.0), self.coverage, seed)


@dataclass(frozen=True)
class SpeckleSpec:
    """What the speckle looks like; InputError if a value is out of its range."""

    standard_deviation: float = 1.0 / 20.0
    """Of the spectral density of the Gaussian field, in ``unit``."""
    unit: SpectralUnit = "cycles/px"
    """Either "cycles/px" (correlation length 3.2 px, mean chord about 10 px) or "rad/px" (2 pi
    times coarser); the paper leaves it open."""
    blur_px: float = 3.0
    """Standard deviation of the Gaussian blur [px], at least 0.75."""
    dark: float = 0.2
    bright: float = 1.0
    """Grey levels of the two phases before the blur, as fractions of full scale [-]."""
    seed: int = 0
    """Of the random numbers."""
    ink: Ink | None = None
    """A second layer; none by default."""

    def __post_init__(self) -> None:
        if self.unit not in _CYCLES:
            raise InputError(f"speckle: expected a unit among {list(_CYCLES)}, got {self.unit!r}")
        _require_band_limited(self.cycles_per_px, self.blur_px, "speckle")
        if not 0.0 <= self.dark < self.bright <= 1.0:
            got = f"dark {self.dark}, bright {self.bright}"
            raise InputError(f"speckle: expected grey levels 0 <= dark < bright <= 1, got {got}")
        require_within("speckle: expected a seed", self.seed, 0)

    @property
    def cycles_per_px(self) -> float:
        """The spectral standard deviation in cycles/px."""
        return self.standard_deviation * _CYCLES[self.unit]

    @property
    def binary_field(self) -> BinaryField:
        """What the pattern, or the layer under the ink, is made of: half dark, half bright."""
        levels = self.dark, self.bright
        return BinaryField(self.cycles_per_px, self.blur_px, levels, 0.5, self.seed)


def _require_band_limited(cycles_per_px: float, blur_px: float, what: str) -> None:
    require_within(f"{what}: expected a blur [px]", blur_px, _NARROWEST_BLUR_PX, _WIDEST_BLUR_PX)
    widest = _WIDEST_FREQUENCY * BinaryField(cycles_per_px, blur_px, (0.0, 1.0), 0.5, 0).finer
    spread = f"{what}: expected, with a blur of {blur_px} px, a spectral standard deviation"
    require_within(f"{spread} [cycles/px]", cycles_per_px, _LOWEST_FREQUENCY, widest)


class Speckle:
    """One speckle pattern: exact intensities at whole pixels and anywhere between.

    ``shape`` (rows, cols) is that of the image to cover [px], see :class:`Layer`, ``period`` (rows,
    cols) that after which it repeats itself [px].
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

        For ``transfer`` see :meth:`Layer.image`; InputError with ink, whose waves are products.
        """
        if transfer is not None and self._ink is not None:
            raise InputError("speckle: expected one layer where pixels average, got two")
        return self._product(lambda layer: layer.image(transfer))

    def __call__(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """Intensities at image positions (row, col) [px], of their shape; NaN where they are.

        Off by at most ``bound``, 6e-8 of full scale a layer; in fact by less than 1 % of that.
        """
        return self._product(lambda layer: layer(row, col))

    def _product(self, value: Callable[[Layer], FloatArray]) -> FloatArray:
        """What the base layer has of a value, darkened by what the ink has of it."""
        base = value(self._base)
        return base if self._ink is None else base * (1.0 - self._darkness * value(self._ink))

    @property
    def spline(self) -> PeriodicSpline:
        """The base layer as a spline, made when first asked for."""
        return self._base.spline

    @property
    def bound(self) -> float:
        """Proved bound of a call's error [fraction of full scale]."""
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
