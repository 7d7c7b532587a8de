"""Figures of infinite lattices: the deformed lattice, waves, branches, dependence on d/l."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import Voronoi

from modeharvest.fem.bloch.dispersion import Dispersion, ZoneMap
from modeharvest.fem.bloch.modes import Branch
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import Wave
from modeharvest.report.figures.curves import DASHES, annotate, curve, legend_above
from modeharvest.report.figures.maps import WIDTH, ColourScale, colour_bar
from modeharvest.report.figures.outlines import LatticePatch, MeshBoundary, triangles
from modeharvest.report.figures.style import (
    BLUE,
    COLOURS,
    DENSITY,
    GLOW,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    SIGNED,
    SIZE,
    draw_path,
    figure,
    scale_bar,
)
from modeharvest.runs.lattice.results import combination_name
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.lattice import ModeRow

WINDOW_WIDTH = 2.35  # of a window [in]
_MARGIN = 0.24  # below it, for the scale bar [in]
_EMBER = LinearSegmentedColormap.from_list(  # seen on a dark page from the first value on
    "ember", np.vstack([to_rgba_array("#46506a"), GLOW(np.linspace(0.3, 1.0, 16))])
)


def draw_lattice(
    patch: LatticePatch,
    pitch: float,
    displacement: FloatArray | None = None,
    gradient: FloatArray | None = None,
) -> Figure:
    """Draw the lattice where it is, or where a displacement takes it, with its cell's outline.

    Parameters
    ----------
    patch
        Copies of the cell, and the window.
    pitch
        Unit cell size l [mm], for the scale bar.
    displacement
        (n, 2) of the cell's nodes [mm]; None for the undeformed lattice.
    gradient
        (2, 2) F̄ of its affine part [-]; None for a periodic displacement.
    """
    moved = None if displacement is None else patch.moved(displacement, gradient)
    F = np.eye(2) if gradient is None else np.asarray(gradient)
    drawn, axes = _window_axes(patch, pitch)
    outline = patch.outline.path(moved)
    draw_path(axes, outline, fc=BLUE, ec="none", alpha=0.28)
    draw_path(axes, outline, fill=False, ec=BLUE, lw=0.7)
    corners = (patch.cell_corners - patch.centre) @ F.T + patch.centre
    axes.add_patch(Polygon(corners, fill=False, ec=RED, lw=1.3, ls=(0, (4, 2)), zorder=3))
    return drawn


def draw_growth(patch: LatticePatch, shape: FloatArray, amplitude: float, pitch: float) -> Figure:
    """Draw a mode whose amplitude rises from nothing on the left to all on the right.

    No equilibrium: a picture of what the mode does. The colours are the displacement's length.

    Parameters
    ----------
    patch
        Copies of the cell, and the window.
    shape
        (n, 2) the mode at the cell's nodes [-].
    amplitude
        Largest displacement, at the right [mm].
    pitch
        Unit cell size l [mm].
    """
    largest = float(np.linalg.norm(shape, axis=1).max())
    left, right = patch.limits[:2]
    t = np.clip((patch.mesh.nodes[:, 0] - left) / (right - left) * 1.25 - 0.15, 0.0, 1.0)
    ramp = t**2 * (3.0 - 2.0 * t)
    moved = amplitude / largest * ramp[:, None] * shape[patch.node]
    drawn, axes = _window_axes(patch, pitch, width=3.6, bar=True)
    path = patch.outline.path(moved)
    length = np.linalg.norm(moved, axis=1)
    scale = ColourScale(_EMBER, 0.0, amplitude / pitch, "l")
    nodes = patch.mesh.nodes + moved
    shading = axes.tripcolor(triangles(nodes, patch.mesh.cells), length / pitch, rasterized=True,
                             shading="gouraud", cmap=scale.colours,
                             norm=scale.normalise)  # fmt: skip
    edge = draw_path(axes, path, fill=False, ec="none", rasterized=True)
    shading.set_clip_path(edge)
    colour_bar(drawn, axes, scale)
    return drawn


def draw_overlay(
    mesh: Mesh, pitch: float, numerical: FloatArray, analytic: FloatArray, largest: float
) -> Figure:
    """Draw one cell deformed by two modes of the same size: the paper's Fig. "graded".

    Parameters
    ----------
    mesh
        A quarter of the mode's cell [mm].
    pitch
        Unit cell size l [mm].
    numerical, analytic
        (n, 2) both modes at its nodes, of equal norm over the material.
    largest
        Largest displacement of the numerical one, as drawn [mm].
    """
    factor = largest / float(np.linalg.norm(numerical, axis=1).max())
    outline = MeshBoundary.of(mesh)
    grey, black = outline.path(factor * analytic), outline.path(factor * numerical)
    nodes = np.vstack([mesh.nodes + factor * analytic, mesh.nodes + factor * numerical])
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    drawn, axes = _frame_axes(high - low)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    draw_path(axes, grey, fc=MUTED, ec="none", alpha=0.45, clip_on=False)
    draw_path(axes, black, fc=INK, ec="none", alpha=0.14, clip_on=False)
    draw_path(axes, black, fill=False, ec=INK, lw=1.1, clip_on=False)
    scale_bar(axes, 0.5 * pitch, "l/2")
    return drawn


def _window_axes(
    patch: LatticePatch, pitch: float, width: float = WINDOW_WIDTH, bar: bool = False
) -> tuple[Figure, Axes]:
    """Empty axes over the patch's window, with a scale bar of one cell."""
    drawn, axes = _frame_axes(patch.window, width, 0.76 if bar else 0.98)
    left, right, bottom, top = patch.limits
    axes.set(xlim=(left, right), ylim=(bottom, top))
    scale_bar(axes, pitch, "l")
    return drawn, axes


