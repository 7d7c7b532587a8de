"""Figures of a homogenized specimen: load and energy over strain, amplitudes, the deformed mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from modeharvest.fem.field import Mesh
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import curve, legend_above, ring
from modeharvest.report.figures.maps import WIDTH, ColourScale, bare_axes, colour_bar
from modeharvest.report.figures.style import BLUE, EDGE, GREEN, MUTED, RED, draw_path
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.elements import reference_element, shape_functions

_FINE = 8
"""Parts of an element's side that are drawn."""
_WIDTH = 3.2
_ROOM = 0.24  # above and below a map [in]


def draw_response(
    path: Mapping[str, Any], critical: float | None, response: Mapping[str, Any],
    first_order: float | None, key: str, label: str,
) -> Figure:  # fmt: skip
    """Draw force or energy over nominal strain: direct simulation and homogenized states.

    ``path``: ``Solution.info["path"]``, empty without a direct simulation, and its ``critical``
    strain [-]; ``response``: the homogenized one as plain values; ``first_order``: its critical
    strain without modes [-]; ``key``: of what is drawn, in a state.
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
    """Draw a nodal field (n,), NaN where there is none, on the deformed macroscopic mesh.

    ``displacement``: (n, 2) [mm].
    """
    at = mesh.nodes + displacement
    margin = 0.012 * float(np.ptp(at, axis=0).max())
    low, high = at.min(axis=0) - margin, at.max(axis=0) + margin
    drawn, axes = bare_axes(_WIDTH, high - low, 0.78, _ROOM, _ROOM)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    has = np.isfinite(values[mesh.cells]).all(axis=1)
    points, triangles, N = _refined(mesh, mesh.cells[has], displacement)
    shown = np.einsum("pk,ck->cp", N, values[mesh.cells[has]]).ravel()
    x, y = points.T
    axes.tripcolor(Triangulation(x, y, triangles), shown, shading="gouraud", rasterized=True,
                   cmap=scale.colours, norm=scale.normalise)  # fmt: skip
    _draw_sides(axes, mesh, displacement)
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


def _refined(
    mesh: Mesh, cells: IntArray, displacement: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Points (c p, 2) and triangles inside of elements, and their shape functions (p, k)."""
    t = np.linspace(0.0, 1.0, _FINE + 1)
    a, b = (places.ravel() for places in np.meshgrid(t, t, indexing="ij"))
    is_triangle = reference_element(mesh.element).triangular
    xi = np.stack([a, b * (1.0 - a)] if is_triangle else [2.0 * a - 1.0, 2.0 * b - 1.0], axis=1)
    N = shape_functions(mesh.element, xi)
    points = np.einsum("pk,cki->cpi", N, (mesh.nodes + displacement)[cells])
    i, j = (index.ravel() for index in np.indices((_FINE, _FINE)))
    k = i * (_FINE + 1) + j
    right, corner, above = k + _FINE + 1, k + _FINE + 2, k + 1
    one = np.concatenate([np.stack(s, axis=1) for s in ((k, right, corner), (k, corner, above))])
    every = one[None] + len(xi) * np.arange(len(cells))[:, None, None]
    return points.reshape(-1, 2), every.reshape(-1, 3), N


def _draw_sides(axes: Axes, mesh: Mesh, displacement: FloatArray) -> None:
    """The sides of the elements, curved as they are."""
    reference, t = reference_element(mesh.element), np.linspace(0.0, 1.0, _FINE + 1)[:, None]
    corners = reference.nodes[: 3 if reference.triangular else 4]
    at = (mesh.nodes + displacement)[mesh.cells]
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    sides = [(1.0 - t) * start + t * end for start, end in ends]
    lines = [np.einsum("pk,cki->cpi", shape_functions(mesh.element, side), at) for side in sides]
    axes.add_collection(LineCollection(list(np.concatenate(lines)), colors=MUTED, lw=0.5, zorder=3))
