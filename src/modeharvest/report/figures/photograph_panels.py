"""The reference photograph and its lens; the list of panels drawn of every photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from modeharvest.idic.photograph.holes import HoleLattice
from modeharvest.idic.slow_fields import Box
from modeharvest.imaging.distortion.calibration.result import Calibration
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures import photographs as maps
from modeharvest.report.figures.maps import WIDTH, ColourScale, colour_bar
from modeharvest.report.figures.photographs import PhotographReportData
from modeharvest.report.figures.style import (
    BLUE,
    GOLD,
    GREEN,
    GREY,
    INK,
    RED,
    SIZE,
    draw_path,
    figure,
    style,
)
from modeharvest.runs.photographs.results import HarvestedFrame
from modeharvest.util.arrays import FloatArray

WIDE, NARROW = 5.2, 3.5  # of a picture on half a page, and on a third of it [in]
CLOSE = 3
"""Cells along the side of a closer look."""
_LEGEND = 0.26  # [in]
_PIXELS = 1000  # along the longer side
_CELLS, _ARROWS = 120, 17  # of a distortion's map, along the longer side
_LENGTH = 0.9  # of the longest arrow, distances between arrows


def draw_reference(atlas: PhotographReportData) -> Figure:
    """Draw the reference and all that was found in it, for a look whether that is right."""
    harvest = atlas.harvest
    with style():
        drawn, axes = _picture(harvest.grid, WIDE, _LEGEND)
        factor = max(1, round(max(harvest.grid.shape) / _PIXELS))
        cells = harvest.grid.binned(factor)
        rows, cols = cells.shape
        part = atlas.grey(harvest.reference)[: rows * factor, : cols * factor]
        joined = part.reshape(rows, factor, cols, factor).mean(axis=(1, 3))
        axes.imshow(joined, extent=cells.extent, cmap=GREY, vmin=0.0, vmax=1.0,
                    interpolation="antialiased", rasterized=True, aspect="auto")  # fmt: skip
        axes.set(xlim=harvest.grid.extent[:2], ylim=harvest.grid.extent[2:])
        draw_path(axes, atlas.outline.path(), fill=False, ec=GOLD, lw=0.9, rasterized=True)
        shown = [Line2D([], [], color=GOLD, lw=1.2, label="material")]
        if harvest.lattice is not None:
            shown += _draw_lattice(axes, harvest.lattice, harvest.grid)
        shown.append(_draw_box(axes, harvest.cellular))
        axes.legend(handles=shown, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(shown),
                    frameon=False, fontsize=7.5, handlelength=1.6, columnspacing=1.4,
                    borderaxespad=0.1)  # fmt: skip
    return drawn


def draw_closeup(atlas: PhotographReportData, frame: HarvestedFrame) -> Figure:
    """Draw some cells of a deformed photograph, pixel by pixel, with the outline as measured."""
    grid, motion = atlas.harvest.grid, atlas.motion(frame)
    middle = np.array(atlas.harvest.cellular.centre)
    x, y = middle + motion(*middle[:, None, None])[0, 0]
    half = 0.5 * CLOSE * atlas.harvest.pitch
    corners = grid.to_px([x - half, x + half], [y + half, y - half])
    (top, bottom), (left, right) = (
        np.clip(np.rint(edge).astype(int), 0, size - 1)
        for edge, size in zip(corners, grid.shape, strict=True)
    )
    part = atlas.grey(frame.image[top : bottom + 1, left : right + 1])
    x0, y0 = map(float, grid.to_mm(top, left))
    extent = PixelGrid(bottom + 1 - top, right + 1 - left, grid.pixel_size, x0, y0).extent
    with style():
        drawn = figure(WIDTH, WIDTH)
        axes = drawn.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.imshow(part, extent=extent, cmap=GREY, vmin=0.0, vmax=1.0, rasterized=True,
                    interpolation="antialiased", aspect="auto")  # fmt: skip
        path = atlas.outline.path(atlas.sheet().moved_nodes(motion))
        draw_path(axes, path, fill=False, ec=GOLD, lw=1.1, rasterized=True)
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    return drawn


def draw_distortion(distortion: Distortion, grid: PixelGrid) -> Figure:
    """Draw the length of S in colour and S itself as arrows, enlarged.

    Parameters
    ----------
    distortion
        Of the optics.
    grid
        The images' pixels.
    """
    rows, cols = _positions(grid, _CELLS)
    down, right = distortion.shift(rows, cols)
    with style():
        drawn, axes, scale = _coloured(grid, np.hypot(down, right))
        rows, cols = _positions(grid, _ARROWS)
        down, right = np.broadcast_arrays(*distortion.shift(rows, cols))
        row, col = np.broadcast_arrays(rows, cols)
        longest = float(np.hypot(down, right).max())
        step = max(grid.shape) / _ARROWS
        enlarged = _LENGTH * step / longest if longest > 0 else 1.0
        axes.quiver(col, row, enlarged * right, enlarged * down, angles="xy", scale_units="xy",
                    scale=1.0, width=0.0035, color="white", pivot="mid")  # fmt: skip
        colour_bar(drawn, axes, scale)
    return drawn


def draw_distortion_sd(calibration: Calibration, grid: PixelGrid) -> Figure:
    """Draw the standard deviation of S by the photographs' noise, both components together."""
    with style():
        sd = np.hypot(*calibration.sd(*_positions(grid, _CELLS)))
        drawn, axes, scale = _coloured(grid, sd)
        colour_bar(drawn, axes, scale)
    return drawn


