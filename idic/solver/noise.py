"""Image noise, given, measured or estimated, and its propagation to residual and unknowns.

A spline passes through every pixel. Between pixels it is a weighted mean of their noise, and of
less variance: 1 at pixels, 0.70 (quintic; cubic 0.57) in the middle between four of them. The
variance of its slope depends on the place likewise. Where the material has shrunk, fewer pixels of
g show the same material, so that g's noise has more weight: by 1/det F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from modeharvest.idic.ansatz import Ansatz
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

_OTHER_STATE = 0.25
"""Largest share of an exposure's variance that is taken for noise: speckle has far more."""
_MOTION = 2.0
"""Ratio to the noise seen in a single image beyond which motion is the likelier cause."""

GIVEN = "given"
"""Source of a noise that the experiment's file states."""
_REACH = 24
"""Distance from a pixel to which its influence on the spline is followed [px]."""


@dataclass(frozen=True)
class CameraNoise:
    """White noise of each photograph."""

    sd: float
    """Standard deviation over the material [grey levels]."""
    source: str
    """Source of the value, in words."""


def measured_noise(images: Sequence[NDArray[Any]], mask: NDArray[np.bool_]) -> CameraNoise:
    """Measure the noise from exposures of one and the same state, the reference first.

    It is half the variance of the residual after one exposure was fitted to the next by a gain and
    an offset (the lamp may have flickered), pooled over neighbours in the series. Images and mask,
    True on material, are (rows, cols); raises InputError if two exposures have so little in common
    that they are of different states.
    """
    halves = []
    for number, (a, b) in enumerate(pairwise(images), start=1):
        cov = np.cov(a[mask], b[mask], dtype=np.float64)
        left, there = cov[1, 1] - cov[0, 1] ** 2 / cov[0, 0], float(b[mask].var(dtype=np.float64))
        if left > _OTHER_STATE * there:
            raise InputError(
                "images.repeats: expected exposures of the reference's state, got number "
                f"{number}, {100 * left / there:.0f} % of whose variance the exposure before "
                f"doesn't explain (a noise of {np.sqrt(0.5 * left):.3g} grey levels); leave it out"
            )
        halves.append(0.5 * left)
    sd, estimate = float(np.sqrt(np.mean(halves))), estimated_noise(images[0], mask).sd
    source = f"measured from {len(images)} exposures of the reference"
    if sd > _MOTION * estimate:
        source += (
            f"; the reference's finest details show {estimate:.2g} grey levels only: if anything "
            "moved between the exposures, leave the repeats out"
        )
    return CameraNoise(sd, source)


def estimated_noise(
    image: NDArray[Any], mask: NDArray[np.bool_], at_edges: bool = False
) -> CameraNoise:
    """Estimate the noise from a single image (rows, cols), by details finer than any pattern.

    The difference of two Laplacians weighs white noise by 6 and a pattern by (k_x k_y)^2, k its
    wave number in rad/px. The estimate is too large if speckles are about 2 px themselves. The mask
    is True on material. A median is taken, or the mean if most noise is ``at_edges`` of speckles.

    Source: J. Immerkaer, Comput. Vis. Image Underst. 64 (1996), doi 10.1006/cviu.1996.0060.
    """
    second = np.array([1.0, -2.0, 1.0])
    details = ndimage.convolve(image.astype(np.float64), np.outer(second, second))
    off = details[ndimage.binary_erosion(mask, iterations=2)]
    if at_edges and off.size:
        sd = off.std() / 6.0
    else:
        sd = np.median(abs(off - np.median(off))) / (6.0 * special.ndtri(0.75))
    return CameraNoise(
        float(sd), "estimated from the finest details of the reference: two exposures measure it"
    )


_LEAST_NOISE, _WIDEST_PX, _WHITE = 0.005, 1.5, 1.4
"""Noise over the speckle's standard deviation, of which less can't be told from misfit; largest
width of a Gaussian by which noise may be correlated [px]; ratio of its estimate from means of 2 x 2
pixels to that from pixels, up to which it is white: interpolation makes it 1.2."""


