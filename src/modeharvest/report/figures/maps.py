"""Maps of the specimen: fields in colour, cut out exactly along its deformed boundary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import Collection, LineCollection
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path
from matplotlib.ticker import LogLocator, MaxNLocator
from matplotlib.transforms import Bbox, TransformedBbox
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures import style
from modeharvest.report.figures.boundaries import MeshBoundary, block_means
from modeharvest.report.model.text import ten_to
from modeharvest.util.arrays import BoolArray, FloatArray

DisplacementFunction = Callable[[FloatArray, FloatArray], FloatArray]
"""(..., 2) displacement [mm] at positions x, y [mm] that broadcast together."""


@dataclass(frozen=True, eq=False)
class MapFrame:
    """Boundary, cells and limits common to all maps of a specimen, so that they can be overlaid."""

    boundary: MeshBoundary
    grid: PixelGrid
    factor: int
    """Grid of the cells that are drawn, and number of image pixels along a cell's side."""
    limits: tuple[float, float, float, float]
    """(left, right, bottom, top) of every map [mm]."""

    @classmethod
    def of(cls, boundary: MeshBoundary, grid: PixelGrid, cells: int = 360) -> MapFrame:
        """Make a frame of about ``cells`` cells along the longer side; ``grid``: image pixels."""
        factor = max(1, round(max(grid.shape) / cells))
        (left, bottom), (right, top) = boundary.nodes.min(axis=0), boundary.nodes.max(axis=0)
        margin = 0.012 * max(right - left, top - bottom)
        limits = (left - margin, right + margin, bottom - margin, top + margin)
        return cls(boundary, grid.binned(factor), factor, limits)

    def average(self, field: FloatArray) -> FloatArray:
        """Average a field (rows, cols) on the images' pixels over the cells, without NaN."""
        known = np.isfinite(field)
        share = block_means(known, self.factor)
        mean = block_means(np.where(known, field, 0.0), self.factor)
        return np.divide(mean, share, out=np.full_like(mean, np.nan), where=share > 0)

    def sample(self, field: NDArray[Any]) -> NDArray[Any]:
        """Sample a field (rows, cols, ...) on the images' pixels at the middle of each cell."""
        return field[np.ix_(*self.pixels)]

    @property
    def pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the images' pixels at the middles of the cells."""
        n = self.factor
        rows, cols = (n // 2 + n * np.arange(size) for size in self.grid.shape)
        return rows, cols

    def moved_nodes(self, motion: DisplacementFunction) -> FloatArray:
        """(n, 2) displacement of the mesh's nodes [mm]."""
        x, y = self.boundary.nodes.T
        return motion(x[:, None], y[:, None])[:, 0]

    def moved_corners(self, motion: DisplacementFunction | None) -> tuple[FloatArray, FloatArray]:
        """(rows + 1, cols + 1) x and y of cells' corners, clipped to the mesh, displaced [mm]."""
        h = 0.5 * self.grid.pixel_size
        low, high = self.boundary.nodes.min(axis=0), self.boundary.nodes.max(axis=0)
        x = np.clip(np.append(self.grid.x - h, self.grid.x[-1] + h), low[0], high[0])
        y = np.clip(np.append(self.grid.y + h, self.grid.y[-1] - h), low[1], high[1])
        X, Y = np.meshgrid(x, y)
        if motion is None:
            return X, Y
        u = motion(x[None, :], y[:, None])
        return X + u[..., 0], Y + u[..., 1]


_FINER = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # the four straight triangles of a T6
_STEPS = (1, 2, 2.5, 5, 10)
WIDTH = 2.35  # width of a map with its colour bar [in]
_MAP = 0.76  # the map's share of the width
_BELOW, _ABOVE = 0.24, 0.22  # heights for the scale bar and the unit [in]
_GAP, _BAR, _POINTED = 0.05, 0.072, 0.05  # gap to a colour bar, its width, length of its tips [in]


@dataclass(frozen=True)
class ColourScale:
    """A mapping from values to colours."""

    colours: Colormap
    low: float
    high: float
    """Ends of the colour map, in ``unit``."""
    unit: str = ""
    """Unit, written above the colour bar; empty for dimensionless values."""
    extend: str = "neither"
    """Whether values lie beyond the ends: "neither", "min", "max" or "both"."""
    is_log: bool = False
    """Whether the scale is logarithmic."""

    @classmethod
    def signed(cls, values: FloatArray, unit: str, share: float = 1.0) -> ColourScale:
        """Scale that diverges from zero to ± end, which includes this ``share`` of the values."""
        end = _quantile(np.abs(values), share)
        return cls(style.SIGNED, -end, end, unit, "neither" if share == 1.0 else "both")

    @classmethod
    def size(cls, values: FloatArray, unit: str, share: float = 1.0) -> ColourScale:
        """Scale that rises from zero to an end, which includes this ``share`` of the values."""
        end = _quantile(values, share)
        return cls(style.SIZE, 0.0, end, unit, "neither" if share == 1.0 else "max")

    @property
    def normalise(self) -> Normalize:
        """Maps values from ``low`` ... ``high`` to 0 ... 1."""
        return (LogNorm if self.is_log else Normalize)(self.low, self.high)

    def of(self, values: FloatArray) -> FloatArray:
        """(..., 4) RGBA colours of values; transparent where these are NaN."""
        shares: Any = self.normalise(values)
        return np.array(self.colours(np.where(np.isnan(values), np.nan, shares)))

    @property
    def ticks(self) -> FloatArray:
        """Round values between the ends, for the ticks of a colour bar."""
        subs = (1.0,) if self.high > 100 * self.low else (1.0, 2.0, 5.0)
        locator = LogLocator(10.0, subs) if self.is_log else MaxNLocator(7, steps=_STEPS)
        values = np.asarray(locator.tick_values(self.low, self.high))
        slack = 1e-9 * (self.high - self.low)
        return values[(values >= self.low - slack) & (values <= self.high + slack)]

    @property
    def power(self) -> int:
        """Exponent of the power of ten beside the unit of very small or large values, else 0."""
        power = int(np.floor(np.log10(max(abs(self.low), abs(self.high)))))
        return 0 if self.is_log or -3 <= power < 5 else power

    @property
    def labels(self) -> list[str]:
        """Labels of the ticks, with equal numbers of decimals unless logarithmic."""
        plain = [f"{tick:.6g}" for tick in self.ticks / 10.0**self.power + 0.0]
        decimals = max((len(text.partition(".")[2]) for text in plain), default=0)
        texts = plain if self.is_log else [f"{float(text):.{decimals}f}" for text in plain]
        return [text.replace("-", "−") for text in texts]


def draw_field(
    map_frame: MapFrame,
    values: FloatArray,
    scale: ColourScale,
    motion: DisplacementFunction | None = None,
    unit: str = "mm",
) -> Figure:
    """Draw a field of the reference configuration, undeformed or displaced by ``motion``.

    ``values``: (rows, cols) on ``map_frame.grid``; NaN is left blank. ``unit``: unit of lengths.
    """
    drawn, axes = empty_map(map_frame, unit=unit)
    _draw_cells(axes, map_frame, scale.of(values), motion)
    colour_bar(axes, scale)
    return drawn


def draw_image(
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray | None,
    grid: PixelGrid,
    displacement: FloatArray,
    scale: ColourScale | None = None,
    unit: str = "mm",
) -> Figure:
    """Draw an image with a transparent background.

    ``image``: (rows, cols) grey levels, 0 black to 1 white; ``material``: (rows, cols) True on
    material, None: all is drawn, with a golden boundary; ``grid``: their pixels. ``displacement``:
    (n, 2) of the mesh's nodes [mm], for the boundary. ``scale``: of the grey levels,
    by default 0 to 1 of full scale.
    """
    drawn, axes = empty_map(map_frame, unit=unit)
    show_grey(axes, map_frame, image, material, grid)
    boundary = map_frame.boundary.path(displacement)
    draw_edge(axes, boundary)
    if material is None:
        style.draw_path(axes, boundary, fill=False, ec=style.GOLD, lw=0.7, rasterized=True,
                        zorder=2)  # fmt: skip
    colour_bar(axes, scale or ColourScale(style.GREY, 0.0, 1.0, "full scale"))
    return drawn


def draw_shape(map_frame: MapFrame, motion: DisplacementFunction) -> Figure:
    """Draw the specimen's boundary deformed over the undeformed one; no colour bar."""
    drawn, axes = empty_map(map_frame)
    style.draw_path(axes, map_frame.boundary.path(), fill=False, ec=style.MUTED, lw=0.45, alpha=0.7,
                    clip_on=False)  # fmt: skip
    deformed = map_frame.boundary.path(map_frame.moved_nodes(motion))
    style.draw_path(axes, deformed, fc=style.BLUE, ec="none", alpha=0.28, clip_on=False)
    style.draw_path(axes, deformed, fill=False, ec=style.BLUE, lw=0.9, clip_on=False)
    return drawn


def draw_blend(
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray | None,
    grid: PixelGrid,
    values: FloatArray,
    scale: ColourScale,
    motion: DisplacementFunction,
) -> Figure:
    """Draw the deformed image, fading from left to right into a field that was measured in it.

    ``image``, ``material``, ``grid``: as for :func:`draw_image`. ``values``: (rows, cols) measured
    field on ``map_frame.grid``, displaced by ``motion``.
    """
    drawn, axes = empty_map(map_frame, width=3.2)
    # The image is transparent where the field is opaque, or its edges would show at the holes.
    show_grey(axes, map_frame, image, material, grid, dissolve=True)
    colours = scale.of(values)
    colours[..., 3] *= _ramp(values.shape)
    _draw_cells(axes, map_frame, colours, motion)
    colour_bar(axes, scale)
    return drawn


def _draw_cells(
    axes: Axes, map_frame: MapFrame, colours: FloatArray, motion: DisplacementFunction | None
) -> None:
    """Draw cells of RGBA ``colours`` (rows, cols, 4), clipped to the boundary, and the boundary."""
    moved = None if motion is None else map_frame.moved_nodes(motion)
    edge = draw_edge(axes, map_frame.boundary.path(moved))
    if motion is None:
        picture = axes.imshow(colours, extent=map_frame.grid.extent, rasterized=True,
                              interpolation="nearest", aspect="auto")  # fmt: skip
        axes.set(xlim=map_frame.limits[:2], ylim=map_frame.limits[2:])
        picture.set_clip_path(edge)
    else:
        X, Y = map_frame.moved_corners(motion)
        axes.pcolormesh(X, Y, colours, rasterized=True).set_clip_path(edge)


def shaded(
    axes: Axes, mesh: Mesh, moved: FloatArray, values: FloatArray, scale: ColourScale
) -> Collection:
    """Colour T6 elements by nodal values (n,); their nodes are displaced by ``moved`` [mm]."""
    x, y = (mesh.nodes + moved).T
    triangles = Triangulation(x, y, mesh.cells[:, np.array(_FINER)].reshape(-1, 3))
    return axes.tripcolor(triangles, values, shading="gouraud", rasterized=True,
                          cmap=scale.colours, norm=scale.normalise)  # fmt: skip


def empty_map(map_frame: MapFrame, width: float = WIDTH, unit: str = "mm") -> tuple[Figure, Axes]:
    """Make an empty map with a scale bar; ``width`` of the figure [in]."""
    left, right, bottom, top = map_frame.limits
    size = np.array([right - left, top - bottom])
    drawn, axes = bare_axes(width, size, _MAP, _BELOW, _ABOVE)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    length = _round_down(0.35 * size[0])
    style.scale_bar(axes, length, f"{length:g} {unit}")
    return drawn, axes


def bare_axes(
    width: float, size: FloatArray, share: float, below: float, above: float, left: float = 0.01
) -> tuple[Figure, Axes]:
    """Make a figure of a ``width`` [in], and invisible axes with the aspect ratio of ``size``.

    ``share``, ``left``: width and left end of the axes over ``width``. ``below``, ``above`` [in].
    """
    tall = share * width * size[1] / size[0]
    height = tall + below + above
    drawn = style.figure(width, height)
    axes = drawn.add_axes((left, below / height, share, tall / height))
    axes.set_axis_off()
    return drawn, axes


def draw_edge(axes: Axes, path: Path, clip_on: bool = False) -> PathPatch:
    """Draw a boundary as a thin line, also outside the axes unless it is clipped."""
    return style.draw_path(axes, path, fill=False, ec=style.EDGE, lw=0.5, rasterized=True,
                           clip_on=clip_on, zorder=1.5)  # fmt: skip


def colour_bar(axes: Axes, scale: ColourScale) -> None:
    """Draw a colour bar to the right of the axes, and its unit above it.

    It has no axes, unlike matplotlib's colour bars: drawing these would take longer than the map.
    """
    drawn, box = axes.get_figure(root=True), axes.get_position()
    assert drawn is not None
    width, height = drawn.get_size_inches()
    point = _POINTED / height
    left, right = box.x1 + _GAP / width, box.x1 + (_GAP + _BAR) / width
    extended = [scale.extend in (end, "both") for end in ("min", "max")]
    bottom, top = box.y0 + extended[0] * point, box.y1 - extended[1] * point
    place: dict[str, Any] = {"transform": drawn.transFigure, "clip_on": False}
    bbox = TransformedBbox(Bbox([(left, bottom), (right, top)]), drawn.transFigure)
    ramp = BboxImage(bbox, cmap=scale.colours, origin="lower", rasterized=True, zorder=1.4,
                     clip_on=False)  # fmt: skip
    ramp.set_data(np.linspace(0.0, 1.0, 256)[:, None])
    axes.add_artist(ramp)
    for value, flat, end, has in (
        (0.0, bottom, box.y0, extended[0]),
        (1.0, top, box.y1, extended[1]),
    ):
        if has:
            corners = [(left, flat), (right, flat), (0.5 * (left + right), end)]
            axes.add_artist(Polygon(corners, fc=scale.colours(value), ec="none", **place))
    heights = bottom + (top - bottom) * np.asarray(scale.normalise(scale.ticks))
    tick, space = 0.028 / width, 0.06 / width
    axes.add_artist(LineCollection([[(right, y), (right + tick, y)] for y in heights], lw=0.8,
                                   colors=style.MUTED, **place))  # fmt: skip
    for y, label in zip(heights, scale.labels, strict=True):
        axes.text(right + space, y, label, fontsize=7.5, va="center_baseline", **place)
    power = f"{ten_to(scale.power)} " if scale.power else ""
    axes.text(left, box.y1 + 0.085 / height, f"{power}{scale.unit}".strip(), fontsize=8,
              label="colour bar", **place)  # fmt: skip


def _ramp(shape: tuple[int, ...]) -> FloatArray:
    """0 on the left, 1 on the right; the smooth transition is further left in lower rows."""
    up, along = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j]
    t = np.clip((along + 0.25 * up - 0.48) / 0.28, 0.0, 1.0)
    return np.asarray(t**2 * (3 - 2 * t))


