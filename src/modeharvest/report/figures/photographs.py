"""Figures of photographs: the reference and its lens, the measured fields, their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from modeharvest.idic.photograph.holes import HoleLattice
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.idic.uncertainty.covariance import FieldErrors
from modeharvest.imaging.distortion.calibrate import Calibration
from modeharvest.imaging.distortion.lens import Distortion, apart_without_affine
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.spline import SplineImage
from modeharvest.report.figures import fits, maps, style
from modeharvest.report.figures.boundaries import MeshBoundary, block_means, mask_boundary
from modeharvest.report.figures.curves import draw_density
from modeharvest.report.figures.fits import UM
from modeharvest.report.figures.maps import ColourScale
from modeharvest.report.figures.style import BLUE, GOLD, GREEN, GREY, INK, RED
from modeharvest.report.figures.whole_field import WholeMaps, middle_pixels
from modeharvest.runs.photographs.results import (
    MOST_SHOWN,
    FrameTruth,
    Harvest,
    HarvestedFrame,
    shown_moments,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.truth import lengths

CLOSE = 3
"""Side of a close-up, in unit cells."""
_NO_PATTERN = WavePattern((), None, ())
_SPECK = 0.01  # largest area of holes and islands that are not drawn [l²]
_LEVELS = (0.5, 99.5)  # percentiles of the reference's grey levels, drawn black and white
_REACH = 0.75  # distance from a local DIC point up to which cells have its value [spacings]


def shown_frames(harvest: Harvest) -> tuple[HarvestedFrame, ...]:
    """Photographs that are shown as figures."""
    frames, moments = harvest.frames, harvest.timeline
    if len(frames) != len(moments):
        return frames[:MOST_SHOWN]
    return tuple(frames[k] for k in shown_moments(moments))


def material_boundary(harvest: Harvest) -> MeshBoundary:
    """Boundary of the reference's material, or of the whole image if no material was found."""
    found = mask_boundary(harvest.mask, harvest.grid, _SPECK * harvest.pitch**2)
    everything = np.ones_like(harvest.mask)
    return found if len(found.nodes) else mask_boundary(everything, harvest.grid)


