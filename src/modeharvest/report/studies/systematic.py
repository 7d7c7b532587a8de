"""Report of a systematic study: effect of each factor on the errors."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from modeharvest.report.figures import style
from modeharvest.report.model.content import Findings, KeyNumber, ReportTable
from modeharvest.report.model.text import number, text_of
from modeharvest.validation.studies.systematic import BASE, FACTORS, SystematicAnalysis

ERROR_LABELS = {
    "measurement_error_px": "measurement error, IDIC − best fit [px]",
    "model_error_px": "model error, truth − best fit [px]",
    "w_px": "w = truth − IDIC [px]",
    "v1_percent": "v₁ off the best fit's [%]",
}

MOVED = "moved from the base [px]"
_FAR, _NEAR = 0.1, 0.01
"""Factors are listed in three groups by how far they move the measurement [px]."""


def by_level(found: SystematicAnalysis) -> pd.DataFrame:
    """A row for each factor and level, including the base's: means over the speckles."""
    done = found.rows
    base = done[done["factor"] == BASE]
    rows = []
    for name, at_base in found.bases.items():
        parts = dict(iter(done[done["factor"] == name].groupby("level")))
        if at_base is not None:
            parts[float(at_base)] = base
        for level in sorted(parts):
            part, factor = parts[level], FACTORS[name]
            if not len(part):
                continue
            good = int((part["outcome"] == "converged").sum())
            scatter = part["measurement_error_px"].std(ddof=0)
            rows.append({
                "factor": factor.label, "name": name, "number": level,
                "level": factor.label_of(level) if factor.names else level,
                "base": "yes" if level == at_base else "",
                **{label: part[key].mean() for key, label in ERROR_LABELS.items()},
                MOVED: part["moved"].mean(),
                "measurement error, sd over speckles [px]": scatter,
                "pixels per ligament": part["pixels_per_ligament"].mean(),
                "converged": f"{good} of {len(part)}",
            })  # fmt: skip
    return pd.DataFrame(rows)


def by_factor(levels: pd.DataFrame) -> pd.DataFrame:
    """A row for each factor, with its smallest and largest errors.

    Factors that move the measurement most come first. Levels with failed convergence are ignored.
    """
    measurement, model = (ERROR_LABELS[f"{name}_error_px"] for name in ("measurement", "model"))
    moved = f"largest, {MOVED}"
    rows = []
    settled = levels[~levels["converged"].map(_not_all_converged)]
    for name, part in settled.groupby("name", sort=False):
        least, most = part.loc[part[measurement].idxmin()], part.loc[part[measurement].idxmax()]
        rows.append({
            "factor": FACTORS[str(name)].label, "name": name,
            f"smallest {measurement}": least[measurement], "at": least["level"],
            f"largest {measurement}": most[measurement], "at ": most["level"],
            "ratio": most[measurement] / least[measurement],
            f"{model}, from": part[model].min(), "to": part[model].max(),
            moved: part[MOVED].max(),
        })  # fmt: skip
    return pd.DataFrame(rows).sort_values(moved, ascending=False, ignore_index=True)


def _not_all_converged(converged: str) -> bool:
    good, _, count = converged.split()
    return good != count


_CURVES: dict[str, dict[str, Any]] = {
    ERROR_LABELS["measurement_error_px"]: {"color": style.BLUE, "marker": "o"},
    ERROR_LABELS["model_error_px"]: {"color": style.GREEN, "marker": "s"},
    MOVED: {"color": style.GOLD, "marker": "^"},
}
_COLUMNS = 3


