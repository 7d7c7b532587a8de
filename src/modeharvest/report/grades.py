"""Reports of graded DIC codes: errors on a benchmark, resolution on the star pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.report.explore import explored_scores
from modeharvest.report.figures import maps, style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import curve, legend_above, plain_ticks
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.output import write_page
from modeharvest.report.model.text import Cell, caption, number, text_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.files import atomic, write_json
from modeharvest.validation.scoring.score import (
    COMMON,
    EVERYWHERE,
    PERCENTILES,
    REGIONS,
    ErrorSpectrum,
    Grading,
    RegionScore,
    Score,
    csv_lines,
    grading_summary,
)
from modeharvest.validation.scoring.star import KEPT
from modeharvest.validation.scoring.star_grades import (
    GRADE_COLUMNS,
    Attenuation,
    StarGrade,
    StarGrading,
    grade_numbers,
    star_csv_lines,
    star_summary,
)

_CELLS = 300
_SHARES = np.logspace(-4, 0, 200)
_CELL_PX = 10
"""Edge of a cell of the star's maps [px]; the image has far more pixels than a page can show."""


def length_scale(scores: Sequence[Score]) -> maps.ColourScale:
    """Logarithmic scale [px] from 2nd to 98th percentiles of all errors, at most four decades."""
    lengths = [_error_length(graded) for graded in scores if len(graded.error_px)]
    ends = [np.quantile(one[one > 0], (0.02, 0.98)) for one in lengths if (one > 0).any()]
    low = min((end[0] for end in ends), default=1e-3)
    high = max((end[1] for end in ends), default=1.0)
    low = max(low, 1e-4 * high)
    return maps.ColourScale(style.SIZE, low, max(high, 2.0 * low), "px", "both", is_log=True)


@dataclass(frozen=True, eq=False)
class ErrorMaps:
    """Maps of the errors of one displacement field; blank where nothing was measured."""

    map_frame: maps.MapFrame
    graded: Score

    @cached_property
    def nearest(self) -> NDArray[np.intp]:
        """(rows, cols) index of each map cell's nearest point; the number of points if too far."""
        graded, grid = self.graded, self.map_frame.grid
        if not len(graded.x):
            return np.zeros(grid.shape, dtype=np.intp)
        reach = max(graded.reach_px * grid.pixel_size / self.map_frame.factor, grid.pixel_size)
        points = np.column_stack([graded.x, graded.y])
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        pixels = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
        return np.asarray(tree.query(pixels, distance_upper_bound=reach)[1])

    def _draw(self, values: FloatArray, scale: maps.ColourScale) -> Figure:
        return maps.draw_field(self.map_frame, np.append(values, np.nan)[self.nearest], scale)

    def draw_length(self, scale: maps.ColourScale) -> Figure:
        """Draw the length of the error; 0, which has no logarithm, in the scale's lowest colour."""
        return self._draw(np.maximum(_error_length(self.graded), 1e-3 * scale.low), scale)

    def draw_component(self, component: int) -> Figure:
        """Draw the error along x (0) or y (1); both components of a field have the same scale."""
        error = self.graded.error_px
        return self._draw(error[:, component], maps.ColourScale.signed(error, "px", 0.98))


def draw_distribution(scores: Sequence[Score]) -> Figure:
    """Draw the share of points with a larger error, over the error; lost points count as larger."""
    drawn, axes = curve("length of the error [px]", "share of points with a larger error [%]")
    for n, graded in enumerate(scores):
        length, points = np.sort(_error_length(graded))[::-1], graded.everywhere.points
        if len(length):
            share = (points - len(length) + np.arange(1, len(length) + 1)) / points
            some = np.searchsorted(share, _SHARES).clip(0, len(share) - 1)
            axes.loglog(np.maximum(length[some], 1e-9), 100 * share[some], color=style.colour(n),
                        label=graded.source)  # fmt: skip
    axes.set(ylim=(0.01, 120))
    return _finished(drawn)


