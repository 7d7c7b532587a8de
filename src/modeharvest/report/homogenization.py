"""Report of a homogenized specimen, compared with direct simulation and with measurement."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from modeharvest.report.figures import homogenization as figures
from modeharvest.report.figures.maps import ColourScale
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.text import Measured, caption, material_text, number, text_of
from modeharvest.runs.homogenization.results import HomogenizationData, aligned
from modeharvest.util.arrays import FloatArray

Summary = Mapping[str, Any]


def homogenization_report(summary: Summary, data: HomogenizationData | None = None) -> Report:
    """The report of a homogenized specimen.

    ``summary``: the content of ``summary.json``. ``data``: the data of the figures; if None, the
    report has no figures, as for the terminal.
    """
    table = ReportTable.of("homogenized-states", map(_state_row, _pairs(summary)))
    branches = ReportTable.of("homogenized-branches", map(_branch_row, summary["branches"]))
    effects = ReportTable.of("homogenized-effects", map(_effect_row, summary["sensitivities"]))
    return Report(
        kind="homogenization", title=summary["title"], findings=findings(summary),
        keys=key_numbers(summary),
        sections=[
            Section.of("homogenized-response", _response_cards(data)),
            Section.of("homogenized-states",
                       [*Card.tabular(table, wide=True), *Card.tabular(branches)]),
            Section.of("homogenized-amplitude", _amplitude_cards(data)),
            Section.of("homogenized-mode", Card.tabular(effects, wide=True)),
        ],
        warnings=[
            *summary["warnings"],
            *(text_of("homogenized-unstable", strain=100 * state["nominal_strain"], **state)
            for state in summary["states"] if state["negative_eigenvalues"])
        ],
        notes=[text_of("homogenized-choices", **summary["case"]["homogenization"])],
        command=data.command if data else "",
        case=summary["case"], files=summary["files"], versions=summary["versions"],
        costs={"RVEs": number(summary["rves"]),
               "linearisations of the specimen": number(summary["linearisations"])},
        **caption("page-homogenization"),
    )  # fmt: skip


def _off(value: float | None, of: float | None) -> float | None:
    """Relative difference of a value from ``of`` [%]; None if one is missing, or ``of`` is 0."""
    return None if value is None or not of else 100.0 * (value / of - 1.0)


def _pairs(summary: Summary) -> list[tuple[Mapping[str, Any], Mapping[str, Any] | None]]:
    """Homogenized states, each with the directly simulated one at its strain, None without one."""
    direct = {state["nominal_strain"]: state for state in summary["direct"]["states"]}
    return [(state, direct.get(state["nominal_strain"])) for state in summary["states"]]


def _state_row(pair: tuple[Mapping[str, Any], Mapping[str, Any] | None]) -> Mapping[str, Any]:
    state, direct = pair
    row = {"strain": f"{100 * state['nominal_strain']:.4g}", "branch": state["branch"],
           "negative": state["negative_eigenvalues"]}  # fmt: skip
    for name, key in (("force", "force_N_per_mm"), ("energy", "energy_N")):
        sds = (state[key.replace("_", f"_sd_{cause}_", 1)] for cause in ("noise", "model_error"))
        row[name] = Measured(state[key], tuple(sd for sd in sds if sd is not None), 5)
        row[f"{name}_direct"] = None if direct is None else f"{direct[key]:.5f}"
        row[f"{name}_off"] = None if direct is None else f"{_off(state[key], direct[key]):+.2f}"
    return row


def _branch_row(branch: Mapping[str, Any]) -> Mapping[str, Any]:
    return {"pattern": " ".join(f"{v:g}" for v in branch["pattern"]),
            "strain": f"{100 * branch['load']:.4g}", "energy": f"{branch['energy']:.6g}",
            "negative": branch["negative_eigenvalues"]}  # fmt: skip


def findings(summary: Summary) -> list[str]:
    """The results in sentences."""
    text, critical, direct = [], summary["critical_strain"], summary["direct"]["critical_strain"]
    if critical is None:
        text.append(text_of("homogenized-no-critical", outcome=summary["outcome"]))
    else:
        sd = summary["critical_strain_sd"]
        noise = summary["critical_strain_sd_noise"]
        error = "" if sd is None else f" ± {100 * sd:.4f} (by noise alone {100 * noise:.4f})"
        last = summary["criticals"][-1]
        text.append(text_of("homogenized-critical", value=100 * critical, error=error, last=last))
        if direct is not None:
            text.append(text_of("homogenized-direct", value=100 * direct,
                                off=_off(critical, direct)))  # fmt: skip
    if summary["branches"]:
        row = _branch_row(summary["branches"][0])
        text.append(text_of("homogenized-ranked", count=len(summary["branches"]), **row))
    first = summary["first_order_critical_strain"]
    if first is not None:
        off = _off(first, direct)
        text.append(text_of("homogenized-first-order", value=100 * first,
                            off="" if off is None else f" ({off:+.1f} %)"))  # fmt: skip
    mode = summary["mode"]
    if mode is not None and mode["errors"] is not None:
        change, sds = 100 * max(mode["wave_change"]), mode["wave_deviation"]
        by = f", {max(sds):.1f} of their standard deviations" if sds else ""
        text.append(text_of("homogenized-snapped", change=change, off=by, errors=mode["errors"]))
    for name in ("displacement", "amplitude"):
        if (both := summary[name]) is not None:
            share = 100 * both["difference_rms_mm"] / both["measured_rms_mm"]
            text.append(text_of(f"homogenized-{name}", share=share, **both))
    material = material_text(summary["case"]["experiment"]["material"])
    return [*text, f"The specimen is of the {material}."]


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The key numbers at the top of the page."""
    critical, direct = summary["critical_strain"], summary["direct"]["critical_strain"]
    off = _off(critical, direct)
    remark = "" if off is None else f"{off:+.1f} % from the direct simulation's"
    strains = {"homogenized-critical": critical, "direct-critical": direct,
               "first-order-critical": summary["first_order_critical_strain"]}  # fmt: skip
    keys = [KeyNumber.of(name, f"{100 * strain:.3f}", remark=remark)
            for name, strain in strains.items() if strain is not None]  # fmt: skip
    pairs = [(state, other) for state, other in _pairs(summary) if other is not None]
    for state, other in pairs[-1:]:
        for name, key in (("force", "force_N_per_mm"), ("energy", "energy_N")):
            off = _off(state[key], other[key])
            keys.append(KeyNumber.of(f"{name}-off", f"{off:+.2f}",
                                     strain=100 * state["nominal_strain"]))  # fmt: skip
    return keys