def _frame_axes(
    size: FloatArray, width: float = WINDOW_WIDTH, share: float = 0.98
) -> tuple[Figure, Axes]:
    tall = share * width * size[1] / size[0]
    above = 0.03 if share > 0.9 else 0.22
    height = tall + _MARGIN + above
    drawn = figure(width, height)
    axes = drawn.add_axes((0.01, _MARGIN / height, share, tall / height))
    axes.set_axis_off()
    return drawn, axes


_LOADS = LinearSegmentedColormap.from_list("loads", to_rgba_array([BLUE, GREEN, GOLD, RED]))
_PIXELS = 360  # along a zone map's side
_NEAR = 2e-4  # turns: waves that near are the same
_UNIT = "N/mm⁴"
_FLOOR = -40.0  # dB below the largest density that are shown


def draw_dispersion(dispersion: Dispersion, critical: Sequence[Wave] = ()) -> Figure:
    """Draw the lowest eigenvalue along a path through the zone, at several loads.

    Parameters
    ----------
    dispersion
        Eigenvalues; higher bands are drawn faintly.
    critical
        Phases (k . a1, k . a2) of the critical waves [rad], ringed where the path meets them.
    """
    distances, values = dispersion.distances, dispersion.eigenvalues
    order = np.argsort(dispersion.loads)
    drawn, axes = curve("wave vector", "lowest eigenvalue [N/mm⁴]")
    axes.grid(visible=False)
    at = [float(distances[k]) for k in dispersion.stops]
    for x in at:
        axes.axvline(x, color=MUTED, lw=0.6, alpha=0.5)
    axes.axhline(0.0, color=MUTED, lw=0.9)
    colours = _LOADS(np.linspace(0.0, 1.0, max(2, len(order))))
    for k, colour in zip(order, colours, strict=False):
        row = values[k]
        for band in row.T[1:]:
            axes.plot(distances, band, color=colour, lw=0.7, alpha=0.35)
        name = f"{100 * dispersion.loads[k]:.3g} %"
        axes.plot(distances, row[:, 0], color=colour, lw=1.6, label=name)
    for x in distances[_on_path(dispersion.waves, critical)]:
        axes.plot([x], [0.0], "o", ms=8, mfc="none", mec=INK, mew=1.2)
    low, high = float(np.nanmin(values[..., 0])), float(np.nanmax(values[..., 0]))
    axes.set(xlim=(at[0], at[-1]), ylim=(min(1.15 * low, -0.04 * high), 1.06 * high))
    axes.set_xticks(at, list(dispersion.labels))
    axes.tick_params(axis="x", labelsize=9)
    legend_above(axes, len(order))
    return drawn


