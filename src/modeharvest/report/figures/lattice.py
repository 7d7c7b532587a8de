"""Figures of infinite lattices: the deformed lattice, waves, branches, dependence on d/l."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import Voronoi

from modeharvest.fem.bloch.dispersion import Dispersion, ZoneMap
from modeharvest.fem.bloch.modes import Branch
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import Wave
from modeharvest.report.figures import curves, style
from modeharvest.report.figures.boundaries import LatticePatch, MeshBoundary
from modeharvest.report.figures.maps import WIDTH, ColourScale, bare_axes, colour_bar, shaded
from modeharvest.report.figures.style import BLUE, COLOURS, DENSITY, INK, MUTED, RED
from modeharvest.runs.lattice.loads import STRAIN, LoadQuantity
from modeharvest.runs.lattice.results import combination_name
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.lattice import ModeRow

_MARGIN, _ABOVE = 0.24, 0.03  # below a window, for the scale bar, and above it [in]
_EMBER = LinearSegmentedColormap.from_list(  # even the lowest values are visible on a dark page
    "ember", np.vstack([to_rgba_array("#46506a"), style.GLOW(np.linspace(0.3, 1.0, 16))])
)
_BRIGHT = LinearSegmentedColormap.from_list(  # for densities, visible on the plot's background
    "bright", DENSITY(np.linspace(0.28, 1.0, 64))
)
_LOADS = LinearSegmentedColormap.from_list(
    "loads", to_rgba_array([BLUE, style.GREEN, style.GOLD, RED])
)
_SHIFTS = np.array(list(product(range(-2, 3), repeat=2)))  # indices of reciprocal vectors near zero
_PIXELS = 360  # along a zone map's side
_NEAR = 2e-4  # difference of phases below which waves are the same [turns]
_UNIT = "N/mm⁴"
_FLOOR = -40.0  # lowest density that is shown, relative to the largest [dB]
_DARK, _LIGHT = "#16191d", "#ffffff"


def draw_lattice(
    patch: LatticePatch,
    pitch: float,
    displacement: FloatArray | None = None,
    gradient: FloatArray | None = None,
) -> Figure:
    """Draw the undeformed or deformed lattice, with the parallelogram of one cell.

    ``patch``: copies of the cell, and the window. ``pitch``: unit cell size l [mm], for the scale
    bar. ``displacement``: (n, 2) of the cell's nodes [mm]; None for the undeformed lattice.
    ``gradient``: (2, 2) F̄ of the affine part [-]; None for a periodic displacement.
    """
    moved = None if displacement is None else patch.moved(displacement, gradient)
    F = np.eye(2) if gradient is None else np.asarray(gradient)
    drawn, axes = _window_axes(patch, pitch)
    boundary = patch.boundary.path(moved)
    style.draw_path(axes, boundary, fc=BLUE, ec="none", alpha=0.28)
    style.draw_path(axes, boundary, fill=False, ec=BLUE, lw=0.7)
    corners = (patch.cell_corners - patch.centre) @ F.T + patch.centre
    axes.add_patch(Polygon(corners, fill=False, ec=RED, lw=1.3, ls=(0, (4, 2)), zorder=3))
    return drawn


def draw_growth(patch: LatticePatch, shape: FloatArray, amplitude: float, pitch: float) -> Figure:
    """Draw a mode whose amplitude increases from zero on the left to the full value on the right.

    This illustrates the mode, and is no equilibrium. Colours show the displacement's length [l].
    ``shape``: (n, 2) the mode at the cell's nodes [-]. ``amplitude``: largest displacement, on the
    right [mm]. ``pitch``: unit cell size l [mm].
    """
    largest = float(np.linalg.norm(shape, axis=1).max())
    left, right = patch.limits[:2]
    t = np.clip((patch.mesh.nodes[:, 0] - left) / (right - left) * 1.25 - 0.15, 0.0, 1.0)
    moved = amplitude / largest * (t**2 * (3.0 - 2.0 * t))[:, None] * shape[patch.node]
    drawn, axes = _window_axes(patch, pitch, 3.6, 0.76, 0.22)
    scale = ColourScale(_EMBER, 0.0, amplitude / pitch, "l")
    shading = shaded(axes, patch.mesh, moved, np.linalg.norm(moved, axis=1) / pitch, scale)
    edge = style.draw_path(axes, patch.boundary.path(moved), fill=False, ec="none", rasterized=True)
    shading.set_clip_path(edge)
    colour_bar(axes, scale)
    return drawn


def draw_overlay(
    mesh: Mesh, pitch: float, numerical: FloatArray, analytic: FloatArray, largest: float
) -> Figure:
    """Draw one cell deformed by two modes of the same size: Fig. 8 of the paper.

    ``mesh``: a quarter of the mode's cell [mm]. ``pitch``: unit cell size l [mm]. ``numerical``,
    ``analytic``: (n, 2) both modes at its nodes, of equal norm over the material. ``largest``:
    largest displacement of the numerical mode as drawn [mm].
    """
    factor = largest / float(np.linalg.norm(numerical, axis=1).max())
    boundary = MeshBoundary.of(mesh)
    grey, black = boundary.path(factor * analytic), boundary.path(factor * numerical)
    nodes = np.vstack([mesh.nodes + factor * analytic, mesh.nodes + factor * numerical])
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    drawn, axes = bare_axes(WIDTH, high - low, 0.98, _MARGIN, _ABOVE)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    style.draw_path(axes, grey, fc=MUTED, ec="none", alpha=0.45, clip_on=False)
    style.draw_path(axes, black, fc=INK, ec="none", alpha=0.14, clip_on=False)
    style.draw_path(axes, black, fill=False, ec=INK, lw=1.1, clip_on=False)
    style.scale_bar(axes, 0.5 * pitch, "l/2")
    return drawn


def _window_axes(
    patch: LatticePatch,
    pitch: float,
    width: float = WIDTH,
    share: float = 0.98,
    above: float = _ABOVE,
) -> tuple[Figure, Axes]:
    """Make empty axes for the patch's window, with a scale bar of one cell size."""
    drawn, axes = bare_axes(width, patch.window, share, _MARGIN, above)
    left, right, bottom, top = patch.limits
    axes.set(xlim=(left, right), ylim=(bottom, top))
    style.scale_bar(axes, pitch, "l")
    return drawn, axes


