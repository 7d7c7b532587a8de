"""At which wavelengths the error of a measured field sits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.families.spectrum import spectral_density
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.fields.measured_spectrum import gridded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.scoring.score import Score

FloatArray = NDArray[np.float64]

BANDS_AN_OCTAVE = 3
_MOST = 1000  # points along the longer side: finer fields are averaged to so many


@dataclass(frozen=True, eq=False)
class ErrorSpectrum:
    """The error by wavelength, in thirds of an octave.

    Parameters
    ----------
    wavelength_px
        (m,) middle of each band, ascending [px].
    rms_px
        (m,) rms error per component in it [px]: the squares of all and of ``affine_px`` add up to
        that of the whole error, but for what bins of a fine field average out.
    affine_px
        Rms of the error's affine part: translation, rotation, strain [px].
    """

    wavelength_px: FloatArray
    rms_px: FloatArray
    affine_px: float


def error_spectrum(graded: Score, grid: PixelGrid) -> ErrorSpectrum | None:
    """Decompose a field's error; None where its points don't fill a box.

    Gaps, at holes and where points were lost, count as zero error: what the pattern of gaps does
    to a wave is spread over its neighbours.
    """
    if not len(graded.x):
        return None
    try:
        u, points, mask = gridded(_averaged(graded, grid))
        unit = 10.0 * points.pixel_size  # any: wavelengths are told in px
        spectrum = spectral_density(u, points, mask, unit, bins_per_cell=10, padding=1)
    except InputError:
        return None
    density = (spectrum.S_xx + spectrum.S_yy).ravel()
    cell = (spectrum.xi1[1] - spectrum.xi1[0]) * (spectrum.xi2[1] - spectrum.xi2[0]) / unit**2
    area = mask.sum() * points.pixel_size**2
    frequency = np.hypot(spectrum.xi1[None, :], spectrum.xi2[:, None]).ravel() / unit
    waves = frequency > 0
    wavelength = 1.0 / (frequency[waves] * grid.pixel_size)
    band = np.rint(BANDS_AN_OCTAVE * np.log2(wavelength)).astype(int)
    low = int(band.min())
    square_mm = np.bincount(band - low, density[waves] * cell) / (2.0 * area)
    middle = 2.0 ** ((low + np.arange(square_mm.size)) / BANDS_AN_OCTAVE)
    there = np.bincount(band - low) > 0
    rms = np.sqrt(square_mm) / grid.pixel_size
    return ErrorSpectrum(
        middle[there], rms[there], _affine_rms(graded, spectrum.affine) / grid.pixel_size
    )


def _averaged(graded: Score, grid: PixelGrid) -> LocalField:
    """The error as a field [mm], its points averaged over squares where there are too many."""
    x, y, error = graded.x, graded.y, graded.error_px * grid.pixel_size
    step = graded.spacing_px * grid.pixel_size
    many = int(np.ceil(max(np.ptp(x), np.ptp(y)) / (step * _MOST)))
    if many > 1:
        side = many * step
        left, low = (at.min() - 0.5 * step for at in (x, y))  # no point of a grid on a border
        col, row = (((at - begin) / side).astype(int) for at, begin in ((x, left), (y, low)))
        cols = int(col.max()) + 1
        square = row * cols + col
        count = np.bincount(square)
        there = np.flatnonzero(count)
        error = np.column_stack([np.bincount(square, e)[there] / count[there] for e in error.T])
        x = left + side * (there % cols + 0.5)
        y = low + side * (there // cols + 0.5)
    return LocalField(x, y, error, source=graded.source)


def _affine_rms(graded: Score, affine: FloatArray) -> float:
    """Rms of an affine field at the points, per component [mm]."""
    points = np.stack([np.ones_like(graded.x), graded.x, graded.y])
    return float(np.sqrt(np.mean((affine @ points) ** 2)))