def _response_cards(data: HomogenizationData | None) -> list[Card]:
    if data is None:
        return []
    quantities = [("force", "force_N_per_mm", "force per thickness [N/mm]"),
                  ("energy", "energy_N", "stored energy per thickness [N]")]  # fmt: skip
    response, first = data.found["response"], data.found["first_order_critical_strain"]
    direct = data.direct.critical_strain
    draw = partial(figures.draw_response, data.path, direct, response, first)
    made = {n: ReportFigure(f"response-{n}", "", partial(draw, *of), wide=True)
            for n, *of in quantities}  # fmt: skip
    words = text_of("homogenized-response")
    return [Card(name.capitalize(), [figure], caption=words) for name, figure in made.items()]


def _amplitude_cards(data: HomogenizationData | None) -> list[Card]:
    if data is None or not data.fields.states:
        return []
    state, mesh = data.compared or data.fields.states[-1], data.fields.mesh
    several, is_lattice = state.amplitudes.shape[1] > 1, np.isfinite(state.amplitudes[:, 0])
    fields = {f"v{k} homogenized" if several else "homogenized": v
              for k, v in enumerate(state.amplitudes.T, start=1)}  # fmt: skip

    def drawn(kind: str, fields: dict[str, FloatArray]) -> list[ReportFigure]:
        every = np.concatenate([values[np.isfinite(values)] for values in fields.values()])
        scale, how = ColourScale.signed(every, "mm"), figures.draw_amplitude
        return [
            ReportFigure(f"{kind}-{k}", label, partial(how, mesh, state.displacement, v, scale))
            for k, (label, v) in enumerate(fields.items(), start=1)
        ]

    means = list[ReportFigure]()
    if data.compared is not None:
        measured = np.where(is_lattice[:, None], data.measured_at(mesh.nodes), np.nan)
        for k, axis in enumerate("xy"):
            u = np.where(is_lattice, state.displacement[:, k], np.nan)
            both = {f"u{axis} homogenized": u, f"v0{axis} measured": measured[:, k]}
            means += drawn(f"mean-{axis}", both)
        if not several:
            names = "homogenized", "measured in the images"
            fields = dict(zip(names, aligned(state.amplitudes[:, 0], measured[:, 2]), strict=True))
    at, points = f"at {100 * state.load:.4g} %", data.fields.points
    places = [np.argmin(points @ sign) for sign in np.array([(1, 1), (-1, 1), (1, -1), (-1, -1)])]
    rves = [
        ReportFigure(
            f"rve-{k}", f"at ({points[n, 0]:.2f}, {points[n, 1]:.2f}) mm",
            partial(figures.draw_microstructure, data.fields.rve, state.microstructure[n]),
        )
        for k, n in enumerate(dict.fromkeys(places), start=1)
    ]  # fmt: skip
    cards = [("Amplitudes" if several else "Amplitude v₁", drawn("amplitude", fields), "fields")]
    if means:
        cards.append(("Mean displacement v₀", means, "means"))
    cards.append(("Microstructure", rves, "microstructure"))
    return [Card(f"{name} {at}", made, wide=True, caption=text_of(f"homogenized-{text}"))
            for name, made, text in cards]  # fmt: skip


def _effect_row(effect: Mapping[str, Any]) -> Mapping[str, Any]:
    sd = effect["sd_noise"] if effect["sd_model_error"] is None else effect["sd_model_error"]
    row = {"name": f"{effect['name']} [{effect['unit']}]", "value": f"{effect['value']:.5f}",
           "noise": effect["sd_noise"], "model": effect["sd_model_error"]}  # fmt: skip
    if effect["snapped"]:
        return row | {"critical": "0 (snapped)", "force": "0 (snapped)", "energy": "0 (snapped)"}
    strain, force, energy = effect["critical_strain"], effect["force"][-1], effect["energy"][-1]
    slopes = {"critical": (strain, 100.0), "force": (force, 1.0), "energy": (energy, 1.0)}
    known = {k: (slope, unit) for k, (slope, unit) in slopes.items() if slope is not None}
    return row if sd is None else row | {k: unit * slope * sd for k, (slope, unit) in known.items()}
