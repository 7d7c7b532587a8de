"""Measured fields on photographs, as figures, animations and PDF, and readings of gauges."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.photograph.finished import FinishedRun
from modeharvest.idic.photograph.gauges import Gauge, GaugeReading, Readings
from modeharvest.report.figures import maps, style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.model.content import Card, ReportFigure, ReportTable
from modeharvest.report.model.text import caption, number
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import MissingDependencyError
from modeharvest.util.files import atomic
from modeharvest.util.progress import Progress, counted, silent

PRINTED = ("u", "v", "logarithmic_xx", "logarithmic_yy", "logarithmic_xy", "rotation", "stretch_1")
_WIDTH, _CELLS, _DPI, _MS, _MOST_ROWS = 5.6, 700, 120, 400, 60
_OPAQUE, _KEPT = 0.65, 0.995  # opacity over a photograph; upper quantile, where colours end
Draw = Callable[[], Figure]


def draw_on_photograph(
    result: NodalResult, values: FloatArray, scale: maps.ColourScale,
    picture: FloatImage | None, title: str = "", unit: str = "mm",
) -> Figure:  # fmt: skip
    """Draw nodal values (n,) over the deformed photograph (rows, cols), 0 to 1, if there is one."""
    grid, moved = result.grid, result.displacement
    factor = max(1, round(max(grid.shape) / _CELLS))
    frame = maps.MapFrame(MeshBoundary.of(result.mesh), grid.binned(factor), factor, grid.extent)
    drawn, axes = maps.empty_map(frame, _WIDTH, unit)
    if picture is not None:
        maps.show_grey(axes, frame, picture, None, grid)
    maps.shaded(axes, result.mesh, moved, values, scale)
    edge = maps.draw_edge(axes, frame.boundary.path(moved), clip_on=True)
    if picture is not None:  # again, on top: sides of transparent triangles would be visible
        maps.show_grey(axes, frame, picture, None, grid)
        axes.images[-1].set(alpha=1.0 - _OPAQUE, clip_path=edge, zorder=1.4)
    axes.set(xlim=frame.limits[:2], ylim=frame.limits[2:])
    axes.text(0.0, 1.02, title, transform=axes.transAxes, fontsize=8.5)
    maps.colour_bar(axes, scale)
    return drawn


def frames(run: FinishedRun, name: str, progress: Progress = silent) -> list[Draw]:
    """Functions that draw a field's component on each photograph of a run, in common colours."""
    ends, unit = [], ""
    for image in counted(tuple(run.files), progress, "colours"):
        values, unit = run.component(image, name)
        ends.append(np.nanquantile(values, [1.0 - _KEPT, _KEPT]))
    low, high = float(np.min(ends)), float(np.max(ends))
    scale = maps.ColourScale(style.SIZE, low, high, unit, "both")
    if low < 0.0 < high:
        scale = maps.ColourScale.signed(np.array([low, high]), unit)

    def draw(image: str) -> Figure:
        title, (values, _) = f"{name.replace('_', ' ')}, {image}", run.component(image, name)
        picture = run.picture(image)
        return draw_on_photograph(run.result(image), values, scale, picture, title, run.unit)

    return [partial(draw, image) for image in run.files]


def animate(run: FinishedRun, name: str, path: Path, progress: Progress = silent) -> None:
    """Write an animation of a field on a run's photographs, as GIF or (by imageio-ffmpeg) MP4."""
    drawn = map(_pixels, counted(frames(run, name, progress), progress, "draw"))
    with atomic(path) as part:
        if path.suffix == ".gif":
            rest = (Image.fromarray(p).quantize(255, Image.Quantize.MAXCOVERAGE) for p in drawn)
            next(rest).save(part, "gif", save_all=True, append_images=rest, duration=_MS, loop=0)
            return
        try:
            from imageio_ffmpeg import write_frames
        except ImportError as error:
            how = "MP4 is written by imageio-ffmpeg: 'pip install imageio-ffmpeg', or take GIF"
            raise MissingDependencyError(how) from error
        stream: Any = None
        for picture in drawn:
            if stream is None:
                size, to = picture.shape[1::-1], ["-f", "mp4"]
                stream = write_frames(str(part), size, fps=1e3 / _MS, output_params=to)
                stream.send(None)
            stream.send(picture)
        stream.close()


def _pixels(draw: Draw) -> NDArray[np.uint8]:
    """(rows, cols, 3) pixels of a figure, padded to multiples of 16 as video formats need."""
    with style.style():
        drawn = draw()
        drawn.set(dpi=_DPI, facecolor="white")
        canvas: Any = FigureCanvasAgg(drawn)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        more = [(0, -n % 16) for n in pixels.shape[:2]]
        return np.pad(pixels, [*more, (0, 0)], constant_values=255)