def report_systematic(found: SystematicAnalysis, seeds: str) -> Findings:
    """Errors over the levels of each factor, as curves and tables."""
    levels = by_level(found)
    spans = by_factor(levels)
    first, base = spans.iloc[0], found.base
    values = {"base": base, "factor": _short(first["factor"]), "moved": first[f"largest, {MOVED}"]}
    keys = ("base-measurement", "base-model", "matters-most")
    return Findings(
        numbers={"base": dict(base), "factors": spans.to_dict("records")},
        text=[
            text_of("systematic-base", base=base),
            *_text(levels, spans),
            text_of("systematic-model-error"),
        ],
        keys=[KeyNumber.of(name, **values) for name in keys],
        figures={"factors": partial(draw_factors, levels, found.bases)},
        words={"seeds": seeds},
        tables=[
            ReportTable.of_frame("Which factor matters", spans),
            ReportTable.of_frame("Every level", levels.drop(columns="number")),
        ],
    )


def _short(factor: str) -> str:
    """A factor's label without its unit."""
    return factor.split(" [")[0]


def _text(levels: pd.DataFrame, spans: pd.DataFrame) -> list[str]:
    """Sentences: factors grouped by how far they move the measurement; levels not converged."""
    text, moved = [], spans[f"largest, {MOVED}"]
    for heading, part in {
        f"These move the measurement by more than {_FAR:g} px": moved > _FAR,
        f"These by {_NEAR:g} to {_FAR:g} px": (moved >= _NEAR) & (moved <= _FAR),
        f"These by less than {_NEAR:g} px": moved < _NEAR,
    }.items():
        factors = zip(spans["factor"][part], moved[part], strict=True)
        named = ", ".join(f"{_short(factor)} ({number(far, 2)} px)" for factor, far in factors)
        text += [f"{heading}: {named}."] if named else []
    lost_ones = levels[levels["converged"].map(_not_all_converged)]
    if len(lost_ones):
        named = ", ".join(f"{r['name']} = {number(r['level'])}" for _, r in lost_ones.iterrows())
        text.append(f"Not every correlation converged at {named}: left out above.")
    return text


def draw_factors(levels: pd.DataFrame, bases: Mapping[str, float | None]) -> Figure:
    """Draw the errors over the levels of each factor, in small plots with a common scale."""
    rows = -(-len(bases) // _COLUMNS)
    drawn = style.figure(9.6, 2.3 * rows)
    grid = drawn.subplots(rows, _COLUMNS, squeeze=False, sharey=True).ravel()
    for axes in grid[len(bases) :]:
        axes.set_visible(False)
    for axes, (name, at_base) in zip(grid, bases.items(), strict=False):
        part = levels[levels["name"] == name]
        for column, look in _CURVES.items():
            shown = part[part[column] > 0.0]  # the base has a change of 0
            axes.plot(shown["number"], shown[column], linewidth=1, markersize=4, label=column,
                      **look)  # fmt: skip
        _label_axes(axes, part, at_base)
    for axes in grid[::_COLUMNS]:
        axes.set_ylabel("rms [px of the base]")
    drawn.legend(*grid[0].get_legend_handles_labels(), ncols=3, loc="upper left")
    drawn.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.3 / drawn.get_figheight()))
    return drawn


def _label_axes(axes: Axes, part: pd.DataFrame, at_base: float | None) -> None:
    factor, name = FACTORS[part["name"].iloc[0]], part["name"].iloc[0]
    levels = part["number"].to_numpy(dtype=np.float64)
    is_geometric = levels.min() > 0 and levels.max() / levels.min() >= 4 and not factor.whole
    axes.set(xlabel=factor.label, yscale="log", xscale="log" if is_geometric else "linear")
    if at_base is not None:
        axes.axvline(at_base, color=style.MUTED, linestyle=":", linewidth=1)
    ticks = [factor.label_of(level) for level in levels]
    if name == "pixel_size":
        axes.set_xlabel("pixel [mm], below: pixels per ligament")
        ticks = [f"{t}\n{p:.3g}" for t, p in zip(ticks, part["pixels per ligament"], strict=True)]
    axes.set_xticks(levels, ticks)
    axes.xaxis.set_minor_locator(NullLocator())