def draw_histogram(scores: Sequence[Score]) -> Figure:
    """Draw a histogram of the errors' lengths, in tenths of a decade, one curve for each field."""
    drawn, axes = curve("length of the error [px]", "share of points per tenth of a decade [%]")
    for n, graded in enumerate(scores):
        length = np.maximum(_error_length(graded), 1e-9)
        if len(length):
            low, high = (int(np.floor(10 * np.log10(end))) for end in (length.min(), length.max()))
            edges = 10.0 ** (np.arange(low, high + 2) / 10)
            share = 100 * np.histogram(length, edges)[0] / graded.everywhere.points
            axes.stairs(share, edges, lw=1.5, color=style.colour(n), label=graded.source)
    axes.set(xscale="log", ylim=(0, None))
    return _finished(drawn)


def draw_regions(scores: Sequence[Score]) -> Figure:
    """Draw the rms error in each region as bars."""
    drawn, axes = curve("", "rms per component [px]")
    width = 0.8 / max(len(scores), 1)
    for n, graded in enumerate(scores):
        at = np.arange(len(REGIONS)) + (n - 0.5 * (len(scores) - 1)) * width
        rms = [graded.by_region[name].rms_px for name in REGIONS]
        axes.bar(at, np.nan_to_num(rms), 0.92 * width, color=style.colour(n), label=graded.source)
    axes.set_xticks(range(len(REGIONS)), REGIONS)
    known = [
        part.rms_px for graded in scores for part in graded.by_region.values() if part.rms_px > 0
    ]
    if known and max(known) > 10.0 * min(known):
        axes.set_yscale("log")
    return _finished(drawn)


def draw_spectra(spectra: Mapping[str, ErrorSpectrum | None]) -> Figure:
    """Draw the rms error over the wavelength, in thirds of an octave."""
    drawn, axes = curve("wavelength [px]", "rms per component in a third of an octave [px]")
    for n, (name, spectrum) in enumerate(spectra.items()):
        if spectrum is not None and (spectrum.rms_px > 0).any():
            axes.loglog(spectrum.wavelength_px, spectrum.rms_px, marker="o", ms=2.5,
                        color=style.colour(n), label=name)  # fmt: skip
    return _finished(drawn)


def _finished(drawn: Figure) -> Figure:
    """Add a legend above the curves, and plain numbers on logarithmic axes."""
    axes = drawn.axes[0]
    plain_ticks(*(axis for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() == "log"))
    legend_above(axes)
    return drawn


def _error_length(graded: Score) -> FloatArray:
    return np.hypot(graded.error_px[:, 0], graded.error_px[:, 1])


def write_grading(folder: Path | str, grading: Grading | StarGrading) -> None:
    """Write a grading as JSON, CSV and ``report.html``, each file atomically.

    JSON and CSV are named ``scores`` for displacement fields, ``resolution`` for the star pattern.
    """
    if isinstance(grading, Grading):
        path, report = Path(folder, "scores"), grading_report(grading)
        numbers, lines = grading_summary(grading), csv_lines(grading)
    else:
        path, report = Path(folder, "resolution"), star_report(grading)
        numbers, lines = star_summary(grading), star_csv_lines(grading.grades)
    write_json(path.with_suffix(".json"), numbers)
    with atomic(path.with_suffix(".csv")) as part:
        part.write_text("\n".join(lines) + "\n", "utf-8")
    write_page(report, path.with_name("report.html"))


