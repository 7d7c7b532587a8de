"""Report of a test's design: expected errors, settings needed for wanted errors, and a map."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from modeharvest.report.figures.curves import curve, plain_ticks
from modeharvest.report.figures.style import INK, SIZE
from modeharvest.report.model.content import Card, KeyNumber, Report, ReportTable, Section
from modeharvest.report.model.text import caption, number, text_of
from modeharvest.util.typed import headings
from modeharvest.validation.design import DesignRanges, ExpectedErrors

Summary = Mapping[str, Any]
_ERRORS, _AXES = headings(ExpectedErrors), headings(DesignRanges)
_WITHIN = 0.5
"""Model error over the standard deviation of u by noise, above which a warning is given [-]."""


def design_report(summary: Summary) -> Report:
    """Make the report of a design; ``summary``: content of ``summary.json``."""
    sought = summary["parameters"]
    shown_errors = {k: v for k, v in _ERRORS.items() if sought or k != "parameter_percent"}
    varied = [
        ReportTable(f"Varied: {_AXES[axis]}",
                    [_AXES[axis], *shown_errors.values(), *(f"sd of {name}" for name in sought)],
                    [[row["value"], *(row[name] for name in shown_errors),
                      *row["parameter_sd"]] for row in rows])
        for axis, rows in summary["varied"].items() if rows
    ]  # fmt: skip
    shown, wanted = summary["map"], summary["wanted"]
    labels = [*(_AXES[axis] for axis in shown["axes"]), _ERRORS[shown["contour"]]]
    level = wanted[shown["contour"]]
    picture = partial(_draw_map, shown, level, labels)
    w, u = summary["expected"]["w_px"] or 0.0, summary["expected"]["u_px"]
    limit = "model-error" if w > _WITHIN * u else "" if w else "no-truth"
    words = {"quantity": labels[2], "level": number(level)}
    return Report(
        kind="design",
        title=summary["title"],
        findings=findings(summary),
        keys=[
            KeyNumber.of(f"design-{name}", number(float(summary["expected"][name]), 3))
            for name in ("v1_percent", "v1_px", "wave_number", "phase", "image_noise")
        ],
        sections=[
            Section.of("design-needed", Card.tabular(_needed(summary), wide=True)),
            Section.of("design-map", [Card.captioned("design-map", picture, **words)]),
            Section.of("design-varied",
                       [card for table in varied for card in Card.tabular(table, wide=True)]),
        ],
        warnings=[text_of(f"design-{limit}", w=w, times=w / u)] if limit else [],
        notes=[text_of(f"design-{name}") for name in ("noise", "speckle", "strain")],
        command=summary["command"],
        case=summary["case"],
        versions=summary["versions"],
        **caption("page-design"),
    )  # fmt: skip


def findings(summary: Summary) -> list[str]:
    """Expected errors in sentences, and whether they are within the wanted ones."""
    expected, wanted = summary["expected"], summary["wanted"]
    text = [text_of("design-expected", **expected, setup=summary["setup"])]
    if names := summary["parameters"]:
        pairs = zip(names, expected["parameter_sd"], strict=True)
        found = ", ".join(f"{name} by {number(sd, 3)}" for name, sd in pairs)
        text.append(text_of("design-parameters", found=found))
    sensor = summary["case"]["imaging"]["sensor"]
    if not sensor["read_noise"] and not sensor["full_well"]:
        text.append(text_of("design-assumed", noise=summary["setup"]["noise"]))
    missed = [name for name in wanted if expected[name] > wanted[name]]
    if missed:
        which = "; ".join(f"{_ERRORS[name]}: {number(wanted[name])}" for name in missed)
        text.append(text_of("design-missed", which=which))
    else:
        text.append(text_of("design-met"))
    return text


def _needed(summary: Summary) -> ReportTable:
    """Table of the limit of each quantity for each wanted error, and of its value in the case."""
    wanted, setup, varied = summary["wanted"], summary["setup"], summary["varied"]
    rows = []
    for axis, values in summary["needed"].items():
        if not varied[axis]:
            continue
        low, high = (number(varied[axis][k]["value"]) for k in (0, -1))
        sign, easiest = ("≥", low) if axis in ("exposures", "light") else ("≤", high)
        found = [number(values[name], 3) for name in wanted]
        cells = [
            f"not within {low} … {high}" if values[name] is None
            else f"any, {low} … {high}" if text == easiest else f"{sign} {text}"
            for name, text in zip(wanted, found, strict=True)
        ]  # fmt: skip
        rows.append([_AXES[axis], setup[axis], *cells])
    heads = [f"{_ERRORS[name]}: {number(value)}" for name, value in wanted.items()]
    title = caption("table-design-needed")["title"]
    return ReportTable(title, ["varied", "as in the case", *heads], rows, on_terminal=True)


def _draw_map(shown: Mapping[str, Any], wanted: float, labels: list[str]) -> Figure:
    """Draw a map of the error, with a contour line at the wanted error if it occurs."""
    drawn, axes = curve(labels[0], labels[1], (6.4, 3.6))
    at, errors = (shown["first"], shown["second"]), np.array(shown["errors"])
    looks: dict[str, Any] = {"norm": LogNorm(), "cmap": SIZE, "shading": "gouraud"}
    colours = axes.pcolormesh(*at, errors, rasterized=True, **looks)
    axes.set(xscale="log", yscale="log")
    if errors.min() < wanted < errors.max():
        line = axes.contour(*at, errors, levels=[wanted], colors=["white"])
        axes.clabel(line, fmt=f"{wanted:g}", fontsize=8)
    axes.grid(visible=False)
    bar = drawn.colorbar(colours, ax=axes)
    bar.set_label(labels[2], color=INK)
    plain_ticks(axes.xaxis, axes.yaxis, bar.ax.yaxis)
    return drawn
