"""Report of a measured displacement: maps of u, v, strain, error bars and residual, and numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.photograph.gauges import Gauge
from modeharvest.report.explore import explored_images
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field, draw_image
from modeharvest.report.figures.on_photographs import axis_text, draw_gauges_on, gauge_cards
from modeharvest.report.figures.sequence import force_cards
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.text import caption, number, text_of
from modeharvest.util.arrays import FloatArray, FloatImage

Summary = Mapping[str, Any]
Residual = Callable[[str, NodalResult], FloatArray]
"""Returns the residual (rows, cols) [grey levels] for an image's name and its result."""
Picture = Callable[[str], FloatImage]
"""Returns the image (rows, cols), 0 black to 1 white, for an image's name."""

_SHOWN = 4
"""Largest number of images shown as maps: evenly spaced, from the first to the last image."""


def measure_report(
    summary: Summary, results: Mapping[str, NodalResult] | None = None,
    residual: Residual | None = None, picture: Picture | None = None, gauges: Sequence[Gauge] = (),
) -> Report:  # fmt: skip
    """Make the report of a measurement.

    ``summary``: content of ``summary.json``. ``results``: results by image name; ``residual`` and
    ``picture`` return residuals and images. Without these three, the report has numbers only, for
    the terminal. ``gauges``: gauges whose readings are in the summary.
    """
    images = summary["images"]
    by_contours = images[-1]["shown"] == "contours"
    table = ReportTable.of("contours" if by_contours else "images", images)
    names, last = [image["name"] for image in images], images[-1]
    shown = np.unique(np.linspace(len(names) - 1, 0, min(_SHOWN, len(names))).round().astype(int))
    maps = [
        Section(f"image-{k + 1}", names[k],
                _cards(k, names[k], results, residual, picture, summary["unit"]))
        for k in shown
    ] if results and residual and picture else []  # fmt: skip
    along = axis_text(summary.get("angle_deg", 0.0))
    strains, placed = {image["name"]: image["strain_x"] for image in images}, None
    if gauges and results and picture:
        shown_on = results[names[-1]], gauges, picture(names[-1]), summary["unit"]
        placed = partial(draw_gauges_on, *shown_on)
    return Report(
        kind="measurement",
        title=summary["title"],
        findings=[text_of("contours-found" if by_contours else "measure-found", last=last)],
        keys=[
            KeyNumber.of("largest-displacement", last=last),
            KeyNumber.of("standard-deviation", last=last),
            *([] if by_contours else [KeyNumber.of("cutoff", last=last)]),
            KeyNumber.of("coverage-of-material", number(100 * last["coverage"], 4)),
        ],
        sections=[
            *maps,
            Section.of("timeline", force_cards(images, "strain_x", f"mean strain along {along}")),
            Section.of("gauges", gauge_cards(summary.get("gauges", ()), strains, placed, along)),
            Section.of("numbers", Card.tabular(table, wide=True)),
        ],
        warnings=[
            *summary["warnings"],
            *(f"not used: {row['name']}: {row['reason']}" for row in summary["skipped"]),
            *(f"{i['name']}: {text}" for i in images for text in i["warnings"]),
        ],
        notes=[
            text_of("measure-mask", **summary),
            text_of("measure-unit", **summary),
            *summary["notes"],
        ],
        command=summary["command"],
        explore=partial(explored_images, results, summary["unit"], residual) if results else None,
        versions=summary["versions"],
        **caption("page-measure-contours" if by_contours else "page-measure"),
    )  # fmt: skip


def _cards(
    k: int, name: str, results: Mapping[str, NodalResult], residual: Residual, picture: Picture,
    unit: str,
) -> list[Card]:  # fmt: skip
    """Cards with maps of one image."""
    result = results[name]
    frame = MapFrame.of(MeshBoundary.of(result.mesh), result.grid)

    def nodal(values: FloatArray, what: str, signed: bool = True) -> Figure:
        field = result.on_pixels(values[:, None], frame.grid)[..., 0]
        scale = ColourScale.signed if signed else ColourScale.size
        return draw_field(frame, field, scale(field, what, 0.99), unit=unit)

    def left() -> Figure:
        field = frame.average(residual(name, result))  # large at edges that show background
        return draw_field(frame, field, ColourScale.signed(field, "levels", 0.95), unit=unit)

    def seen() -> Figure:
        return draw_image(frame, picture(name), None, result.grid, result.displacement, unit=unit)

    u, strain = result.displacement, result.field("logarithmic")
    sd = np.linalg.norm(result.standard_deviation, axis=1)
    panels: dict[str, list[tuple[str, Callable[[], Figure]]]] = {
        "Displacement": [("along " + "xy"[c], partial(nodal, u[:, c], unit)) for c in (0, 1)],
        "Standard deviation of u, both components": [("", partial(nodal, sd, unit, False))],
        "Logarithmic strain": [
            (f"{'xy'[i]}{'xy'[j]}", partial(nodal, strain[:, i, j], "strain [-]"))
            for i, j in ((0, 0), (1, 1), (0, 1))
        ],
        "Deformed image, with the mesh’s edges as measured": [("", seen)],
    }
    if result.shown == "speckle":
        panels["Residual f(x) − g(x + u)"] = [("", left)]
    return [
        Card(title, [ReportFigure(f"map-{k + 1}-{n}-{m}", label, draw)
                     for m, (label, draw) in enumerate(figures)], wide=len(figures) > 2)
        for n, (title, figures) in enumerate(panels.items())
    ]  # fmt: skip
