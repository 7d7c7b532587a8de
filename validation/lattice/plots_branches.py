"""Curves of a lattice: branches against load, and what the pattern depends on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from modeharvest.fem.modes import Branch
from modeharvest.validation.lattice.mode_table import ModeRow
from modeharvest.validation.plots_path import curve, say
from modeharvest.validation.style import BLUE, GOLD, GREEN, INK, MUTED, RED, style

FloatArray = NDArray[np.float64]

_COLOURS = (BLUE, RED, GREEN, GOLD)
_DASHES = (0, (3, 2))
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def combination_name(combination: Sequence[float]) -> str:
    """Modes and signs, with numbers where their sizes differ: "φ₁ + φ₂" or "0.8 φ₁ − 0.6 φ₂"."""
    parts = [(k, c) for k, c in enumerate(combination, start=1) if abs(c) > 1e-6]
    alike = np.ptp([abs(c) for _, c in parts] or [0.0]) < 1e-6
    text = ""
    for k, c in parts:
        text += " − " if c < 0 else " + "
        text += ("" if alike else f"{abs(c):.2g} ") + f"φ{k}".translate(_SUBSCRIPTS)
    return text[3:] if text.startswith(" + ") else "−" + text[3:]


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
    with style():
        drawn, axes = curve("load: nominal strain [%]", label)
        if zero:
            axes.axhline(0.0, color=MUTED, lw=0.9)
        for n, branch in enumerate(b for b in branches if b.states):
            load = 100.0 * np.array([s.load for s in branch.states])
            stable = np.array([s.negative_eigenvalues == 0 for s in branch.states])
            heights, colour = np.array(value(branch)), _COLOURS[n % len(_COLOURS)]
            name = combination_name(branch.combination)
            name += "" if stable.all() else ", unstable" if not stable.any() else ", partly stable"
            start = [] if critical is None else [100.0 * critical]
            axes.plot([*start, *load], [*np.zeros(len(start)), *heights], color=colour, lw=1.5,
                      ls="-" if stable.all() else _DASHES, label=name)  # fmt: skip
            axes.plot(load[stable], heights[stable], "o", color=colour, ms=3.5)
            axes.plot(load[~stable], heights[~stable], "o", color=colour, ms=3.5, mfc="none")
        if critical is not None:
            axes.plot([100.0 * critical], [0.0], "o", ms=8, mfc="none", mec=INK, mew=1.2)
        _legend(axes)
    return drawn


def draw_overlaps(rows: Sequence[ModeRow]) -> Figure:
    """Draw the overlap of the numerical with the analytic mode against d/l."""
    return _over_ratio(rows, "overlap with Eq. (mode) [–]", lambda row: row.overlap)


def draw_captured(rows: Sequence[ModeRow]) -> Figure:
    """Draw the energy that the automatically found family captures against d/l."""
    drawn = _over_ratio(rows, "energy in the automatic family [%]", lambda r: 100.0 * r.captured)
    for colour, loading in zip(_COLOURS, _loadings(rows), strict=False):
        for row in _series(rows, loading):
            if row.waves > 2:
                say(drawn.axes[0], row.ratio, 100.0 * row.captured, str(row.waves), colour,
                    (0, 5), "center")  # fmt: skip
    return drawn


def draw_critical_strains(rows: Sequence[ModeRow]) -> Figure:
    """Draw the first critical strain, and where it is not the pattern's, that one dashed."""
    with style():
        drawn, axes = curve("hole diameter over cell size d/l [–]", "critical strain [%]")
        for colour, loading in zip(_COLOURS, _loadings(rows), strict=False):
            series = _series(rows, loading)
            ratio = np.array([row.ratio for row in series])
            first = 100.0 * np.array([row.first if row.found else np.nan for row in series])
            pattern = 100.0 * np.array([row.pattern for row in series])
            axes.plot(ratio, pattern, color=colour, lw=1.1, ls=_DASHES)
            axes.plot(ratio, first, color=colour, lw=1.6, label=loading)
            _dots(axes, series, first, colour)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        _legend(axes)
    return drawn


def _over_ratio(rows: Sequence[ModeRow], label: str, value: Callable[[ModeRow], float]) -> Figure:
    with style():
        drawn, axes = curve("hole diameter over cell size d/l [–]", label)
        for colour, loading in zip(_COLOURS, _loadings(rows), strict=False):
            series = _series(rows, loading)
            heights = np.array([value(row) for row in series])
            axes.plot([row.ratio for row in series], heights, color=colour, lw=1.6, label=loading)
            _dots(axes, series, heights, colour)
        _legend(axes)
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


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=7.5, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                    ncols=4, handlelength=1.6, columnspacing=1.2, borderaxespad=0.1)  # fmt: skip
