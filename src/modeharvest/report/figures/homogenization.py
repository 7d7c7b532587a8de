"""Figures of a homogenized specimen: load and energy over strain, amplitudes, the deformed mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from modeharvest.fem.field import Mesh
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import curve, legend_above, ring
from modeharvest.report.figures.maps import WIDTH, ColourScale, bare_axes, colour_bar
from modeharvest.report.figures.style import BLUE, EDGE, GREEN, MUTED, RED, draw_path
from modeharvest.util.arrays import FloatArray
from modeharvest.util.elements import reference_element, shape_functions

_FINE = 8
"""Number of parts into which an element's side is divided for drawing."""
_WIDTH = 3.2
_ROOM = 0.24  # margin above and below a map [in]


def draw_response(
    path: Mapping[str, Any], critical: float | None, response: Mapping[str, Any],
    first_order: float | None, key: str, label: str,
) -> Figure:  # fmt: skip
    """Draw force or energy over nominal strain: direct simulation and homogenized states.

    ``path``: ``Solution.info["path"]`` of a direct simulation, empty without one; ``critical``: its
    critical strain [-]; ``response``: homogenized response as plain values; ``first_order``: its
    critical strain without modes [-]; ``key``: "force_N_per_mm" or "energy_N".
    """
    drawn, axes = curve("nominal strain [%]", label)
    of_path = {"force_N_per_mm": "reaction_N_per_mm", "energy_N": "energy_N"}[key]
    first: tuple[Any, Any] = (), ()
    if path:
        first = path["primary"]["nominal_strain"], path["primary"][of_path]
        axes.plot(100 * np.array(first[0]), first[1], color=BLUE, lw=1.0, ls=":",
                  label="direct, primary path")  # fmt: skip
    for branch in (path[name] for name in path if name != "primary"):
        strain, values = np.array(branch["nominal_strain"]), np.array(branch[of_path])
        if critical is not None:
            strain = np.append(critical, strain)
            values = np.append(np.interp(critical, *first), values)
            ring(axes, 100 * critical, values[0])
        axes.plot(100 * strain, values, "s-", color=BLUE, lw=1.8, ms=3.5, label="direct, buckled",
                  markevery=slice(critical is not None, None))  # fmt: skip
    states = response["states"]
    strain, values = (np.array([s[k] for s in states], float) for k in ("nominal_strain", key))
    sd = np.array([s[f"{key.partition('_')[0]}_sd{key[key.index('_') :]}"] or 0.0 for s in states])
    axes.errorbar(100 * strain, values, 2 * sd, color=RED, marker="o", ms=4.5, ls="none",
                  capsize=2.5, elinewidth=1, label="homogenized, ± 2 sd")  # fmt: skip
    for at, name, colour in (
        (response["critical_strain"], "critical, homogenized", RED),
        (first_order, "critical, first order", GREEN),
    ):
        if at is not None:
            axes.axvline(100 * at, color=colour, lw=0.9, ls="--", label=name)
    legend_above(axes, 3)
    axes.set(xlim=(0, None), ylim=(0, None))
    return drawn


def draw_amplitude(
    mesh: Mesh, displacement: FloatArray, values: FloatArray, scale: ColourScale
) -> Figure:
    """Draw a nodal field (n,), blank where it is NaN, on the deformed macroscopic mesh.

    ``displacement``: (n, 2) nodal displacement [mm].
    """
    at = mesh.nodes + displacement
    margin = 0.012 * float(np.ptp(at, axis=0).max())
    low, high = at.min(axis=0) - margin, at.max(axis=0) + margin
    drawn, axes = bare_axes(_WIDTH, high - low, 0.78, _ROOM, _ROOM)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    grids = _within(mesh, np.column_stack([at, values]))
    for x, y, shown in grids[np.isfinite(grids).all(axis=(1, 2, 3))]:
        axes.pcolormesh(x, y, shown, shading="gouraud", rasterized=True,
                        cmap=scale.colours, norm=scale.normalise)  # fmt: skip
    sides = (grids[:, :2, 0], grids[:, :2, -1], grids[:, :2, :, 0], grids[:, :2, :, -1])
    lines = np.concatenate(sides).swapaxes(1, 2)
    axes.add_collection(LineCollection(list(lines), colors=MUTED, lw=0.5, zorder=3))
    colour_bar(axes, scale)
    return drawn


def draw_microstructure(rve: Mesh, displacement: FloatArray) -> Figure:
    """Draw a deformed RVE over its undeformed boundary; ``displacement`` (k, 2) [mm]."""
    boundary = MeshBoundary.of(rve)
    every = np.concatenate([rve.nodes, rve.nodes + displacement])
    low, high = every.min(axis=0), every.max(axis=0)
    drawn, axes = bare_axes(WIDTH, high - low, 0.98, 0.03, 0.03)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    draw_path(axes, boundary.path(), fill=False, ec=MUTED, lw=0.5, ls=":", clip_on=False)
    draw_path(axes, boundary.path(displacement), fc=BLUE, ec=EDGE, lw=0.5, alpha=0.6, clip_on=False)
    return drawn


def _within(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(c, f, p, p) values interpolated from nodal ones (n, f) to a grid over each element."""
    t, reference = np.linspace(0.0, 1.0, _FINE + 1), reference_element(mesh.element)
    a, b = np.meshgrid(t, t, indexing="ij")
    xi = [a, b * (1.0 - a)] if reference.triangular else [2.0 * a - 1.0, 2.0 * b - 1.0]
    N = shape_functions(mesh.element, np.stack(xi, axis=-1).reshape(-1, 2))
    found = np.einsum("pk,ckf->cfp", N, nodal[mesh.cells])
    return np.asarray(found.reshape(*found.shape[:2], *a.shape))
