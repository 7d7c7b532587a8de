"""Report of a robustness study: success, the paper's epsilon, the basin of convergence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from modeharvest.report.figures.style import BLUE, GOLD, GREEN, RED, figure, style
from modeharvest.report.model import Findings, KeyNumber, Plot, short
from modeharvest.validation.studies.robustness import (
    OUTLIER_PERCENT,
    PUBLISHED,
    SAME_PX,
    RobustnessStudy,
    by_radius,
    by_strain,
    other_minima,
    success_numbers,
)

"""Ends nearer than this, rms, are the same minimum [px]."""

"""Above this epsilon the paper calls a result erroneous."""

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
        axes.axvline(PUBLISHED["mean_epsilon_percent"], color=RED, linestyle=":", linewidth=1)
        axes.set_xlabel("ε [%]")
        drawn.tight_layout()
    outliers = int((asked["epsilon_percent"] > OUTLIER_PERCENT).sum())
    caption = (
        f"The paper's ε of every start; {seeds}. Dashed: {OUTLIER_PERCENT} %, above which the "
        f"paper calls a result erroneous: {outliers or 'none'} here, 2 there. Dotted: the paper's "
        f"mean, {PUBLISHED['mean_epsilon_percent']} %."
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
        axes.plot(10.0, 100.0 * PUBLISHED["success"], "x", color=RED)
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


def report_robustness(study: RobustnessStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """Success, epsilon and the honest distance, and the basin's picture."""
    return robustness_findings(table, study.radius, study.seeds)


def robustness_findings(table: pd.DataFrame, radius: float, seeds: str) -> Findings:
    """Read the table of all starts.

    Parameters
    ----------
    table
        A row for each case of
        :func:`modeharvest.validation.studies.robustness.one_start`. One that failed counts
        as one that did not arrive.
    radius
        That of the paper's question [-].
    seeds
        In words.
    """
    table = table.assign(same=table["distance_px"] < SAME_PX)
    moved = table[table["strain_error"] == 0.0]
    asked = moved[moved["radius"] == radius]
    found = success_numbers(asked, radius)
    basin, strains = by_radius(moved[moved["radius"] > 0.0]), by_strain(table)
    tables = {"Basin of convergence": basin}
    if not moved["same"].all():
        tables["Starts that end elsewhere"] = other_minima(moved)
    if len(strains):
        tables["Start of v0"] = strains
    return Findings(
        numbers={**found, "basin": basin.to_dict("records")},
        sentences=(
            *_sentences(found),
            *_basin_sentences(basin),
            *_undetected_sentences(moved),
            *_strain_sentences(strains),
        ),
        keys=_keys(found),
        plots=(
            draw_distances(asked, radius, seeds),
            draw_epsilons(asked, seeds),
            draw_basin(basin, seeds),
            *((draw_starts_of_v0(strains),) if len(strains) else ()),
        ),
        tables=tables,
    )


def _keys(found: Mapping[str, Any]) -> tuple[KeyNumber, ...]:
    low, high = found["success_interval_95"]
    return (
        KeyNumber(
            "starts that arrive", f"{found['same_minimum']} of {found['starts']}", "",
            f"95 % interval {100 * low:.1f} to {100 * high:.1f} %; the paper: 98 of 100",
        ),
        KeyNumber(
            "mean ε, as the paper defines it", short(found["mean_epsilon_percent"]), "%",
            f"the paper: {PUBLISHED['mean_epsilon_percent']} %, without two outliers "
            f"{PUBLISHED['mean_epsilon_without_outliers_percent']} %",
        ),
        KeyNumber(
            "largest distance between ends", short(found["largest_distance_px"]), "px",
            f"rms; starts up to {found['largest_start_distance_px']:.3g} px away",
        ),
    )  # fmt: skip


def _sentences(found: Mapping[str, Any]) -> tuple[str, ...]:
    low, high = found["success_interval_95"]
    said = [
        f"{found['same_minimum']} of {found['starts']} starts with mode parameters up to "
        f"{100 * found['radius']:g} % off end in the standard start's minimum (within {SAME_PX} "
        f"px rms): {100 * found['success']:.1f} %, 95 % interval {100 * low:.1f} to "
        f"{100 * high:.1f} %. The paper has {100 * PUBLISHED['success']:.0f} of 100.",
        f"The paper's ε = 100 (‖u‖ − ‖u_pert‖)/‖u‖, here without its sign, is "
        f"{short(found['mean_epsilon_percent'])} % on average and "
        f"{short(found['largest_epsilon_percent'])} % at most; {found['outliers'] or 'none'} lie "
        f"above {OUTLIER_PERCENT} %, the paper's outliers. The paper has "
        f"{PUBLISHED['mean_epsilon_percent']} % on average, "
        f"{PUBLISHED['mean_epsilon_without_outliers_percent']} % without two outliers.",
        "A difference of norms can vanish for fields that differ. The norm of the difference is "
        f"{short(found['largest_distance_px'])} px rms at most, "
        f"{short(found['largest_distance_of_arrived_px'])} px among those that arrive.",
        "The paper's perturbations are shares of the parameters' nominal values, which are 0 for "
        "the two phases; here these are off by up to the same share of the unit cell, too.",
    ]
    elsewhere = found["starts"] - found["same_minimum"] - found["failed"]
    if elsewhere:
        said.append(
            f"Of the {elsewhere} that end elsewhere, "
            f"{found['elsewhere_but_called_converged']} pass for converged; the others are "
            "recognised."
        )
    if found["failed"]:
        said.append(f"{found['failed']} failed, and count as not arrived.")
    return tuple(said)


def _basin_sentences(basin: pd.DataFrame) -> tuple[str, ...]:
    """Up to where all arrive, and whether the others are recognised."""
    full = basin["same minimum"] == basin["starts"]
    sure = basin.loc[full.cummin(), "off by up to [%]"]
    said = (
        f"All starts arrive up to {sure.iloc[-1]:g} % off."
        if len(sure)
        else "At no radius do all starts arrive."
    )
    if full.all():
        return (said,)
    lowest = basin.loc[basin["success [%]"].idxmin()]
    return (
        f"{said} The fewest do at {lowest['off by up to [%]']:g} %: "
        f"{lowest['same minimum']:.0f} of {lowest['starts']:.0f}.",
    )


def _undetected_sentences(moved: pd.DataFrame) -> tuple[str, ...]:
    """How many ends elsewhere the paper's error does not see."""
    others = moved[~moved["same"] & moved["distance_px"].notna()]
    unseen = others[others["epsilon_percent"] <= OUTLIER_PERCENT]["distance_px"]
    if not len(unseen):
        return ()
    return (
        f"The paper's ε does not see {len(unseen)} of the {len(others)} ends elsewhere: it is "
        f"below {OUTLIER_PERCENT} % there, with displacements {short(float(unseen.min()))} to "
        f"{short(float(unseen.max()))} px rms off.",
    )


def _strain_sentences(strains: pd.DataFrame) -> tuple[str, ...]:
    if not len(strains):
        return ()
    same = strains["distance of the end [px]"] < SAME_PX
    off = strains["strain of the start, off by [%]"]
    tried, arrived = (", ".join(f"{v:+g}" for v in part).replace("-", "−")
                      for part in (off, off[same]))  # fmt: skip
    which = "" if same.all() or not same.any() else f": {arrived} %"
    return (
        f"With the strain of v₀'s start off by {tried} %, {int(same.sum())} of {len(strains)} "
        f"arrive{which}.",
    )
