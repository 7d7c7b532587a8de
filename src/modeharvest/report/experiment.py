"""Report of a virtual experiment: every panel of the paper's figures for every snapshot, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from markupsafe import Markup

from modeharvest.fem.field import Solution
from modeharvest.idic.spectra.pattern import REFERENCE_MODE
from modeharvest.report.figures.curves import draw_eigenvalues, draw_load
from modeharvest.report.figures.experiment import (
    ExperimentData,
    draw_hero,
    snapshot_label,
    snapshot_panels,
)
from modeharvest.report.figures.fits import convergence_card, panel_sections, shape_numbers
from modeharvest.report.figures.whole_field import whole_panel_numbers
from modeharvest.report.model import (
    Card,
    Cell,
    KeyNumber,
    Mark,
    Measured,
    Report,
    ReportFigure,
    ReportTable,
    Section,
    caption,
    material_text,
    number,
    percent,
    text_of,
)
from modeharvest.util.typed import quantities
from modeharvest.validation.summary import SnapshotSummary
from modeharvest.validation.whole_field import WholeFieldSummary

Snapshot = Mapping[str, Any]
Summary = Mapping[str, Any]

_BRIEF = {
    "branch": "branch", "pattern_amplitude_px": "pattern, largest length [px]",
    "rms_w_px": "w = truth − IDIC, rms [px]", "rms_best_fit_px": "model error, rms [px]",
    "rms_idic_to_best_fit_px": "measurement error, rms [px]", "chi_square": "χ² of the residual",
    "iterations_all_levels": "iterations on all levels", "outcome": "outcome",
}  # fmt: skip
"""What the terminal shows of each snapshot."""
_MODE = tuple(
    zip(("a₁", "a₂", "a₃", "a₄", "a₅", "a₆", "a₇"), ("-",) * 5 + ("mm",) * 2, strict=True)
)


def experiment_report(summary: Summary, data: ExperimentData | None = None) -> Report:
    """The report of a virtual experiment.

    ``summary``: the content of ``summary.json``. ``data``: what its figures show; without, the
    report has numbers only, as for the terminal.
    """
    case = summary.get("case", {})
    imperfection = case.get("experiment", {}).get("imperfection")
    seeds = [f"speckle {case['imaging']['speckle']['seed']}"] if "imaging" in case else []
    seeds += [f"imperfection {imperfection['seed']}"] if imperfection else []
    material = case.get("experiment", {}).get("material")
    factorisations = number(summary.get("factorisations"))
    residual = number(summary["inverse_map_max_residual_px"])
    states, snapshots = data.states if data is not None else [], summary["snapshots"]
    steps = [convergence_card(s, snapshots[s.k]["outcome_why"]) for s in states]
    return Report(
        kind="virtual experiment",
        title=summary.get("title") or "Validation",
        lead=caption("page-experiment")["lead"],
        findings=(
            [critical_line(summary.get("critical_strain"), material)]
            + [text for text in (_expected(summary), *_energies(summary)) if text]
        ),
        keys=key_numbers(summary),
        brief=ReportTable(
            "Results",
            ("nominal strain", *(percent(s["nominal_strain"]) for s in snapshots)),
            _rows(snapshots, _BRIEF),
        ),
        sections=[
            Section("expected", "Obtained and expected values", _expected_cards(summary)),
            *([] if data is None else _figures(data, summary)),
            Section("numbers", "Numbers", number_cards(summary)),
            Section.of("solver", steps),
        ],
        warnings=summary.get("warnings", []),
        notes=notes(summary),
        command="modeharvest run CASE --out DIR",
        remark="CASE is the name of a shipped case (paper-virtual is the paper’s) or a TOML file "
        f"with the values below. Seeds: {', '.join(seeds)}.",
        case=case,
        costs={
            "factorisations of the whole path": factorisations,
            "largest residual of the inverse mapping": f"{residual} px",
        },
        versions=summary.get("versions", {}),
        hero=_hero(data) if data is not None else None,
        hero_caption=text_of("experiment-hero", state=states[-1].label if states else ""),
    )


def critical_line(strain: float | None, material: Mapping[str, Any] | None) -> str:
    """A sentence on the critical strain [-], None if the path has no bifurcation, and of what."""
    text = "No bifurcation on the path (stable, imperfect, or odd numbers of holes both ways)"
    if strain is not None:
        text = f"Critical strain {100 * strain:.4f} %"
    return f"{text}; {material_text(material)}." if material else f"{text}."


def _expected(summary: Summary) -> str:
    rows = summary.get("expected", [])
    missed = [
        f"{row['quantity']}: expected {row['expected']}, obtained {row['obtained']:.4g} "
        f"{row['unit']}"
        for row in rows
        if not row["ok"]
    ]
    if missed:
        return f"Missed {len(missed)} of {len(rows)} expected values: {'; '.join(missed)}."
    return f"All {len(rows)} expected values are met." if rows else ""


def _energies(summary: Summary) -> list[str]:
    return [
        text_of("experiment-energy", at=percent(row["nominal_strain"]),
                stable=number(row["branch_N"]), unstable=number(row["unstable_N"]))
        for row in summary.get("energy_below_unstable", [])
    ]  # fmt: skip


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The few numbers at the top."""
    last = summary["snapshots"][-1]
    at = f"at {percent(last['nominal_strain'])}"
    critical = summary.get("critical_strain")
    expected, whole = summary.get("expected", []), last.get("whole_field")
    met = sum(bool(row["ok"]) for row in expected)

    def key(name: str, value: float | None, unit: str, remark: str, digits: int = 3) -> KeyNumber:
        known = value is not None and value == value
        return KeyNumber(name, f"{value:.{digits}g}" if known else None, unit, remark)

    return [
        key("critical strain", None if critical is None else 100 * critical, "%",
            "none found" if critical is None else "where the pattern sets in", 4),
        key("pattern", last["pattern_amplitude_px"], "px", f"largest {_symbol(last)} {at}"),
        _mode_key(last, at),
        key("model (ansatz) error", last["rms_best_fit_px"], "px", f"rms of truth − best fit {at}"),
        key("measurement error", last["rms_idic_to_best_fit_px"], "px",
            f"rms of IDIC − best fit {at}", 2),
        *([key("whole displacement", whole["rms_px"], "px",
               f"rms of truth − measured up to all edges {at}", 2)] if whole else []),
        KeyNumber("expected values met", f"{met} of {len(expected)}" if expected else None, "",
                  "table below" if expected else "none known for this specimen"),
    ]  # fmt: skip