def grading_report(grading: Grading) -> Report:
    """The report of graded and ranked displacement fields."""
    scores, best = grading.scores, grading.scores[0]
    boundary = MeshBoundary.of(grading.truth.solution.mesh)
    frame, scale = maps.MapFrame.of(boundary, grading.truth.grid, _CELLS), length_scale(scores)
    drawn = [ErrorMaps(frame, graded) for graded in scores]
    several = len(scores) > 1
    what = text_of("scores-several" if several else "scores-one", count=len(scores))
    common = text_of("scores-common", name=COMMON, share=100 * grading.common_share)
    return Report(
        kind="scores",
        title=f"Benchmark {grading.truth.id} at {100 * grading.strain:g} %",
        keys=[
            KeyNumber.of("score", first="Best: " * several, best=best),
            KeyNumber.of("most-points", best=best),
            KeyNumber.of("covered", f"{100 * best.covered:.1f}"),
        ],
        sections=[
            Section.of("ranking", _ranking(grading), "scores", edge=grading.edge_px,
                       common=common if several else ""),
            Section.of("curves", _score_curves(grading), "score-curves"),
            Section.of("maps", [_score_maps(field, scale, n) for n, field in enumerate(drawn)],
                       "score-maps"),
        ],
        warnings=grading.notes,
        explore=partial(explored_scores, grading, lambda at, s: ErrorMaps(at, s).nearest),
        hero=ReportFigure("best", "Length of the error", partial(drawn[0].draw_length, scale)),
        hero_caption=f"Length of the error of {best.source}.",
        **caption("page-scores", what=what, strain=grading.strain),
    )  # fmt: skip


def _ranking(grading: Grading) -> list[Card]:
    several = len(grading.scores) > 1
    columns = ["field", "rms [px]", "50 % [px]", "95 % [px]", "largest [px]",
               *(f"rms, {name} [px]" for name in REGIONS),
               *([f"rms, {COMMON} [px]"] if several else []),
               "points", "returned", "material covered"]  # fmt: skip
    rows: list[list[Cell]] = []
    details: list[list[Cell]] = []
    for rank, graded in enumerate(grading.scores, start=1):
        every, name = graded.everywhere, f"{rank}. {graded.source}"
        row: list[Cell] = [name, *_three(every.rms_px, *every.percentiles_px[::2], every.max_px)]
        row += _three(*(graded.by_region[region].rms_px for region in REGIONS))
        row += _three(grading.common[graded.source].rms_px) if several else []
        rows.append([*row, every.points, _returned(every), f"{100 * graded.covered:.1f} %"])
        details += [
            [name if where == EVERYWHERE else "", where, part.points, _returned(part),
             *_three(*part.bias_px, part.rms_px, *part.percentiles_px, part.max_px)]
            for where, part in grading.parts(graded).items()
        ]  # fmt: skip
    heads = ["field", "where", "points", "returned", "bias along x [px]", "bias along y, up [px]",
             "rms [px]", *(f"{p} % [px]" for p in PERCENTILES), "largest [px]"]  # fmt: skip
    tables = [
        ReportTable("Ranking", columns, rows, on_terminal=True),
        ReportTable("Bias and percentiles, by region", heads, details, folded=True),
    ]
    return [Card("Ranking", tables=tables, wide=True)]


def _three(*values: float) -> list[str]:
    return [number(value, 3) for value in values]


def _returned(part: RegionScore) -> str:
    return f"{100 * part.returned:.1f} %" if part.points else "–"


def _score_curves(grading: Grading) -> list[Card]:
    scores = grading.scores
    drawn = {
        "histogram": partial(draw_histogram, scores),
        "distribution": partial(draw_distribution, scores),
        "regions": partial(draw_regions, scores),
    }
    if any(grading.spectra.values()):
        drawn["spectrum"] = partial(draw_spectra, grading.spectra)
    return [Card.captioned(name, draw) for name, draw in drawn.items()]


def _score_maps(drawn: ErrorMaps, scale: maps.ColourScale, n: int) -> Card:
    graded = drawn.graded
    figures = [
        ReportFigure(f"length-{n}", "Length of the error", partial(drawn.draw_length, scale)),
        ReportFigure(f"x-{n}", "Error along x", partial(drawn.draw_component, 0)),
        ReportFigure(f"y-{n}", "Error along y", partial(drawn.draw_component, 1)),
    ]
    text = f"a point every {number(round(graded.spacing_px, 2))} px"
    if graded.off_material:
        text += f", {number(graded.off_material)} points off the material not graded"
    return Card(f"{n + 1}. {graded.source}", figures, paper=text, wide=True)


