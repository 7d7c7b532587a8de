"""Pictures of graded codes: what is left of each period, noise against resolution, maps."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from modeharvest.validation.resolution.attenuation import Attenuation
from modeharvest.validation.resolution.grading import StarGrade
from modeharvest.validation.resolution.transfer import KEPT
from modeharvest.validation.style import BLUE, GOLD, GREEN, INK, MUTED, RED, SIGNED, figure, style

FloatArray = NDArray[np.float64]

COLOURS = (BLUE, RED, GREEN, GOLD, *mpl.colormaps["tab10"].colors[4:])  # type: ignore[attr-defined]
"""A code keeps its colour in all pictures."""
_CELL_PX = 10
"""Edge of a cell of the maps; the image has far more pixels than a page."""


def draw_attenuation(grades: Sequence[StarGrade]) -> Figure:
    """Draw T over the period, a band of two standard errors about it, and where it crosses 0.9."""
    with style():
        drawn, axes = _curve("period of the wave [px]", "share of its amplitude that is left [–]")
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        for n, grade in enumerate(grades):
            found = grade.attenuation
            share, error = found.curve
            colour = COLOURS[n % len(COLOURS)]
            axes.fill_between(found.period, share - 2 * error, share + 2 * error, color=colour,
                              alpha=0.2, linewidth=0)  # fmt: skip
            axes.plot(found.period, share, color=colour, label=grade.name)
            if np.isfinite(found.finest_px):
                axes.plot([found.finest_px], [KEPT], "o", ms=4.5, color=colour)
        axes.set(xscale="log", ylim=(-0.3, 1.15))
        _plain_numbers(axes.xaxis)
        _legend(axes)
    return drawn


def draw_trade_off(grades: Sequence[StarGrade]) -> Figure:
    """Draw the noise floor over l10, lines of equal indicator below."""
    known = [g for g in grades if np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0]
    with style():
        drawn, axes = _curve("l₁₀ % [px]", "noise floor n [px]")
        x = [g.attenuation.finest_px for g in known]
        y = [g.noise.v_px for g in known if g.noise is not None]
        low, high = 0.7 * min(x), 1.5 * max(x)
        bottom, top = 0.6 * min(y), 1.7 * max(y)
        for value in _round_values(min(x) * min(y), max(x) * max(y)):
            axes.plot([low, high], [value / low, value / high], color=MUTED, linewidth=0.6,
                      alpha=0.6)  # fmt: skip
            end = min(high, value / (1.04 * bottom))
            if low < end and value / end < top:
                axes.annotate(f"{value:g} px²", (end, value / end), (-3, 3), fontsize=6.5,
                              textcoords="offset points", ha="right", color=MUTED)  # fmt: skip
        for n, grade in enumerate(grades):
            if grade not in known or grade.noise is None:
                continue
            axes.errorbar(grade.attenuation.finest_px, grade.noise.v_px,
                          2 * grade.noise.v_se_px, 2 * grade.attenuation.finest_se_px, marker="o",
                          ms=5, capsize=2, color=COLOURS[n % len(COLOURS)], linewidth=1,
                          linestyle="none", label=grade.name)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(bottom, top))
        _plain_numbers(axes.xaxis)
        _plain_numbers(axes.yaxis)
        _legend(axes)
    return drawn


def draw_centre_row(found: Attenuation, colour: str = BLUE) -> Figure:
    """Draw the centre row's T, raw, and the smoothed curve through all rows."""
    with style():
        drawn, axes = _curve("period of the wave [px]", "measured over true [–]", (9.0, 2.1))
        axes.plot(found.centre.period, found.centre.share, color=MUTED, linewidth=0.5, alpha=0.8)
        axes.plot(found.period, found.curve[0], color=colour, linewidth=1.8)
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        low, high = np.quantile(found.centre.share, (0.005, 0.995))
        axes.set_ylim(min(low, 0.0) - 0.05, max(high, 1.0) + 0.05)
    return drawn


def draw_map(grade: StarGrade, values: FloatArray, end: float | None = None) -> Figure:
    """Draw displacements or errors (n,) of a code's points along y [px], down is positive.

    ``end`` is that of the colours; by default what 99 % of the values stay below.
    """
    star = grade.star
    seen = np.isfinite(values)
    at = -grade.moved.y[seen], grade.moved.x[seen]
    reach = min(0.5 * star.rows, float(np.abs(at[0]).max()) + _CELL_PX)
    shape = (max(1, round(2 * reach / _CELL_PX)), max(1, star.cols // _CELL_PX))
    limits = ((-reach, reach), (-0.5, star.cols - 0.5))
    count = np.histogram2d(*at, shape, limits)[0]
    total = np.histogram2d(*at, shape, limits, weights=values[seen])[0]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    top = float(np.quantile(np.abs(values[seen]), 0.99)) if end is None else end
    with style():
        drawn = figure(9.0, 1.75)
        axes = drawn.add_axes((0.035, 0.24, 0.88, 0.72))
        image = axes.imshow(mean, cmap=SIGNED, vmin=-top, vmax=top, aspect="auto",
                            extent=(*limits[1], *limits[0][::-1]),
                            interpolation="nearest")  # fmt: skip
        periods = [p for p in (10, 25, 50, 100, 150, 200, 250, 300)
                   if star.shortest_px <= p <= star.longest_px]  # fmt: skip
        axes.set_xticks(star.column(periods), [str(p) for p in periods])
        axes.set_xlabel("period [px]")
        axes.set_yticks([])
        bar = drawn.add_axes((0.93, 0.24, 0.011, 0.72))
        drawn.colorbar(image, cax=bar).ax.set_title("px", fontsize=7.5)
    return drawn


def _curve(x: str, y: str, size: tuple[float, float] = (5.2, 3.3)) -> tuple[Figure, Axes]:
    """An empty picture for curves."""
    drawn = figure(*size)
    axes = drawn.add_subplot()
    axes.set(xlabel=x, ylabel=y)
    axes.grid(color=MUTED, alpha=0.18, lw=0.6)
    drawn.subplots_adjust(0.6 / size[0], 0.45 / size[1], 0.985, 0.92 if size[1] > 3 else 0.96)
    return drawn, axes


def _round_values(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from below ``low`` to above ``high``."""
    first, last = int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1
    every = [m * 10.0**p for p in range(first, last + 1) for m in (1, 2, 5)]
    return [v for v in every if 0.3 * low <= v <= 3.0 * high]


def _plain_numbers(axis: Axis) -> None:
    """Write 20 rather than 2 x 10^1."""
    shown = FuncFormatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "1235" else "")
    axis.set_major_formatter(shown)
    axis.set_minor_formatter(shown)
    axis.set_tick_params(which="minor", labelsize=7, labelcolor=INK)


def _legend(axes: Axes) -> None:
    """Names above the picture, where no curve is."""
    count = len(axes.get_legend_handles_labels()[0])
    if count:
        axes.legend(frameon=False, fontsize=7.5, ncols=min(count, 4), loc="lower right",
                    bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)  # fmt: skip
