"""Maps of the specimen: fields in colour, cut out exactly along its deformed boundary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures.outlines import MeshBoundary
from modeharvest.report.figures.style import (
    BLUE,
    EDGE,
    GREY,
    INK,
    MUTED,
    SIGNED,
    SIZE,
    draw_path,
    figure,
    scale_bar,
)
from modeharvest.util.arrays import BoolArray, FloatArray

DisplacementFunction = Callable[[FloatArray, FloatArray], FloatArray]
"""(..., 2) displacement [mm] at positions x, y [mm] that broadcast together."""


@dataclass(frozen=True, eq=False)
class MapFrame:
    """What all maps of a specimen share, so that they can be laid over each other.

    Parameters
    ----------
    outline
        Of the specimen.
    grid
        The images' pixels joined to the cells that are drawn.
    factor
        Pixels joined, in each direction.
    limits
        (left, right, bottom, top) of every map [mm].
    """

    outline: MeshBoundary
    grid: PixelGrid
    factor: int
    limits: tuple[float, float, float, float]

    @classmethod
    def of(cls, outline: MeshBoundary, grid: PixelGrid, cells: int = 360) -> MapFrame:
        """Make a frame for an outline, with about that many cells along the longer side."""
        factor = max(1, round(max(grid.shape) / cells))
        (left, bottom), (right, top) = outline.nodes.min(axis=0), outline.nodes.max(axis=0)
        margin = 0.012 * max(right - left, top - bottom)
        limits = (left - margin, right + margin, bottom - margin, top + margin)
        return cls(outline, grid.binned(factor), factor, limits)

    def average(self, field: FloatArray) -> FloatArray:
        """Average a field (rows, cols) of the images over the cells, NaN left out."""
        known = np.isfinite(field)
        count = self._sum(known.astype(np.float64))
        total = self._sum(np.where(known, field, 0.0))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _sum(self, field: FloatArray) -> FloatArray:
        """Sums over the cells' pixels; rows first, which is several times faster."""
        (rows, cols), n = self.grid.shape, self.factor
        whole = field[: rows * n].reshape(rows, n, -1).sum(axis=1)[:, : cols * n]
        return np.asarray(whole.reshape(rows, cols, n).sum(axis=2))

    def sample(self, field: FloatArray) -> FloatArray:
        """Take the middle pixel of each cell from a field (rows, cols) of the images."""
        rows, cols = self.grid.shape
        n, middle = self.factor, self.factor // 2
        return field[middle : rows * n : n, middle : cols * n : n]

    def moved_nodes(self, motion: DisplacementFunction | None) -> FloatArray | None:
        """(n, 2) displacement of the mesh's nodes [mm]."""
        if motion is None:
            return None
        x, y = self.outline.nodes.T
        return motion(x[:, None], y[:, None])[:, 0]

    def moved_corners(self, motion: DisplacementFunction | None) -> tuple[FloatArray, FloatArray]:
        """(rows + 1, cols + 1) positions of the cells' corners [mm], none off the specimen."""
        h = 0.5 * self.grid.pixel_size
        low, high = self.outline.nodes.min(axis=0), self.outline.nodes.max(axis=0)
        x = np.clip(np.append(self.grid.x - h, self.grid.x[-1] + h), low[0], high[0])
        y = np.clip(np.append(self.grid.y + h, self.grid.y[-1] - h), low[1], high[1])
        X, Y = np.meshgrid(x, y)
        if motion is None:
            return X, Y
        u = motion(x[None, :], y[:, None])
        return X + u[..., 0], Y + u[..., 1]


WIDTH = 2.35  # of a map with its colour bar [in]
_MAP, _BAR_LEFT, _BAR = 0.76, 0.79, 0.03  # shares of the width
_BELOW, _ABOVE = 0.24, 0.22  # for the scale bar and the unit [in]


