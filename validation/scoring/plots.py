"""Pictures of graded fields: error maps, distributions, regions and spectra, several codes in one.

A code keeps its colour in all pictures; all lengths of errors share one logarithmic scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.plots_fields import Scale, draw_field
from modeharvest.validation.plots_path import curve
from modeharvest.validation.scoring.regions import REGIONS
from modeharvest.validation.scoring.score import Score
from modeharvest.validation.scoring.spectrum import ErrorSpectrum
from modeharvest.validation.sheet import Sheet
from modeharvest.validation.style import BLUE, GOLD, GREEN, RED, SIZE, style

FloatArray = NDArray[np.float64]

_COLOURS = (BLUE, RED, GREEN, GOLD, *mpl.colormaps["tab10"].colors[4:])  # type: ignore[attr-defined]
_CELLS = 300
_SHARES = np.logspace(-4, 0, 200)


@dataclass(frozen=True)
class LogScale(Scale):
    """Colours for values of many orders of magnitude."""

    @property
    def normalise(self) -> Normalize:
        """Values to 0 ... 1, by their logarithm."""
        return LogNorm(self.low, self.high)


@dataclass(frozen=True, eq=False)
class ErrorMaps:
    """What the maps of several codes share.

    Parameters
    ----------
    sheet
        Frame, outline and cells.
    lengths
        The scale of the error's length.
    """

    sheet: Sheet
    lengths: LogScale

    @classmethod
    def of(cls, mesh: Mesh, grid: PixelGrid, scores: Sequence[Score]) -> ErrorMaps:
        """Make a sheet, and a scale on which 98 % of every code's errors are told apart."""
        lengths = [_length(graded) for graded in scores if len(graded.error_px)]
        ends = [np.quantile(one[one > 0], (0.02, 0.98)) for one in lengths if (one > 0).any()]
        low = min((end[0] for end in ends), default=1e-3)
        high = max((end[1] for end in ends), default=1.0)
        low = max(low, 1e-4 * high)
        high = max(high, 2.0 * low)
        return cls(Sheet.of(mesh, grid, _CELLS), LogScale(SIZE, low, high, "px", "both"))


@dataclass(frozen=True, eq=False)
class FieldMaps:
    """The maps of one code's errors.

    Parameters
    ----------
    maps
        What they share with those of the others.
    graded
        The field.
    """

    maps: ErrorMaps
    graded: Score

    @cached_property
    def _nearest(self) -> NDArray[np.intp]:
        """(rows, cols) of the sheet: number of the nearest point, the count of all if too far."""
        graded, sheet = self.graded, self.maps.sheet
        if not len(graded.x):
            return np.zeros(sheet.grid.shape, dtype=np.intp)
        reach = max(graded.reach_px * sheet.grid.pixel_size / sheet.factor, sheet.grid.pixel_size)
        points = np.column_stack([graded.x, graded.y])
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        pixels = np.stack(np.meshgrid(sheet.grid.x, sheet.grid.y), axis=-1)
        return np.asarray(tree.query(pixels, distance_upper_bound=reach)[1])

    def _draw(self, values: FloatArray, scale: Scale) -> Figure:
        """A map; blank where nothing was measured."""
        return draw_field(self.maps.sheet, np.append(values, np.nan)[self._nearest], scale)

    def draw_length(self) -> Figure:
        """Draw the error's length, on the scale of all codes."""
        scale = self.maps.lengths
        return self._draw(np.maximum(_length(self.graded), 1e-3 * scale.low), scale)  # 0 has no log

    def draw_component(self, component: int) -> Figure:
        """Draw the error along x (0) or y (1), on a scale of its own."""
        error = self.graded.error_px
        return self._draw(error[:, component], Scale.signed(error, "px", 0.98))


def draw_distribution(scores: Sequence[Score]) -> Figure:
    """Draw which share of a field's points, lost ones counted as wrong, errs by more."""
    with style():
        drawn, axes = curve("length of the error [px]", "share of points that err by more [%]")
        for n, graded in enumerate(scores):
            length = np.sort(_length(graded))[::-1]
            if not len(length):
                continue
            points = graded.everywhere.points
            lost = points - len(length)
            share = (lost + np.arange(1, len(length) + 1)) / points
            some = np.searchsorted(share, _SHARES).clip(0, len(share) - 1)
            axes.loglog(np.maximum(length[some], 1e-9), 100 * share[some], color=colour(n))
        axes.set(ylim=(0.01, 120))
    return drawn


def draw_histogram(scores: Sequence[Score]) -> Figure:
    """Draw how many of a field's points err by how much, in tenths of a decade."""
    with style():
        drawn, axes = curve("length of the error [px]", "share of points per tenth of a decade [%]")
        for n, graded in enumerate(scores):
            length = np.maximum(_length(graded), 1e-9)
            if not len(length):
                continue
            low, high = (int(np.floor(10 * np.log10(end))) for end in (length.min(), length.max()))
            edges = 10.0 ** (np.arange(low, high + 2) / 10)
            count, _ = np.histogram(length, edges)
            axes.stairs(100 * count / graded.everywhere.points, edges, lw=1.5, color=colour(n))
        axes.set(xscale="log", ylim=(0, None))
    return drawn


def draw_regions(scores: Sequence[Score]) -> Figure:
    """Draw bars of the rms error by region."""
    with style():
        drawn, axes = curve("", "rms per component [px]")
        width = 0.8 / max(len(scores), 1)
        for n, graded in enumerate(scores):
            at = np.arange(len(REGIONS)) + (n - 0.5 * (len(scores) - 1)) * width
            rms = [graded.by_region[name].rms_px for name in REGIONS]
            axes.bar(at, np.nan_to_num(rms), 0.92 * width, color=colour(n))
        axes.set_xticks(range(len(REGIONS)), REGIONS)
        if any(graded.everywhere.rms_px > 0 for graded in scores):
            axes.set_yscale("log")
    return drawn


def draw_spectra(spectra: Mapping[str, ErrorSpectrum | None]) -> Figure:
    """Draw the rms error by wavelength, in thirds of an octave."""
    with style():
        drawn, axes = curve("wavelength [px]", "rms per component in a third of an octave [px]")
        for n, spectrum in enumerate(spectra.values()):
            if spectrum is not None and (spectrum.rms_px > 0).any():
                axes.loglog(spectrum.wavelength_px, spectrum.rms_px, marker="o", ms=2.5,
                            color=colour(n))  # fmt: skip
    return drawn


def _length(graded: Score) -> FloatArray:
    return np.hypot(graded.error_px[:, 0], graded.error_px[:, 1])


def colour(n: int) -> str:
    """Of the n-th code in all curves and bars, "#rrggbb"."""
    return str(to_hex(_COLOURS[n % len(_COLOURS)]))
