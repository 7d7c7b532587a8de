"""``report.html`` of a virtual experiment: figures of every snapshot, tables, notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from modeharvest.fem.field import Solution
from modeharvest.idic.spectra.pattern import REFERENCE_MODE
from modeharvest.report.figures.curves import draw_convergence, draw_eigenvalues, draw_load
from modeharvest.report.figures.experiment import (
    ExperimentReportData,
    SnapshotPanel,
    draw_hero,
    panels_of,
)
from modeharvest.report.figures.style import to_svg
from modeharvest.report.model import Picture, material_text, render
from modeharvest.util.files import atomic
from modeharvest.util.progress import Progress, silent
from modeharvest.util.typed import quantities
from modeharvest.validation.summary import SnapshotSummary

Snapshot = Mapping[str, Any]

_MODE = (("a₁", "–"), ("a₂", "–"), ("a₃", "–"), ("a₄", "–"), ("a₅", "–"), ("a₆", "mm"),
         ("a₇", "mm"))  # fmt: skip
_DETAILS = {"w": "w", "best": "best_fit", "loss": "idic_to_best_fit"}


def key_numbers(summary: Mapping[str, Any]) -> list[dict[str, str]]:
    """The few numbers at the top: what they are called, the number, its unit, a remark."""
    last = summary["snapshots"][-1]
    at = f"at {100 * last['nominal_strain']:.4g}\N{NO-BREAK SPACE}%"
    critical = summary.get("critical_strain")
    expected = summary.get("expected", [])
    met = sum(bool(row["ok"]) for row in expected)
    keys = [
        _key("critical strain", None if critical is None else 100 * critical, "%",
             "none found" if critical is None else "where the pattern sets in", 4),
        _key("pattern", last["pattern_amplitude_px"], "px", f"largest {_symbol(last)} {at}", 3),
        _key("best possible fit", last["rms_best_fit_px"], "px", "rms, what the model can't say",
             3),
        _key("IDIC − best fit", last["rms_idic_to_best_fit_px"], "px",
             "rms, what the measurement loses", 2),
        {"name": "expected values met", "value": f"{met} of {len(expected)}" if expected else "–",
         "unit": "", "remark": "table below" if expected else "none known for this specimen"},
    ]  # fmt: skip
    if "modes" in last:
        observable = [mode["observable"] for mode in last["modes"]]
        text = f"{sum(observable)} of {len(observable)}"
        mode = {"name": "modes", "value": text, "unit": "", "remark": f"observable {at}"}
    else:
        free = bool(last.get("mode_deviation_percent"))
        remark = f"the worst of a₁ … a₇ {at}" if free else "held at the ideal pattern"
        mode = _key("mode off the ideal", _largest_deviation(last), "%", remark, 2)
    return [*keys[:2], mode, *keys[2:]]


def number_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the table of numbers: label, unit, a value for each snapshot."""
    snapshots = summary["snapshots"]
    return [
        {
            "label": label.replace("v₁φ₁", _symbol(snapshots[0])),
            "unit": unit,
            "values": [s.get(key) for s in snapshots],
        }
        for label, unit, key in quantities(SnapshotSummary)
        if any(s.get(key) is not None for s in snapshots)
    ]


def mode_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the modes' parameters: for each snapshot value, standard errors and best fit."""
    snapshots = [s for s in summary["snapshots"] if len(s.get("mode", ())) == len(_MODE)]
    if not snapshots:
        return _rows_of_modes([s["modes"] for s in summary["snapshots"] if "modes" in s])
    ideal = snapshots[0].get("mode_ideal", REFERENCE_MODE)
    return [
        {"name": name, "unit": unit, "ideal": ideal[k],
         "cells": [{"value": s["mode"][k], "error": _item(s.get("mode_standard_error"), k),
                    "model": _item(s.get("mode_model_error"), k),
                    "best": _item(s.get("mode_best_fit"), k)} for s in snapshots]}
        for k, (name, unit) in enumerate(_MODE)
    ]  # fmt: skip


