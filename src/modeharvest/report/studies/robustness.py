"""Report of a robustness study: success, the paper's epsilon, the basin of convergence."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from modeharvest.report.figures import style
from modeharvest.report.figures.curves import SMALL, curve
from modeharvest.report.model.content import Findings, KeyNumber, ReportTable
from modeharvest.report.model.text import text_of
from modeharvest.validation.studies.robustness import (
    OUTLIER_PERCENT,
    PUBLISHED,
    SAME_PX,
    RobustnessAnalysis,
    success_interval,
)


def by_radius(moved: pd.DataFrame) -> pd.DataFrame:
    """A row for each radius of the perturbations: guesses that converge to the same minimum."""
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
    """Guesses that fail or lead to another minimum; reproducible by number, radius and seed."""
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


def _histogram(name: str, limit: float, label: str, table: pd.DataFrame) -> Figure:
    """Histogram of the initial guesses over a column on a logarithmic axis; a line at ``limit``."""
    drawn, axes = curve(label, "initial guesses", SMALL)
    values = np.maximum(table[name].dropna().to_numpy(), 1e-12)
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(max(values.max(), limit)))
    axes.hist(values, bins=np.logspace(low, max(high, low + 1), 40).tolist(), color=style.BLUE)
    axes.axvline(limit, color=style.GOLD, linestyle="--", linewidth=1)
    axes.set(xscale="log")
    return drawn


def draw_distances(table: pd.DataFrame) -> Figure:
    """Draw a histogram of the results' distances from that of the standard initial guess."""
    label = "distance from the standard guess’ displacement [px rms]"
    return _histogram("distance_px", SAME_PX, label, table)


def draw_epsilons(table: pd.DataFrame) -> Figure:
    """Draw a histogram of the paper's error epsilon of all initial guesses."""
    drawn = _histogram("epsilon_percent", OUTLIER_PERCENT, "ε [%]", table)
    drawn.axes[0].axvline(
        PUBLISHED["mean_epsilon_percent"], color=style.RED, linestyle=":", linewidth=1
    )
    return drawn


def draw_basin(rows: pd.DataFrame) -> Figure:
    """Draw the success rate over the radius of the perturbations, with 95 % intervals."""
    drawn, axes = curve("mode parameters off by up to [%]", "same minimum [%]", SMALL)
    x, y = rows["off by up to [%]"], rows["success [%]"]
    spread = np.clip([y - rows["95 % from"], rows["to [%]"] - y], 0.0, None)
    axes.errorbar(x, y, yerr=spread, color=style.GREEN, marker="o", markersize=3, capsize=2)
    axes.plot(10.0, 100.0 * PUBLISHED["success"], "x", color=style.RED)
    axes.set(xlim=(0.0, None), ylim=(0.0, 104.0))
    return drawn


def draw_strains(strains: pd.DataFrame) -> Figure:
    """Draw distances of guesses with a wrong strain, and of their results, over its error."""
    rows = strains.sort_values("strain_percent")
    off = rows["strain_percent"]
    drawn, axes = curve("strain of v₀’s initial guess off by [%]", "distance [px rms]", SMALL)
    for end, label, colour, marker in (
        ("start_distance_px", "initial guess", style.GOLD, "^"),
        ("distance_px", "result", style.BLUE, "o"),
    ):
        far = np.maximum(rows[end], 1e-12)
        axes.plot(off, far, color=colour, marker=marker, linewidth=1, markersize=4, label=label)
    axes.axhline(SAME_PX, color=style.GREEN, linestyle="--", linewidth=1)
    axes.set(yscale="log")
    axes.legend()
    return drawn


def report_robustness(found: RobustnessAnalysis, seeds: str) -> Findings:
    """Success rate, epsilon, distances, and the basin of convergence."""
    asked, statistics = found.at_radius, found.statistics
    strains = found.strains.assign(strain_percent=100.0 * found.strains["strain_error"])
    basin = by_radius(found.moved[found.moved["radius"] > 0.0])
    low, high = statistics.success_interval_95
    elsewhere = statistics.initial_guesses - statistics.same_minimum - statistics.failed
    values = {
        "found": statistics, "published": PUBLISHED, "seeds": seeds, "same": SAME_PX,
        "limit": OUTLIER_PERCENT, "outliers": statistics.outliers or "none",
        "elsewhere": elsewhere, "radius": 100 * statistics.radius,
        "success": 100 * statistics.success, "low": 100 * low, "high": 100 * high,
        "paper": 100 * PUBLISHED["success"],
    }  # fmt: skip
    texts = ["success", "epsilon", "distance", "phases"]
    texts += ["elsewhere"] * (elsewhere > 0) + ["failed"] * (statistics.failed > 0)
    figures = {
        "distances": partial(draw_distances, asked),
        "epsilon": partial(draw_epsilons, asked),
        "basin": partial(draw_basin, basin),
    }
    tables = [ReportTable.of_frame("Basin of convergence", basin)]
    if not found.moved["same"].all():
        tables.append(ReportTable.of_frame("Other minima", other_minima(found.moved)))
    if len(strains):
        figures["strains"] = partial(draw_strains, strains)
        tables.append(ReportTable.of("strains", strains.to_dict("records")))
    return Findings(
        numbers={**asdict(statistics), "basin": basin.to_dict("records")},
        text=[
            *(text_of(f"robustness-{name}", **values) for name in texts),
            _basin_text(basin),
            *_undetected(found.moved),
            *_strain_text(strains),
        ],
        keys=[KeyNumber.of(name, **values) for name in ("same-minimum", "epsilon", "distance")],
        figures=figures,
        words={**values, "count": len(asked)},
        tables=tables,
    )


def _basin_text(basin: pd.DataFrame) -> str:
    """Text: the largest radius up to which all guesses converge, and the one with fewest."""
    full = basin["same minimum"] == basin["initial guesses"]
    sure = basin.loc[full.cummin(), "off by up to [%]"]
    text = text_of("robustness-nowhere")
    if len(sure):
        text = text_of("robustness-sure", sure=sure.iloc[-1])
    if not full.all():
        radius, count, same, *_ = basin.loc[basin["success [%]"].idxmin()]
        text += text_of("robustness-fewest", radius=radius, same=same, count=count)
    return text


def _undetected(moved: pd.DataFrame) -> list[str]:
    """A sentence on other minima that the paper's error does not detect; none if there are none."""
    others = moved[~moved["same"] & moved["distance_px"].notna()]
    unseen = others[others["epsilon_percent"] <= OUTLIER_PERCENT]["distance_px"]
    if not len(unseen):
        return []
    return [text_of("robustness-undetected", unseen=unseen, others=others, limit=OUTLIER_PERCENT,
                    least=unseen.min(), most=unseen.max())]  # fmt: skip


def _strain_text(strains: pd.DataFrame) -> list[str]:
    if not len(strains):
        return []
    same, off = strains["distance_px"] < SAME_PX, strains["strain_percent"]
    tried, converged = (", ".join(f"{v:+g}" for v in part).replace("-", "−")
                        for part in (off, off[same]))  # fmt: skip
    which = "" if same.all() or not same.any() else f": {converged} %"
    return [text_of("robustness-strains", tried=tried, same=same.sum(), off=off, which=which)]