def _mode_key(last: Snapshot, at: str) -> KeyNumber:
    """The mode against the ideal one; of several modes, how many are observable."""
    if "modes" in last:
        observable = [mode["observable"] for mode in last["modes"]]
        count = f"{sum(observable)} of {len(observable)}"
        return KeyNumber("modes", count, "", f"observable {at}")
    if not _is_free(last):
        return KeyNumber("deviation of the mode", None, "", "fixed at the ideal pattern")
    remark = f"from the ideal pattern, the largest of a₁ … a₇ {at}"
    return KeyNumber("deviation of the mode", f"{_largest_deviation(last):.2g}", "%", remark)


def _symbol(snapshot: Snapshot) -> str:
    """The pattern, of one mode or of several."""
    return "Σ vᵢφᵢ" if "modes" in snapshot else "v₁φ₁"


def _expected_cards(summary: Summary) -> list[Card]:
    rows = [
        (row["quantity"], row["obtained"], row["unit"].replace("-", "–"), row["expected"],
         verdict(row["ok"]), row["source"])
        for row in summary.get("expected", [])
    ]  # fmt: skip
    columns = ("quantity", "obtained", "unit", "expected", "", "source")
    table = ReportTable("Expected values", columns, rows, name="expected-values")
    return Card.tabular(table, wide=True)


def verdict(ok: bool) -> Mark:
    """Whether an expected value was met."""
    return Mark("✓ met" if ok else "✗ missed", ok)


def number_cards(summary: Summary) -> list[Card]:
    """Tables of all snapshots; rows that no snapshot has are left out."""
    snapshots, critical = summary["snapshots"], summary.get("critical_strain")
    symbol = _symbol(snapshots[0])
    heads = {name: f"{label} [{unit}]" if unit not in ("", "–") else label
             for kind in (SnapshotSummary, WholeFieldSummary)
             for label, unit, name in quantities(kind)}  # fmt: skip
    rows = _rows(
        [{**s, **s.get("whole_field", {})} for s in snapshots],
        {k: label.replace("v₁φ₁", symbol) for k, label in heads.items()},
    )
    labels = [snapshot_label(s["nominal_strain"], s["branch"], critical) for s in snapshots]
    columns = ("rms: per component, all material", *labels)
    table = ReportTable("Results", columns, rows, name="results")
    return [*Card.tabular(table, wide=True), *_mode_cards(summary)]