def _rows_of_modes(snapshots: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """The same for several modes, their parameters one below the other."""
    return [
        {"name": f"φ{'₁₂₃'[i]} {name}", "unit": mode["units"][k].replace("-", "–"),
         "ideal": mode["ideal"][k],
         "cells": [{"value": s[i]["found"][k], "error": _item(s[i]["standard_error"], k),
                    "model": _item(s[i]["model_error"], k),
                    "best": _item(s[i]["best_fit"], k)} for s in snapshots]}
        for i, mode in enumerate(snapshots[0] if snapshots else ())
        for k, name in enumerate(mode["names"])
    ]  # fmt: skip


def panel_numbers(key: str, snapshot: Snapshot) -> str:
    """One line of numbers under the picture of a panel; empty if there is nothing to add."""
    if key in _DETAILS:
        details = snapshot.get("details_px", {}).get(_DETAILS[key])
        if details is None:
            return ""
        return (
            f"rms {details['rms_per_component']:.3g} px per component; lengths: median "
            f"{details['median_length']:.3g} px, largest {details['max_length']:.3g} px"
        )
    if key == "residual":
        return f"rms {snapshot['rms_residual']:.3g} of full scale"
    if key == "v1" and "pattern_inner_px" in snapshot:
        return (
            f"{_symbol(snapshot)}: at most {snapshot['pattern_inner_px']:.3g} px inside, "
            f"{snapshot['pattern_corners_px']:.3g} px in the corner cells"
        )
    return ""


def notes(summary: Mapping[str, Any]) -> list[str]:
    """What a reader should know before trusting the numbers, drawn from the data."""
    said = [_expected(summary.get("expected", []))]
    if str(summary.get("simulation_outcome") or "complete") != "complete":
        said.append(f"The simulation is {summary['simulation_outcome']}.")
    for snapshot in summary["snapshots"]:
        said += _about(snapshot)
    said += [
        _standard_errors(summary),
        "The best fit weighs all material pixels alike, IDIC weighs them by the image's "
        "gradient and leaves out the rims of the holes: even without any noise the two differ.",
        "rms is per component: the root of the mean square over both components of all material "
        "pixels. The rms length of the vectors is √2 times that.",
    ]
    if summary.get("expected"):
        said.append(
            "The paper does not give its material constants and prints fields, not numbers. The "
            "expected values come from an independent calculation with this project's choice of "
            "material."
        )
    return said


def _standard_errors(summary: Mapping[str, Any]) -> str:
    """What the standard errors mean for these images."""
    noise = [s["noise_sd"] for s in summary["snapshots"] if s.get("noise_sd") is not None]
    sensor = summary.get("case", {}).get("imaging", {}).get("sensor", {})
    if noise:
        said = (
            "The images are single exposures of the virtual camera, with a predicted noise of "
            f"{max(noise):.2g} of full scale (rms; rounding to whole grey levels is part of it): "
            "where χ² is above 1, the rest of the residual is"
        )
    elif sensor.get("read_noise") or sensor.get("full_well"):
        said = (
            "The sensor makes noise, but what was measured are its noise-free averages "
            "(“camera = true” measures the exposures): the residual is"
        )
    else:
        said = "No noise was added to these images: the residual is"
    return (
        "Of a parameter's two standard errors the first takes the whole residual for white noise "
        f"in both images. {said} what the ansatz can't describe, so it says how firmly the images "
        "hold a parameter, not how far it is from the truth. The second, by model error, takes "
        "each unit cell's share of the residual for one draw. Compare them with the best fit "
        "beside."
    )


def _expected(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return "No expected values are known for this specimen: nothing to compare with."
    missed = [
        f"{row['quantity']}: expected {row['expected']}, obtained {row['obtained']:.4g} "
        f"{row['unit']}"
        for row in rows
        if not row["ok"]
    ]
    if missed:
        return f"Missed {len(missed)} of {len(rows)} expected values: {'; '.join(missed)}."
    return f"All {len(rows)} expected values are met."


def _about(snapshot: Snapshot) -> list[str]:
    """Warnings about one snapshot."""
    at = f"At {100 * snapshot['nominal_strain']:.4g} %"
    said = []
    if snapshot.get("negative_pivots"):
        said.append(
            f"{at} the state is unstable ({snapshot['negative_pivots']} negative pivots): a real "
            "specimen would not be found in it."
        )
    if snapshot["outcome"] != "converged":
        said.append(f"{at} the correlation ended as “{snapshot['outcome']}”: "
                    f"{snapshot['outcome_why']}")  # fmt: skip
    if snapshot.get("undetermined"):
        said.append(f"{at} the images say nothing about {', '.join(snapshot['undetermined'])}.")
    said += [f"{at} {warning}." for warning in snapshot.get("identifiability_warnings", ())]
    if "residual_verdict" in snapshot:
        verdict = snapshot["residual_verdict"]
        said.append(f"{at} {verdict[0].lower()}{verdict[1:]}")
    if snapshot.get("noise_sd") and "weighting" in snapshot:  # a choice that noise asks for
        weighting = snapshot["weighting"]
        said.append(f"{at} {weighting[0].lower()}{weighting[1:]}")
    inner, corners = snapshot.get("pattern_inner_px"), snapshot.get("pattern_corners_px")
    if inner is not None and corners is not None and inner < corners:
        describes = (
            "The modes describe"
            if "modes" in snapshot
            else f"The mode's parameters (up to {_largest_deviation(snapshot):.0f} % off the ideal) "
            "describe"
            if _is_free(snapshot)
            else "Held at the ideal pattern, the mode describes"
        )
        said.append(
            f"{at} there is no pattern to be observed: {_symbol(snapshot)} is at most {inner:.2g} px inside. "
            f"{describes} the edge effect in the corner cells ({corners:.2g} px) that the mode "
            "takes up, as in the paper; the best fit to the truth does the same."
        )
    return said


def _symbol(snapshot: Snapshot) -> str:
    """The pattern, of one mode or of several."""
    return "Σ vᵢφᵢ" if "modes" in snapshot else "v₁φ₁"


def _is_free(snapshot: Snapshot) -> bool:
    """Whether the mode's parameters were unknowns."""
    return bool(snapshot.get("mode_deviation_percent"))


def _largest_deviation(snapshot: Snapshot) -> float:
    """Largest deviation of a mode parameter from the ideal [%]; NaN without a mode."""
    return max((abs(v) for v in snapshot.get("mode_deviation_percent", ())), default=float("nan"))


def _item(values: Sequence[float | None] | None, k: int) -> float | None:
    return values[k] if values else None


def _key(name: str, value: float | None, unit: str, remark: str, digits: int) -> dict[str, str]:
    known = value is not None and value == value
    return {
        "name": name,
        "value": f"{value:.{digits}g}" if known else "–",
        "unit": unit if known else "",
        "remark": remark,
    }


EXPERIMENT_TEMPLATE = "experiment.html"
EXPERIMENT_SECTIONS = (
    ("images", "The image and its pattern", ("image", "Sxx", "Syy")),
    ("found", "What was measured", ("v0x", "v0y", "v1", "phi1", "flucx", "flucy")),
    ("errors", "How wrong it is, and why", ("residual", "w", "best", "loss")),
)
"""Anchor, heading and panels of each group of pictures."""


@dataclass(frozen=True)
class Drawings:
    """The pictures of a validation, made before there are numbers to write below them.

    Parameters
    ----------
    headings
        How each snapshot is called: ``id``, ``state``, ``strain`` and ``branch``.
    hero
        SVG of the last snapshot.
    panels
        By key, a picture for each snapshot.
    curves
        Load path and eigenvalues, where the solution has them.
    convergence
        A picture for each snapshot.
    """

    headings: list[dict[str, str]]
    hero: str
    panels: dict[str, list[Picture]]
    curves: list[Picture]
    convergence: list[Picture]


def draw(atlas: ExperimentReportData, progress: Progress = silent) -> Drawings:
    """Draw all that is shown of a validation; what needs the truth last, as it may be on its way.

    Parameters
    ----------
    atlas
        What is shown.
    progress
        Listener.
    """
    solution = atlas.solution
    headings = [_heading(solution, strain) for strain in atlas.strains]
    curves = _curves(solution)
    convergence = [
        _picture("convergence", "Convergence", heading, draw_convergence(result))
        for heading, result in zip(headings, atlas.results, strict=True)
    ]
    shown = panels_of(len(atlas.results[0].ansatz.modes))
    pictures = {}
    for n, panel in enumerate(sorted(shown, key=lambda panel: panel.needs_truth)):
        progress(n, len(shown), "report")
        pictures[panel.key] = [
            _picture(panel.key, panel.title, heading, panel.draw(atlas, k),
                     _panel_caption(panel, atlas, k), panel.exact)
            for k, heading in enumerate(headings)
        ]  # fmt: skip
    hero = to_svg(draw_hero(atlas, len(headings) - 1), "hero", "Image and pattern")
    progress(1, 1, "report")
    return Drawings(headings, hero, pictures, curves, convergence)


def write_experiment_report(
    path: Path | str, case: Mapping[str, Any], drawings: Drawings, summary: Mapping[str, Any]
) -> None:
    """Write the report of a validation, atomically.

    Parameters
    ----------
    path
        The HTML file.
    case
        What was run, as plain values (:meth:`modeharvest.runs.case.Case.plain`).
    drawings
        Of the same snapshots as the summary's.
    summary
        The content of ``summary.json``.
    """
    page = render(
        EXPERIMENT_TEMPLATE,
        title=summary.get("title") or "Validation",
        case=case,
        summary=summary,
        headings=drawings.headings,
        hero=drawings.hero,
        keys=key_numbers(summary),
        material=material_text(case["experiment"]["material"]),
        sections=_sections(drawings, summary),
        curves=drawings.curves,
        convergence=drawings.convergence,
        numbers=number_rows(summary),
        modes=mode_rows(summary),
        reservations=notes(summary),
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")


def _sections(drawings: Drawings, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The groups of panels, the numbers of each snapshot below its pictures."""
    modes = sum(key.startswith("phi") for key in drawings.panels)
    panels = {panel.key: panel for panel in panels_of(modes)}

    def card(key: str) -> dict[str, Any]:
        pictures = [
            replace(picture, fact=picture.fact or panel_numbers(key, snapshot))
            for picture, snapshot in zip(drawings.panels[key], summary["snapshots"], strict=True)
        ]
        return {"panel": panels[key], "pictures": pictures}

    return [
        {"id": anchor, "title": title, "cards": [card(k) for k in panels if _is_in(k, keys)]}
        for anchor, title, keys in EXPERIMENT_SECTIONS
    ]


def _is_in(key: str, section: Sequence[str]) -> bool:
    """Whether a panel belongs to a section; those of further modes, where the first one's are."""
    return key in section or (key[-1] in "23" and f"{key[:-1]}1" in section)


def _panel_caption(panel: SnapshotPanel, atlas: ExperimentReportData, k: int) -> str:
    """What the drawing itself has to say."""
    if panel.key.startswith("phi"):
        i = int(panel.key[3:])
        return f"drawn as with v{'₁₂₃'[i - 1]} = {atlas.shape_scale(k, i - 1):.3g} mm everywhere"
    return ""


def _curves(solution: Solution) -> list[Picture]:
    """Load path and eigenvalues, where the solution has them."""
    path, critical = solution.info.get("path"), solution.info.get("critical")
    if not path or not path.get("primary", {}).get("nominal_strain"):
        return []
    load = draw_load(path, _critical_strain(solution))
    eigenvalues = draw_eigenvalues(path, critical)
    return [
        Picture("load", "Load over strain", to_svg(load, "load", "Load over strain")),
        Picture("eigenvalues", "Stability", to_svg(eigenvalues, "eigenvalues", "Eigenvalues")),
    ]


def _critical_strain(solution: Solution) -> float | None:
    critical = solution.info.get("critical")
    return None if critical is None else float(critical["strain"])


def _heading(solution: Solution, strain: float) -> dict[str, str]:
    """How a snapshot is called on the page."""
    branch, critical = solution.at(strain).branch, _critical_strain(solution)
    if branch != "primary":
        state = "After buckling"
    elif critical is None:
        state = "Deformed"
    else:
        state = "Before buckling" if strain < critical else "Unstable path"
    return {"id": f"{round(1e4 * strain):04d}", "state": state, "strain": f"{100 * strain:.4g} %",
            "branch": branch}  # fmt: skip


def _picture(
    key: str,
    title: str,
    heading: Mapping[str, str],
    drawn: Figure,
    fact: str = "",
    exact: bool = False,
) -> Picture:
    name = f"{key}-{heading['id']}"
    label = f"{heading['state']} · {heading['strain']}"
    return Picture(name, label, to_svg(drawn, name, f"{title}, {label}", exact=exact), fact)