def power_of_long_waves(
    residual: NDArray[Any], mask: BoolArray, contrast: float, at_edges: bool = False
) -> float:
    """Power of noise at long waves, over its variance: 1 if white, more if neighbours share it.

    Cameras that compute colours, smooth or compress correlate the noise of neighbouring pixels. The
    correlation is assumed to be that of white noise blurred by a Gaussian, whose width follows from
    two estimates: by the finest details, and by those of means over 2 x 2 pixels. ``residual``
    (rows, cols) of two images of speckle, which doesn't show in it; ``mask`` True where it counts;
    ``contrast``: standard deviation of the speckle [grey levels]; ``at_edges``: whether most noise
    is at edges of speckles, as aliases of undersampled images are.
    """
    rows, cols = (2 * (n // 2) for n in mask.shape)
    means, inside = (
        part[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).mean(axis=(1, 3))
        for part in (residual, mask)
    )
    if not ndimage.binary_erosion(inside == 1.0, iterations=2).any():
        return 1.0
    fine = estimated_noise(residual, mask, at_edges).sd
    coarse = estimated_noise(means, inside == 1.0, at_edges).sd
    ratio, widths = 2.0 * coarse / max(fine, 1e-12), np.linspace(0.0, _WIDEST_PX, 61)
    if ratio <= _WHITE or 2.0 * coarse <= _LEAST_NOISE * contrast:
        return 1.0
    k = np.linspace(-np.pi, np.pi, 400, endpoint=False) + np.pi / 400
    spectra = np.exp(-(np.outer(widths, k) ** 2))
    of_pixels, of_means = 16.0 * np.sin(k / 2) ** 4, 32.0 * np.cos(k / 2) ** 2 * np.sin(k) ** 4
    ratios = (spectra @ of_means) / (spectra @ of_pixels)  # of variances, along one axis: of both
    return float(np.interp(ratio, ratios, spectra.mean(axis=1) ** -2))


_ACROSS = 128
"""Rows and columns, at most, over which means are taken: displacements vary slowly."""
_LEAST_DET = 0.1
"""Least det F: a material that shrinks more is that of a diverging iteration."""
_PHASES = 64
"""Positions between two pixels at which a spline's noise is tabulated."""


@dataclass(frozen=True)
class ImageNoise:
    """White noise of the two images; InputError if one is negative or not finite."""

    reference: float
    deformed: float
    """Standard deviations in f and in g [grey levels]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.reference < np.inf and 0.0 <= self.deformed < np.inf):
            raise InputError(
                "expected noise of 0 grey levels or more in each image, got "
                f"{self.reference} and {self.deformed}"
            )

    @classmethod
    def of(cls, value: ImageNoise | float) -> ImageNoise:
        """The noise itself, or that of two images with the same."""
        return value if isinstance(value, ImageNoise) else cls(float(value), float(value))

    @classmethod
    def estimated(cls, pair: ImagePair) -> ImageNoise:
        """The noise that the finest details of the material show in each image."""
        f, g = zip((pair.reference, pair.deformed), pair.masks, strict=True)
        return cls(estimated_noise(*f).sd, estimated_noise(*g).sd)


@dataclass(frozen=True)
class NoiseTransfer:
    """Transfer of white noise of variance 1 in g to the residual f(x) - g(x + u).

    Means over the pixels compared. The defaults are those of g sampled at its pixels.
    """

    value: float = 1.0
    """Variance of the interpolated noise [-]."""
    slope: float = 0.0
    """Variance of its slope along an axis [1/px^2]."""
    density: float = 1.0
    """1/det F: pixels of the reference for each pixel of g [-]."""

    @classmethod
    def of(
        cls, ansatz: Ansatz, a: FloatArray, grid: PixelGrid, mask: BoolArray, order: int
    ) -> NoiseTransfer:
        """Take the places where the compared pixels, True in ``mask`` (rows, cols), are mapped."""
        rows, cols, some = subsampled(mask)
        if not some.any():
            return cls()
        x, y = grid.x[cols], grid.y[rows]
        u = ansatz.displacement(a, x, y)
        h = 0.5 * grid.pixel_size
        F_x, F_y = (
            (ansatz.displacement(a, x + dx, y + dy) - ansatz.displacement(a, x - dx, y - dy))[some]
            / (2.0 * h)
            for dx, dy in ((h, 0.0), (0.0, h))
        )
        det = (1.0 + F_x[:, 0]) * (1.0 + F_y[:, 1]) - F_y[:, 0] * F_x[:, 1]
        return cls.at(np.asarray(u[some] / grid.pixel_size), np.asarray(det), order)

    @classmethod
    def at(cls, u_px: FloatArray, det: FloatArray, order: int) -> NoiseTransfer:
        """Take pixels displaced by ``u_px`` (k, 2) [px], with det F (k,), and a spline's order."""
        # Whole pixels don't change the position between pixels.
        (w_x, s_x), (w_y, s_y) = (_variances(order, u_px[:, c] % 1.0) for c in (0, 1))
        return cls(
            float(np.mean(w_x * w_y)),
            float(0.5 * np.mean(s_x * w_y + w_x * s_y)),
            float(np.mean(1.0 / np.maximum(det, _LEAST_DET))),
        )


def subsampled(mask: BoolArray) -> tuple[NDArray[np.intp], NDArray[np.intp], BoolArray]:
    """At most 128 rows and columns of a mask's bounding box, and the mask there."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    rows, cols = rows[:: len(rows) // _ACROSS + 1], cols[:: len(cols) // _ACROSS + 1]
    return rows, cols, mask[np.ix_(rows, cols)]


def spline_autocorrelation(
    ansatz: Ansatz,
    a: FloatArray,
    grid: PixelGrid,
    mask: BoolArray,
    order: int,
    lags_px: Sequence[int],
) -> FloatArray:
    """(2, lags) autocorrelation of white noise in g, sampled at x + u, down columns, along rows.

    The mean over the compared pixels, True in ``mask`` (rows, cols); pixels some lag [px] apart
    have the same position between pixels of g.
    """
    rows, cols, some = subsampled(mask)
    if not some.any():
        return np.zeros((2, len(lags_px)))
    phase = (ansatz.displacement(a, grid.x[cols], grid.y[rows])[some] / grid.pixel_size) % 1.0
    table = _autocovariances(order)

    def at_lag(component: int, lag: int) -> FloatArray:
        own = table[lag] if lag < len(table) else np.zeros(_PHASES + 1)
        return _between(own, phase[:, component])

    across, down = at_lag(0, 0), at_lag(1, 0)
    found = [[np.mean(across * at_lag(1, lag)), np.mean(down * at_lag(0, lag))] for lag in lags_px]
    return np.asarray(np.transpose(found) / np.mean(across * down))


def slope_noise(order: int, blur_px: float) -> float:
    """Variance at a pixel of the slope of white noise of variance 1, blurred first [1/px^2].

    ``order``: of the spline whose slope it is. For a Gaussian blur of standard deviation s, from
    0.6 px on, this is 1/(8 pi s^4), to 11 % at 0.6 px, 4 % at 0.8 px and 1 % at 1 px.
    """
    if blur_px > 0.0:
        return float(1.0 / (8.0 * np.pi * blur_px**4))
    return float(_variances(order, np.zeros(1))[1][0])


def _variances(order: int, phase: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variances along an axis of interpolated noise of variance 1 and of its slope.

    The phase, 0 ... 1, is the position between two pixels.
    """
    value, slope = _table(order)
    return _between(value, phase), _between(slope, phase)


def _between(table: FloatArray, phase: FloatArray) -> FloatArray:
    """Interpolate a table at even phases 0 ... 1 linearly, without the search of np.interp."""
    at = _PHASES * phase
    low = np.minimum(at.astype(np.int64), _PHASES - 1)
    return np.asarray(table[low] + (at - low) * np.diff(table)[low])


@cache
def _table(order: int) -> tuple[FloatArray, FloatArray]:
    """Both variances at phases 0 ... 1: sums of squares of the spline through a unit impulse."""
    value, slope = _impulse(order)
    return (value**2).sum(axis=1), (slope**2).sum(axis=1)


@cache
def _autocovariances(order: int) -> FloatArray:
    """(lags, phases) autocovariance along an axis of interpolated noise of variance 1."""
    value, _ = _impulse(order)
    n = value.shape[1]
    return np.array([(value[:, : n - lag] * value[:, lag:]).sum(axis=1) for lag in range(_REACH)])


def _impulse(order: int) -> tuple[FloatArray, FloatArray]:
    """(phases 0 ... 1, positions a pixel apart) spline through a unit impulse, and its slope."""
    impulse = np.zeros((2 * _REACH + 1, 2 * _REACH + 1))
    impulse[_REACH, _REACH] = 1.0
    spline = SplineImage.of(impulse, order, np.float64)
    phase = np.arange(_PHASES + 1)[:, None] / _PHASES
    value, _, slope = spline.sample(float(_REACH), phase + np.arange(4, 2 * _REACH - 4))
    return value, slope
