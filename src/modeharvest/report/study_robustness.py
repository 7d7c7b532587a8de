"""Report of a robustness study: success, the paper's epsilon, the basin of convergence."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from modeharvest.report.figures.curves import SMALL, curve
from modeharvest.report.figures.style import BLUE, GOLD, GREEN, RED
from modeharvest.report.model import Card, Findings, KeyNumber, ReportTable, number
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
            "initial guesses": same.count,
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
    """Each initial guess that leads to another minimum; its number and the seed make it again."""
    others = moved[~moved["same"]].sort_values(["radius", "start"])
    return pd.DataFrame({
        "off by up to [%]": 100.0 * others["radius"],
        "number of the guess": others["start"],
        "distance of the guess [px rms]": others["start_distance_px"].round(2),
        "distance of the result [px rms]": others["distance_px"].round(3),
        "ε [%]": others["epsilon_percent"].round(3),
        "outcome": others["outcome"].fillna("failed"),
        "iterations": others["all_iterations"],
    })  # fmt: skip


def by_strain(part: pd.DataFrame) -> pd.DataFrame:
    """Where initial guesses with a wrong strain lead; empty if there was none."""
    return pd.DataFrame({
        "strain of the guess, off by [%]": 100.0 * part["strain_error"],
        "distance of the guess [px]": part["start_distance_px"],
        "distance of the result [px]": part["distance_px"],
        "outcome": part["outcome"],
        "iterations": part["all_iterations"],
    })  # fmt: skip


def _histogram(name: str, limit: float, label: str, table: pd.DataFrame) -> Figure:
    """Count initial guesses on a logarithmic axis that reaches the limit, which is marked."""
    drawn, axes = curve(label, "initial guesses", SMALL)
    values = np.maximum(table[name].dropna().to_numpy(), 1e-12)
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(max(values.max(), limit)))
    axes.hist(values, bins=np.logspace(low, max(high, low + 1), 40).tolist(), color=BLUE)
    axes.axvline(limit, color=GOLD, linestyle="--", linewidth=1)
    axes.set(xscale="log")
    return drawn


def draw_distances(table: pd.DataFrame) -> Figure:
    """Draw how far from the standard initial guess' result the others' are."""
    label = "distance from the standard guess’ displacement [px rms]"
    return _histogram("distance_px", SAME_PX, label, table)


def draw_epsilons(table: pd.DataFrame) -> Figure:
    """Draw the paper's error of each initial guess."""
    drawn = _histogram("epsilon_percent", OUTLIER_PERCENT, "ε [%]", table)
    drawn.axes[0].axvline(PUBLISHED["mean_epsilon_percent"], color=RED, linestyle=":", linewidth=1)
    return drawn


def draw_basin(rows: pd.DataFrame) -> Figure:
    """Draw success over how far off the mode's parameters are."""
    drawn, axes = curve("mode parameters off by up to [%]", "same minimum [%]", SMALL)
    x, y = rows["off by up to [%]"], rows["success [%]"]
    spread = np.clip([y - rows["95 % from"], rows["to [%]"] - y], 0.0, None)
    axes.errorbar(x, y, yerr=spread, color=GREEN, marker="o", markersize=3, capsize=2)
    axes.plot(10.0, 100.0 * PUBLISHED["success"], "x", color=RED)
    axes.set(xlim=(0.0, None), ylim=(0.0, 104.0))
    return drawn


def draw_strains(strains: pd.DataFrame) -> Figure:
    """Draw where initial guesses with a wrong strain end."""
    rows = strains.sort_values("strain of the guess, off by [%]")
    off = rows["strain of the guess, off by [%]"]
    drawn, axes = curve("strain of v₀’s initial guess off by [%]", "distance [px rms]", SMALL)
    for end, label, colour, marker in (
        ("guess", "initial guess", GOLD, "^"), ("result", "result", BLUE, "o"),
    ):  # fmt: skip
        far = np.maximum(rows[f"distance of the {end} [px]"], 1e-12)
        axes.plot(off, far, color=colour, marker=marker, linewidth=1, markersize=4, label=label)
    axes.axhline(SAME_PX, color=GREEN, linestyle="--", linewidth=1)
    axes.set(yscale="log")
    axes.legend(frameon=False, fontsize=7.5)
    return drawn


def _figures(
    asked: pd.DataFrame, basin: pd.DataFrame, strains: pd.DataFrame, radius: float, seeds: str
) -> list[Card]:
    outliers = int((asked["epsilon_percent"] > OUTLIER_PERCENT).sum())
    cards = [
        Card.single(
            "distances", "Distance between results", partial(draw_distances, asked),
            f"{len(asked)} initial guesses, up to {100 * radius:g} % off; {seeds}. Dashed: nearer "
            "results count as the same minimum.",
        ),
        Card.single(
            "epsilon", "The paper’s error", partial(draw_epsilons, asked),
            f"The paper’s ε of every initial guess; {seeds}. Dashed: {OUTLIER_PERCENT} %, above "
            f"which the paper calls a result erroneous: {outliers or 'none'} here, 2 there. "
            f"Dotted: the paper’s mean, {PUBLISHED['mean_epsilon_percent']} %.",
        ),
        Card.single(
            "basin", "Basin of convergence", partial(draw_basin, basin),
            f"Bars: 95 % intervals; {seeds}. Cross: the paper’s 98 of 100 at 10 %.",
        ),
        Card.single(
            "strains", "Initial guesses with a wrong strain", partial(draw_strains, strains),
            "Distances from the standard guess’ result, the mode’s parameters as they are. Dashed: "
            "nearer results count as the same minimum.",
        ),
    ]  # fmt: skip
    return cards if len(strains) else cards[:3]