@dataclass(frozen=True)
class ColourScale:
    """Colours for values.

    Parameters
    ----------
    colours
        The colour map.
    low, high
        Its ends, in ``unit``.
    unit
        As written above the colour bar; "" for a number without one.
    extend
        Whether values lie beyond the ends: "neither", "min", "max" or "both".
    """

    colours: Colormap
    low: float
    high: float
    unit: str = ""
    extend: str = "neither"

    @classmethod
    def signed(cls, values: FloatArray, unit: str, share: float = 1.0) -> ColourScale:
        """Diverge from zero, with equal ends that keep this ``share`` of the values inside."""
        end = _quantile(np.abs(values), share)
        return cls(SIGNED, -end, end, unit, "neither" if share == 1.0 else "both")

    @classmethod
    def size(cls, values: FloatArray, unit: str, share: float = 1.0) -> ColourScale:
        """Rise from zero, with an end that keeps this ``share`` of the values inside."""
        end = _quantile(values, share)
        return cls(SIZE, 0.0, end, unit, "neither" if share == 1.0 else "max")

    @property
    def normalise(self) -> Normalize:
        """Values to 0 ... 1."""
        return Normalize(self.low, self.high)


def draw_field(
    map_frame: MapFrame,
    values: FloatArray,
    scale: ColourScale,
    motion: DisplacementFunction | None = None,
) -> Figure:
    """Draw a field of the reference configuration, where it is or where ``motion`` takes it.

    Parameters
    ----------
    map_frame
        Frame and outline.
    values
        (rows, cols) on ``map_frame.grid``; NaN is left blank.
    scale
        Colours and unit.
    motion
        The displacement to draw it with; None for the reference configuration.
    """
    drawn, axes = _empty_map(map_frame)
    edge = _draw_edge(axes, map_frame.outline.path(map_frame.moved_nodes(motion)))
    X, Y = map_frame.moved_corners(motion)
    quads = axes.pcolormesh(X, Y, values, cmap=scale.colours,
                            norm=scale.normalise, rasterized=True)  # fmt: skip
    quads.set_clip_path(edge)
    colour_bar(drawn, axes, scale)
    return drawn


def draw_image(
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray,
    grid: PixelGrid,
    displacement: FloatArray,
) -> Figure:
    """Draw an image, its background left to the page.

    Parameters
    ----------
    map_frame
        Frame and outline.
    image, material
        (rows, cols) grey levels [fraction of full scale] and where they show material.
    grid
        Their pixels.
    displacement
        (n, 2) true displacement at the mesh's nodes [mm], for the outline.
    """
    drawn, axes = _empty_map(map_frame)
    _show_grey(axes, map_frame, image, material, grid)
    _draw_edge(axes, map_frame.outline.path(displacement))
    colour_bar(drawn, axes, ColourScale(GREY, 0.0, 1.0))
    return drawn


def draw_shape(map_frame: MapFrame, motion: DisplacementFunction) -> Figure:
    """Draw the specimen's outline deformed over the undeformed one; no colour bar."""
    drawn, axes = _empty_map(map_frame)
    draw_path(axes, map_frame.outline.path(), fill=False, ec=MUTED, lw=0.45, alpha=0.7,
              clip_on=False)  # fmt: skip
    deformed = map_frame.outline.path(map_frame.moved_nodes(motion))
    draw_path(axes, deformed, fc=BLUE, ec="none", alpha=0.28, clip_on=False)
    draw_path(axes, deformed, fill=False, ec=BLUE, lw=0.9, clip_on=False)
    return drawn


def draw_blend(
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray,
    grid: PixelGrid,
    values: FloatArray,
    scale: ColourScale,
    motion: DisplacementFunction,
) -> Figure:
    """Let the deformed image dissolve, from left to right, into what was measured in it.

    Parameters
    ----------
    map_frame
        Frame and outline.
    image, material
        (rows, cols) grey levels [fraction of full scale] and where they show material.
    grid
        Their pixels.
    values
        (rows, cols) on ``map_frame.grid``, what was measured; NaN is left blank.
    scale
        Colours and unit.
    motion
        The displacement to draw it with.
    """
    drawn, axes = _empty_map(map_frame, width=3.2)
    # Gone where the field is opaque, or slivers of it would show along the holes.
    _show_grey(axes, map_frame, image, material, grid, dissolve=True)
    edge = _draw_edge(axes, map_frame.outline.path(map_frame.moved_nodes(motion)))
    X, Y = map_frame.moved_corners(motion)
    colours = scale.colours(scale.normalise(values))
    colours[..., 3] *= _ramp(values.shape)
    quads = axes.pcolormesh(X, Y, colours, rasterized=True)
    quads.set_clip_path(edge)
    colour_bar(drawn, axes, scale)
    return drawn


