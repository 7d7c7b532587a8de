"""The report of a harvest: one page like the paper's Figs. "spect_real" and "real"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from modeharvest.files import atomic
from modeharvest.progress import Progress, silent
from modeharvest.validation.harvest import words
from modeharvest.validation.harvest.atlas import SHAPE, HarvestAtlas
from modeharvest.validation.harvest.panels import SECTIONS, HarvestPanel, panels
from modeharvest.validation.harvest.plots import draw_hero, mode_scale
from modeharvest.validation.harvest.plots_photographs import (
    draw_distortion,
    draw_distortion_error,
    draw_distortion_sd,
    draw_reference,
)
from modeharvest.validation.harvest.plots_timeline import draw_timeline, draw_waves
from modeharvest.validation.harvest.run import Harvest, HarvestedFrame
from modeharvest.validation.harvest.summary import harvest_summary
from modeharvest.validation.page import render
from modeharvest.validation.plots_path import draw_convergence
from modeharvest.validation.report import Picture
from modeharvest.validation.style import to_svg

__all__ = ["Harvest", "HarvestedFrame", "harvest_summary", "write_harvest_report"]

TEMPLATE = "photographs.html"
WORDS = {
    "FRAME_COLUMNS": words.FRAME_COLUMNS,
    "frame_rows": words.frame_rows,
    "mode_tables": words.mode_tables,
    "error_text": words.error_text,
    "wave_rows": words.wave_rows,
    "percent": words.percent,
    "key_numbers": words.key_numbers,
    "notes": words.notes,
    "label": words.label,
}
"""What the template calls by name."""


def write_harvest_report(
    path: Path | str,
    harvest: Harvest,
    summary: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> None:
    """Write the report of a harvest, atomically.

    Parameters
    ----------
    path
        The HTML file.
    harvest
        What it shows.
    summary
        Its :func:`~modeharvest.validation.harvest.summary.harvest_summary`, if it is there.
    progress
        Listener.
    """
    told = harvest_summary(harvest) if summary is None else summary
    atlas = HarvestAtlas(harvest)
    by_name = {frame["name"]: frame for frame in told["frames"]}
    shown = [by_name[frame.name] for frame in atlas.shown]
    labels = words.labels(shown)
    page = render(
        TEMPLATE,
        title=harvest.title,
        harvest=harvest,
        summary=told,
        words=WORDS,
        shown=shown,
        labels=labels,
        hero=to_svg(draw_hero(atlas), "hero", "The last photograph and its pattern"),
        reference=_picture("reference", "The reference", draw_reference(atlas)),
        optics=_optics(harvest),
        sections=_sections(atlas, by_name, labels, progress),
        curves=_curves(harvest, told),
        convergence=[
            _picture(f"convergence-{k}", labels[frame.name], draw_convergence(frame.result))
            for k, frame in enumerate(atlas.shown, start=1)
        ],
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _picture(name: str, label: str, drawn: Figure, fact: str = "", exact: bool = False) -> Picture:
    return Picture(name, label, to_svg(drawn, name, label, exact=exact), fact)


def _sections(
    atlas: HarvestAtlas,
    frames: Mapping[str, Mapping[str, Any]],
    labels: Mapping[str, str],
    progress: Progress,
) -> list[dict[str, Any]]:
    """The groups of panels, each panel with a picture for every photograph that has it."""
    every = panels(atlas)
    cards: dict[str, list[dict[str, Any]]] = {anchor: [] for anchor, _ in SECTIONS}
    for n, panel in enumerate(every):
        progress(n, len(every), "report")
        pictures = [
            _picture(f"{panel.key}-{k}", labels[frame.name], panel.draw(atlas, frame),
                     _fact(panel, atlas, frame, frames[frame.name]), panel.exact)
            for k, frame in enumerate(atlas.shown, start=1) if panel.shows(atlas, frame)
        ]  # fmt: skip
        cards[panel.section].append({"panel": panel, "pictures": pictures})
    return [{"id": anchor, "title": title, "cards": cards[anchor]}
            for anchor, title in SECTIONS if cards[anchor]]  # fmt: skip


def _fact(
    panel: HarvestPanel, atlas: HarvestAtlas, frame: HarvestedFrame, told: Mapping[str, Any]
) -> str:
    if panel.key.startswith("phi"):
        i = int(panel.key.removeprefix("phi"))
        scale = mode_scale(atlas, frame, i - 1)
        return f"drawn as with {scale:.3g} mm for v everywhere: at most {SHAPE} l"
    return words.fact(panel.key, told)


def _optics(harvest: Harvest) -> list[Picture]:
    """Distortion, its standard deviation and its error, as far as they are known."""
    lens, grid = harvest.lens, harvest.grid
    if lens is None:
        return []
    pictures = [_picture("distortion", "Distortion S", draw_distortion(lens, grid))]
    if harvest.calibration is not None:
        drawn = draw_distortion_sd(harvest.calibration, grid)
        pictures.append(_picture("distortion-sd", "Standard deviation of S", drawn))
    if harvest.truth is not None and harvest.truth.distortion is not None:
        drawn = draw_distortion_error(lens, harvest.truth.distortion, grid)
        pictures.append(_picture("distortion-error", "S − truth, affine part aside", drawn))
    return pictures


def _curves(harvest: Harvest, summary: Mapping[str, Any]) -> list[Picture]:
    """The test from photograph to photograph, where there is more than one."""
    curves = []
    if harvest.timeline:
        drawn = draw_timeline(harvest.timeline, harvest.buckling)
        curves.append(_picture("timeline-pattern", "The pattern’s amplitude", drawn))
    frames = [frame for frame in summary["frames"] if frame["modes"]]
    if len(frames) > 1:
        curves.append(_picture("timeline-waves", "Its wave vectors", draw_waves(frames)))
    return curves