def draw_distortion_error(found: Distortion, true: Distortion, grid: PixelGrid) -> Figure:
    """Draw the length of S_found - S_true without its affine part, which can't be observed."""
    with style():
        drawn, axes, scale = _coloured(grid, np.hypot(*unaffine(found, true, grid)))
        colour_bar(drawn, axes, scale)
    return drawn


def unaffine(found: Distortion, true: Distortion, grid: PixelGrid) -> FloatArray:
    """(2, n, m) S_found - S_true [px] on a coarse grid over the image, its affine part removed."""
    rows, cols = _positions(grid, _CELLS)
    pairs = zip(found.shift(rows, cols), true.shift(rows, cols), strict=True)
    difference = np.stack([np.broadcast_arrays(a - b, rows + cols)[0] for a, b in pairs])
    row, col = np.broadcast_arrays(rows, cols)
    basis = np.stack([np.ones(row.size), row.ravel(), col.ravel()], axis=1)
    flat = difference.reshape(2, -1).T
    left = flat - basis @ np.linalg.lstsq(basis, flat, rcond=None)[0]
    return np.asarray(left.T.reshape(difference.shape))


def _positions(grid: PixelGrid, count: int) -> tuple[FloatArray, FloatArray]:
    """Middles of about ``count`` cells along the image's longer side, as an open grid [px]."""
    step = max(grid.shape) / count
    rows, cols = (max(2, round(size / step)) for size in grid.shape)
    along_row = (np.arange(rows) + 0.5) * grid.rows / rows - 0.5
    along_col = (np.arange(cols) + 0.5) * grid.cols / cols - 0.5
    return along_row[:, None], along_col[None, :]


def _picture(grid: PixelGrid, width: float, above: float, share: float = 1.0
             ) -> tuple[Figure, Axes]:  # fmt: skip
    """An empty picture for the whole image, over this share of its width; room above [in]."""
    tall = share * width * grid.rows / grid.cols
    height = tall + above + 0.04
    drawn = figure(width, height)
    axes = drawn.add_axes((0.002, 0.02 / height, 0.996 * share, tall / height))
    axes.set_axis_off()
    return drawn, axes


