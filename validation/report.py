"""``report.html``: one self-contained page with every picture and number of a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import material_in_words
from modeharvest.files import atomic
from modeharvest.idic.families.pattern import Pattern
from modeharvest.idic.families.spectrum import Spectrum
from modeharvest.imaging.imageset import ImageSet
from modeharvest.progress import Progress, silent
from modeharvest.validation import words
from modeharvest.validation.page import render
from modeharvest.validation.plots import PANELS, Atlas, Panel, draw_hero
from modeharvest.validation.plots_path import draw_convergence, draw_eigenvalues, draw_load
from modeharvest.validation.style import to_svg
from modeharvest.validation.truth import Comparison

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


def write_report(
    path: Path | str,
    case: Mapping[str, Any],
    solution: Solution,
    images: ImageSet,
    comparisons: Sequence[Comparison],
    spectra: Sequence[tuple[Spectrum, Pattern]],
    summary: Mapping[str, Any],
    progress: Progress = silent,
) -> None:
    """Write the report of a validation, atomically.

    Parameters
    ----------
    path
        The HTML file.
    case
        What was run, as plain values (:meth:`modeharvest.case.Case.plain`).
    solution, images
        What the truth comes from, and what was measured.
    comparisons
        One for each snapshot, by ascending strain.
    spectra
        For each of them, spectral densities and what is read off them.
    summary
        The content of ``summary.json``.
    progress
        Listener.
    """
    pitch = float(case["experiment"]["specimen"]["pitch"])
    atlas = Atlas(solution, images, comparisons, spectra, pitch)
    headings = [_heading(snapshot, summary) for snapshot in summary["snapshots"]]
    page = render(
        TEMPLATE,
        title=summary.get("title") or "Validation",
        case=case,
        summary=summary,
        headings=headings,
        hero=to_svg(draw_hero(atlas, len(comparisons) - 1), "hero", "Image and pattern"),
        keys=words.key_numbers(summary),
        material=material_in_words(case["experiment"]["material"]),
        sections=_sections(atlas, summary, headings, progress),
        curves=_curves(solution, summary),
        convergence=[
            _picture("convergence", "Convergence", heading, draw_convergence(c.result))
            for heading, c in zip(headings, comparisons, strict=True)
        ],
        numbers=words.number_rows(summary),
        modes=words.mode_rows(summary),
        reservations=words.notes(summary),
    )  # fmt: skip
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _sections(
    atlas: Atlas,
    summary: Mapping[str, Any],
    headings: Sequence[Mapping[str, str]],
    progress: Progress,
) -> list[dict[str, Any]]:
    """The groups of panels, each panel with a picture for every snapshot."""
    panels = {p.key: p for p in PANELS if atlas.has_mode or not p.needs_mode}
    cards = {}
    for n, panel in enumerate(panels.values()):
        progress(n, len(panels), "report")
        cards[panel.key] = [
            _picture(panel.key, panel.title, heading, panel.draw(atlas, k),
                     _fact(panel, atlas, k, summary), panel.exact)
            for k, heading in enumerate(headings)
        ]  # fmt: skip
    return [
        {"id": anchor, "title": title,
         "cards": [{"panel": panels[k], "pictures": cards[k]} for k in keys if k in panels]}
        for anchor, title, keys in SECTIONS
    ]  # fmt: skip


def _fact(panel: Panel, atlas: Atlas, k: int, summary: Mapping[str, Any]) -> str:
    if panel.key == "phi1":
        return f"drawn as with v₁ = {atlas.shape_scale(k):.3g} mm everywhere"
    return words.fact(panel.key, summary["snapshots"][k])


def _curves(solution: Solution, summary: Mapping[str, Any]) -> list[Picture]:
    """Load path and eigenvalues, where the solution has them."""
    path, critical = solution.info.get("path"), solution.info.get("critical")
    if not path or not path.get("primary", {}).get("nominal_strain"):
        return []
    load = draw_load(path, summary.get("critical_strain"))
    eigenvalues = draw_eigenvalues(path, critical)
    return [
        Picture("load", "Load over strain", to_svg(load, "load", "Load over strain")),
        Picture("eigenvalues", "Stability", to_svg(eigenvalues, "eigenvalues", "Eigenvalues")),
    ]


def _heading(snapshot: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[str, str]:
    """How a snapshot is called on the page."""
    strain, critical = snapshot["nominal_strain"], summary.get("critical_strain")
    if snapshot["branch"] != "primary":
        state = "After buckling"
    elif critical is None:
        state = "Deformed"
    else:
        state = "Before buckling" if strain < critical else "Unstable path"
    return {"id": f"{round(1e4 * strain):04d}", "state": state, "strain": f"{100 * strain:.4g} %",
            "branch": snapshot["branch"]}  # fmt: skip


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
