"""Pages and figures of graded DIC codes: errors on a benchmark, resolution on the star pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures.curves import curve
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field
from modeharvest.report.figures.style import (
    BLUE,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    SIGNED,
    SIZE,
    figure,
    style,
    to_svg,
)
from modeharvest.report.model import Picture, render, short
from modeharvest.util.arrays import FloatArray
from modeharvest.util.files import atomic, write_json
from modeharvest.validation.resolution.attenuation import Attenuation
from modeharvest.validation.resolution.grading import (
    GRADE_COLUMNS,
    StarGrade,
    StarGrading,
    grade_numbers,
    star_csv_lines,
    star_summary,
)
from modeharvest.validation.resolution.star import KEPT
from modeharvest.validation.scoring.grading import (
    COMMON,
    EVERYWHERE,
    Grading,
    csv_lines,
    grading_summary,
    without_nan,
)
from modeharvest.validation.scoring.score import PERCENTILES, REGIONS, ErrorSpectrum, Score

CODE_COLOURS = (BLUE, RED, GREEN, GOLD, *mpl.colormaps["tab10"].colors[4:])  # type: ignore[attr-defined]
_CELLS = 300
_SHARES = np.logspace(-4, 0, 200)


@dataclass(frozen=True)
class LogScale(ColourScale):
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

    sheet: MapFrame
    lengths: LogScale

    @classmethod
    def of(cls, mesh: Mesh, grid: PixelGrid, scores: Sequence[Score]) -> ErrorMaps:
        """Make a sheet, and a scale on which 98 % of every code's errors are told apart."""
        lengths = [_error_length(graded) for graded in scores if len(graded.error_px)]
        ends = [np.quantile(one[one > 0], (0.02, 0.98)) for one in lengths if (one > 0).any()]
        low = min((end[0] for end in ends), default=1e-3)
        high = max((end[1] for end in ends), default=1.0)
        low = max(low, 1e-4 * high)
        high = max(high, 2.0 * low)
        return cls(MapFrame.of(mesh, grid, _CELLS), LogScale(SIZE, low, high, "px", "both"))


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

    def _draw(self, values: FloatArray, scale: ColourScale) -> Figure:
        """A map; blank where nothing was measured."""
        return draw_field(self.maps.sheet, np.append(values, np.nan)[self._nearest], scale)

    def draw_length(self) -> Figure:
        """Draw the error's length, on the scale of all codes."""
        scale = self.maps.lengths
        return self._draw(
            np.maximum(_error_length(self.graded), 1e-3 * scale.low), scale
        )  # 0 has no log

    def draw_component(self, component: int) -> Figure:
        """Draw the error along x (0) or y (1), on a scale of its own."""
        error = self.graded.error_px
        return self._draw(error[:, component], ColourScale.signed(error, "px", 0.98))


def draw_distribution(scores: Sequence[Score]) -> Figure:
    """Draw which share of a field's points, lost ones counted as wrong, errs by more."""
    with style():
        drawn, axes = curve("length of the error [px]", "share of points that err by more [%]")
        for n, graded in enumerate(scores):
            length = np.sort(_error_length(graded))[::-1]
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
            length = np.maximum(_error_length(graded), 1e-9)
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


def _error_length(graded: Score) -> FloatArray:
    return np.hypot(graded.error_px[:, 0], graded.error_px[:, 1])


def colour(n: int) -> str:
    """Of the n-th code in all curves and bars, "#rrggbb"."""
    return str(to_hex(CODE_COLOURS[n % len(CODE_COLOURS)]))


GRADING_TEMPLATE = "scores.html"

"""Rows of the table beside the regions."""


def write_grading(folder: Path | str, grading: Grading) -> None:
    """Write ``scores.json``, ``scores.csv`` and ``report.html``, each whole or not at all."""
    folder = Path(folder)
    write_json(folder / "scores.json", without_nan(grading_summary(grading)))
    with atomic(folder / "scores.csv") as part:
        part.write_text("\n".join(csv_lines(grading)) + "\n", "utf-8")
    with atomic(folder / "report.html") as part:
        part.write_text(grading_page(grading), "utf-8")


def grading_page(grading: Grading) -> str:
    """The report, HTML."""
    shared = ErrorMaps.of(grading.truth.solution.mesh, grading.truth.grid, grading.scores)
    maps = [FieldMaps(shared, graded) for graded in grading.scores]
    curves = [
        _picture("histogram", "Histogram of errors", draw_histogram(grading.scores)),
        _picture("distribution", "Share of points with a larger error",
                 draw_distribution(grading.scores)),
        _picture("regions", "By region", draw_regions(grading.scores)),
    ]  # fmt: skip
    if any(grading.spectra.values()):
        drawn = draw_spectra(grading.spectra)
        curves.append(_picture("spectrum", "By wavelength", drawn))
    return render(
        GRADING_TEMPLATE,
        title=f"Benchmark {grading.truth.id} at {100 * grading.strain:g} %",
        grading=grading,
        hero=to_svg(maps[0].draw_length(), "best", "Length of the best one's error"),
        everywhere=EVERYWHERE,
        common=COMMON,
        percentiles=PERCENTILES,
        regions=REGIONS,
        colour=colour,
        three=_three_digits,
        curves=curves,
        fields=[_field(of_field, n) for n, of_field in enumerate(maps)],
    )


