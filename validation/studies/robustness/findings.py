"""What the table of a robustness study tells: success, epsilon, the basin of convergence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import binomtest

from modeharvest.validation.page import short
from modeharvest.validation.studies.robustness.plots import (
    OUTLIER_PERCENT,
    PAPER,
    SAME_PX,
    draw_basin,
    draw_distances,
    draw_epsilons,
    draw_starts_of_v0,
)
from modeharvest.validation.studies.robustness.study import Robustness
from modeharvest.validation.studies.study import Findings, KeyNumber


def report_robustness(study: Robustness, table: pd.DataFrame, folder: Path) -> Findings:
    """Success, epsilon and the honest distance, and the basin's picture."""
    return findings(table, study.radius, study.seeds)


def findings(table: pd.DataFrame, radius: float, seeds: str) -> Findings:
    """Read the table of all starts.

    Parameters
    ----------
    table
        A row for each case of
        :func:`modeharvest.validation.studies.robustness.study.one_start`. One that failed counts
        as one that did not arrive.
    radius
        That of the paper's question [-].
    seeds
        In words.
    """
    table = table.assign(same=table["distance_px"] < SAME_PX)
    moved = table[table["strain_error"] == 0.0]
    asked = moved[moved["radius"] == radius]
    found = numbers(asked, radius)
    basin, strains = by_radius(moved[moved["radius"] > 0.0]), by_strain(table)
    tables = {"Basin of convergence": basin}
    if not moved["same"].all():
        tables["Starts that end elsewhere"] = elsewhere(moved)
    if len(strains):
        tables["Start of v0"] = strains
    return Findings(
        numbers={**found, "basin": basin.to_dict("records")},
        sentences=(
            *_sentences(found),
            *_basin_sentences(basin),
            *_unseen_sentences(moved),
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


def numbers(asked: pd.DataFrame, radius: float) -> dict[str, Any]:
    """The paper's numbers and the honest ones, of the starts within one radius."""
    good, n = int(asked["same"].sum()), len(asked)
    epsilon, arrived = asked["epsilon_percent"].dropna(), asked["same"]
    outliers = epsilon > OUTLIER_PERCENT
    others = asked[~arrived & (asked["error"] == "")]
    return {
        "starts": n,
        "radius": radius,
        "same_minimum": good,
        "success": good / n,
        "success_interval_95": list(wilson(good, n)),
        "mean_epsilon_percent": float(epsilon.mean()),
        "largest_epsilon_percent": float(epsilon.max()),
        "mean_epsilon_without_outliers_percent": float(epsilon[~outliers].mean()),
        "outliers": int(outliers.sum()),
        "largest_distance_px": float(asked["distance_px"].max()),
        "largest_distance_of_arrived_px": float(asked.loc[arrived, "distance_px"].max()),
        "largest_start_distance_px": float(asked["start_distance_px"].max()),
        "elsewhere_but_called_converged": int((others["outcome"] == "converged").sum()),
        "failed": int((asked["error"] != "").sum()),
        "paper": PAPER,
    }


def wilson(good: int, n: int) -> tuple[float, float]:
    """95 % confidence interval of a share, by Wilson's score.

    References
    ----------
    E. B. Wilson, J. Am. Stat. Assoc. 22 (1927), doi 10.1080/01621459.1927.10502953.
    """
    low, high = binomtest(good, n).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def by_radius(moved: pd.DataFrame) -> pd.DataFrame:
    """Success against the radius of the perturbations."""
    rows = []
    for radius, part in moved.groupby("radius"):
        good, n = int(part["same"].sum()), len(part)
        low, high = wilson(good, n)
        others = part[~part["same"]]
        told = int((others["outcome"] != "converged").sum())
        rows.append({
            "off by up to [%]": 100.0 * radius,
            "starts": n,
            "same minimum": good,
            "success [%]": 100.0 * good / n,
            "95 % from": 100.0 * low,
            "to [%]": 100.0 * high,
            "others recognised": f"{told} of {n - good}",
            "largest distance among the same [px]": part.loc[part["same"], "distance_px"].max(),
            "mean iterations": part["all_iterations"].mean(),
        })  # fmt: skip
    return pd.DataFrame(rows)


def elsewhere(moved: pd.DataFrame) -> pd.DataFrame:
    """Each start that does not arrive; with the seed its number makes it again."""
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


def by_strain(table: pd.DataFrame) -> pd.DataFrame:
    """Where starts with a wrong strain end; empty if there was none."""
    part = table[table["strain_error"] != 0.0]
    return pd.DataFrame({
        "strain of the start, off by [%]": 100.0 * part["strain_error"],
        "distance of the start [px]": part["start_distance_px"],
        "distance of the end [px]": part["distance_px"],
        "outcome": part["outcome"],
        "iterations": part["all_iterations"],
    })  # fmt: skip


def _keys(found: Mapping[str, Any]) -> tuple[KeyNumber, ...]:
    low, high = found["success_interval_95"]
    return (
        KeyNumber(
            "starts that arrive", f"{found['same_minimum']} of {found['starts']}", "",
            f"95 % interval {100 * low:.1f} to {100 * high:.1f} %; the paper: 98 of 100",
        ),
        KeyNumber(
            "mean ε, as the paper defines it", short(found["mean_epsilon_percent"]), "%",
            f"the paper: {PAPER['mean_epsilon_percent']} %, without two outliers "
            f"{PAPER['mean_epsilon_without_outliers_percent']} %",
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
        f"{100 * high:.1f} %. The paper has {100 * PAPER['success']:.0f} of 100.",
        f"The paper's ε = 100 (‖u‖ − ‖u_pert‖)/‖u‖, here without its sign, is "
        f"{short(found['mean_epsilon_percent'])} % on average and "
        f"{short(found['largest_epsilon_percent'])} % at most; {found['outliers'] or 'none'} lie "
        f"above {OUTLIER_PERCENT} %, the paper's outliers. The paper has "
        f"{PAPER['mean_epsilon_percent']} % on average, "
        f"{PAPER['mean_epsilon_without_outliers_percent']} % without two outliers.",
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


def _unseen_sentences(moved: pd.DataFrame) -> tuple[str, ...]:
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
