"""Pictures of a robustness study: where starts end, the paper's error, the basin."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from modeharvest.validation.studies.study import Plot
from modeharvest.validation.style import BLUE, GOLD, GREEN, RED, figure, style

SAME_PX = 0.01
"""Ends nearer than this, rms, are the same minimum [px]."""
OUTLIER_PERCENT = 1.5
"""Above this epsilon the paper calls a result erroneous."""
PAPER = {
    "success": 0.98,
    "mean_epsilon_percent": 0.86,
    "mean_epsilon_without_outliers_percent": 0.45,
}
"""Section "Virtual Experiments" of the paper: 100 starts, parameters up to 10 % off."""


def draw_distances(asked: pd.DataFrame, radius: float, seeds: str) -> Plot:
    """Draw how far from the standard start's end the others end."""
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        _histogram(axes, asked, "distance_px", SAME_PX)
        axes.set_xlabel("distance from the standard start's displacement [px rms]")
        drawn.tight_layout()
    caption = (
        f"{len(asked)} starts, up to {100 * radius:g} % off; {seeds}. Dashed: nearer ends count "
        "as the same minimum."
    )
    return Plot("distances", "Where the starts end", drawn, caption)


def draw_epsilons(asked: pd.DataFrame, seeds: str) -> Plot:
    """Draw the paper's error of each start."""
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        _histogram(axes, asked, "epsilon_percent", OUTLIER_PERCENT)
        axes.axvline(PAPER["mean_epsilon_percent"], color=RED, linestyle=":", linewidth=1)
        axes.set_xlabel("ε [%]")
        drawn.tight_layout()
    outliers = int((asked["epsilon_percent"] > OUTLIER_PERCENT).sum())
    caption = (
        f"The paper's ε of every start; {seeds}. Dashed: {OUTLIER_PERCENT} %, above which the "
        f"paper calls a result erroneous: {outliers or 'none'} here, 2 there. Dotted: the paper's "
        f"mean, {PAPER['mean_epsilon_percent']} %."
    )
    return Plot("epsilon", "The paper's error", drawn, caption)


def _histogram(axes: Axes, asked: pd.DataFrame, name: str, limit: float) -> None:
    """Count the starts on a logarithmic axis that reaches the limit, which is marked."""
    values = np.maximum(asked[name].dropna().to_numpy(), 1e-12)
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(max(values.max(), limit)))
    axes.hist(values, bins=np.logspace(low, max(high, low + 1), 40).tolist(), color=BLUE)
    axes.axvline(limit, color=GOLD, linestyle="--", linewidth=1)
    axes.set(xscale="log", ylabel="starts")


def draw_basin(rows: pd.DataFrame, seeds: str) -> Plot:
    """Draw success over how far off the mode's parameters are."""
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        x, y = rows["off by up to [%]"], rows["success [%]"]
        spread = np.clip([y - rows["95 % from"], rows["to [%]"] - y], 0.0, None)
        axes.errorbar(x, y, yerr=spread, color=GREEN, marker="o", markersize=3, capsize=2)
        axes.plot(10.0, 100.0 * PAPER["success"], "x", color=RED)
        axes.set(xlim=(0.0, None), ylim=(0.0, 104.0), ylabel="same minimum [%]")
        axes.set_xlabel("mode parameters off by up to [%]")
        drawn.tight_layout()
    caption = f"Bars: 95 % intervals; {seeds}. Cross: the paper's 98 of 100 at 10 %."
    return Plot("basin", "Basin of convergence", drawn, caption)


def draw_starts_of_v0(strains: pd.DataFrame) -> Plot:
    """Draw where starts with a wrong strain end."""
    rows = strains.sort_values("strain of the start, off by [%]")
    off = rows["strain of the start, off by [%]"]
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        for end, colour, marker in (("start", GOLD, "^"), ("end", BLUE, "o")):
            far = np.maximum(rows[f"distance of the {end} [px]"], 1e-12)
            axes.plot(off, far, color=colour, marker=marker, linewidth=1, markersize=4,
                      label=f"the {end}")  # fmt: skip
        axes.axhline(SAME_PX, color=GREEN, linestyle="--", linewidth=1)
        axes.set(yscale="log", xlabel="strain of v₀'s start off by [%]", ylabel="distance [px rms]")
        axes.legend(frameon=False, fontsize=7.5)
        drawn.tight_layout()
    return Plot("strains", "Starts with a wrong strain", drawn, "Distances from the standard "
                "start's end, the mode's parameters as they are. Dashed: nearer ends count as the "
                "same minimum.")  # fmt: skip
