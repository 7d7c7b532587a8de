"""Report of an identification: parameters and their errors, force over strain, residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modeharvest.idic.finite_element.identification.identify import Identified
from modeharvest.idic.finite_element.identification.observed import ImageData, StateObservation
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import curve, legend_above
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field
from modeharvest.report.figures.style import BLUE, EDGE, GOLD, RED
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.text import Measured, caption, number, text_of

Summary = Mapping[str, Any]
_TEST = "{chi_squared:.4g} of {degrees_of_freedom}, p = {p_value:.2g}"
_PARTS = ("x", "y", "diameter", "ovality along the axes", "ovality along the diagonals")
_HOLES_SHOWN = 0.15  # approximate largest change of a hole as drawn, over its diameter [-]


def identification_report(
    summary: Summary, found: Identified | None = None, data: Sequence[StateObservation | None] = ()
) -> Report:
    """The report of an identification.

    ``summary``: the content of ``summary.json``. ``found``, ``data``: the identified model and the
    data of its states, for the figures of force and residuals; without them, these are left out.
    """
    parameters = summary["parameters"]
    table = ReportTable.of("identified", map(_row, parameters))
    names = [p["name"] for p in parameters]
    rows = [[name, *(None if c is None else f"{c:+.3f}" for c in row)]
            for name, row in zip(names, summary["correlations"], strict=True)]  # fmt: skip
    correlations = ReportTable(**caption("table-identified-correlations"),
                               columns=["", *names], rows=rows)  # fmt: skip
    laws = ReportTable.of("identified-laws", map(_law_row, summary["laws"]))
    states = ReportTable.of("identified-states", map(_state_row, summary["states"]))
    return Report(
        kind="identification",
        title=summary["title"],
        findings=[
            *(text_of("identified-parameter", **p, of_unit=f" {p['unit']}".removesuffix(" -"))
              for p in parameters if p["sd"] is not None),
            *summary["statements"],
            text_of("identified-outcome", **summary),
        ],
        keys=[
            KeyNumber(p["name"], number(p["value"], 4), p["unit"].replace("-", ""),
                      "" if p["sd"] is None else f"± {number(p['sd'], 2)}")
            for p in parameters[:6]
        ],
        sections=[
            Section.of("identified", [
                *Card.tabular(table, wide=True), *Card.tabular(correlations),
                *(Card.tabular(laws, wide=True) if laws.rows else []),
                *_hole_cards(summary),
            ]),
            Section.of("identified-states", [
                *_force_cards(summary, found), *_residual_cards(summary, found, data),
                *Card.tabular(states, wide=True),
            ]),
        ],
        warnings=summary["warnings"],
        command=summary["command"],
        case=summary["case"],
        files={"solution.h5": "the model's states (HDF5)", "solution.vtu": "the same for ParaView"},
        costs={"evaluations of the model": number(summary["evaluations"]),
               "its unknowns": number(summary["model_unknowns"])},
        versions=summary["versions"],
        **caption("page-identification"),
    )  # fmt: skip


def _row(p: Mapping[str, Any]) -> Mapping[str, Any]:
    unit = "" if p["unit"] == "-" else f" [{p['unit']}]"
    sd, true = p["sd_with_model_error"], p["true"]
    off = None if true is None or not sd else f"{(p['value'] - true) / sd:+.2f}"
    written = {
        key: None if p[key] is None else f"{p[key]:.{digits}g}"
        for key, digits in (("value", 5), ("sd", 2), ("mesh_error", 2),
                            ("sd_with_model_error", 2), ("true", 5), ("start", 5))
    }  # fmt: skip
    return {**written, "name": p["name"] + unit, "off": off}


def _law_row(law: Mapping[str, Any]) -> Mapping[str, Any]:
    values = [f"{p['name']} {Measured(p['value'], (p['sd_with_model_error'] or np.nan,))}"
              for p in law["parameters"]]  # fmt: skip
    tests = {name: _TEST.format(**law[name]) for name in ("model_error", "law_error")}
    return {**law, **tests, "parameters": ", ".join(values)}


def _state_row(state: Mapping[str, Any]) -> Mapping[str, Any]:
    measured, sd = state["force_measured_N_per_mm"], state["force_sd_N_per_mm"]
    return {
        **state,
        "strain": f"{100 * state['nominal_strain']:.5g}",
        "force": str(Measured(state["force_N_per_mm"], (sd,))),
        "measured": None if measured is None else f"{measured:.5f}",
        "residual_rms": f"{state['residual_rms']:.4g}",
        "residual_noise": f"{state['residual_noise']:.4g}",
    }


def _force_cards(summary: Summary, found: Identified | None) -> list[Card]:
    if found is None:
        return []
    draw = partial(_draw_force, summary["states"], summary["force_sd_N_per_mm"])
    figure = ReportFigure("force", "", draw, wide=True)
    return [Card("Force against strain", [figure], caption=text_of("identified-force"))]


def _draw_force(states: Sequence[Mapping[str, Any]], reading_sd: float | None) -> Figure:
    drawn, axes = curve("nominal strain [%]", "force per thickness [N/mm]")
    columns = ("nominal_strain", "force_N_per_mm", "force_sd_N_per_mm", "force_measured_N_per_mm")
    e, force, sd, measured = np.array([[s[c] for c in columns] for s in states], float).T
    e, force, sd = (np.append(0.0, values) for values in (100 * e, force, np.nan_to_num(sd)))
    axes.fill_between(e, force - 2 * sd, force + 2 * sd, color=BLUE, alpha=0.2, lw=0)
    axes.plot(e, force, "s-", color=BLUE, ms=3.5, label="model")
    if reading_sd is not None:
        axes.errorbar(e[1:], measured, 2 * reading_sd, color=RED, marker="o", ms=4.5, ls="none",
                      capsize=2.5, elinewidth=1, label="measured")  # fmt: skip
    legend_above(axes)
    axes.set(xlim=(0, None), ylim=(0, None))
    return drawn


def _hole_cards(summary: Summary) -> list[Card]:
    holes = summary["holes"]
    if holes is None:
        return []
    off = np.array([hole["off"] for hole in holes])
    largest = max(np.abs(off[:, :2]).max(), 0.5 * np.abs(off[:, 2:]).max(), 1e-12)
    times = float(f"{_HOLES_SHOWN * holes[0]['diameter'] / largest:.1g}")
    figure = ReportFigure("holes", "", partial(_draw_holes, holes, times), wide=True)
    sd = np.array([hole["off_sd"] for hole in holes])
    known = zip(1e3 * np.sqrt(np.mean(sd**2, axis=0)), _PARTS, strict=True)
    words = ", ".join(f"{microns:.1f} µm in {part}" for microns, part in known if microns)
    text = text_of("identified-holes", times=times, known=words)
    return [Card("Holes as found", [figure], caption=text)]


def _draw_holes(holes: Sequence[Mapping[str, Any]], times: float) -> Figure:
    drawn, axes = curve("x [mm]", "y [mm]")
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for what, colour, style in (("", EDGE, "--"), ("true", GOLD, "-"), ("off", BLUE, "-")):
        for hole in holes:
            if what and hole[what] is None:
                continue
            x, y, growth, oval, slant = times * np.array(hole[what]) if what else np.zeros(5)
            shape = (hole["diameter"] + growth) * np.eye(2) + [[oval, slant], [slant, -oval]]
            edge = np.add(hole["centre"], (x, y))[:, None] + 0.5 * shape @ circle
            axes.plot(*edge, style, color=colour, lw=0.8)
    axes.set_aspect("equal")
    return drawn


def _residual_cards(
    summary: Summary, found: Identified | None, data: Sequence[StateObservation | None]
) -> list[Card]:
    if found is None:
        return []
    figures, unit = [], "levels" if summary["case"]["data"] else "full scale"
    for k, (state, part) in enumerate(zip(found.states, data, strict=False), start=1):
        if isinstance(part, ImageData):
            frame = MapFrame.of(MeshBoundary.of(part.pixels.mesh), part.pair.grid)
            field = frame.average(part.residual(state))
            draw = partial(draw_field, frame, field, ColourScale.signed(field, unit, 0.999))
            figures.append(ReportFigure(f"residual-{k}", f"{100 * state.strain:.4g} %", draw))
    text = text_of("identified-residual")
    return [Card("Residual f(x) − g(x + u)", figures, caption=text)] if figures else []
