"""Waves on a lattice: which of them are near to instability, and which a pattern is made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import Voronoi

from modeharvest.fem.dispersion import Dispersion, ZoneMap
from modeharvest.fem.modes import Wave
from modeharvest.validation.plots_fields import WIDTH, Scale, colour_bar
from modeharvest.validation.plots_path import curve
from modeharvest.validation.style import (
    BLUE,
    DENSITY,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    SIGNED,
    SIZE,
    figure,
    style,
)

FloatArray = NDArray[np.float64]

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
    with style():
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
        axes.legend(frameon=False, fontsize=7.5, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                    ncols=len(order), handlelength=1.4, borderaxespad=0.1)  # fmt: skip
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
    with style():
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
    seen = np.abs(xi).max(axis=1) <= reach + 1e-9
    xi, density = xi[seen], density[seen]
    level = 10.0 * np.log10(np.maximum(density, 1e-30) / largest)
    order = np.argsort(level)
    shown = order[level[order] >= _FLOOR]
    scale = Scale(DENSITY, _FLOOR, 0.0, "dB")
    with style():
        drawn, axes = _plane(reach + 0.2)
        axes.set_facecolor(DENSITY(0.0))
        axes.plot(xi[:, 0], xi[:, 1], "o", ms=1.1, color="#ffffff", alpha=0.22, mew=0)
        size = 3.0 + 105.0 * (1.0 - level[shown] / _FLOOR) ** 3
        axes.scatter(xi[shown, 0], xi[shown, 1], s=size, c=scale.normalise(level[shown]),
                     cmap=_bright(), vmin=0.0, vmax=1.0, lw=0)  # fmt: skip
        colour_bar(drawn, axes, Scale(_bright(), _FLOOR, 0.0, "dB"))
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


def _zone_scale(values: FloatArray) -> Scale:
    """Colours that diverge from zero where there is something below it."""
    low, high = float(values.min()), float(values.max())
    if low < -1e-3 * high:
        end = max(-low, 0.05 * high)
        return Scale(SIGNED.reversed(), -end, end, _UNIT, "max" if high > end else "neither")
    return Scale(SIZE, 0.0, high, _UNIT)


def _on_path(waves: FloatArray, critical: Sequence[Wave]) -> NDArray[np.bool_]:
    """(p,) which waves of a path are critical ones, or their opposites."""
    turns = np.asarray(waves) / (2.0 * np.pi)
    on = np.zeros(len(turns), dtype=bool)
    for wave in critical:
        for sign in (1.0, -1.0):
            off = turns - sign * np.asarray(wave) / (2.0 * np.pi)
            on |= np.abs(off - np.rint(off)).max(axis=1) < _NEAR
    return on
