"""Infinite lattices seen through a window: undeformed, buckled, and two modes laid over each other.

The material is drawn along its exact curved edges; the page's ink is its colour.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.validation.lattice.patch import Patch
from modeharvest.validation.outline import Outline
from modeharvest.validation.plots_fields import Scale, colour_bar
from modeharvest.validation.style import (
    BLUE,
    GLOW,
    INK,
    MUTED,
    RED,
    draw_path,
    figure,
    scale_bar,
    style,
)

FloatArray = NDArray[np.float64]

WIDTH = 2.35  # of a window [in]
_MARGIN = 0.24  # below it, for the scale bar [in]
_EMBER = LinearSegmentedColormap.from_list(  # seen on a dark page from the first value on
    "ember", np.vstack([to_rgba_array("#46506a"), GLOW(np.linspace(0.3, 1.0, 16))])
)
_FINER = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # triangles of a T6


def draw_lattice(
    patch: Patch,
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
    with style():
        drawn, axes = _window(patch, pitch)
        outline = patch.outline.path(moved)
        draw_path(axes, outline, fc=BLUE, ec="none", alpha=0.28)
        draw_path(axes, outline, fill=False, ec=BLUE, lw=0.7)
        corners = (patch.cell_corners - patch.centre) @ F.T + patch.centre
        axes.add_patch(Polygon(corners, fill=False, ec=RED, lw=1.3, ls=(0, (4, 2)), zorder=3))
    return drawn


def draw_growth(patch: Patch, shape: FloatArray, amplitude: float, pitch: float) -> Figure:
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
    with style():
        drawn, axes = _window(patch, pitch, width=3.6, bar=True)
        path = patch.outline.path(moved)
        length = np.linalg.norm(moved, axis=1)
        scale = Scale(_EMBER, 0.0, amplitude / pitch, "l")
        nodes = patch.mesh.nodes + moved
        triangles = patch.mesh.cells[:, np.array(_FINER)].reshape(-1, 3)
        net = Triangulation(nodes[:, 0], nodes[:, 1], triangles)
        shading = axes.tripcolor(net, length / pitch, shading="gouraud", cmap=scale.colours,
                                 norm=scale.normalise, rasterized=True)  # fmt: skip
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
    outline = Outline.of(mesh)
    grey, black = outline.path(factor * analytic), outline.path(factor * numerical)
    nodes = np.vstack([mesh.nodes + factor * analytic, mesh.nodes + factor * numerical])
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    with style():
        drawn, axes = _frame(high - low)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        draw_path(axes, grey, fc=MUTED, ec="none", alpha=0.45, clip_on=False)
        draw_path(axes, black, fc=INK, ec="none", alpha=0.14, clip_on=False)
        draw_path(axes, black, fill=False, ec=INK, lw=1.1, clip_on=False)
        scale_bar(axes, 0.5 * pitch, "l/2")
    return drawn


def _window(
    patch: Patch, pitch: float, width: float = WIDTH, bar: bool = False
) -> tuple[Figure, Axes]:
    """Empty axes over the patch's window, with a scale bar of one cell."""
    drawn, axes = _frame(patch.window, width, 0.76 if bar else 0.98)
    left, right, bottom, top = patch.limits
    axes.set(xlim=(left, right), ylim=(bottom, top))
    scale_bar(axes, pitch, "l")
    return drawn, axes


def _frame(size: FloatArray, width: float = WIDTH, share: float = 0.98) -> tuple[Figure, Axes]:
    tall = share * width * size[1] / size[0]
    above = 0.03 if share > 0.9 else 0.22
    height = tall + _MARGIN + above
    drawn = figure(width, height)
    axes = drawn.add_axes((0.01, _MARGIN / height, share, tall / height))
    axes.set_axis_off()
    return drawn, axes