def draw_dispersion(
    dispersion: Dispersion, critical: Sequence[Wave] = (), load: LoadQuantity = STRAIN
) -> Figure:
    """Draw the lowest eigenvalue along a path through the Brillouin zone, at several loads.

    ``dispersion``: eigenvalues; higher bands are drawn faintly. ``critical``: phases (k . a1, k .
    a2) of the critical waves [rad], marked by rings where the path meets them.
    """
    distances, values = dispersion.distances, dispersion.eigenvalues
    order = np.argsort(dispersion.loads)
    drawn, axes = curves.curve("wave vector", "lowest eigenvalue [N/mm⁴]")
    axes.grid(visible=False)
    at = [float(distances[k]) for k in dispersion.stops]
    for x in at:
        axes.axvline(x, color=MUTED, lw=0.6, alpha=0.5)
    axes.axhline(0.0, color=MUTED, lw=0.9)
    colours = _LOADS(np.linspace(0.0, 1.0, max(2, len(order))))
    for k, colour in zip(order, colours, strict=False):
        axes.plot(distances, values[k, :, 1:], color=colour, lw=0.7, alpha=0.35)
        name = load.text(float(dispersion.loads[k]), 3)
        axes.plot(distances, values[k, :, 0], color=colour, lw=1.6, label=name)
    for x in distances[_on_path(dispersion.waves, critical)]:
        curves.ring(axes, x, 0.0)
    low, high = float(np.nanmin(values[..., 0])), float(np.nanmax(values[..., 0]))
    axes.set(xlim=(at[0], at[-1]), ylim=(min(1.15 * low, -0.04 * high), 1.06 * high))
    axes.set_xticks(at, list(dispersion.labels))
    axes.tick_params(axis="x", labelsize=9)
    curves.legend_above(axes, len(order))
    return drawn


