"""Report of a robustness study: success, the paper's epsilon, the basin of convergence."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from modeharvest.report.figures.style import BLUE, GOLD, GREEN, RED, figure, style
from modeharvest.report.model import Findings, KeyNumber, Plot, short
from modeharvest.validation.studies.robustness import (
    OUTLIER_PERCENT,
    PUBLISHED,
    SAME_PX,
    GuessStatistics,
    Proportion,
    RobustnessAnalysis,
    RobustnessStudy,
)


def by_radius(moved: pd.DataFrame) -> pd.DataFrame:
    """Success against the radius of the perturbations."""
    rows = []
    for radius, part in moved.groupby("radius"):
        same = Proportion(int(part["same"].sum()), len(part))
        low, high = same.interval
        others = part[~part["same"]]
        detected = int((others["outcome"] != "converged").sum())
        rows.append({
            "off by up to [%]": 100.0 * radius,
            "starts": same.count,
            "same minimum": same.good,
            "success [%]": 100.0 * same.good / same.count,
            "95 % from": 100.0 * low,
            "to [%]": 100.0 * high,
            "other minima detected": f"{detected} of {len(others)}",
            "largest distance among the same [px]": part.loc[part["same"], "distance_px"].max(),
            "mean iterations": part["all_iterations"].mean(),
        })  # fmt: skip
    return pd.DataFrame(rows)


def other_minima(moved: pd.DataFrame) -> pd.DataFrame:
    """Each initial guess that leads elsewhere; with the seed its number makes it again."""
    others = moved[~moved["same"]].sort_values(["radius", "start"])
    return pd.DataFrame({
        "off by up to [%]": 100.0 * others["radius"],
        "number of the start": others["start"],
        "distance of the start [px rms]": others["start_distance_px"].round(2),
        "distance of the end [px rms]": others["distance_px"].round(3),
        "ε [%]": others["epsilon_percent"].round(3),
        "outcome": others["outcome"].fillna("failed"),
        "iterations": others["all_iterations"],
    })  # fmt: skip


def by_strain(part: pd.DataFrame) -> pd.DataFrame:
    """Where initial guesses with a wrong strain lead; empty if there was none."""
    return pd.DataFrame({
        "strain of the start, off by [%]": 100.0 * part["strain_error"],
        "distance of the start [px]": part["start_distance_px"],
        "distance of the end [px]": part["distance_px"],
        "outcome": part["outcome"],
        "iterations": part["all_iterations"],
    })  # fmt: skip


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
    return robustness_findings(study.analyse(table, folder), study.seeds)


def robustness_findings(found: RobustnessAnalysis, seeds: str) -> Findings:
    """What the analysis of a study says; ``seeds`` in words."""
    numbers = asdict(found.statistics)
    radius, strains = found.statistics.radius, by_strain(found.strains)
    basin = by_radius(found.moved[found.moved["radius"] > 0.0])
    tables = {"Basin of convergence": basin}
    if not found.moved["same"].all():
        tables["Starts that end elsewhere"] = other_minima(found.moved)
    if len(strains):
        tables["Start of v0"] = strains
    return Findings(
        numbers={**numbers, "basin": basin.to_dict("records")},
        sentences=(
            *_sentences(found.statistics),
            *_basin_sentences(basin),
            *_undetected_sentences(found.moved),
            *_strain_sentences(strains),
        ),
        keys=_keys(found.statistics),
        plots=(
            draw_distances(found.at_radius, radius, seeds),
            draw_epsilons(found.at_radius, seeds),
            draw_basin(basin, seeds),
            *((draw_starts_of_v0(strains),) if len(strains) else ()),
        ),
        tables=tables,
    )


def _keys(found: GuessStatistics) -> tuple[KeyNumber, ...]:
    low, high = found.success_interval_95
    return (
        KeyNumber(
            "starts that arrive", f"{found.same_minimum} of {found.starts}", "",
            f"95 % interval {100 * low:.1f} to {100 * high:.1f} %; the paper: 98 of 100",
        ),
        KeyNumber(
            "mean ε, as the paper defines it", short(found.mean_epsilon_percent), "%",
            f"the paper: {PUBLISHED['mean_epsilon_percent']} %, without two outliers "
            f"{PUBLISHED['mean_epsilon_without_outliers_percent']} %",
        ),
        KeyNumber(
            "largest distance between ends", short(found.largest_distance_px), "px",
            f"rms; starts up to {found.largest_start_distance_px:.3g} px away",
        ),
    )  # fmt: skip


def _sentences(found: GuessStatistics) -> tuple[str, ...]:
    low, high = found.success_interval_95
    said = [
        f"{found.same_minimum} of {found.starts} starts with mode parameters up to "
        f"{100 * found.radius:g} % off end in the standard start's minimum (within {SAME_PX} "
        f"px rms): {100 * found.success:.1f} %, 95 % interval {100 * low:.1f} to "
        f"{100 * high:.1f} %. The paper has {100 * PUBLISHED['success']:.0f} of 100.",
        f"The paper's ε = 100 (‖u‖ − ‖u_pert‖)/‖u‖, here without its sign, is "
        f"{short(found.mean_epsilon_percent)} % on average and "
        f"{short(found.largest_epsilon_percent)} % at most; {found.outliers or 'none'} lie "
        f"above {OUTLIER_PERCENT} %, the paper's outliers. The paper has "
        f"{PUBLISHED['mean_epsilon_percent']} % on average, "
        f"{PUBLISHED['mean_epsilon_without_outliers_percent']} % without two outliers.",
        "A difference of norms can vanish for fields that differ. The norm of the difference is "
        f"{short(found.largest_distance_px)} px rms at most, "
        f"{short(found.largest_distance_of_arrived_px)} px among those that arrive.",
        "The paper's perturbations are shares of the parameters' nominal values, which are 0 for "
        "the two phases; here these are off by up to the same share of the unit cell, too.",
    ]
    elsewhere = found.starts - found.same_minimum - found.failed
    if elsewhere:
        said.append(
            f"Of the {elsewhere} that end elsewhere, "
            f"{found.other_minimum_called_converged} pass for converged; the others are "
            "recognised."
        )
    if found.failed:
        said.append(f"{found.failed} failed, and count as not arrived.")
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