def draw_zone_map(zone: ZoneMap, pitch: float, critical: Sequence[Wave] = ()) -> Figure:
    """Draw the lowest eigenvalue over the plane of wave vectors, in Cartesian components.

    Parameters
    ----------
    zone
        Eigenvalues over one period.
    pitch
        l [mm].
    critical
        Phases (k . a1, k . a2) of the critical waves [rad], ringed with all their images.
    """
    reciprocal = np.linalg.inv(zone.lattice).T * pitch  # rows b1, b2: a_i . b_j = l delta_ij
    corners = _first_zone(reciprocal)
    half = 1.12 * float(np.abs(corners).max())
    t = np.linspace(-half, half, _PIXELS)
    xi = np.stack(np.meshgrid(t, t), axis=-1)
    values = zone.eigenvalues[:-1, :-1]  # the last row and column repeat the first
    turns = xi @ zone.lattice.T / pitch + 0.5
    places = [turns[..., k] * len(values) for k in (0, 1)]
    shown = map_coordinates(values, places, order=3, mode="grid-wrap")
    scale = _zone_scale(values)
    drawn, axes = _plane(half)
    axes.imshow(shown, extent=(-half, half, -half, half), origin="lower", cmap=scale.colours,
                norm=scale.normalise, interpolation="bilinear", aspect="auto",
                rasterized=True)  # fmt: skip
    axes.add_patch(Polygon(corners, fill=False, ec="#ffffff", lw=1.8, alpha=0.7))
    axes.add_patch(Polygon(corners, fill=False, ec="#16191d", lw=0.9))
    for xi_c in _images(critical, reciprocal, half):
        axes.plot(*xi_c, "o", ms=9, mfc="none", mec="#ffffff", mew=2.2, clip_on=False)
        axes.plot(*xi_c, "o", ms=9, mfc="none", mec="#16191d", mew=1.0, clip_on=False)
    colour_bar(drawn, axes, scale)
    return drawn


def draw_lattice_spectrum(
    xi: FloatArray, density: FloatArray, largest: float, reach: float = 2.0
) -> Figure:
    """Draw a density at the discrete wave vectors of a periodic field, in dB below the largest.

    Parameters
    ----------
    xi
        (n, 2) wave vectors [1/l].
    density
        (n,) S_xx or S_yy [mm^6].
    largest
        What 0 dB is: the largest of both components [mm^6].
    reach
        Of the axes [1/l].
    """
    shown_waves = np.abs(xi).max(axis=1) <= reach + 1e-9
    xi, density = xi[shown_waves], density[shown_waves]
    level = 10.0 * np.log10(np.maximum(density, 1e-30) / largest)
    order = np.argsort(level)
    shown = order[level[order] >= _FLOOR]
    scale = ColourScale(DENSITY, _FLOOR, 0.0, "dB")
    drawn, axes = _plane(reach + 0.2)
    axes.set_facecolor(DENSITY(0.0))
    axes.plot(xi[:, 0], xi[:, 1], "o", ms=1.1, color="#ffffff", alpha=0.22, mew=0)
    size = 3.0 + 105.0 * (1.0 - level[shown] / _FLOOR) ** 3
    axes.scatter(xi[shown, 0], xi[shown, 1], s=size, c=scale.normalise(level[shown]),
                 cmap=_bright(), vmin=0.0, vmax=1.0, lw=0)  # fmt: skip
    colour_bar(drawn, axes, ColourScale(_bright(), _FLOOR, 0.0, "dB"))
    return drawn


def _bright() -> LinearSegmentedColormap:
    """The densities' colours from where they are seen on their own background."""
    return LinearSegmentedColormap.from_list("bright", DENSITY(np.linspace(0.28, 1.0, 64)))


def _plane(half: float) -> tuple[Figure, Axes]:
    """Empty axes for wave vectors within ± half [1/l]."""
    drawn = figure(WIDTH, WIDTH * 0.88)
    axes = drawn.add_axes((0.17, 0.205, 0.59, 0.67))
    axes.set(xlim=(-half, half), ylim=(-half, half), xlabel="ξ₁ [1/l]")
    axes.set_ylabel("ξ₂ [1/l]", labelpad=0)
    step = 0.5 if half < 1.6 else 1.0
    ticks = np.arange(-np.floor(half / step), np.floor(half / step) + 1) * step
    axes.set(xticks=ticks, yticks=ticks)
    axes.tick_params(labelsize=7)
    return drawn, axes


