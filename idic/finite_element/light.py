"""Light that changed: gain and offset that make a deformed image as bright as the reference.

Both images get the same mean and contrast: everywhere by polynomials, or in windows of many
speckles around each pixel, where the light changed otherwise. A displacement that is off by some
pixels hardly matters then, because these are the mean and contrast of the same speckles.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from modeharvest.fem.field import Mesh
from modeharvest.idic.chebyshev import Box, ChebyshevField
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.noise import ImageNoise, NoiseTransfer
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.masks import shrunk

LOCAL: Literal["local"] = "local"
"""Gain and offset from around each pixel, instead of a degree."""
Light = int | Literal["local"] | None
"""How gain and offset vary: as polynomials of a total degree, LOCAL, or None for images of one
brightness, which have neither."""
Maps = tuple[FloatArray, FloatArray]
"""Gain [-] and offset [grey levels], (rows, cols) each: f = gain g(x + u) + offset."""

UNEVEN, _MOST = 0.02, 0.96
"""Range of the light's relative change over most of the material that polynomials may leave
undescribed. Without any change, noise of 3 % in a strip of 360 x 40 px makes 0.012 of it."""
_BY_CHANCE = 0.2
"""That range by noise alone, at most, over the noise's share of the mean level."""
_MARGIN_PX = 4.0
"""Pixels closer to an edge don't count: a displacement that is off shows background there [px]."""
_SAMPLES, _IN_A_WINDOW, _LEAST = 100_000, 2000, 0.1
"""Pixels from which brightness is fitted, at least, and in a window, if it has so many: speckle and
noise of fewer would be taken for light; least gain anywhere, over the mean."""
_UNLIKE, _ROUNDS = 4.5, 4
"""Residual over its median, 3 standard deviations of noise, beyond which pixels don't match; how
often gain and offset are found without these."""
_WINDOW = 3.0
"""Standard deviation of the Gaussian window, over the speckle size."""
_BINS = 4.0
"""Bins in a window's standard deviation."""
_ORDER = 5
"""Order of the spline through the deformed image."""
_NOISE = 0.5
"""Largest share of an image's variance that is taken for noise: fine speckle looks like it."""
_FAR = 2e-3
"""Weight of the whole material in each window, over that of a window full of material: it alone
counts far from the material."""


