"""Maps of the specimen: fields in colour, cut out exactly along its deformed outline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.outline import Outline
from modeharvest.validation.style import (
    BLUE,
    EDGE,
    GREY,
    INK,
    MUTED,
    SIGNED,
    SIZE,
    figure,
    scale_bar,
    style,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Motion = Callable[[FloatArray, FloatArray], FloatArray]
"""(..., 2) displacement [mm] at positions x, y [mm] that broadcast together."""

WIDTH = 3.0  # of a map with its colour bar [in]
_MAP, _BAR_LEFT, _BAR = 0.80, 0.855, 0.03  # shares of the width
_BELOW, _ABOVE = 0.24, 0.22  # for the scale bar and the unit [in]


@dataclass(frozen=True)
class Scale:
    """Colours for values.

    Parameters
    ----------
    colours
        The colour map.
    low, high
        Its ends, in ``unit``.
    unit
        As written on the colour bar.
    extend
        Whether values lie beyond the ends: "neither", "min", "max" or "both".
    """

    colours: Colormap
    low: float
    high: float
    unit: str
    extend: str = "neither"

    @classmethod
    def signed(cls, values: FloatArray, unit: str, share: float = 1.0) -> Scale:
        """Diverge from zero, with equal ends that keep this ``share`` of the values inside."""
        end = _quantile(np.abs(values), share)
        return cls(SIGNED, -end, end, unit, "neither" if share == 1.0 else "both")

    @classmethod
    def size(cls, values: FloatArray, unit: str, share: float = 1.0) -> Scale:
        """Rise from zero, with an end that keeps this ``share`` of the values inside."""
        end = _quantile(values, share)
        return cls(SIZE, 0.0, end, unit, "neither" if share == 1.0 else "max")

    @property
    def normalise(self) -> Normalize:
        """Values to 0 ... 1."""
        return Normalize(self.low, self.high)


@dataclass(frozen=True, eq=False)
class Sheet:
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

    outline: Outline
    grid: PixelGrid
    factor: int
    limits: tuple[float, float, float, float]

    @classmethod
    def of(cls, mesh: Mesh, grid: PixelGrid, cells: int = 360) -> Sheet:
        """Make a sheet for a mesh, with about that many cells along the longer side."""
        factor = max(1, round(max(grid.shape) / cells))
        (left, bottom), (right, top) = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        margin = 0.012 * max(right - left, top - bottom)
        limits = (left - margin, right + margin, bottom - margin, top + margin)
        return cls(Outline.of(mesh), grid.binned(factor), factor, limits)

    def average(self, field: FloatArray) -> FloatArray:
        """Average a field (rows, cols) of the images over the cells, NaN left out."""
        rows, cols = self.grid.shape
        n = self.factor
        blocks = field[: rows * n, : cols * n].reshape(rows, n, cols, n)
        known = np.isfinite(blocks)
        count = known.sum(axis=(1, 3))
        total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def sample(self, field: FloatArray) -> FloatArray:
        """Take the middle pixel of each cell from a field (rows, cols) of the images."""
        rows, cols = self.grid.shape
        n, middle = self.factor, self.factor // 2
        return field[middle : rows * n : n, middle : cols * n : n]

    def moved_nodes(self, motion: Motion | None) -> FloatArray | None:
        """(n, 2) displacement of the mesh's nodes [mm]."""
        if motion is None:
            return None
        x, y = self.outline.nodes.T
        return motion(x[:, None], y[:, None])[:, 0]

    def moved_corners(self, motion: Motion | None) -> tuple[FloatArray, FloatArray]:
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


def draw_field(
    sheet: Sheet, values: FloatArray, scale: Scale, motion: Motion | None = None
) -> Figure:
    """Draw a field of the reference configuration, where it is or where ``motion`` takes it.

    Parameters
    ----------
    sheet
        Frame and outline.
    values
        (rows, cols) on ``sheet.grid``; NaN is left blank.
    scale
        Colours and unit.
    motion
        The displacement to draw it with; None for the reference configuration.
    """
    with style():
        drawn, axes = _map(sheet)
        edge = _edge(sheet, motion)
        axes.add_patch(edge)
        X, Y = sheet.moved_corners(motion)
        quads = axes.pcolormesh(X, Y, values, cmap=scale.colours,
                                norm=scale.normalise, rasterized=True)  # fmt: skip
        quads.set_clip_path(edge)
        colour_bar(drawn, axes, scale)
    return drawn