def draw_zone_map(zone: ZoneMap, pitch: float, critical: Sequence[Wave] = ()) -> Figure:
    """Draw the lowest eigenvalue over the plane of wave vectors, in Cartesian components.

    ``zone``: eigenvalues over one period. ``pitch``: l [mm]. ``critical``: phases (k . a1, k . a2)
    of the critical waves [rad], marked by rings together with all equivalent waves.
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
    axes.add_patch(Polygon(corners, fill=False, ec=_LIGHT, lw=1.8, alpha=0.7))
    axes.add_patch(Polygon(corners, fill=False, ec=_DARK, lw=0.9))
    for x, y in _images(critical, reciprocal, half):
        for colour, width in ((_LIGHT, 2.2), (_DARK, 1.0)):
            axes.plot([x], [y], "o", ms=9, mfc="none", mec=colour, mew=width, clip_on=False)
    colour_bar(axes, scale)
    return drawn


def draw_lattice_spectrum(
    xi: FloatArray, density: FloatArray, largest: float, reach: float = 2.0
) -> Figure:
    """Draw a density at the discrete wave vectors of a periodic field, in dB below the largest.

    ``xi``: (n, 2) wave vectors [1/l]. ``density``: (n,) S_xx or S_yy [mm^6]. ``largest``: density
    at 0 dB, the largest of S_xx and S_yy [mm^6]. ``reach``: largest component shown [1/l].
    """
    within = np.abs(xi).max(axis=1) <= reach + 1e-9
    xi, density = xi[within], density[within]
    level = 10.0 * np.log10(np.maximum(density, 1e-30) / largest)
    order = np.argsort(level)
    shown = order[level[order] >= _FLOOR]
    drawn, axes = _plane(reach + 0.2)
    axes.set_facecolor(DENSITY(0.0))
    axes.plot(xi[:, 0], xi[:, 1], "o", ms=1.1, color=_LIGHT, alpha=0.22, mew=0)
    share = 1.0 - level[shown] / _FLOOR
    axes.scatter(xi[shown, 0], xi[shown, 1], s=3.0 + 105.0 * share**3, c=share, cmap=_BRIGHT,
                 vmin=0.0, vmax=1.0, lw=0)  # fmt: skip
    colour_bar(axes, ColourScale(_BRIGHT, _FLOOR, 0.0, "dB"))
    return drawn


def _plane(half: float) -> tuple[Figure, Axes]:
    """Make empty axes for wave vectors within ± ``half`` [1/l]."""
    step = 0.5 if half < 1.6 else 1.0
    return curves.wave_plane(half, step, (0.205, 0.205, 0.565, 0.642), 0.88)


def _first_zone(reciprocal: FloatArray) -> FloatArray:
    """(c, 2) corners of the first Brillouin zone, in the units of the reciprocal vectors."""
    points = _SHIFTS @ reciprocal
    cells = Voronoi(points)
    centre = int(np.argmin(np.linalg.norm(points, axis=1)))
    corners = cells.vertices[cells.regions[cells.point_region[centre]]]
    return np.asarray(corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))])


def _images(critical: Sequence[Wave], reciprocal: FloatArray, half: float) -> FloatArray:
    """(c, 2) wave vectors [1/l] within ± ``half`` equivalent to ± the critical waves."""
    turns = (_turns(critical)[:, None] + _SHIFTS).reshape(-1, 2)
    xi = np.unique(np.round(turns @ reciprocal, 9), axis=0)
    return np.asarray(xi[np.abs(xi).max(axis=1) <= half])


def _zone_scale(values: FloatArray) -> ColourScale:
    """Colours that diverge from zero if there are negative values, and else rise from it."""
    low, high = float(values.min()), float(values.max())
    if low < -1e-3 * high:
        end = max(-low, 0.05 * high)
        return ColourScale(
            style.SIGNED.reversed(), -end, end, _UNIT, "max" if high > end else "neither"
        )
    return ColourScale(style.SIZE, 0.0, high, _UNIT)


def _on_path(waves: FloatArray, critical: Sequence[Wave]) -> NDArray[np.bool_]:
    """(p,) True for waves of a path that are equivalent to critical ones or their opposites."""
    off = np.asarray(waves)[:, None] / (2.0 * np.pi) - _turns(critical)
    return np.asarray((np.abs(off - np.rint(off)).max(axis=-1) < _NEAR).any(axis=1))


def _turns(critical: Sequence[Wave]) -> FloatArray:
    """(2c, 2) phases of the critical waves and their opposites [turns]."""
    phases = np.reshape(np.asarray(critical, dtype=np.float64), (-1, 2))
    return np.asarray(np.vstack([phases, -phases]) / (2.0 * np.pi), dtype=np.float64)


def draw_energies(
    branches: Sequence[Branch], critical: float | None, load: LoadQuantity = STRAIN
) -> Figure:
    """Draw each branch's energy minus that of the primary path at the same load [kPa].

    ``branches``: those without states are left out. ``critical``: critical load [-].
    """

    def above(branch: Branch) -> list[float]:
        return [1e3 * (s.energy - s.primary_energy) for s in branch.states]

    return _branches(branches, critical, load, "energy − primary path's [kPa]", above, zero=True)


def draw_amplitudes(
    branches: Sequence[Branch], critical: float | None, load: LoadQuantity = STRAIN
) -> Figure:
    """Draw the norm of the critical modes' amplitudes along each branch [mm]."""
    drawn = _branches(branches, critical, load, "amplitude, rms over the material [mm]", _size)
    axes = drawn.axes[0]
    for line, branch in zip(axes.lines[::3], (b for b in branches if b.states), strict=False):
        kept = [(size, s.load) for size, s in zip(_size(branch), branch.states, strict=True)]
        points = np.vstack([branch.curve, kept])  # the branch was followed in finer steps
        points = points[np.argsort(points[:, 0])]
        points = points[points[:, 0] <= max(kept)[0]]
        line.set_data(load.per_load * points[:, 1], points[:, 0])
    return drawn