def _coloured(grid: PixelGrid, length: FloatArray) -> tuple[Figure, Axes, ColourScale]:
    """A map of lengths [px] over the whole image, in its own frame: columns right, rows down."""
    drawn, axes = _picture(grid, NARROW, 0.26, 0.77)
    scale = ColourScale.size(length, "px")
    axes.imshow(length, extent=(-0.5, grid.cols - 0.5, grid.rows - 0.5, -0.5), cmap=SIZE,
                norm=scale.normalise, interpolation="bilinear", rasterized=True,
                aspect="auto")  # fmt: skip
    axes.set(xlim=(-0.5, grid.cols - 0.5), ylim=(grid.rows - 0.5, -0.5))
    return drawn, axes, scale


def _draw_box(axes: Axes, box: Box) -> Line2D:
    """The part of the specimen that has holes."""
    axes.add_patch(Rectangle((box.x_min, box.y_min), box.x_max - box.x_min, box.y_max - box.y_min,
                             fill=False, ec=RED, lw=1.3, ls=(0, (4, 2))))  # fmt: skip
    return Line2D([], [], color=RED, lw=1.3, ls=(0, (3, 1.5)), label="part with holes")


def _draw_lattice(axes: Axes, lattice: HoleLattice, grid: PixelGrid) -> list[Line2D]:
    """Holes, the straight lattice through them, and what does not fit."""
    (i0, j0), (i1, j1) = lattice.index.min(axis=0), lattice.index.max(axis=0)
    ends = [((i, j0), (i, j1)) for i in range(i0, i1 + 1)]
    ends += [((i0, j), (i1, j)) for j in range(j0, j1 + 1)]
    lines = [np.stack(_to_mm(lattice.position(pair), grid), axis=1) for pair in ends]
    axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=0.7, alpha=0.9))
    said = [Line2D([], [], color=BLUE, lw=1.0, label="lattice")]
    kinds = (
        (lattice.centres, "o", GREEN, f"{len(lattice)} holes"),
        (lattice.position(lattice.missing), "x", RED, f"{len(lattice.missing)} missing"),
        (lattice.extra, "s", INK, f"{len(lattice.extra)} not on it"),
    )
    for at, marker, colour, name in kinds:
        if len(at):
            dots = axes.plot(*_to_mm(at, grid), marker, color=colour, ms=3.0, mew=1.0, ls="none",
                             label=name)  # fmt: skip
            said += dots
    return said


def _to_mm(at: FloatArray, grid: PixelGrid) -> tuple[FloatArray, FloatArray]:
    return grid.to_mm(at[..., 0], at[..., 1])


Draw = Callable[[PhotographReportData, HarvestedFrame], Figure]
Shows = Callable[[PhotographReportData, HarvestedFrame], bool]


def _always(atlas: PhotographReportData, frame: HarvestedFrame) -> bool:
    return True


@dataclass(frozen=True)
class PhotographPanel:
    """One quantity, drawn for every photograph that has it; as a panel of a validation.

    Parameters
    ----------
    section
        Anchor of the part of the page where it is.
    key, symbol, title, paper, caption, exact
        As in :class:`modeharvest.report.figures.experiment.SnapshotPanel`.
    draw
        Makes the picture of a frame.
    shows
        Whether there is something to draw for a frame.
    """

    section: str
    key: str
    symbol: str
    title: str
    paper: str
    caption: str
    draw: Draw
    shows: Shows = _always
    exact: bool = False


PHOTOGRAPH_SECTIONS = (
    ("photographs", "Photographs and pattern"),
    ("found", "What was measured"),
    ("left", "What is left over"),
    ("sure", "How sure it is"),
    ("truth", "Against the truth"),
)
"""Anchor and heading of each group of panels."""


