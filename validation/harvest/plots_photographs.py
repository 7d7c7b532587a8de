"""What was made of the photographs: the reference with its holes, and the lens that took them."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from modeharvest.idic.calibration.result import Calibration
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.specimen.hole_lattice import HoleLattice
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.harvest.atlas import HarvestAtlas
from modeharvest.validation.harvest.run import HarvestedFrame
from modeharvest.validation.plots_fields import WIDTH, Scale, colour_bar
from modeharvest.validation.style import (
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

FloatArray = NDArray[np.float64]

WIDE, NARROW = 5.2, 3.5  # of a picture on half a page, and on a third of it [in]
CLOSE = 3
"""Cells along the side of a closer look."""
_LEGEND = 0.26  # [in]
_PIXELS = 1000  # along the longer side
_CELLS, _ARROWS = 120, 17  # of a distortion's map, along the longer side
_LENGTH = 0.9  # of the longest arrow, distances between arrows


def draw_reference(atlas: HarvestAtlas) -> Figure:
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


def draw_closeup(atlas: HarvestAtlas, frame: HarvestedFrame) -> Figure:
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


def _coloured(grid: PixelGrid, length: FloatArray) -> tuple[Figure, Axes, Scale]:
    """A map of lengths [px] over the whole image, in its own frame: columns right, rows down."""
    drawn, axes = _picture(grid, NARROW, 0.26, 0.77)
    scale = Scale.size(length, "px")
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