def draw_differences(branches: Sequence[Branch], load: LoadQuantity = STRAIN) -> Figure:
    """Draw each branch's energy minus that of the lowest branch at the same load [Pa]."""
    lowest: dict[float, float] = {}
    for state in (s for branch in branches for s in branch.states):
        lowest[state.load] = min(state.energy, lowest.get(state.load, np.inf))

    def above(branch: Branch) -> list[float]:
        return [1e6 * (s.energy - lowest[s.load]) for s in branch.states]

    return _branches(branches, None, load, "energy − lowest branch's [Pa]", above, zero=True)


def _size(branch: Branch) -> list[float]:
    return [float(np.linalg.norm(s.amplitudes)) for s in branch.states]


def _branches(
    branches: Sequence[Branch],
    critical: float | None,
    quantity: LoadQuantity,
    label: str,
    value: Callable[[Branch], list[float]],
    zero: bool = False,
) -> Figure:
    drawn, axes = curves.curve(quantity.axis, label)
    if zero:
        axes.axhline(0.0, color=MUTED, lw=0.9)
    for n, branch in enumerate(b for b in branches if b.states):
        load = quantity.per_load * np.array([s.load for s in branch.states])
        stable = np.array([s.negative_eigenvalues == 0 for s in branch.states])
        heights, colour = np.array(value(branch)), COLOURS[n % len(COLOURS)]
        name = combination_name(branch.combination)
        name += "" if stable.all() else ", unstable" if not stable.any() else ", partly stable"
        start = [] if critical is None else [quantity.per_load * critical]
        axes.plot([*start, *load], [*np.zeros(len(start)), *heights], color=colour, lw=1.5,
                  ls="-" if stable.all() else curves.DASHES, label=name)  # fmt: skip
        axes.plot(load[stable], heights[stable], "o", color=colour, ms=3.5)
        axes.plot(load[~stable], heights[~stable], "o", color=colour, ms=3.5, mfc="none")
    if critical is not None:
        curves.ring(axes, quantity.per_load * critical, 0.0)
    curves.legend_above(axes)
    return drawn


def draw_overlaps(rows: Sequence[ModeRow]) -> Figure:
    """Draw the overlap of the numerical with the analytic mode against d/l."""
    return _over_ratio(rows, "overlap with Eq. (6) [–]", lambda row: row.overlap)


def draw_captured(rows: Sequence[ModeRow]) -> Figure:
    """Draw the share of energy captured by the automatically found family, against d/l."""
    drawn = _over_ratio(rows, "energy in the automatic family [%]", lambda r: 100.0 * r.captured)
    for colour, _, series in _by_loading(rows):
        for row in series:
            if row.waves > 2:
                at = row.ratio, 100.0 * row.captured
                curves.annotate(drawn.axes[0], *at, str(row.waves), colour, (0, 5), "center")
    return drawn


def draw_critical_strains(rows: Sequence[ModeRow]) -> Figure:
    """Draw the first critical strain, and the pattern's own dashed, against d/l."""
    drawn = _over_ratio(
        rows, "critical strain [%]", lambda r: 100.0 * r.first if r.found else math.nan
    )
    axes = drawn.axes[0]
    for colour, _, series in _by_loading(rows):
        pattern = [100.0 * row.pattern for row in series]
        axes.plot([row.ratio for row in series], pattern, color=colour, lw=1.1, ls=curves.DASHES,
                  zorder=1.9)  # fmt: skip
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    curves.plain_ticks(axes.yaxis)
    return drawn


def _over_ratio(rows: Sequence[ModeRow], label: str, value: Callable[[ModeRow], float]) -> Figure:
    """Draw a curve for each loading, with dots that are filled where the pattern buckles first."""
    drawn, axes = curves.curve("hole diameter over cell size d/l [–]", label)
    for colour, loading, series in _by_loading(rows):
        ratios, heights = [row.ratio for row in series], [value(row) for row in series]
        axes.plot(ratios, heights, color=colour, lw=1.6, label=loading)
        for row, height in zip(series, heights, strict=True):
            axes.plot([row.ratio], [height], "o", color=colour, ms=4,
                      mfc=colour if row.is_first else "none")  # fmt: skip
    curves.legend_above(axes)
    return drawn


def _by_loading(rows: Sequence[ModeRow]) -> list[tuple[str, str, list[ModeRow]]]:
    """Colour, name and rows, sorted by d/l, of each loading."""
    loadings = dict.fromkeys(row.loading for row in rows)
    return [
        (colour, loading, sorted((r for r in rows if r.loading == loading), key=lambda r: r.ratio))
        for colour, loading in zip(COLOURS, loadings, strict=False)
    ]