def show_grey(
    axes: Axes,
    map_frame: MapFrame,
    image: NDArray[np.float32],
    material: BoolArray | None,
    grid: PixelGrid,
    dissolve: bool = False,
) -> None:
    """Show an image averaged over blocks of pixels, transparent off the material."""
    joined = max(1, map_frame.factor // 2)
    if material is None:
        level = block_means(image, joined)
        cover = np.ones_like(level)
    else:
        cover = block_means(material, joined)
        level = block_means(np.where(material, image, 0.0), joined) / np.maximum(cover, 1e-9)
    rgba = np.repeat(np.clip(level, 0.0, 1.0)[..., None], 4, axis=2)
    rgba[..., 3] = cover * np.minimum(1.0, 4.0 * (1.0 - _ramp(cover.shape))) if dissolve else cover
    axes.imshow(np.nan_to_num(rgba), extent=grid.binned(joined).extent, aspect="auto",
                interpolation="antialiased", rasterized=True)  # fmt: skip
    axes.set(xlim=map_frame.limits[:2], ylim=map_frame.limits[2:])


def _quantile(values: FloatArray, share: float) -> float:
    """Quantile ``share`` of the finite values; 1 if there are none or it isn't positive."""
    finite = values[np.isfinite(values)]
    end = float(np.quantile(finite, share)) if finite.size else 0.0
    return end if end > 0.0 else 1.0


def _round_down(length: float) -> float:
    """Largest value of the form 1, 2 or 5 times a power of ten that is at most ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length))
