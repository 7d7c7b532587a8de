"""``report.html``: one self-contained page with every picture and number of a validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import material_in_words
from modeharvest.files import atomic
from modeharvest.progress import Progress, silent
from modeharvest.validation import words
from modeharvest.validation.page import render
from modeharvest.validation.plots import PANELS, Atlas, Panel, draw_hero
from modeharvest.validation.plots_path import draw_convergence, draw_eigenvalues, draw_load
from modeharvest.validation.style import to_svg

TEMPLATE = "experiment.html"
SECTIONS = (
    ("images", "The image and its pattern", ("image", "Sxx", "Syy")),
    ("found", "What was measured", ("v0x", "v0y", "v1", "phi1", "flucx", "flucy")),
    ("errors", "How wrong it is, and why", ("residual", "w", "best", "loss")),
)
"""Anchor, heading and panels of each group of pictures."""


@dataclass(frozen=True)
class Picture:
    """A picture in the page.

    Parameters
    ----------
    id
        Its anchor: the panel's key and the strain in hundredths of a percent.
    label
        What is written above it.
    svg
        The picture itself.
    fact
        One line of numbers below it.
    """

    id: str
    label: str
    svg: str
    fact: str = ""


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


def draw(atlas: Atlas, progress: Progress = silent) -> Drawings:
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
    shown = [panel for panel in PANELS if atlas.has_mode or not panel.needs_mode]
    pictures = {}
    for n, panel in enumerate(sorted(shown, key=lambda panel: panel.needs_truth)):
        progress(n, len(shown), "report")
        pictures[panel.key] = [
            _picture(panel.key, panel.title, heading, panel.draw(atlas, k),
                     _fact(panel, atlas, k), panel.exact)
            for k, heading in enumerate(headings)
        ]  # fmt: skip
    hero = to_svg(draw_hero(atlas, len(headings) - 1), "hero", "Image and pattern")
    progress(1, 1, "report")
    return Drawings(headings, hero, pictures, curves, convergence)


def write_report(
    path: Path | str, case: Mapping[str, Any], drawings: Drawings, summary: Mapping[str, Any]
) -> None:
    """Write the report of a validation, atomically.

    Parameters
    ----------
    path
        The HTML file.
    case
        What was run, as plain values (:meth:`modeharvest.case.Case.plain`).
    drawings
        Of the same snapshots as the summary's.
    summary
        The content of ``summary.json``.
    """
    page = render(
        TEMPLATE,
        title=summary.get("title") or "Validation",
        case=case,
        summary=summary,
        headings=drawings.headings,
        hero=drawings.hero,
        keys=words.key_numbers(summary),
        material=material_in_words(case["experiment"]["material"]),
        sections=_sections(drawings, summary),
        curves=drawings.curves,
        convergence=drawings.convergence,
        numbers=words.number_rows(summary),
        modes=words.mode_rows(summary),
        reservations=words.notes(summary),
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")


def _sections(drawings: Drawings, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The groups of panels, the numbers of each snapshot below its pictures."""
    panels = {panel.key: panel for panel in PANELS}

    def card(key: str) -> dict[str, Any]:
        pictures = [
            replace(picture, fact=picture.fact or words.fact(key, snapshot))
            for picture, snapshot in zip(drawings.panels[key], summary["snapshots"], strict=True)
        ]
        return {"panel": panels[key], "pictures": pictures}

    return [
        {"id": anchor, "title": title, "cards": [card(k) for k in keys if k in drawings.panels]}
        for anchor, title, keys in SECTIONS
    ]


def _fact(panel: Panel, atlas: Atlas, k: int) -> str:
    """What the drawing itself has to say."""
    if panel.key == "phi1":
        return f"drawn as with v₁ = {atlas.shape_scale(k):.3g} mm everywhere"
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