def _field(maps: FieldMaps, n: int) -> dict[str, Any]:
    """A field's maps."""
    return {
        "score": maps.graded,
        "pictures": [
            _picture(f"length-{n}", "Length of the error", maps.draw_length()),
            _picture(f"x-{n}", "Error along x", maps.draw_component(0)),
            _picture(f"y-{n}", "Error along y", maps.draw_component(1)),
        ],
    }


def _three_digits(value: float) -> str:
    return short(float(f"{value:.3g}"))


def _picture(name: str, label: str, drawn: Figure) -> Picture:
    return Picture(name, label, to_svg(drawn, name, label))


STAR_COLOURS = (BLUE, RED, GREEN, GOLD, *mpl.colormaps["tab10"].colors[4:])  # type: ignore[attr-defined]
"""A code keeps its colour in all pictures."""
_CELL_PX = 10
"""Edge of a cell of the maps; the image has far more pixels than a page."""


def draw_attenuation(grades: Sequence[StarGrade]) -> Figure:
    """Draw T over the period, a band of two standard errors about it, and where it crosses 0.9."""
    with style():
        drawn, axes = _curve("period of the wave [px]", "share of its amplitude that is left [–]")
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        for n, grade in enumerate(grades):
            found = grade.attenuation
            share, error = found.curve
            colour = STAR_COLOURS[n % len(STAR_COLOURS)]
            axes.fill_between(found.period, share - 2 * error, share + 2 * error, color=colour,
                              alpha=0.2, linewidth=0)  # fmt: skip
            axes.plot(found.period, share, color=colour, label=grade.name)
            if np.isfinite(found.finest_px):
                axes.plot([found.finest_px], [KEPT], "o", ms=4.5, color=colour)
        axes.set(xscale="log", ylim=(-0.3, 1.15))
        _plain_numbers(axes.xaxis)
        _legend(axes)
    return drawn


def draw_trade_off(grades: Sequence[StarGrade]) -> Figure:
    """Draw the noise floor over l10, lines of equal indicator below."""
    known = [g for g in grades if np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0]
    with style():
        drawn, axes = _curve("l₁₀ % [px]", "noise floor n [px]")
        x = [g.attenuation.finest_px for g in known]
        y = [g.noise.v_px for g in known if g.noise is not None]
        low, high = 0.7 * min(x), 1.5 * max(x)
        bottom, top = 0.6 * min(y), 1.7 * max(y)
        for value in _round_values(min(x) * min(y), max(x) * max(y)):
            axes.plot([low, high], [value / low, value / high], color=MUTED, linewidth=0.6,
                      alpha=0.6)  # fmt: skip
            end = min(high, value / (1.04 * bottom))
            if low < end and value / end < top:
                axes.annotate(f"{value:g} px²", (end, value / end), (-3, 3), fontsize=6.5,
                              textcoords="offset points", ha="right", color=MUTED)  # fmt: skip
        for n, grade in enumerate(grades):
            if grade not in known or grade.noise is None:
                continue
            axes.errorbar(grade.attenuation.finest_px, grade.noise.v_px,
                          2 * grade.noise.v_se_px, 2 * grade.attenuation.finest_se_px, marker="o",
                          ms=5, capsize=2, color=STAR_COLOURS[n % len(STAR_COLOURS)], linewidth=1,
                          linestyle="none", label=grade.name)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(bottom, top))
        _plain_numbers(axes.xaxis)
        _plain_numbers(axes.yaxis)
        _legend(axes)
    return drawn


def draw_centre_row(found: Attenuation, colour: str = BLUE) -> Figure:
    """Draw the centre row's T, raw, and the smoothed curve through all rows."""
    with style():
        drawn, axes = _curve("period of the wave [px]", "measured over true [–]", (9.0, 2.1))
        axes.plot(found.centre.period, found.centre.share, color=MUTED, linewidth=0.5, alpha=0.8)
        axes.plot(found.period, found.curve[0], color=colour, linewidth=1.8)
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        low, high = np.quantile(found.centre.share, (0.005, 0.995))
        axes.set_ylim(min(low, 0.0) - 0.05, max(high, 1.0) + 0.05)
    return drawn