def drawn_levels(harvest: Harvest) -> tuple[float, float]:
    """Grey levels of the reference that are drawn black and white."""
    step = max(1, max(harvest.grid.shape) // 700)
    low, high = np.percentile(harvest.reference[::step, ::step], _LEVELS)
    return float(low), float(max(high, low + 1e-12))


def grey_levels(image: NDArray[Any], levels: tuple[float, float]) -> NDArray[np.float32]:
    """Scale a photograph so that the two ``levels`` become 0 (black) and 1 (white); clipped."""
    low, high = map(np.float32, levels)
    return np.clip((np.asarray(image, dtype=np.float32) - low) / (high - low), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PhotographState(fits.FittedState):
    """A deformed photograph."""

    harvest: Harvest
    frame: HarvestedFrame
    levels: tuple[float, float]
    """Grey levels that are drawn black and white."""


def photograph_states(harvest: Harvest, labels: Mapping[str, str]) -> list[PhotographState]:
    """States of the photographs that are shown; ``labels``: labels by the photographs' names."""
    shown = shown_frames(harvest)
    view = fits.SpecimenView(material_boundary(harvest), harvest.grid, harvest.mask, harvest.pitch)
    levels = drawn_levels(harvest)
    pairs = [(frame.spectrum, frame.pattern or _NO_PATTERN) for frame in shown]
    end = fits.largest_density((spectrum, pattern) for spectrum, pattern in pairs if spectrum)

    def densities(k: int) -> tuple[Spectrum, WavePattern, float]:
        spectrum, pattern = pairs[k]
        assert spectrum is not None
        return spectrum, pattern, end

    return [
        PhotographState(str(k + 1), labels[frame.name], view, frame.result, partial(densities, k),
                        harvest, frame, levels)
        for k, frame in enumerate(shown)
    ]  # fmt: skip


def draw_hero(state: PhotographState) -> Figure:
    """Draw a photograph that fades into the size of the pattern measured in it."""
    result, map_frame = state.result, state.view.map_frame()
    pattern = result.displacement(map_frame.grid)
    if state.frame.modes:
        pattern = pattern - result.v0(map_frame.grid)
    image = grey_levels(state.frame.image, state.levels)
    drawn = fits.draw_dissolving(state, image, None, UM * np.linalg.norm(pattern, axis=-1))
    # The photograph is clipped to the measured boundary: its mask may have ragged edges.
    axes = drawn.axes[0]
    axes.images[0].set_clip_path(axes.patches[0])
    return drawn


def draw_deformed(state: PhotographState) -> Figure:
    """Draw a deformed photograph with the reference's boundary, displaced as measured."""
    map_frame = state.view.map_frame()
    moved = map_frame.moved_nodes(state.motion)
    image = grey_levels(state.frame.image, state.levels)
    scale = ColourScale(GREY, *state.levels, "levels")
    return maps.draw_image(map_frame, image, None, state.view.grid, moved, scale)


def draw_closeup(state: PhotographState) -> Figure:
    """Draw a few cells of a deformed photograph in full resolution, with the measured boundary."""
    grid, middle = state.view.grid, np.array(state.harvest.geometry.region.cellular.centre)
    x, y = middle + state.motion(*middle[:, None, None])[0, 0]
    half = 0.5 * CLOSE * state.view.pitch
    corners = grid.to_px([x - half, x + half], [y + half, y - half])
    (top, bottom), (left, right) = (
        np.clip(np.rint(edge).astype(int), 0, size - 1)
        for edge, size in zip(corners, grid.shape, strict=True)
    )
    part = grey_levels(state.frame.image[top : bottom + 1, left : right + 1], state.levels)
    x0, y0 = map(float, grid.to_mm(top, left))
    drawn = style.figure(maps.WIDTH, maps.WIDTH)
    axes = drawn.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    _show(axes, part, PixelGrid(len(part), part.shape[1], grid.pixel_size, x0, y0).extent)
    path = state.view.boundary.path(state.view.map_frame().moved_nodes(state.motion))
    style.draw_path(axes, path, fill=False, ec=GOLD, lw=1.1, rasterized=True)
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    return drawn


def _show(axes: Axes, grey: NDArray[Any], extent: tuple[float, float, float, float]) -> None:
    """Show grey levels from 0 (black) to 1 (white)."""
    axes.imshow(grey, extent=extent, cmap=GREY, vmin=0.0, vmax=1.0, interpolation="antialiased",
                rasterized=True, aspect="auto")  # fmt: skip


def draw_part_spectrum(state: PhotographState, part: int, component: int) -> Figure:
    """Draw S_xx or S_yy of a part of the displacement, in the same colours for all photographs."""
    parts = [frame.parts[part] for frame in shown_frames(state.harvest)]
    end = fits.largest_density([(p.spectrum, p.pattern) for p in parts])
    own = state.frame.parts[part]
    return draw_density(own.spectrum, own.pattern, component, end)


def draw_residual(state: PhotographState) -> Figure:
    """Draw the residual at single pixels in the deformed configuration; blank if not compared."""
    map_frame = state.view.map_frame(fits.FINE)
    values = residual_of(state, map_frame)
    unit = "full scale" if state.harvest.full_scale else "levels"
    return maps.draw_field(map_frame, values, ColourScale.signed(values, unit, 0.99), state.motion)


def residual_of(state: PhotographState, map_frame: maps.MapFrame) -> FloatArray:
    """f - gain g(x + u) - offset at a frame's pixels [full scale or grey levels], or NaN."""
    harvest, ansatz, a = state.harvest, state.result.ansatz, state.result.unknowns
    (rows, cols), grid = map_frame.pixels, middle_pixels(map_frame, state.harvest.grid)
    u = state.result.displacement(grid) / grid.pixel_size * map_frame.factor
    spline = SplineImage.of(np.asarray(state.frame.image), state.result.order)
    value, _, _ = spline.sample(rows[:, None] - u[..., 1], cols[None, :] + u[..., 0])
    gain, offset = ansatz.gain_and_offset(a, grid.x, grid.y)
    residual = map_frame.sample(harvest.reference) - gain * value - offset
    compared = map_frame.sample(eroded(harvest.mask, harvest.case.correlation.edge_px))
    return np.where(compared, residual / (harvest.full_scale or 1.0), np.nan)


def draw_w(state: PhotographState) -> Figure:
    """Draw ‖w‖ (local DIC or whole displacement, minus IDIC) in the deformed configuration."""
    w, grid = state.frame.w, state.view.grid
    assert w is not None
    cells = min(fits.SMOOTH, max(40, int(max(grid.shape) * grid.pixel_size / w.spacing)))
    map_frame = state.view.map_frame(cells)
    points = np.stack(np.meshgrid(map_frame.grid.x, map_frame.grid.y), axis=-1)
    near, nearest = cKDTree(np.column_stack([w.x, w.y])[w.good]).query(points)
    reach = _REACH * max(w.spacing, map_frame.grid.pixel_size)
    length = np.linalg.norm(w.u[w.good], axis=1)[nearest]
    return fits.draw_length(state, np.where(near <= reach, length, np.nan), cells)


def has_error(state: PhotographState, name: str, i: int, cause: str) -> bool:
    """Whether the standard deviation is known that :func:`draw_error` draws for the same."""
    return _errors(state, cause) is not None and (name == "v0" or fits.has_mode(i)(state))


def draw_error(state: PhotographState, name: str, i: int, cause: str) -> Figure:
    """Draw the standard deviation of "v0", or of "v" or "fluc" of mode i, by "noise" or "model".

    For vectors it is the root of the sum of both components' variances.
    """
    map_frame, errors = state.view.map_frame(fits.COARSE), _errors(state, cause)
    assert errors is not None
    if name == "v":
        sd = np.asarray(errors.v[i])
    else:
        sd = np.linalg.norm(errors.v0 if name == "v0" else errors.fluctuation[i], axis=-1)
    sd = UM * _resampled(state.frame, sd, map_frame)
    if name != "v0":
        sd = np.where(state.support(i, fits.COARSE) > 0.0, sd, np.nan)
    scale = ColourScale.size(state.view.on_material(sd, fits.COARSE), "µm", 0.99)
    return maps.draw_field(map_frame, sd, scale)


def _errors(state: PhotographState, cause: str) -> FieldErrors | None:
    return state.frame.by_noise if cause == "noise" else state.frame.by_model_error


def _resampled(frame: HarvestedFrame, sd: FloatArray, map_frame: maps.MapFrame) -> FloatArray:
    """Error bars, interpolated linearly from the frame's axes to a map's cells; NaN if infinite."""
    along_y, along_x = np.argsort(frame.error_y), np.argsort(frame.error_x)
    between = RegularGridInterpolator(
        (frame.error_y[along_y], frame.error_x[along_x]),
        np.where(np.isfinite(sd), sd, np.nan)[np.ix_(along_y, along_x)],
        bounds_error=False, fill_value=None,
    )  # fmt: skip
    y, x = np.meshgrid(map_frame.grid.y, map_frame.grid.x, indexing="ij")
    return np.asarray(np.maximum(between((y, x)), 0.0))


def draw_error_against_truth(state: PhotographState, part: str) -> Figure:
    """Draw the length of a part of the error in the deformed configuration.

    ``part``: "true_w" for truth - IDIC, "best" for truth - best fit, "loss" for best fit - IDIC.
    """
    harvest, map_frame, known = state.harvest, state.view.map_frame(), truth_of(state)
    assert known is not None
    grid, truth = middle_pixels(map_frame, harvest.grid), map_frame.sample(known.displacement)
    best, idic = known.best.displacement(grid), state.result.displacement(grid)
    error = {"true_w": truth - idic, "best": truth - best, "loss": best - idic}[part]
    return fits.draw_length(state, np.where(map_frame.sample(harvest.mask), lengths(error), np.nan))


def truth_of(state: PhotographState) -> FrameTruth | None:
    """The truth of a photograph; None if it is not known."""
    truth = state.harvest.truth
    return None if truth is None else truth.frames.get(state.frame.name)


WHOLE_MAPS: WholeMaps[PhotographState] = WholeMaps(
    lambda s: s.frame.whole,
    lambda s: None if (truth := truth_of(s)) is None else truth.displacement,
)

WIDE, NARROW = 5.2, 3.5  # widths of figures on half a page, and on a third of it [in]
_LEGEND = 0.26  # height of a legend [in]
_PIXELS = 1000  # approximate number along the reference's longer side, as drawn
_CELLS, _ARROWS = 120, 17  # number along the longer side of a distortion's map
_LENGTH = 0.9  # length of the longest arrow, over the distance between arrows [-]


def draw_reference(harvest: Harvest, boundary: MeshBoundary, levels: tuple[float, float]) -> Figure:
    """Draw the reference and what was detected in it (material, lattice, region), for checking."""
    size = np.array([harvest.grid.cols, harvest.grid.rows])
    drawn, axes = maps.bare_axes(WIDE, size, 0.996, 0.02, _LEGEND, 0.002)
    factor = max(1, round(max(harvest.grid.shape) / _PIXELS))
    joined = block_means(grey_levels(harvest.reference, levels), factor)
    _show(axes, joined, harvest.grid.binned(factor).extent)
    axes.set(xlim=harvest.grid.extent[:2], ylim=harvest.grid.extent[2:])
    style.draw_path(axes, boundary.path(), fill=False, ec=GOLD, lw=0.9, rasterized=True)
    shown = [Line2D([], [], color=GOLD, lw=1.2, label="material")]
    if harvest.geometry.lattice is not None:
        shown += _draw_lattice(axes, harvest.geometry.lattice, harvest.grid)
    box = harvest.geometry.region.cellular
    axes.add_patch(Rectangle((box.x_min, box.y_min), box.x_max - box.x_min, box.y_max - box.y_min,
                             fill=False, ec=RED, lw=1.3, ls=(0, (4, 2))))  # fmt: skip
    shown.append(Line2D([], [], color=RED, lw=1.3, ls=(0, (3, 1.5)), label="part with holes"))
    axes.legend(handles=shown, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(shown),
                handlelength=1.6, columnspacing=1.4, borderaxespad=0.1)  # fmt: skip
    return drawn


def draw_distortion(distortion: Distortion, grid: PixelGrid) -> Figure:
    """Draw a distortion S: length [px] in colour, and enlarged arrows; ``grid``: image pixels."""
    drawn = _coloured(grid, np.hypot(*distortion.shift(*_positions(grid, _CELLS))))
    rows, cols = _positions(grid, _ARROWS)
    down, right, row, col = np.broadcast_arrays(*distortion.shift(rows, cols), rows, cols)
    longest = float(np.hypot(down, right).max())
    step = max(grid.shape) / _ARROWS
    enlarged = _LENGTH * step / longest if longest > 0 else 1.0
    drawn.axes[0].quiver(col, row, enlarged * right, enlarged * down, angles="xy", color="white",
                         scale_units="xy", scale=1.0, width=0.0035, pivot="mid")  # fmt: skip
    return drawn


def draw_distortion_sd(calibration: Calibration, grid: PixelGrid) -> Figure:
    """Draw the standard deviation of S by image noise [px], from both components' variances."""
    return _coloured(grid, np.hypot(*calibration.sd(*_positions(grid, _CELLS))))


def draw_distortion_error(found: Distortion, true: Distortion, grid: PixelGrid) -> Figure:
    """Draw the length of S_found - S_true [px] without the affine part, which isn't observable."""
    return _coloured(grid, np.hypot(*apart_without_affine(found, true, *_positions(grid, _CELLS))))


def _positions(grid: PixelGrid, count: int) -> tuple[FloatArray, FloatArray]:
    """Rows (r, 1) and columns (1, c) of cells' centres [px], about ``count`` on the longer side."""
    step = max(grid.shape) / count
    rows, cols = (max(2, round(size / step)) for size in grid.shape)
    along_row = (np.arange(rows) + 0.5) * grid.rows / rows - 0.5
    along_col = (np.arange(cols) + 0.5) * grid.cols / cols - 0.5
    return along_row[:, None], along_col[None, :]


def _coloured(grid: PixelGrid, length: FloatArray) -> Figure:
    """Draw a map of lengths [px] over the whole image, columns to the right and rows down."""
    size = np.array([grid.cols, grid.rows])
    drawn, axes = maps.bare_axes(NARROW, size, 0.77, 0.02, _LEGEND, 0.002)
    scale = ColourScale.size(length, "px")
    axes.imshow(length, extent=(-0.5, grid.cols - 0.5, grid.rows - 0.5, -0.5), cmap=style.SIZE,
                norm=scale.normalise, interpolation="bilinear", rasterized=True,
                aspect="auto")  # fmt: skip
    axes.set(xlim=(-0.5, grid.cols - 0.5), ylim=(grid.rows - 0.5, -0.5))
    maps.colour_bar(axes, scale)
    return drawn


def _draw_lattice(axes: Axes, lattice: HoleLattice, grid: PixelGrid) -> list[Line2D]:
    """Draw holes, their straight lattice, and deviations from it; returns entries of a legend."""
    (i0, j0), (i1, j1) = lattice.index.min(axis=0), lattice.index.max(axis=0)
    ends = [((i, j0), (i, j1)) for i in range(i0, i1 + 1)]
    ends += [((i0, j), (i1, j)) for j in range(j0, j1 + 1)]
    lines = [np.stack(grid.to_mm(*lattice.position(pair).T), axis=1) for pair in ends]
    axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=0.7, alpha=0.9))
    handles = [Line2D([], [], color=BLUE, lw=1.0, label="lattice")]
    kinds = (
        (lattice.centres, "o", GREEN, f"{len(lattice)} holes"),
        (lattice.position(lattice.missing), "x", RED, f"{len(lattice.missing)} missing"),
        (lattice.extra, "s", INK, f"{len(lattice.extra)} off it"),
    )
    for at, marker, colour, name in kinds:
        if len(at):
            dots = axes.plot(*grid.to_mm(*at.T), marker, color=colour, ms=3.0, mew=1.0, ls="none",
                             label=name)  # fmt: skip
            handles += dots
    return handles