def photograph_panels(atlas: PhotographReportData) -> list[PhotographPanel]:
    """Every panel of a harvest, those without a picture left out."""
    count = max((len(frame.modes) for frame in atlas.shown), default=0)
    every = [*_IMAGES]
    for k, part in enumerate(atlas.shown[0].parts):
        every += _part(k, part.name)
    every += _SLOW
    for i in range(count):
        every += _mode(i, f"<sub>{i + 1}</sub>")
    every += [*_RESIDUAL, *_errors("v0", "v<sub>0</sub>", "Smooth field", "")]
    for i in range(count):
        n = f"<sub>{i + 1}</sub>"
        every += _errors(f"v{i + 1}", f"v{n}", "Amplitude of the mode", "", i)
        every += _errors(f"fluc{i + 1}", f"v{n}φ{n}", "Correlated fluctuation",
                         " The mode’s own uncertainty is in it.", i)  # fmt: skip
    every += _TRUTH
    return [p for p in every if any(p.shows(atlas, frame) for frame in atlas.shown)]


def _has_spectrum(atlas: PhotographReportData, frame: HarvestedFrame) -> bool:
    return frame.spectrum is not None


def _has_local(atlas: PhotographReportData, frame: HarvestedFrame) -> bool:
    return frame.local is not None


def _has_truth(atlas: PhotographReportData, frame: HarvestedFrame) -> bool:
    truth = atlas.harvest.truth
    return truth is not None and frame.name in truth.frames


def _has_mode(i: int) -> Shows:
    return lambda atlas, frame: i in frame.modes


def _has_model_error(i: int | None) -> Shows:
    return lambda atlas, frame: frame.by_model_error is not None and (i is None or i in frame.modes)


_IMAGES = (
    PhotographPanel(
        "photographs", "image", "", "Deformed photograph", "spect_real (a)",
        "As it was correlated, free from optical distortion. Over it, in yellow, the material’s "
        "outline in the reference, moved by what was measured: it should run along the edges.",
        maps.draw_deformed,
    ),
    PhotographPanel(
        "photographs", "closeup", "", "A closer look", "",
        f"{CLOSE} × {CLOSE} cells in the middle, pixel by pixel, with the outline as above.",
        draw_closeup,
    ),
    PhotographPanel(
        "photographs", "Sxx", "S<sub>xx</sub>", "Spectral density along x", "spect_real (b)",
        "Of the displacement without its affine part. The colours end at the pattern’s own "
        "density, the same for all photographs; what is beyond, on the axes, comes from the "
        "specimen’s edges. Rings: the wave vectors found (faint: the largest peak where there is "
        "no pattern).",
        partial(maps.draw_spectrum, component=0), _has_spectrum,
    ),
    PhotographPanel(
        "photographs", "Syy", "S<sub>yy</sub>", "Spectral density along y", "spect_real (c)",
        "A wave and its mirror image on either diagonal make four peaks at (±½, ±½): a pattern "
        "that repeats after two cells.",
        partial(maps.draw_spectrum, component=1), _has_spectrum,
    ),
)  # fmt: skip

_SLOW = (
    PhotographPanel(
        "found", "v0x", "v<sub>0</sub> · e<sub>x</sub>", "Smooth field along x", "real (a) and (i)",
        "The applied deformation, and the specimen’s rigid motion between the photographs.",
        partial(maps.draw_v0, component=0),
    ),
    PhotographPanel(
        "found", "v0y", "v<sub>0</sub> · e<sub>y</sub>", "Smooth field along y", "real (b) and (j)",
        "Where the pattern draws the specimen in, across the loading, is the auxetic effect.",
        partial(maps.draw_v0, component=1),
    ),
)  # fmt: skip

_RESIDUAL = (
    PhotographPanel(
        "left", "residual", "f − g∘φ", "Residual", "real (g) and (o)",
        "In the deformed configuration; single pixels, not averages. The colours end at the 99th "
        "percentile. Camera noise is in it, and what the ansatz can’t describe. Blank along the "
        "edges: not compared there.",
        maps.draw_residual, exact=True,
    ),
    PhotographPanel(
        "left", "w", "‖w‖", "Microfluctuation field", "real (h) and (p)",
        "Local DIC − IDIC in the deformed configuration, the local DIC’s own errors included; "
        "blank where it has no point. The colours end at the 99.8th percentile.",
        maps.draw_w, _has_local,
    ),
)  # fmt: skip