def report_robustness(study: RobustnessStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """Success, epsilon and distance, and the basin's picture."""
    return robustness_findings(study.analyse(table, folder), study.seeds)


def robustness_findings(found: RobustnessAnalysis, seeds: str) -> Findings:
    """The findings of an analysis; ``seeds`` in words."""
    radius, strains = found.statistics.radius, by_strain(found.strains)
    basin = by_radius(found.moved[found.moved["radius"] > 0.0])
    tables = {"Basin of convergence": basin}
    if not found.moved["same"].all():
        tables["Other minima"] = other_minima(found.moved)
    if len(strains):
        tables["Initial guess of v0"] = strains
    return Findings(
        numbers={**asdict(found.statistics), "basin": basin.to_dict("records")},
        sentences=(
            *_sentences(found.statistics),
            *_basin_sentences(basin),
            *_undetected(found.moved),
            *_strain_sentences(strains),
        ),
        keys=_keys(found.statistics),
        figures=_figures(found.at_radius, basin, strains, radius, seeds),
        tables=[ReportTable.of(title, table) for title, table in tables.items()],
    )


def _keys(found: GuessStatistics) -> tuple[KeyNumber, ...]:
    low, high = found.success_interval_95
    return (
        KeyNumber(
            "initial guesses that converge", f"{found.same_minimum} of {found.initial_guesses}", "",
            f"95 % interval {100 * low:.1f} to {100 * high:.1f} %; the paper: 98 of 100",
        ),
        KeyNumber(
            "mean ε, as the paper defines it", number(found.mean_epsilon_percent), "%",
            f"the paper: {PUBLISHED['mean_epsilon_percent']} %, without two outliers "
            f"{PUBLISHED['mean_epsilon_without_outliers_percent']} %",
        ),
        KeyNumber(
            "largest distance between results", number(found.largest_distance_px), "px",
            f"rms; initial guesses up to {found.largest_start_distance_px:.3g} px away",
        ),
    )  # fmt: skip


def _sentences(found: GuessStatistics) -> tuple[str, ...]:
    low, high = found.success_interval_95
    text = [
        f"{found.same_minimum} of {found.initial_guesses} initial guesses with mode parameters "
        f"up to {100 * found.radius:g} % off converge to the standard guess' minimum "
        f"(within {SAME_PX} px rms): {100 * found.success:.1f} %, 95 % interval "
        f"{100 * low:.1f} to {100 * high:.1f} %. The paper has {100 * PUBLISHED['success']:.0f} of "
        "100.",
        f"The paper's ε = 100 (‖u‖ − ‖u_pert‖)/‖u‖, here without its sign, is "
        f"{number(found.mean_epsilon_percent)} % on average and "
        f"{number(found.largest_epsilon_percent)} % at most; {found.outliers or 'none'} lie "
        f"above {OUTLIER_PERCENT} %, the paper's outliers. The paper has "
        f"{PUBLISHED['mean_epsilon_percent']} % on average, "
        f"{PUBLISHED['mean_epsilon_without_outliers_percent']} % without two outliers.",
        "A difference of norms can vanish for fields that differ. The norm of the difference is "
        f"{number(found.largest_distance_px)} px rms at most, "
        f"{number(found.largest_distance_of_arrived_px)} px among those in the same minimum.",
        "The paper's perturbations are shares of the parameters' nominal values, which are 0 for "
        "the two phases; here these are off by up to the same share of the unit cell, too.",
    ]
    elsewhere = found.initial_guesses - found.same_minimum - found.failed
    if elsewhere:
        text.append(
            f"Of the {elsewhere} in other minima, "
            f"{found.other_minimum_called_converged} are called converged; the others are "
            "detected."
        )
    if found.failed:
        text.append(f"{found.failed} failed, and count as not converged to it.")
    return tuple(text)


def _basin_sentences(basin: pd.DataFrame) -> tuple[str, ...]:
    """Up to where all converge to the same minimum."""
    full = basin["same minimum"] == basin["initial guesses"]
    sure = basin.loc[full.cummin(), "off by up to [%]"]
    text = (
        f"All initial guesses converge to the same minimum up to {sure.iloc[-1]:g} % off."
        if len(sure)
        else "At no radius do all initial guesses converge to it."
    )
    if full.all():
        return (text,)
    lowest = basin.loc[basin["success [%]"].idxmin()]
    return (
        f"{text} The fewest do so at {lowest['off by up to [%]']:g} %: "
        f"{lowest['same minimum']:.0f} of {lowest['initial guesses']:.0f}.",
    )


def _undetected(moved: pd.DataFrame) -> tuple[str, ...]:
    """How many other minima the paper's error does not detect."""
    others = moved[~moved["same"] & moved["distance_px"].notna()]
    unseen = others[others["epsilon_percent"] <= OUTLIER_PERCENT]["distance_px"]
    if not len(unseen):
        return ()
    return (
        f"The paper's ε does not detect {len(unseen)} of the {len(others)} results in other "
        f"minima: it is below {OUTLIER_PERCENT} % there, with displacements "
        f"{number(float(unseen.min()))} to {number(float(unseen.max()))} px rms off.",
    )


def _strain_sentences(strains: pd.DataFrame) -> tuple[str, ...]:
    if not len(strains):
        return ()
    same = strains["distance of the result [px]"] < SAME_PX
    off = strains["strain of the guess, off by [%]"]
    tried, converged = (", ".join(f"{v:+g}" for v in part).replace("-", "−")
                      for part in (off, off[same]))  # fmt: skip
    which = "" if same.all() or not same.any() else f": {converged} %"
    return (
        f"With the strain of v₀'s initial guess off by {tried} %, {int(same.sum())} of "
        f"{len(strains)} converge to the same minimum{which}.",
    )