def draw_attenuation(grades: Sequence[StarGrade]) -> Figure:
    """Draw T over the period with a band of ± two standard errors; dots where it rises to 0.9."""
    drawn, axes = curve("period of the wave [px]", "measured over true amplitude [–]")
    axes.axhline(KEPT, color=style.MUTED, linestyle=":", linewidth=1)
    for n, grade in enumerate(grades):
        found = grade.attenuation
        share, error = found.curve
        axes.fill_between(found.period, share - 2 * error, share + 2 * error, color=style.colour(n),
                          alpha=0.2, linewidth=0)  # fmt: skip
        axes.plot(found.period, share, color=style.colour(n), label=grade.name)
        if np.isfinite(found.finest_px):
            axes.plot([found.finest_px], [KEPT], "o", ms=4.5, color=style.colour(n))
    axes.set(xscale="log", ylim=(-0.3, 1.15))
    return _finished(drawn)


def draw_trade_off(grades: Sequence[StarGrade]) -> Figure:
    """Draw the noise floor n over l10, with lines of equal indicator n l10 in the background."""
    known = [g for g in grades if np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0]
    drawn, axes = curve("l₁₀ % [px]", "noise floor n [px]")
    x = [g.attenuation.finest_px for g in known]
    y = [g.noise.v_px for g in known if g.noise is not None]
    low, high = 0.7 * min(x), 1.5 * max(x)
    bottom, top = 0.6 * min(y), 1.7 * max(y)
    for value in _round_values(min(x) * min(y), max(x) * max(y)):
        axes.plot([low, high], [value / low, value / high], color=style.MUTED, linewidth=0.6,
                  alpha=0.6)  # fmt: skip
        end = min(high, value / (1.04 * bottom))
        if low < end and value / end < top:
            axes.annotate(f"{value:g} px²", (end, value / end), (-3, 3), fontsize=6.5,
                          textcoords="offset points", ha="right", color=style.MUTED)  # fmt: skip
    for n, grade in enumerate(grades):
        if grade in known and grade.noise is not None:
            axes.errorbar(grade.attenuation.finest_px, grade.noise.v_px, 2 * grade.noise.v_se_px,
                          2 * grade.attenuation.finest_se_px, marker="o", ms=5, capsize=2,
                          color=style.colour(n), lw=1, ls="none", label=grade.name)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(bottom, top))
    return _finished(drawn)


def draw_centre_row(found: Attenuation, look: str = style.BLUE) -> Figure:
    """Draw the unsmoothed T of the centre row, and the smoothed T of all rows near it."""
    drawn, axes = curve("period of the wave [px]", "measured over true [–]", (9.0, 2.1))
    axes.plot(found.centre.period, found.centre.share, color=style.MUTED, linewidth=0.5, alpha=0.8)
    axes.plot(found.period, found.curve[0], color=look, linewidth=1.8)
    axes.axhline(KEPT, color=style.MUTED, linestyle=":", linewidth=1)
    low, high = np.quantile(found.centre.share, (0.005, 0.995))
    axes.set_ylim(min(low, 0.0) - 0.05, max(high, 1.0) + 0.05)
    return drawn