def draw_map(grade: StarGrade, values: FloatArray, end: float | None = None) -> Figure:
    """Draw displacements or errors (n,) of a code's points along y [px], down is positive.

    ``end`` is that of the colours; by default what 99 % of the values stay below.
    """
    star = grade.star
    seen = np.isfinite(values)
    at = -grade.moved.y[seen], grade.moved.x[seen]
    reach = min(0.5 * star.rows, float(np.abs(at[0]).max()) + _CELL_PX)
    shape = (max(1, round(2 * reach / _CELL_PX)), max(1, star.cols // _CELL_PX))
    limits = ((-reach, reach), (-0.5, star.cols - 0.5))
    count = np.histogram2d(*at, shape, limits)[0]
    total = np.histogram2d(*at, shape, limits, weights=values[seen])[0]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    top = float(np.quantile(np.abs(values[seen]), 0.99)) if end is None else end
    with style():
        drawn = figure(9.0, 1.75)
        axes = drawn.add_axes((0.035, 0.24, 0.88, 0.72))
        image = axes.imshow(mean, cmap=SIGNED, vmin=-top, vmax=top, aspect="auto",
                            extent=(*limits[1], *limits[0][::-1]),
                            interpolation="nearest")  # fmt: skip
        periods = [p for p in (10, 25, 50, 100, 150, 200, 250, 300)
                   if star.shortest_px <= p <= star.longest_px]  # fmt: skip
        axes.set_xticks(star.column(periods), [str(p) for p in periods])
        axes.set_xlabel("period [px]")
        axes.set_yticks([])
        bar = drawn.add_axes((0.93, 0.24, 0.011, 0.72))
        drawn.colorbar(image, cax=bar).ax.set_title("px", fontsize=7.5)
    return drawn


def _curve(x: str, y: str, size: tuple[float, float] = (5.2, 3.3)) -> tuple[Figure, Axes]:
    """An empty picture for curves."""
    drawn = figure(*size)
    axes = drawn.add_subplot()
    axes.set(xlabel=x, ylabel=y)
    axes.grid(color=MUTED, alpha=0.18, lw=0.6)
    drawn.subplots_adjust(0.6 / size[0], 0.45 / size[1], 0.985, 0.92 if size[1] > 3 else 0.96)
    return drawn, axes


def _round_values(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from below ``low`` to above ``high``."""
    first, last = int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1
    every = [m * 10.0**p for p in range(first, last + 1) for m in (1, 2, 5)]
    return [v for v in every if 0.3 * low <= v <= 3.0 * high]


def _plain_numbers(axis: Axis) -> None:
    """Write 20 rather than 2 x 10^1."""
    shown = FuncFormatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "1235" else "")
    axis.set_major_formatter(shown)
    axis.set_minor_formatter(shown)
    axis.set_tick_params(which="minor", labelsize=7, labelcolor=INK)


def _legend(axes: Axes) -> None:
    """Names above the picture, where no curve is."""
    count = len(axes.get_legend_handles_labels()[0])
    if count:
        axes.legend(frameon=False, fontsize=7.5, ncols=min(count, 4), loc="lower right",
                    bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)  # fmt: skip


STAR_TEMPLATE = "star.html"

"""Heading of a number in tables: its key in ``resolution.json``."""


def write_star_grading(folder: Path | str, grading: StarGrading) -> None:
    """Write the three files, each whole or not at all."""
    folder = Path(folder)
    write_json(folder / "resolution.json", star_summary(grading))
    with atomic(folder / "resolution.csv") as part:
        part.write_text("\n".join(star_csv_lines(grading.grades)) + "\n", "utf-8")
    with atomic(folder / "report.html") as part:
        part.write_text(star_page(grading), "utf-8")


def star_page(grading: StarGrading) -> str:
    """The report, HTML."""
    grades = grading.grades
    curves = [_star_picture("attenuation", "What is left of a wave", draw_attenuation(grades))]
    if any(np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0 for g in grades):
        curves.append(
            _star_picture("trade-off", "Noise against resolution", draw_trade_off(grades))
        )
    return render(
        STAR_TEMPLATE,
        title="How fine a displacement is resolved",
        grading=grading,
        star=grading.star_set.spec.star,
        columns=GRADE_COLUMNS,
        rows=[grade_numbers(grade) for grade in grades],
        curves=curves,
        codes=[_code(grade, n) for n, grade in enumerate(grades)],
    )


def _code(grade: StarGrade, n: int) -> dict[str, Any]:
    """A code's row and maps."""
    colour = STAR_COLOURS[n % len(STAR_COLOURS)]
    down = np.where(grade.moved.good, -grade.moved.u[:, 1], np.nan)
    maps = {
        "row": ("Along the centre row", draw_centre_row(grade.attenuation, colour)),
        "v": ("v, down", draw_map(grade, down, 1.2 * grade.star.amplitude_px)),
        "error": ("Its error, down", draw_map(grade, -grade.error_px[:, 1])),
    }
    pictures = [_star_picture(f"{key}-{n}", *drawn) for key, drawn in maps.items()]
    return {"name": grade.name, "pictures": pictures}


def _star_picture(name: str, label: str, drawn: Figure) -> Picture:
    return Picture(name, label, to_svg(drawn, name, label))