def _rows(snapshots: Sequence[Snapshot], labels: Mapping[str, str]) -> list[list[Cell]]:
    """A row for each quantity that a snapshot has."""
    rows: list[list[Cell]] = [[label, *(s.get(name) for s in snapshots)]
                              for name, label in labels.items()]  # fmt: skip
    return [row for row in rows if any(value is not None for value in row[1:])]


def _mode_cards(summary: Summary) -> list[Card]:
    """The modes' parameters, each with both standard errors, and the best fit's."""
    found = [(percent(s["nominal_strain"]), modes)
             for s in summary["snapshots"] if (modes := _modes_of(s))]  # fmt: skip
    several = bool(found) and len(found[0][1]) > 1
    columns, rows = ["", "ideal"], []
    for strain, _ in found:
        columns += [f"{strain}: IDIC ± noise ± model error", f"{strain}: best fit"]
    for i, mode in enumerate(found[0][1] if found else ()):
        for k, (name, unit) in enumerate(zip(mode["names"], mode["units"], strict=True)):
            text = f"φ{i + 1} {name}" if several else name
            row: list[Cell] = [f"{text} [{unit}]" if unit != "-" else text, mode["ideal"][k]]
            rows.append(row + [cell for _, modes in found for cell in _parameter(modes[i], k)])
    table = ReportTable("Parameters of the modes", columns, rows, name="mode")
    words = text_of("experiment-modes" if several else "experiment-mode")
    return Card.tabular(table, caption=words, wide=True)


def _modes_of(snapshot: Snapshot) -> Sequence[Mapping[str, Any]]:
    """The modes with parameters, in the same form for one and for several."""
    if "modes" in snapshot:
        return list(snapshot["modes"])
    if len(snapshot.get("mode", ())) != len(_MODE):
        return []
    names, units = zip(*_MODE, strict=True)
    keys = ("standard_error", "model_error", "best_fit")
    return [{
        "names": names, "units": units, "found": snapshot["mode"],
        "ideal": snapshot.get("mode_ideal", REFERENCE_MODE),
        **{key: snapshot.get(f"mode_{key}") for key in keys},
    }]  # fmt: skip


def _parameter(mode: Mapping[str, Any], k: int) -> list[Cell]:
    """Parameter k with its standard errors, and the best fit's."""
    noise, model, best = (mode[key][k] if mode[key] else None
                          for key in ("standard_error", "model_error", "best_fit"))  # fmt: skip
    errors = float("inf") if noise is None else noise, model
    return [Measured(mode["found"][k], errors), None if best is None else Measured(best)]


def experiment_figures(data: ExperimentData) -> list[ReportFigure]:
    """The figures that :func:`experiment_report` refers to, before there is a summary."""
    panels = snapshot_panels(data.modes)
    cards = [
        *_path_cards(data.solution),
        *(convergence_card(state) for state in data.states),
        *(panel.card(data.states, lambda key, state: "") for panel in panels),
    ]
    return [_hero(data), *(figure for card in cards for figure in card.figures)]


def _hero(data: ExperimentData) -> ReportFigure:
    drawn = partial(draw_hero, data.states[-1])
    return ReportFigure("hero", "Image and pattern", drawn, late=not data.modes)


def _figures(data: ExperimentData, summary: Summary) -> list[Section]:
    snapshots: Sequence[Snapshot] = summary["snapshots"]
    several = data.modes > 1
    images, found, errors, whole = panel_sections(
        ("images", "found", "errors", "whole"), snapshot_panels(data.modes), data.states,
        lambda key, state: panel_numbers(key, snapshots[state.k]) or shape_numbers(key, state),
        pattern=Markup("Σ v<sub>i</sub>φ<sub>i</sub>" if several else "v<sub>1</sub>φ<sub>1</sub>"),
        of_spectra="" if several else "Fig. “spect_virt” of the paper. ",
        known="",
        source="" if several else "Fig. “virt” of the paper. ",
    )  # fmt: skip
    text = {s.label: snapshots[s.k].get("pattern_reading", ()) for s in data.states}
    reading = Card("Reading of the densities", text=text, name="reading")
    cards = [*images.cards[:2], reading, *images.cards[2:]]
    return [
        Section("path", "Load path", _path_cards(data.solution)),
        Section(images.name, images.title, cards, images.lead),
        found,
        errors,
        *([whole] if whole.cards else []),
    ]