def draw_gauge(name: str, readings: Sequence[Readings], strain: FloatArray | None = None,
               along: str = "x") -> Figure:  # fmt: skip
    """Draw the strains read by a gauge in each image, with 95 % intervals.

    The abscissa is the image's number, or if given, ``strain`` (n,) of each image [-].
    """
    drawn = style.figure(3.6, 2.4)
    axes = drawn.add_axes((0.22, 0.19, 0.75, 0.69))
    number = np.arange(1, len(readings) + 1)
    at = number if strain is None else 100.0 * strain
    for k, what in enumerate(what for what in readings[0] if "strain" in what):
        value, sd = np.array([r[what][:2] for r in readings], dtype=np.float64).T
        axes.errorbar(at, value, 1.96 * np.nan_to_num(sd), color=style.colour(k), marker="o",
                      ms=3, capsize=2, lw=1.2, label=what.replace("_", " "))  # fmt: skip
    axes.set(xlabel=f"mean strain along {along} [%]", ylabel="strain [-]")
    if strain is None:
        axes.set(xlabel="image", xticks=number[:: 1 + len(number) // 10])
    axes.set_title(name, fontsize=8.5, loc="left")
    axes.legend()
    return drawn


def draw_gauges_on(
    result: NodalResult, gauges: Sequence[Gauge], picture: FloatImage | None, unit: str
) -> Figure:
    """Draw displaced gauges on the deformed photograph (rows, cols), 0 to 1, if there is one."""
    grid = result.grid
    factor = max(1, round(max(grid.shape) / _CELLS))
    frame = maps.MapFrame(MeshBoundary.of(result.mesh), grid.binned(factor), factor, grid.extent)
    drawn, axes = maps.empty_map(frame, _WIDTH, unit)
    if picture is not None:
        maps.show_grey(axes, frame, picture, None, grid)
    for k, gauge in enumerate(gauges):
        corners = gauge.corners(grid)
        moved = corners + np.nan_to_num(result.at(corners))  # NaN for corners in a hole
        closed = np.vstack([moved, moved[:1]]) if gauge.polygon else moved
        axes.plot(*closed.T, "o-", color=style.colour(k), ms=4, lw=1.6)
        axes.annotate(gauge.name, moved[0], (6, 6), textcoords="offset points", fontsize=8.5,
                      color=style.colour(k), bbox={"fc": "white", "lw": 0, "pad": 1.5})  # fmt: skip
    axes.set(xlim=frame.limits[:2], ylim=frame.limits[2:])
    return drawn


def axis_text(angle: float) -> str:
    """Text for the axis of a specimen at an angle to x [degrees]."""
    return f"the specimen’s axis, {angle:g}° to x" if angle else "x"


def gauge_cards(
    rows: Sequence[Mapping[str, Any]], strains: Mapping[str, float], placed: Draw | None,
    along: str = "x",
) -> list[Card]:  # fmt: skip
    """Make cards of the gauges on the last photograph, their strains, and the last readings.

    ``rows``: readings in ``summary.json``; ``strains``: mean strain [-] ``along`` an axis by image
    name, in the order of the test; ``placed``: draws the gauges, None for no figure of them.
    """
    if not rows:
        return []
    last = [*strains][-1]
    cards = [] if placed is None else [Card.captioned("gauges-placed", placed, image=last)]
    for k, gauge in enumerate(dict.fromkeys(row["gauge"] for row in rows)):
        own = [
            {row["reads"]: GaugeReading(row["value"], row["sd"], row["unit"])
             for row in rows if row["gauge"] == gauge and row["image"] == image}
            for image in strains
        ]  # fmt: skip
        drawn = partial(draw_gauge, gauge, own, np.array([*strains.values()]), along)
        figure = ReportFigure(f"gauge-{k + 1}", "", drawn)
        cards.append(Card(**caption("gauge", gauge=gauge), figures=[figure]))
    table = [
        {**row, "reads": row["reads"].replace("_", " "), "value": number(row["value"], 5),
         "sd": number(row["sd"], 2)}
        for row in rows if row["image"] == last
    ]  # fmt: skip
    return [*cards, *Card.tabular(ReportTable.of("gauges", table, image=last), wide=True)]


def print_fields(
    run: FinishedRun, names: Sequence[str], path: Path, progress: Progress = silent
) -> None:
    """Write a PDF of fields on all photographs of a run, with a table of their quantiles."""
    pages, rows = list[Draw](), [["image", "field", "5 %", "median", "95 %", "unit"]]
    for name in names:
        pages += frames(run, name, progress)
        for image in run.files:
            values, unit = run.component(image, name)
            some = np.nanquantile(values, [0.05, 0.5, 0.95])
            rows.append([image, name, *(f"{value:.4g}" for value in some), unit])
    write_pdf(path, "Displacement and strain", rows, pages)


def write_pdf(
    path: Path, title: str, numbers: Sequence[Sequence[str]], pages: Iterable[Draw]
) -> None:
    """Write a PDF: a title, a table of numbers (headings in the first row), a page per figure."""
    head, *rows = map(list, numbers)
    with atomic(path) as part, style.style(), PdfPages(part) as pdf:
        save = partial(pdf.savefig, dpi=200, bbox_inches="tight", pad_inches=0.4)
        for k in range(0, max(len(rows), 1), _MOST_ROWS):
            axes = (cover := style.figure(8.27, 11.69)).add_axes((0.08, 0.05, 0.84, 0.88))
            axes.set_axis_off()
            axes.set_title(title, fontsize=14, loc="left")
            some = [head, *rows[k : k + _MOST_ROWS]]
            table = axes.table(some, loc="upper left", cellLoc="left", edges="B")
            table.auto_set_font_size(False)
            table.set_fontsize(7.5)
            save(cover)
        for draw in pages:
            save(draw())