def draw_map(grade: StarGrade, values: FloatArray, end: float | None = None) -> Figure:
    """Draw displacements or errors (n,) along y at a code's points [px], positive downwards.

    ``end``: end of the colour scale [px]; by default the 99th percentile of the magnitudes.
    """
    star = grade.star
    valid = np.isfinite(values)
    at = -grade.moved.y[valid], grade.moved.x[valid]
    reach = min(0.5 * star.rows, float(np.abs(at[0]).max()) + _CELL_PX)
    shape = (max(1, round(2 * reach / _CELL_PX)), max(1, star.cols // _CELL_PX))
    limits = ((-reach, reach), (-0.5, star.cols - 0.5))
    count = np.histogram2d(*at, shape, limits)[0]
    total = np.histogram2d(*at, shape, limits, weights=values[valid])[0]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    top = float(np.quantile(np.abs(values[valid]), 0.99)) if end is None else end
    drawn = style.figure(9.0, 1.75)
    axes = drawn.add_axes((0.035, 0.24, 0.88, 0.72))
    scale = maps.ColourScale(style.SIGNED, -top, top, "px")
    axes.imshow(scale.of(mean), aspect="auto", extent=(*limits[1], *limits[0][::-1]),
                interpolation="nearest")  # fmt: skip
    periods = [p for p in (10, 25, 50, 100, 150, 200, 250, 300)
               if star.shortest_px <= p <= star.longest_px]  # fmt: skip
    axes.set_xticks(star.column(periods), [str(p) for p in periods])
    axes.set_xlabel("period [px]")
    axes.set_yticks([])
    maps.colour_bar(axes, scale)
    return drawn


def _round_values(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten, from 0.3 times ``low`` to 3 times ``high``."""
    first, last = int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1
    every = [m * 10.0**p for p in range(first, last + 1) for m in (1, 2, 5)]
    return [v for v in every if 0.3 * low <= v <= 3.0 * high]


def star_report(grading: StarGrading) -> Report:
    """The report of codes graded on the star pattern."""
    grades, star = grading.grades, grading.star_set.spec.star
    rows = [grade_numbers(grade) for grade in grades]
    best, several = rows[0], len(rows) > 1
    cells = [[f"{n}. {row['name']}", *(row[key] for key in GRADE_COLUMNS)]
             for n, row in enumerate(rows, start=1)]  # fmt: skip
    heads = ["code", *GRADE_COLUMNS.values()]
    table = ReportTable("Ranking", heads, cells, on_terminal=True)
    words = caption(
        "page-resolution", amplitude=star.amplitude_px, shortest=number(star.shortest_px),
        longest=number(star.longest_px), id=grading.star_set.id,
    )  # fmt: skip
    return Report(
        kind="resolution",
        keys=[
            KeyNumber.of("indicator", first="Best: " * several, best=best),
            KeyNumber.of("finest", best=best),
            KeyNumber.of("noise-floor", best=best),
        ],
        sections=[
            Section.of("ranking", Card.tabular(table, wide=True), "resolution"),
            Section.of("curves", _star_curves(grades), "star-curves"),
            Section.of("maps", [_star_maps(grade, n) for n, grade in enumerate(grades)],
                       "star-maps"),
        ],
        warnings=grading.notes,
        **words,
    )  # fmt: skip


def _star_curves(grades: Sequence[StarGrade]) -> list[Card]:
    drawn = {"attenuation": partial(draw_attenuation, grades)}
    if any(np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0 for g in grades):
        drawn["trade-off"] = partial(draw_trade_off, grades)
    return [Card.captioned(name, draw) for name, draw in drawn.items()]


def _star_maps(grade: StarGrade, n: int) -> Card:
    down = np.where(grade.moved.good, -grade.moved.u[:, 1], np.nan)
    end = 1.2 * grade.star.amplitude_px
    row = partial(draw_centre_row, grade.attenuation, style.colour(n))
    error = partial(draw_map, grade, -grade.error_px[:, 1])
    figures = [
        ReportFigure(f"row-{n}", "Along the centre row", row, wide=True),
        ReportFigure(f"v-{n}", "v, down", partial(draw_map, grade, down, end), wide=True),
        ReportFigure(f"error-{n}", "Its error, down", error, wide=True),
    ]
    return Card(f"{n + 1}. {grade.name}", figures, wide=True)
