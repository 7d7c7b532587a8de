"""Report of a robustness study: success, the paper's epsilon, the basin of convergence."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from modeharvest.report.figures import style
from modeharvest.report.figures.curves import SMALL, curve
from modeharvest.report.model import Card, Findings, KeyNumber, ReportTable, number, text_of
from modeharvest.validation.studies.robustness import (
    OUTLIER_PERCENT,
    PUBLISHED,
    SAME_PX,
    GuessStatistics,
    RobustnessAnalysis,
    success_interval,
)


def by_radius(moved: pd.DataFrame) -> pd.DataFrame:
    """Success against the radius of the perturbations."""
    rows = []
    for radius, part in moved.groupby("radius"):
        good, count = int(part["same"].sum()), len(part)
        low, high = success_interval(good, count)
        others = part[~part["same"]]
        detected = int((others["outcome"] != "converged").sum())
        rows.append({
            "off by up to [%]": 100.0 * radius,
            "initial guesses": count,
            "same minimum": good,
            "success [%]": 100.0 * good / count,
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
    axes.hist(values, bins=np.logspace(low, max(high, low + 1), 40).tolist(), color=style.BLUE)
    axes.axvline(limit, color=style.GOLD, linestyle="--", linewidth=1)
    axes.set(xscale="log")
    return drawn


def draw_distances(table: pd.DataFrame) -> Figure:
    """Draw how far from the standard initial guess' result the others' are."""
    label = "distance from the standard guess’ displacement [px rms]"
    return _histogram("distance_px", SAME_PX, label, table)


def draw_epsilons(table: pd.DataFrame) -> Figure:
    """Draw the paper's error of each initial guess."""
    drawn = _histogram("epsilon_percent", OUTLIER_PERCENT, "ε [%]", table)
    drawn.axes[0].axvline(
        PUBLISHED["mean_epsilon_percent"], color=style.RED, linestyle=":", linewidth=1
    )
    return drawn


def draw_basin(rows: pd.DataFrame) -> Figure:
    """Draw success over how far off the mode's parameters are."""
    drawn, axes = curve("mode parameters off by up to [%]", "same minimum [%]", SMALL)
    x, y = rows["off by up to [%]"], rows["success [%]"]
    spread = np.clip([y - rows["95 % from"], rows["to [%]"] - y], 0.0, None)
    axes.errorbar(x, y, yerr=spread, color=style.GREEN, marker="o", markersize=3, capsize=2)
    axes.plot(10.0, 100.0 * PUBLISHED["success"], "x", color=style.RED)
    axes.set(xlim=(0.0, None), ylim=(0.0, 104.0))
    return drawn


def draw_strains(strains: pd.DataFrame) -> Figure:
    """Draw where initial guesses with a wrong strain end."""
    rows = strains.sort_values("strain of the guess, off by [%]")
    off = rows["strain of the guess, off by [%]"]
    drawn, axes = curve("strain of v₀’s initial guess off by [%]", "distance [px rms]", SMALL)
    for end, label, colour, marker in (
        ("guess", "initial guess", style.GOLD, "^"), ("result", "result", style.BLUE, "o"),
    ):  # fmt: skip
        far = np.maximum(rows[f"distance of the {end} [px]"], 1e-12)
        axes.plot(off, far, color=colour, marker=marker, linewidth=1, markersize=4, label=label)
    axes.axhline(SAME_PX, color=style.GREEN, linestyle="--", linewidth=1)
    axes.set(yscale="log")
    axes.legend()
    return drawn


def _figures(
    asked: pd.DataFrame, basin: pd.DataFrame, strains: pd.DataFrame, radius: float, seeds: str
) -> list[Card]:
    outliers = int((asked["epsilon_percent"] > OUTLIER_PERCENT).sum())
    drawn = {
        "distances": partial(draw_distances, asked), "epsilon": partial(draw_epsilons, asked),
        "basin": partial(draw_basin, basin),
    }  # fmt: skip
    if len(strains):
        drawn["strains"] = partial(draw_strains, strains)
    return [
        Card.captioned(name, draw, f"robustness-{name}", seeds=seeds, count=len(asked),
                       radius=f"{100 * radius:g}", limit=OUTLIER_PERCENT,
                       outliers=outliers or "none", mean=PUBLISHED["mean_epsilon_percent"])
        for name, draw in drawn.items()
    ]  # fmt: skip