def _first_zone(reciprocal: FloatArray) -> FloatArray:
    """(c, 2) corners of the first Brillouin zone, in the units of the reciprocal vectors."""
    steps = np.arange(-2, 3)
    points = np.array([[i, j] for i in steps for j in steps]) @ reciprocal
    cells = Voronoi(points)
    centre = int(np.argmin(np.linalg.norm(points, axis=1)))
    corners = cells.vertices[cells.regions[cells.point_region[centre]]]
    return np.asarray(corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))])


def _images(critical: Sequence[Wave], reciprocal: FloatArray, half: float) -> FloatArray:
    """(c, 2) all wave vectors within ± half that are the critical waves or their opposites."""
    steps = np.arange(-2, 3)
    shifts = np.array([[i, j] for i in steps for j in steps])
    turns = [s * np.asarray(wave) / (2.0 * np.pi) + shifts for wave in critical for s in (1, -1)]
    if not turns:
        return np.zeros((0, 2))
    xi = np.unique(np.round(np.vstack(turns) @ reciprocal, 9), axis=0)
    return np.asarray(xi[np.abs(xi).max(axis=1) <= half])


def _zone_scale(values: FloatArray) -> ColourScale:
    """Colours that diverge from zero where there is something below it."""
    low, high = float(values.min()), float(values.max())
    if low < -1e-3 * high:
        end = max(-low, 0.05 * high)
        return ColourScale(SIGNED.reversed(), -end, end, _UNIT, "max" if high > end else "neither")
    return ColourScale(SIZE, 0.0, high, _UNIT)


def _on_path(waves: FloatArray, critical: Sequence[Wave]) -> NDArray[np.bool_]:
    """(p,) which waves of a path are critical ones, or their opposites."""
    turns = np.asarray(waves) / (2.0 * np.pi)
    on = np.zeros(len(turns), dtype=bool)
    for wave in critical:
        for sign in (1.0, -1.0):
            off = turns - sign * np.asarray(wave) / (2.0 * np.pi)
            on |= np.abs(off - np.rint(off)).max(axis=1) < _NEAR
    return on


def draw_energies(branches: Sequence[Branch], critical: float | None) -> Figure:
    """Draw each branch's energy over that of the primary path at the same load.

    Parameters
    ----------
    branches
        Those with states.
    critical
        Critical load [-].
    """
    return _branches(branches, critical, "energy − primary path's [kPa]", _excess, zero=True)


def draw_amplitudes(branches: Sequence[Branch], critical: float | None) -> Figure:
    """Draw the size of the critical modes' amplitudes along each branch."""
    drawn = _branches(branches, critical, "amplitude, rms over the material [mm]", _size)
    axes = drawn.axes[0]
    for line, branch in zip(axes.lines[::3], (b for b in branches if b.states), strict=False):
        kept = [(size, s.load) for size, s in zip(_size(branch), branch.states, strict=True)]
        points = np.vstack([branch.curve, kept])  # the branch is passed in finer steps
        points = points[np.argsort(points[:, 0])]
        points = points[points[:, 0] <= max(kept)[0]]
        line.set_data(100.0 * points[:, 1], points[:, 0])
    return drawn


def draw_differences(branches: Sequence[Branch]) -> Figure:
    """Draw each branch's energy over that of the lowest branch at the same load."""
    lowest: dict[float, float] = {}
    for state in (s for branch in branches for s in branch.states):
        lowest[state.load] = min(state.energy, lowest.get(state.load, np.inf))

    def above(branch: Branch) -> list[float]:
        return [1e6 * (s.energy - lowest[s.load]) for s in branch.states]

    return _branches(branches, None, "energy − lowest branch's [Pa]", above, zero=True)


def _excess(branch: Branch) -> list[float]:
    return [1e3 * (s.energy - s.primary_energy) for s in branch.states]


def _size(branch: Branch) -> list[float]:
    return [float(np.linalg.norm(s.amplitudes)) for s in branch.states]


