"""Figures of what was measured in photographs: the paper's Fig. "real", and standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from modeharvest.idic.solver.pyramid import eroded
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.uncertainty.covariance import FieldErrors
from modeharvest.imaging.spline import SplineImage
from modeharvest.report.figures import maps as fields
from modeharvest.report.figures.curves import draw_density, pattern_density
from modeharvest.report.figures.maps import ColourScale, DisplacementFunction, MapFrame
from modeharvest.report.figures.outlines import MeshBoundary, mask_boundary
from modeharvest.report.figures.style import GLOW, GOLD, draw_path, style
from modeharvest.runs.photographs.results import Harvest, HarvestedFrame
from modeharvest.util.arrays import BoolArray, FloatArray

MOST_SHOWN = 6
"""Photographs with pictures of their own, at most; numbers are told of all."""
FINE, SMOOTH, COARSE = 640, 320, 160
"""Cells along a map's longer side: as fine as speckles, as patterns, as error bars."""
DRAWN_SHAPE = 0.16
"""Largest displacement that modes are drawn with [l]."""
_SPECK = 0.01  # l²: holes and islands smaller than that are not drawn
_LEVELS = (0.5, 99.5)  # percentiles of the reference's grey levels, drawn black and white


@dataclass(frozen=True, eq=False)
class PhotographReportData:
    """A harvest with the frames that its maps are drawn in.

    Parameters
    ----------
    harvest
        What is shown.
    """

    harvest: Harvest
    _sheets: dict[int, MapFrame] = field(default_factory=dict, repr=False)

    @cached_property
    def shown(self) -> tuple[HarvestedFrame, ...]:
        """The frames with pictures: those around buckling, and evenly spaced ones."""
        frames, moments = self.harvest.frames, self.harvest.timeline
        if len(frames) <= MOST_SHOWN:
            return frames
        has_pattern = [m.has_pattern for m in moments] if len(moments) == len(frames) else []
        first = has_pattern.index(True) if True in has_pattern else 0
        chosen = {max(0, first - 1), first, len(frames) - 1}
        for k in np.linspace(0, len(frames) - 1, MOST_SHOWN).round().astype(int):
            if len(chosen) < MOST_SHOWN:
                chosen.add(int(k))
        return tuple(frames[k] for k in sorted(chosen))

    @cached_property
    def outline(self) -> MeshBoundary:
        """Of the material in the reference."""
        harvest = self.harvest
        found = mask_boundary(harvest.mask, harvest.grid, _SPECK * harvest.pitch**2)
        return found if len(found.nodes) else mask_boundary(
            np.ones_like(harvest.mask), harvest.grid)  # fmt: skip

    def sheet(self, cells: int = SMOOTH) -> MapFrame:
        """The frame of maps with about that many cells along the longer side."""
        if cells not in self._sheets:
            grid = self.harvest.grid
            factor = max(1, round(max(grid.shape) / cells))
            low, high = self.outline.nodes.min(axis=0), self.outline.nodes.max(axis=0)
            margin = 0.012 * float((high - low).max())
            limits = (low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
            self._sheets[cells] = MapFrame(self.outline, grid.binned(factor), factor, limits)
        return self._sheets[cells]

    @cached_property
    def levels(self) -> tuple[float, float]:
        """Grey levels of the reference that are drawn black and white."""
        step = max(1, max(self.harvest.grid.shape) // 700)
        low, high = np.percentile(self.harvest.reference[::step, ::step], _LEVELS)
        return float(low), float(max(high, low + 1e-12))

    def grey(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """Grey levels of a photograph as 0 (black) to 1 (white)."""
        low, high = self.levels
        return np.clip((np.asarray(image, dtype=np.float32) - np.float32(low))
                       / np.float32(high - low), 0.0, 1.0)  # fmt: skip

    def seen(self, values: FloatArray, cells: int = SMOOTH) -> FloatArray:
        """Values on a sheet; NaN off the material, where the ansatz means nothing."""
        return np.where(self.material(cells), values, np.nan)

    def material(self, cells: int = SMOOTH) -> BoolArray:
        """Which cells of a sheet have material in the reference."""
        sheet, mask = self.sheet(cells), self.harvest.mask
        (rows, cols), n = sheet.grid.shape, sheet.factor
        blocks = mask[: rows * n, : cols * n].reshape(rows, n, cols, n)
        return np.asarray(blocks.any(axis=(1, 3)))

    @staticmethod
    def motion(frame: HarvestedFrame) -> DisplacementFunction:
        """The displacement that was measured in a frame."""
        result = frame.result
        return lambda x, y: result.ansatz.displacement(result.unknowns, x, y)


UM = 1e3  # micrometres in a millimetre
Cause = Literal["noise", "model_error"]
_NO_PATTERN = WavePattern((), None, "none", None, 0.0, ())
_REACH = 0.75  # spacings of a local DIC from a point, within which a cell has its value


def draw_deformed(atlas: PhotographReportData, frame: HarvestedFrame) -> Figure:
    """Draw a deformed photograph, and over it the reference's outline moved as measured."""
    sheet, motion = atlas.sheet(), atlas.motion(frame)
    moved = sheet.moved_nodes(motion)
    assert moved is not None
    everywhere = np.ones(frame.image.shape, dtype=np.bool_)
    drawn = fields.draw_image(sheet, atlas.grey(frame.image), everywhere, atlas.harvest.grid, moved)
    with style():
        path = sheet.outline.path(moved)
        axes, bar = drawn.axes
        draw_path(axes, path, fill=False, ec=GOLD, lw=0.7, rasterized=True, zorder=2)
        bar.set_yticks([0.0, 1.0], [f"{level:.0f}" for level in atlas.levels])
        bar.set_title("levels", fontsize=8, pad=6, loc="left")
    return drawn


def draw_spectrum(atlas: PhotographReportData, frame: HarvestedFrame, component: int) -> Figure:
    """Draw S_xx (component 0) or S_yy (1); the colours end at the strongest pattern shown."""
    assert frame.spectrum is not None
    pairs = [(f.spectrum, f.pattern) for f in atlas.shown if f.spectrum and f.pattern]
    end = max((pattern_density(*pair) for pair in pairs), default=0.0)
    return draw_density(frame.spectrum, frame.pattern or _NO_PATTERN, component, end)


def draw_part_spectrum(
    atlas: PhotographReportData, frame: HarvestedFrame, part: int, component: int
) -> Figure:
    """Draw the same of a part with modes of its own; the colours are that part's."""
    end = max(pattern_density(f.parts[part].spectrum, f.parts[part].pattern) for f in atlas.shown)
    own = frame.parts[part]
    return draw_density(own.spectrum, own.pattern, component, end)


def draw_v0(atlas: PhotographReportData, frame: HarvestedFrame, component: int) -> Figure:
    """Draw a component of the slow field."""
    v0 = UM * frame.result.v0(atlas.sheet().grid)[..., component]
    return fields.draw_field(atlas.sheet(), v0, ColourScale.signed(atlas.seen(v0), "µm"))


def draw_amplitude(atlas: PhotographReportData, frame: HarvestedFrame, i: int) -> Figure:
    """Draw v_i where phi_i is not zero; the colours end at the largest value among the holes."""
    support = _support(atlas, frame, i)
    v = UM * frame.result.v(i, atlas.sheet().grid)
    inside = atlas.seen(np.where(support == 1.0, v, np.nan))
    scale = replace(ColourScale.signed(inside, "µm"), extend="both")
    return fields.draw_field(atlas.sheet(), np.where(support > 0.0, v, np.nan), scale)


def draw_mode(atlas: PhotographReportData, frame: HarvestedFrame, i: int) -> Figure:
    """Draw phi_i as a deformed outline over the undeformed one."""
    result, scale = frame.result, mode_scale(atlas, frame, i)
    return fields.draw_shape(
        atlas.sheet(), lambda x, y: scale * result.ansatz.phi(i, result.unknowns, x, y)
    )


def mode_scale(atlas: PhotographReportData, frame: HarvestedFrame, i: int) -> float:
    """By how much phi_i is drawn, for a largest displacement of SHAPE l [mm]."""
    largest = float(np.linalg.norm(frame.result.phi(i, atlas.sheet().grid), axis=-1).max())
    return DRAWN_SHAPE * atlas.harvest.pitch / largest if largest > 0 else 1.0


def draw_fluctuation(
    atlas: PhotographReportData, frame: HarvestedFrame, i: int, component: int
) -> Figure:
    """Draw a component of v_i phi_i in the deformed configuration of this contribution alone."""
    result = frame.result
    field = UM * result.fluctuation(i, atlas.sheet().grid)[..., component]
    return fields.draw_field(
        atlas.sheet(), field, ColourScale.signed(atlas.seen(field), "µm"),
        lambda x, y: result.ansatz.fluctuation(i, result.unknowns, x, y),
    )  # fmt: skip


def draw_residual(atlas: PhotographReportData, frame: HarvestedFrame) -> Figure:
    """Draw f - g(x + u) in the deformed configuration, single pixels."""
    full = atlas.harvest.full_scale
    values = np.asarray(_residual(atlas, frame) / (full or 1.0), dtype=np.float64)
    scale = ColourScale.signed(values, "" if full else "levels", 0.99)
    return fields.draw_field(atlas.sheet(FINE), values, scale, atlas.motion(frame))


def draw_w(atlas: PhotographReportData, frame: HarvestedFrame) -> Figure:
    """Draw the length of w = local DIC - IDIC in the deformed configuration."""
    assert frame.local is not None
    result = frame.result
    w = frame.local.less(lambda points: result.ansatz.displacement_at(result.unknowns, points))
    cells = min(SMOOTH, max(40, int(max(atlas.harvest.grid.shape) * atlas.harvest.grid.pixel_size
                                    / w.spacing)))  # fmt: skip
    sheet = atlas.sheet(cells)
    points = np.stack(np.meshgrid(sheet.grid.x, sheet.grid.y), axis=-1)
    near, nearest = cKDTree(np.column_stack([w.x, w.y])[w.good]).query(points)
    reach = _REACH * max(w.spacing, sheet.grid.pixel_size)
    length = UM * np.linalg.norm(w.u[w.good], axis=1)[nearest]
    length = np.where(near <= reach, length, np.nan)
    scale = ColourScale.size(length, "µm", 0.998)
    return fields.draw_field(sheet, length, scale, atlas.motion(frame))


def draw_error(
    atlas: PhotographReportData, frame: HarvestedFrame, field: str, cause: Cause
) -> Figure:
    """Draw the standard deviation of "v0", "v1", ... or "fluc1", ..., lengths of vector fields.

    That of a vector is the root of the sum of both components' variances.
    """
    sheet = atlas.sheet(COARSE)
    errors = frame.by_noise if cause == "noise" else frame.by_model_error
    assert errors is not None
    sd = UM * _resampled(frame, _sd(errors, field), sheet)
    if field != "v0":
        i = int(field.removeprefix("fluc").removeprefix("v")) - 1
        sd = np.where(_support(atlas, frame, i, COARSE) > 0.0, sd, np.nan)
    return fields.draw_field(sheet, sd, ColourScale.size(atlas.seen(sd, COARSE), "µm", 0.99))


def draw_error_against_truth(
    atlas: PhotographReportData, frame: HarvestedFrame, part: str
) -> Figure:
    """Draw a part of the error, in the deformed configuration.

    "true_w" is truth - IDIC, "best" truth - best fit, "loss" best fit - IDIC.
    """
    truth = atlas.harvest.truth
    assert truth is not None
    known, sheet = truth.frames[frame.name], atlas.sheet()
    rows, cols = _pixels(sheet)
    x, y = atlas.harvest.grid.x[cols], atlas.harvest.grid.y[rows]
    fields_of = {
        "truth": lambda: np.asarray(known.displacement[np.ix_(rows, cols)], dtype=np.float64),
        "best": lambda: known.best.ansatz.displacement(known.best.unknowns, x, y),
        "idic": lambda: frame.result.ansatz.displacement(frame.result.unknowns, x, y),
    }
    first, second = {"true_w": ("truth", "idic"), "best": ("truth", "best"),
                     "loss": ("best", "idic")}[part]  # fmt: skip
    length = UM * np.linalg.norm(fields_of[first]() - fields_of[second](), axis=-1)
    length = np.where(atlas.harvest.mask[np.ix_(rows, cols)], length, np.nan)
    return fields.draw_field(
        sheet, length, ColourScale.size(length, "µm", 0.998), atlas.motion(frame)
    )


def draw_hero(atlas: PhotographReportData) -> Figure:
    """Let the last photograph dissolve into the pattern that was found in it."""
    frame, sheet = atlas.harvest.frames[-1], atlas.sheet()
    pattern = frame.result.displacement(sheet.grid)
    if frame.modes:
        pattern = pattern - frame.result.v0(sheet.grid)
    length = UM * np.linalg.norm(pattern, axis=-1)
    end = ColourScale.size(atlas.seen(length), "µm")
    everywhere = np.ones(frame.image.shape, dtype=np.bool_)
    drawn = fields.draw_blend(
        sheet, atlas.grey(frame.image), everywhere, atlas.harvest.grid, length,
        ColourScale(GLOW, 0.0, end.high, "µm"), atlas.motion(frame),
    )  # fmt: skip
    # The photograph ends where the measured outline does: a mask of it may have ragged edges.
    axes = drawn.axes[0]
    axes.images[0].set_clip_path(axes.patches[0])
    return drawn


def _support(
    atlas: PhotographReportData, frame: HarvestedFrame, i: int, cells: int = SMOOTH
) -> FloatArray:
    """Taper of mode i on a sheet [-]."""
    taper, grid = frame.result.ansatz.modes[i].taper, atlas.sheet(cells).grid
    return np.asarray(taper.along_y(grid.y)[:, None] * taper.along_x(grid.x)[None, :])


def _pixels(sheet: MapFrame) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the images' pixels that the middles of a sheet's cells show."""
    n = sheet.factor
    rows, cols = (n // 2 + n * np.arange(size) for size in sheet.grid.shape)
    return rows, cols


def _residual(atlas: PhotographReportData, frame: HarvestedFrame) -> FloatArray:
    """The residual at a pixel of each fine cell [grey levels]; NaN where not compared."""
    harvest, ansatz, a = atlas.harvest, frame.result.ansatz, frame.result.unknowns
    rows, cols = _pixels(atlas.sheet(FINE))
    x, y = harvest.grid.x[cols], harvest.grid.y[rows]
    u = ansatz.displacement(a, x, y) / harvest.grid.pixel_size
    spline = SplineImage.of(np.asarray(frame.image), frame.result.order)
    value, _, _ = spline.sample(rows[:, None] - u[..., 1], cols[None, :] + u[..., 0])
    gain, offset = ansatz.gain_and_offset(a, x, y)
    picked = np.ix_(rows, cols)
    residual = harvest.reference[picked] - gain * value - offset
    return np.where(eroded(harvest.mask, harvest.edge_px)[picked], residual, np.nan)


def _sd(errors: FieldErrors, field: str) -> FloatArray:
    """(q, p) standard deviation of a field [mm]."""
    if field == "v0":
        return np.asarray(np.linalg.norm(errors.v0, axis=-1))
    if field.startswith("fluc"):
        return np.asarray(np.linalg.norm(errors.fluctuation[int(field[4:]) - 1], axis=-1))
    return np.asarray(errors.v[int(field[1:]) - 1])


def _resampled(frame: HarvestedFrame, sd: FloatArray, sheet: MapFrame) -> FloatArray:
    """Error bars on the cells of a sheet, linear between the axes' values; NaN if infinite."""
    along_y, along_x = np.argsort(frame.error_y), np.argsort(frame.error_x)
    between = RegularGridInterpolator(
        (frame.error_y[along_y], frame.error_x[along_x]),
        np.where(np.isfinite(sd), sd, np.nan)[np.ix_(along_y, along_x)],
        bounds_error=False, fill_value=None,
    )  # fmt: skip
    y, x = np.meshgrid(sheet.grid.y, sheet.grid.x, indexing="ij")
    return np.asarray(np.maximum(between((y, x)), 0.0))