_TRUTH = (
    PhotographPanel(
        "truth", "true_w", "‖w‖", "Truth − IDIC", "",
        "All that the measurement does not say, in the deformed configuration. The colours end at "
        "the 99.8th percentile, here and beside.",
        partial(maps.draw_error_against_truth, part="true_w"), _has_truth,
    ),
    PhotographPanel(
        "truth", "best", "‖u − u<sub>best</sub>‖", "What the ansatz can’t say", "",
        "Truth − best fit of the same unknowns to the true displacement.",
        partial(maps.draw_error_against_truth, part="best"), _has_truth,
    ),
    PhotographPanel(
        "truth", "loss", "‖u<sub>best</sub> − u<sub>IDIC</sub>‖", "What the measurement loses", "",
        "Best fit − IDIC: what is lost on top, on its own, smaller scale.",
        partial(maps.draw_error_against_truth, part="loss"), _has_truth,
    ),
)  # fmt: skip


def _part(k: int, name: str) -> list[PhotographPanel]:
    """Spectral densities of part k (from 0)."""
    return [
        PhotographPanel(
            "photographs", f"S{axis}{axis}-{k + 1}", f"S<sub>{axis}{axis}</sub>",
            f"Spectral density along {axis}, region “{name}”", "",
            "Of the displacement in this region alone, which has modes of its own.",
            partial(maps.draw_part_spectrum, part=k, component=component),
        )
        for component, axis in enumerate("xy")
    ]  # fmt: skip


def _mode(i: int, n: str) -> list[PhotographPanel]:
    """Amplitude, mode and fluctuation of mode i (from 0), n its number as HTML."""
    shows = _has_mode(i)
    return [
        PhotographPanel(
            "found", f"v{i + 1}", f"v{n}", "Amplitude of the mode", _paper(i, "(c) and (k)"),
            f"Where the pattern lives; blank where φ{n} is zero and v{n} means nothing. The values "
            f"are large because φ{n} is scaled to 0.04.",
            partial(maps.draw_amplitude, i=i), shows,
        ),
        PhotographPanel(
            "found", f"phi{i + 1}", f"φ{n}", "The mode", _paper(i, "(d) and (l)"),
            "The identified mode as a deformed configuration over the undeformed outline, enlarged "
            "to a largest displacement of 0.16 l.",
            partial(maps.draw_mode, i=i), shows,
        ),
        PhotographPanel(
            "found", f"fluc{i + 1}x", f"v{n}φ{n} · e<sub>x</sub>", "Correlated fluctuation along x",
            _paper(i, "(e) and (m)"), "In the deformed configuration of this contribution alone.",
            partial(maps.draw_fluctuation, i=i, component=0), shows,
        ),
        PhotographPanel(
            "found", f"fluc{i + 1}y", f"v{n}φ{n} · e<sub>y</sub>", "Correlated fluctuation along y",
            _paper(i, "(f) and (n)"), "In the deformed configuration of this contribution alone.",
            partial(maps.draw_fluctuation, i=i, component=1), shows,
        ),
    ]  # fmt: skip


def _errors(field: str, symbol: str, title: str, more: str, i: int | None = None
            ) -> list[PhotographPanel]:  # fmt: skip
    """Standard deviations of a field by both causes."""
    of_noise = _always if i is None else _has_mode(i)
    return [
        PhotographPanel(
            "sure", f"{field}-noise", f"sd({symbol})", f"{title}, by noise", "",
            f"One standard deviation by the photographs’ noise.{more}",
            partial(maps.draw_error, field=field, cause="noise"), of_noise,
        ),
        PhotographPanel(
            "sure", f"{field}-model_error", f"sd({symbol})", f"{title}, by model error", "",
            "One standard deviation by what the ansatz can’t describe, which pushes its unknowns "
            "about from cell to cell; noise included.",
            partial(maps.draw_error, field=field, cause="model_error"), _has_model_error(i),
        ),
    ]  # fmt: skip


def _paper(i: int, panel: str) -> str:
    return f"real {panel}" if i == 0 else ""