def _empty_map(map_frame: MapFrame, width: float = WIDTH) -> tuple[Figure, Axes]:
    """An empty map with a scale bar."""
    left, right, bottom, top = map_frame.limits
    tall = _MAP * width * (top - bottom) / (right - left)
    height = tall + _BELOW + _ABOVE
    drawn = figure(width, height)
    axes = drawn.add_axes((0.01, _BELOW / height, _MAP, tall / height))
    axes.set_axis_off()
    axes.set(xlim=(left, right), ylim=(bottom, top))
    length = _round_down(0.35 * (right - left))
    scale_bar(axes, length, f"{length:g} mm")
    return drawn, axes


def _draw_edge(axes: Axes, path: Path) -> PathPatch:
    return draw_path(axes, path, fill=False, ec=EDGE, lw=0.5, rasterized=True, clip_on=False,
                     zorder=1.5)  # fmt: skip


def colour_bar(drawn: Figure, axes: Axes, scale: ColourScale) -> None:
    """A bar beside the map, its unit above it.

    Parameters
    ----------
    drawn, axes
        The figure, and the map in it.
    scale
        Colours and unit.
    """
    box = axes.get_position()
    place = drawn.add_axes((_BAR_LEFT, box.y0, _BAR, box.height), label="colour bar")
    mappable = ScalarMappable(scale.normalise, scale.colours)
    bar = drawn.colorbar(mappable, cax=place, extend=scale.extend, extendfrac=0.02)
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=2, pad=2, labelsize=7.5, color=MUTED)
    bar.ax.set_title(scale.unit, fontsize=8, pad=6, loc="left", color=INK)
    if bar.solids is not None:
        bar.solids.set_rasterized(True)
    bar.ax.set_label("colour bar")


def _ramp(shape: tuple[int, ...]) -> FloatArray:
    """0 on the left, 1 on the right, a smooth slope between them that leans to the left."""
    up, along = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j]
    t = np.clip((along + 0.25 * up - 0.48) / 0.28, 0.0, 1.0)
    return np.asarray(t**2 * (3 - 2 * t))


def _show_grey(
    axes: Axes,
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray,
    grid: PixelGrid,
    dissolve: bool = False,
) -> None:
    """Show an image averaged over blocks of pixels, its background transparent."""
    joined = max(1, map_frame.factor // 2)
    coarse = grid.binned(joined)
    rows, cols = coarse.shape

    def blocks(a: NDArray[Any]) -> FloatArray:
        part = a[: rows * joined, : cols * joined].reshape(rows, joined, cols, joined)
        return np.asarray(part.mean(axis=(1, 3), dtype=np.float64))

    cover = blocks(material)
    level = blocks(np.where(material, image, 0.0)) / np.maximum(cover, 1e-9)
    rgba = np.repeat(np.clip(level, 0.0, 1.0)[..., None], 4, axis=2)
    rgba[..., 3] = cover * np.minimum(1.0, 4.0 * (1.0 - _ramp(coarse.shape))) if dissolve else cover
    axes.imshow(np.nan_to_num(rgba), extent=coarse.extent, interpolation="antialiased",
                rasterized=True, aspect="auto")  # fmt: skip
    axes.set(xlim=map_frame.limits[:2], ylim=map_frame.limits[2:])


def _quantile(values: FloatArray, share: float) -> float:
    """The value that this share of the finite ones does not exceed; 1 where there is none."""
    finite = values[np.isfinite(values)]
    end = float(np.quantile(finite, share)) if finite.size else 0.0
    return end if end > 0.0 else 1.0


def _round_down(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length))