def draw_image(sheet: Sheet, image: NDArray[np.float32], material: BoolArray, grid: PixelGrid,
               joined: int) -> Figure:  # fmt: skip
    """Draw an image, its background left to the page.

    Parameters
    ----------
    sheet
        Frame.
    image, material
        (rows, cols) grey levels [fraction of full scale] and where they show material.
    grid
        Their pixels.
    joined
        Pixels averaged in each direction.
    """
    with style():
        drawn, axes = _map(sheet)
        rgba, coarse = _grey(image, material, grid, joined)
        axes.imshow(rgba, extent=coarse.extent, interpolation="antialiased", rasterized=True,
                    aspect="auto")  # fmt: skip
        axes.set(xlim=sheet.limits[:2], ylim=sheet.limits[2:])
        colour_bar(drawn, axes, Scale(GREY, 0.0, 1.0, "–"))
    return drawn


def draw_shape(sheet: Sheet, motion: Motion) -> Figure:
    """Draw the specimen's outline deformed over the undeformed one; no colour bar."""
    with style():
        drawn, axes = _map(sheet)
        axes.add_patch(PathPatch(sheet.outline.path(), fill=False, ec=MUTED, lw=0.45, alpha=0.7,
                                 clip_on=False))  # fmt: skip
        deformed = sheet.outline.path(sheet.moved_nodes(motion))
        axes.add_patch(PathPatch(deformed, fc=BLUE, ec="none", alpha=0.28, clip_on=False))
        axes.add_patch(PathPatch(deformed, fill=False, ec=BLUE, lw=0.9, clip_on=False))
    return drawn


def draw_blend(
    sheet: Sheet,
    image: NDArray[np.float32],
    material: BoolArray,
    grid: PixelGrid,
    values: FloatArray,
    scale: Scale,
    motion: Motion,
) -> Figure:
    """Let the deformed image dissolve, from left to right, into what was measured in it."""
    with style():
        drawn, axes = _map(sheet, width=4.2)
        rgba, coarse = _grey(image, material, grid, max(1, sheet.factor // 2))
        axes.imshow(rgba, extent=coarse.extent, interpolation="antialiased", rasterized=True,
                    aspect="auto")  # fmt: skip
        edge = _edge(sheet, motion)
        axes.add_patch(edge)
        X, Y = sheet.moved_corners(motion)
        along = np.linspace(0.0, 1.0, values.shape[1])[None, :]
        up = np.linspace(0.0, 1.0, values.shape[0])[:, None]
        opacity = np.clip((along + 0.25 * up - 0.48) / 0.28, 0.0, 1.0)
        quads = axes.pcolormesh(X, Y, values, cmap=scale.colours,
                                norm=scale.normalise, alpha=opacity**2 * (3 - 2 * opacity),
                                rasterized=True, linewidth=0, antialiased=False)  # fmt: skip
        quads.set_clip_path(edge)
        axes.set(xlim=sheet.limits[:2], ylim=sheet.limits[2:])
        colour_bar(drawn, axes, scale)
    return drawn


def _map(sheet: Sheet, width: float = WIDTH) -> tuple[Figure, Axes]:
    """An empty map with a scale bar."""
    left, right, bottom, top = sheet.limits
    tall = _MAP * width * (top - bottom) / (right - left)
    height = tall + _BELOW + _ABOVE
    drawn = figure(width, height)
    axes = drawn.add_axes((0.01, _BELOW / height, _MAP, tall / height))
    axes.set_axis_off()
    axes.set(xlim=(left, right), ylim=(bottom, top))
    length = _round_down(0.35 * (right - left))
    scale_bar(axes, length, f"{length:g} mm")
    return drawn, axes


def _edge(sheet: Sheet, motion: Motion | None) -> PathPatch:
    path = sheet.outline.path(sheet.moved_nodes(motion))
    return PathPatch(path, fill=False, ec=EDGE, lw=0.5, rasterized=True, clip_on=False, zorder=1.5)


def colour_bar(drawn: Figure, axes: Axes, scale: Scale) -> None:
    """A bar beside the map, its unit above it."""
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


def _grey(
    image: NDArray[np.float32], material: BoolArray, grid: PixelGrid, joined: int
) -> tuple[FloatArray, PixelGrid]:
    """(rows, cols, 4) averages over blocks of pixels; background transparent."""
    coarse = grid.binned(joined)
    rows, cols = coarse.shape

    def blocks(a: NDArray[np.float64]) -> FloatArray:
        part = a[: rows * joined, : cols * joined].reshape(rows, joined, cols, joined)
        return np.asarray(part.mean(axis=(1, 3)))

    cover = blocks(material.astype(np.float64))
    level = blocks(np.where(material, image, 0.0)) / np.maximum(cover, 1e-9)
    rgba = np.repeat(np.clip(level, 0.0, 1.0)[..., None], 4, axis=2)
    rgba[..., 3] = cover
    return np.nan_to_num(rgba), coarse


def _quantile(values: FloatArray, share: float) -> float:
    """The value that this share of the finite ones does not exceed; 1 where there is none."""
    finite = values[np.isfinite(values)]
    end = float(np.quantile(finite, share)) if finite.size else 0.0
    return end if end > 0.0 else 1.0


def _round_down(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length))
