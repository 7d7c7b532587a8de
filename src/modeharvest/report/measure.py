"""Report of a measured displacement: maps of u, v, strain, error bars and residual, and numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field
from modeharvest.report.model import (
    Card,
    Cell,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
    number,
)
from modeharvest.util.arrays import FloatArray

Summary = Mapping[str, Any]
Residual = Callable[[str, NodalResult], FloatArray]
"""From an image's name and its result to (rows, cols) [grey levels]."""

_SHOWN = 4
"""Images with maps of their own, at most: the last ones are spread evenly over the sequence."""
_COLUMNS = {
    "rms_px": "u, rms [px]", "max_px": "u, largest [px]", "median_sd_px": "sd, median [px]",
    "cutoff_px": "cut-off wavelength [px]", "unknowns": "unknowns", "pixels": "pixels",
    "residual_rms": "residual [levels]", "residual_noise": "of it noise [levels]",
    "gain": "gain", "library": "factorised by",
}  # fmt: skip


def measure_report(
    summary: Summary,
    results: Mapping[str, NodalResult] | None = None,
    residual: Residual | None = None,
) -> Report:
    """The report of a measurement.

    ``summary``: the content of ``summary.json``. ``results`` by the images' names, and what gives
    their ``residual``; without, the report has numbers only, as for the terminal.
    """
    images = summary["images"]
    rows: list[list[Cell]] = [[i["name"], *(i[key] for key in _COLUMNS)] for i in images]
    table = ReportTable("Images", ["image", *_COLUMNS.values()], rows, "images", on_terminal=True)
    names = [image["name"] for image in images]
    shown = np.unique(np.linspace(len(names) - 1, 0, min(_SHOWN, len(names))).round().astype(int))
    maps = [
        Section(f"image-{k + 1}", names[k], _cards(k, names[k], results, residual, summary["unit"]))
        for k in shown
    ] if results and residual else []  # fmt: skip
    last = images[-1]
    return Report(
        kind="measurement",
        title=summary["title"],
        lead="The displacement of a speckled surface by finite-element digital image correlation, "
        "up to the edges of the material, with standard deviations that count noise and smoothing.",
        findings=[
            f"{last['name']}: u is {number(last['rms_px'])} px rms per component, at most "
            f"{number(last['max_px'])} px, known to {number(last['median_sd_px'], 2)} px; "
            f"waves shorter than {number(last['cutoff_px'], 3)} px are smoothed away."
        ],
        keys=[
            KeyNumber("largest displacement", number(last["max_px"], 4), "px", last["name"]),
            KeyNumber("standard deviation", number(last["median_sd_px"], 2), "px", "median"),
            KeyNumber("cut-off wavelength", number(last["cutoff_px"], 3), "px"),
            KeyNumber("coverage", number(100 * last["coverage"], 4), "%", "of the material"),
        ],
        sections=[*maps, Section("numbers", "Numbers", Card.tabular(table, wide=True))],
        warnings=[
            *summary["warnings"],
            *(f"{i['name']}: {text}" for i in images for text in i["warnings"]),
        ],
        notes=[
            f"The mask of the material was {summary['mask']}: mask.tif.",
            f"Lengths in all files are in {summary['unit']}, from the middle of the image, x right "
            "and y up.",
            *summary["notes"],
        ],
        command=summary["command"],
        remark="Run it again after an interruption: finished images are not measured again.",
        files={
            "results/*.h5": "nodes, displacement, standard deviations (HDF5)",
            "results/*.vtu": "the same with strains, for ParaView",
            "results/*.csv": "the same as a table of the nodes",
            "results/*.tif": "u, v and their standard deviations at every pixel (float32)",
        },
        versions=summary["versions"],
    )


def _cards(
    k: int, name: str, results: Mapping[str, NodalResult], residual: Residual, unit: str
) -> list[Card]:
    """Maps of one image."""
    result = results[name]
    frame = MapFrame.of(MeshBoundary.of(result.mesh), result.grid)

    def nodal(values: FloatArray, what: str, signed: bool = True) -> Figure:
        field = result.on_pixels(values[:, None], frame.grid)[..., 0]
        scale = ColourScale.signed if signed else ColourScale.size
        return draw_field(frame, field, scale(field, what, 0.999), unit=unit)

    def left() -> Figure:
        field = frame.average(residual(name, result))
        return draw_field(frame, field, ColourScale.signed(field, "levels", 0.999), unit=unit)

    u, strain = result.displacement, result.field("logarithmic")
    sd = np.linalg.norm(result.standard_deviation, axis=1)
    panels: dict[str, list[tuple[str, Callable[[], Figure]]]] = {
        "Displacement": [(axis, partial(nodal, u[:, c], unit)) for c, axis in enumerate("uv")],
        "Logarithmic strain": [
            (f"{'xy'[i]}{'xy'[j]}", partial(nodal, strain[:, i, j], "-"))
            for i, j in ((0, 0), (1, 1), (0, 1))
        ],
        "Standard deviation of u, length": [("", partial(nodal, sd, unit, False))],
        "Residual f − g(x + u)": [("", left)],
    }
    return [
        Card(title, [ReportFigure(f"map-{k + 1}-{n}-{m}", label, draw)
                     for m, (label, draw) in enumerate(figures)])
        for n, (title, figures) in enumerate(panels.items())
    ]  # fmt: skip