def panel_numbers(key: str, snapshot: Snapshot) -> str:
    """One line of numbers under the picture of a panel; empty if there is nothing to add."""
    if key == "residual":
        return f"rms {snapshot['rms_residual']:.3g} of full scale"
    if key.startswith("whole-"):
        return whole_panel_numbers(key, snapshot["whole_field"])
    part = {"w": "w", "best": "best_fit", "loss": "idic_to_best_fit"}.get(key, "")
    details = snapshot.get("details_px", {}).get(part)
    return "" if details is None else text_of("experiment-lengths", **details)


def _path_cards(solution: Solution) -> list[Card]:
    """Load path and eigenvalues, where the solution has them."""
    path, critical = solution.info.get("path"), solution.info.get("critical")
    if not path or not path.get("primary", {}).get("nominal_strain"):
        return []
    load = partial(draw_load, path, None if critical is None else critical["strain"])
    eigenvalues = partial(draw_eigenvalues, path, critical)
    return [Card.captioned("load", load), Card.captioned("eigenvalues", eigenvalues)]


def notes(summary: Summary) -> list[str]:
    """What a reader should know before trusting the numbers, drawn from the data."""
    text = []
    if not summary.get("expected"):
        text.append("No expected values are known for this specimen: nothing to compare with.")
    if str(summary.get("simulation_outcome") or "complete") != "complete":
        text.append(f"The simulation is {summary['simulation_outcome']}.")
    for snapshot in summary["snapshots"]:
        text += _about(snapshot)
    text += [
        _standard_errors(summary),
        text_of("experiment-weights"),
        text_of("experiment-rms"),
        *([text_of("experiment-material")] if summary.get("expected") else []),
    ]
    return text


def _standard_errors(summary: Summary) -> str:
    """What the standard errors mean for these images."""
    noise = [s["noise_sd"] for s in summary["snapshots"] if s.get("noise_sd") is not None]
    sensor = summary.get("case", {}).get("imaging", {}).get("sensor", {})
    text = text_of("experiment-noise-free")
    if noise:
        text = text_of("experiment-exposures", noise=max(noise))
    elif sensor.get("read_noise") or sensor.get("full_well"):
        text = text_of("experiment-averages")
    return text_of("experiment-errors", text=text)


def _about(snapshot: Snapshot) -> list[str]:
    """Warnings about one snapshot."""
    at = f"At {100 * snapshot['nominal_strain']:.4g} %"
    text = []
    if snapshot.get("negative_pivots"):
        text.append(text_of("experiment-unstable", at=at, pivots=snapshot["negative_pivots"]))
    if snapshot["outcome"] != "converged":
        text.append(f"{at} the correlation ended as “{snapshot['outcome']}”: "
                    f"{snapshot['outcome_why']}")  # fmt: skip
    if snapshot.get("undetermined"):
        text.append(f"{at} the images do not determine {', '.join(snapshot['undetermined'])}.")
    text += [f"{at} {warning}." for warning in snapshot.get("identifiability_warnings", ())]
    text += [f"{at} {_lower(snapshot[key])}" for key in ("residual_verdict",) if key in snapshot]
    if snapshot.get("noise_sd") and "weighting" in snapshot:  # a choice that noise asks for
        text.append(f"{at} {_lower(snapshot['weighting'])}")
    inner, corners = snapshot.get("pattern_inner_px"), snapshot.get("pattern_corners_px")
    if inner is not None and corners is not None and inner < corners:
        deviation = _largest_deviation(snapshot)
        describes = (
            "The modes describe"
            if "modes" in snapshot
            else f"The mode's parameters (up to {deviation:.0f} % off the ideal) describe"
            if _is_free(snapshot)
            else "Fixed at the ideal pattern, the mode describes"
        )
        text.append(text_of(
            "experiment-no-pattern", at=at, symbol=_symbol(snapshot), inner=inner, corners=corners,
            describes=describes,
        ))  # fmt: skip
    return text


def _lower(text: str) -> str:
    return f"{text[0].lower()}{text[1:]}"


def _is_free(snapshot: Snapshot) -> bool:
    """Whether the mode's parameters were unknowns."""
    return bool(snapshot.get("mode_deviation_percent"))


def _largest_deviation(snapshot: Snapshot) -> float:
    """Largest deviation of a mode parameter from the ideal [%]; NaN without a mode."""
    return max((abs(v) for v in snapshot.get("mode_deviation_percent", ())), default=float("nan"))