def _branches(
    branches: Sequence[Branch],
    critical: float | None,
    label: str,
    value: Callable[[Branch], list[float]],
    zero: bool = False,
) -> Figure:
    drawn, axes = curve("load: nominal strain [%]", label)
    if zero:
        axes.axhline(0.0, color=MUTED, lw=0.9)
    for n, branch in enumerate(b for b in branches if b.states):
        load = 100.0 * np.array([s.load for s in branch.states])
        stable = np.array([s.negative_eigenvalues == 0 for s in branch.states])
        heights, colour = np.array(value(branch)), COLOURS[n % len(COLOURS)]
        name = combination_name(branch.combination)
        name += "" if stable.all() else ", unstable" if not stable.any() else ", partly stable"
        start = [] if critical is None else [100.0 * critical]
        axes.plot([*start, *load], [*np.zeros(len(start)), *heights], color=colour, lw=1.5,
                  ls="-" if stable.all() else DASHES, label=name)  # fmt: skip
        axes.plot(load[stable], heights[stable], "o", color=colour, ms=3.5)
        axes.plot(load[~stable], heights[~stable], "o", color=colour, ms=3.5, mfc="none")
    if critical is not None:
        axes.plot([100.0 * critical], [0.0], "o", ms=8, mfc="none", mec=INK, mew=1.2)
    legend_above(axes)
    return drawn


def draw_overlaps(rows: Sequence[ModeRow]) -> Figure:
    """Draw the overlap of the numerical with the analytic mode against d/l."""
    return _over_ratio(rows, "overlap with Eq. (mode) [–]", lambda row: row.overlap)


def draw_captured(rows: Sequence[ModeRow]) -> Figure:
    """Draw the energy that the automatically found family captures against d/l."""
    drawn = _over_ratio(rows, "energy in the automatic family [%]", lambda r: 100.0 * r.captured)
    for colour, loading in zip(COLOURS, _loadings(rows), strict=False):
        for row in _series(rows, loading):
            if row.waves > 2:
                annotate(drawn.axes[0], row.ratio, 100.0 * row.captured, str(row.waves), colour,
                    (0, 5), "center")  # fmt: skip
    return drawn


def draw_critical_strains(rows: Sequence[ModeRow]) -> Figure:
    """Draw the first critical strain, and where it is not the pattern's, that one dashed."""
    drawn, axes = curve("hole diameter over cell size d/l [–]", "critical strain [%]")
    for colour, loading in zip(COLOURS, _loadings(rows), strict=False):
        series = _series(rows, loading)
        ratio = np.array([row.ratio for row in series])
        first = 100.0 * np.array([row.first if row.found else np.nan for row in series])
        pattern = 100.0 * np.array([row.pattern for row in series])
        axes.plot(ratio, pattern, color=colour, lw=1.1, ls=DASHES)
        axes.plot(ratio, first, color=colour, lw=1.6, label=loading)
        _dots(axes, series, first, colour)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    legend_above(axes)
    return drawn


def _over_ratio(rows: Sequence[ModeRow], label: str, value: Callable[[ModeRow], float]) -> Figure:
    drawn, axes = curve("hole diameter over cell size d/l [–]", label)
    for colour, loading in zip(COLOURS, _loadings(rows), strict=False):
        series = _series(rows, loading)
        heights = np.array([value(row) for row in series])
        axes.plot([row.ratio for row in series], heights, color=colour, lw=1.6, label=loading)
        _dots(axes, series, heights, colour)
    legend_above(axes)
    return drawn


def _dots(axes: Axes, series: Sequence[ModeRow], heights: FloatArray, colour: str) -> None:
    """A dot for each row: filled where the pattern is what buckles first."""
    for row, height in zip(series, heights, strict=True):
        axes.plot([row.ratio], [height], "o", color=colour, ms=4,
                  mfc=colour if row.is_first else "none")  # fmt: skip


def _loadings(rows: Sequence[ModeRow]) -> list[str]:
    return list(dict.fromkeys(row.loading for row in rows))


def _series(rows: Sequence[ModeRow], loading: str) -> list[ModeRow]:
    return sorted((row for row in rows if row.loading == loading), key=lambda row: row.ratio)