def report_robustness(found: RobustnessAnalysis, seeds: str) -> Findings:
    """Success, epsilon and distance, and the basin's picture."""
    radius, strains = found.statistics.radius, by_strain(found.strains)
    basin = by_radius(found.moved[found.moved["radius"] > 0.0])
    tables = {"Basin of convergence": basin}
    if not found.moved["same"].all():
        tables["Other minima"] = other_minima(found.moved)
    if len(strains):
        tables["Initial guess of v0"] = strains
    return Findings(
        numbers={**asdict(found.statistics), "basin": basin.to_dict("records")},
        text=(
            *_text(found.statistics),
            *_basin_text(basin),
            *_undetected(found.moved),
            *_strain_text(strains),
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


def _text(found: GuessStatistics) -> tuple[str, ...]:
    low, high = found.success_interval_95
    elsewhere = found.initial_guesses - found.same_minimum - found.failed
    text = [
        text_of("robustness-success", found=found, radius=100 * found.radius, same=SAME_PX,
                 success=100 * found.success, low=100 * low, high=100 * high,
                 published=100 * PUBLISHED["success"]),
        text_of("robustness-epsilon", mean=number(found.mean_epsilon_percent),
                 largest=number(found.largest_epsilon_percent), limit=OUTLIER_PERCENT,
                 outliers=found.outliers or "none", published=PUBLISHED),
        text_of("robustness-distance", largest=number(found.largest_distance_px),
                 arrived=number(found.largest_distance_of_arrived_px)),
        text_of("robustness-phases"),
    ]  # fmt: skip
    if elsewhere:
        text.append(text_of("robustness-elsewhere", elsewhere=elsewhere,
                             converged=found.other_minimum_called_converged))  # fmt: skip
    if found.failed:
        text.append(f"{found.failed} failed, and count as not converged to it.")
    return tuple(text)


def _basin_text(basin: pd.DataFrame) -> tuple[str, ...]:
    """Up to where all converge to the same minimum."""
    full = basin["same minimum"] == basin["initial guesses"]
    sure = basin.loc[full.cummin(), "off by up to [%]"]
    text = "At no radius do all initial guesses converge to it."
    if len(sure):
        text = f"All initial guesses converge to the same minimum up to {sure.iloc[-1]:g} % off."
    if not full.all():
        lowest = basin.loc[basin["success [%]"].idxmin()]
        text += (f" The fewest do so at {lowest['off by up to [%]']:g} %: "
                 f"{lowest['same minimum']:.0f} of {lowest['initial guesses']:.0f}.")  # fmt: skip
    return (text,)


def _undetected(moved: pd.DataFrame) -> tuple[str, ...]:
    """How many other minima the paper's error does not detect."""
    others = moved[~moved["same"] & moved["distance_px"].notna()]
    unseen = others[others["epsilon_percent"] <= OUTLIER_PERCENT]["distance_px"]
    if not len(unseen):
        return ()
    least, most = (number(float(end)) for end in (unseen.min(), unseen.max()))
    return (text_of("robustness-undetected", unseen=len(unseen), others=len(others), least=least,
                     most=most, limit=OUTLIER_PERCENT),)  # fmt: skip


def _strain_text(strains: pd.DataFrame) -> tuple[str, ...]:
    if not len(strains):
        return ()
    same = strains["distance of the result [px]"] < SAME_PX
    off = strains["strain of the guess, off by [%]"]
    tried, converged = (", ".join(f"{v:+g}" for v in part).replace("-", "−")
                        for part in (off, off[same]))  # fmt: skip
    which = "" if same.all() or not same.any() else f": {converged} %"
    return (text_of("robustness-strains", tried=tried, same=int(same.sum()), count=len(strains),
                     which=which),)  # fmt: skip