class _Samples(NamedTuple):
    """Pixels of the reference that are compared, evenly spread."""

    row: NDArray[Any]
    col: NDArray[Any]
    f: FloatArray
    g: FloatArray
    """(p,) g(x + u) [grey levels]; NaN outside the image."""
    noise: tuple[float, float]
    """Variances of noise in f and in g(x + u) [grey levels squared]."""

    @classmethod
    def of(cls, pair: ImagePair, u: FloatArray) -> _Samples:
        """Choose pixels off the edges; u (rows, cols, 2) [mm], NaN where it isn't known."""
        inner = shrunk(pair.masks[0], _MARGIN_PX)
        where = (inner if inner.any() else pair.masks[0]) & np.isfinite(u).all(axis=-1)
        window = 4.0 * np.pi * (_WINDOW * speckle_size(pair.reference, pair.masks[0])) ** 2
        every = max(1, int(min(where.sum() / _SAMPLES, window / _IN_A_WINDOW)))
        row, col = (places[::every] for places in np.nonzero(where))
        f, g = pair.reference[row, col].astype(float), _moved(pair, u, row, col)
        noise, u_px = ImageNoise.estimated(pair), np.asarray(u[row, col] / pair.grid.pixel_size)
        in_g = noise.deformed**2 * NoiseTransfer.at(u_px, np.ones(len(u_px)), _ORDER).value
        found = cls(row, col, f, g, (noise.reference**2, in_g))
        if not found.known.any() or not np.ptp(found.g[found.known]) > 0.0:
            raise InputError("expected pixels of the material in both images, got none in common")
        return found

    @property
    def known(self) -> BoolArray:
        """(p,) True inside the deformed image."""
        return np.asarray(np.isfinite(self.g))

    def maps(self, pair: ImagePair, light: int | Literal["local"]) -> Maps:
        """Gain and offset of a light, over the pair's pixels."""
        if light == LOCAL:
            width = _WINDOW * speckle_size(pair.reference, pair.masks[0])
            gain, offset = self._around_each(pair.grid.shape, width)
        else:
            gain, offset = self._polynomials(pair.grid, light)
        return np.maximum(gain, _LEAST * gain[pair.masks[0]].mean()), offset

    def _polynomials(self, grid: PixelGrid, degree: int) -> Maps:
        """Polynomials of a total degree."""
        field = ChebyshevField(Box(*grid.x[[0, -1]], *grid.y[[-1, 0]]), degree)
        basis, there = field.basis(grid.x[self.col], grid.y[self.row]), self.known
        both = np.column_stack([self.f, self.g])
        for _ in range(_ROUNDS):
            within = basis[there]
            mean = within @ np.linalg.lstsq(within, both[there])[0]
            f, g = np.abs(both[there] - mean).T
            gain = np.linalg.lstsq(within.T @ (g[:, None] * within), within.T @ f)[0]
            left = self.f - basis @ gain * self.g
            offset = np.linalg.lstsq(within, left[there])[0]
            off = np.abs(left - basis @ offset)
            there = off <= _UNLIKE * np.nanmedian(off)
        a, b = (field.evaluate(part, grid.x[None], grid.y[:, None]) for part in (gain, offset))
        return a, b

    def _around_each(self, shape: tuple[int, int], width: float) -> Maps:
        """Those of windows of a standard deviation [px]: ratio of contrasts, difference of means.

        Noise is no contrast: more of it in one image would be light where speckle is faint. Windows
        average the light: gain and offset are found again in what is left, some times.
        """
        bin_px = max(1, int(width / _BINS))
        bins = tuple(-(-size // bin_px) for size in shape)
        place, there = (self.row // bin_px) * bins[1] + self.col // bin_px, self.known
        levels = self.f[there].mean(), self.g[there].mean()
        f, g = self.f - levels[0], self.g - levels[1]  # for variances without loss of digits

        def on(part: FloatArray, rows: NDArray[Any], cols: NDArray[Any]) -> FloatArray:
            at = np.broadcast_arrays((rows + 0.5) / bin_px - 0.5, (cols + 0.5) / bin_px - 0.5)
            return np.asarray(map_coordinates(part, at, mode="nearest"))

        gain, offset, lit = np.ones(bins), np.zeros(bins), g
        for _ in range(_ROUNDS):
            powers = np.stack([np.ones_like(f), f, lit, f**2, lit**2])[:, there]
            sums = np.stack([np.bincount(place[there], part, bins[0] * bins[1]) for part in powers])
            far = _FAR * bin_px**2 * powers.mean(axis=1)
            around = gaussian_filter(sums.reshape(-1, *bins), (0.0, width / bin_px, width / bin_px),
                                     mode="constant") + far[:, None, None]  # fmt: skip
            mean, square = np.split(around[1:] / around[0], 2)
            both, noise = square - mean**2, [self.noise[0] * np.ones(bins), self.noise[1] * gain**2]
            speckle = np.maximum(both - noise, (1.0 - _NOISE) * both)
            more = np.sqrt(speckle[0] / speckle[1])
            gain, offset = more * gain, more * (offset - mean[1]) + mean[0]
            lit = on(gain, self.row, self.col) * g + on(offset, self.row, self.col)
            left = np.abs(f - lit)
            there = left <= _UNLIKE * np.nanmedian(left)
        gain, offset = (on(part, *np.ogrid[: shape[0], : shape[1]]) for part in (gain, offset))
        return gain, offset + levels[0] - gain * levels[1]


def brightness(pair: ImagePair, u: FloatArray, light: Light = 0) -> Maps:
    """Gain and offset that make g(x + u) as bright as f; 1 and 0 without a light.

    Pixels at edges and those that don't match don't count. ``u`` (rows, cols, 2) [mm], NaN where
    it isn't known. InputError if the images have no pixels in common.
    """
    if light is None:
        return np.ones(pair.grid.shape), np.zeros(pair.grid.shape)
    return _Samples.of(pair, u).maps(pair, light)


def alike(pair: ImagePair, mesh: Mesh, u: FloatArray, light: Light) -> ImagePair:
    """Make brightness and contrast of the pair equal, in the reference's levels; u (n, 2) [mm]."""
    gain, offset = brightness(pair, on_pixels(pair.grid, mesh, u), light)
    a, b = (part[pair.masks[0]].mean() for part in (gain, offset))
    reference = a * (pair.reference - offset) / gain + b
    return pair.with_images(reference.astype(np.float32), a * pair.deformed + b)


def residual(pair: ImagePair, u: FloatArray, light: Light = 0) -> FloatArray:
    """(rows, cols) f - gain g(x + u) - offset [grey levels]; NaN outside material and image."""
    gain, offset = brightness(pair, u, light)
    at = np.nonzero(pair.masks[0] & np.isfinite(u).all(axis=-1))
    found = np.full(pair.grid.shape, np.nan)
    found[at] = pair.reference[at] - gain[at] * _moved(pair, u, *at) - offset[at]
    return found


def light_for(pair: ImagePair, u: FloatArray, degree: int | None) -> Light:
    """The degree; LOCAL if the light changed otherwise.

    ``u`` (rows, cols, 2) [mm], NaN where it isn't known; near the truth elsewhere.
    """
    if degree is None or not np.isfinite(u).any():
        return degree
    at = _Samples.of(pair, u)
    chance = _BY_CHANCE * float(np.sqrt(sum(at.noise)) / abs(pair.reference[pair.masks[0]].mean()))
    change = _range_between(at.maps(pair, degree), at.maps(pair, LOCAL), pair, u)
    return LOCAL if change > max(UNEVEN, chance) else degree


def uneven_light(pair: ImagePair, u: FloatArray, degree: int) -> float:
    """Range of the light's relative change over the material that only the next degree describes.

    Over most of the material [-]; ``u`` (rows, cols, 2) [mm].
    """
    at = _Samples.of(pair, u)
    return _range_between(at.maps(pair, degree), at.maps(pair, degree + 1), pair, u)


def on_pixels(grid: PixelGrid, mesh: Mesh, u: FloatArray) -> FloatArray:
    """(rows, cols, 2) nodal displacement u (n, 2) at the pixels; NaN beside the mesh."""
    at = locate(mesh.nodes, mesh.cells, mesh.element, grid, nodal=u).values
    return np.moveaxis(at, 0, -1)


def _range_between(coarse: Maps, fine: Maps, pair: ImagePair, u: FloatArray) -> float:
    """Range, over most of the material, of the relative change of light between two maps [-]."""
    mask = pair.masks[0] & np.isfinite(u).all(axis=-1)
    typical = float(pair.reference[mask].mean())
    level, around = ((typical - offset[mask]) / gain[mask] for gain, offset in (coarse, fine))
    low, high = np.quantile(around - level, [0.5 - 0.5 * _MOST, 0.5 + 0.5 * _MOST])
    return float((high - low) / abs(around.mean()))


def _moved(pair: ImagePair, u: FloatArray, row: NDArray[Any], col: NDArray[Any]) -> FloatArray:
    """(p,) g(x + u) of some pixels [grey levels]; NaN outside the deformed image."""
    moved = u[row, col] / pair.grid.pixel_size
    g, _, _ = SplineImage.of(pair.deformed, _ORDER).sample(row - moved[:, 1], col + moved[:, 0])
    return g
