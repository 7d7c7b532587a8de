"""The inverse mapping compared with riley-raster's nodal shader, pixel by pixel.

Both find the point of the undeformed mesh that each pixel of the deformed one shows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import riley_side
from laps import in_turn, use_threads
from meshes import ELEMENTS, MeshView, aligned, bulged, specimen

from modeharvest.imaging.mapping.isoparametric import locate


def rows(quick: bool) -> dict[str, dict[str, Any]]:
    """Names of the rows, and the options of :func:`measure` for each."""
    size = {"specimen": 700, "bulged": 300, "laps": 3} if quick else {
        "specimen": 2751, "bulged": 1000, "laps": 7}  # fmt: skip
    found: dict[str, dict[str, Any]] = {}
    for threads in (1, 2):
        found[f"geometry-T6-{threads}"] = {
            "rows": size["specimen"], "laps": size["laps"], "threads": threads,
        }  # fmt: skip
    for element in ELEMENTS:
        for kind in ("bulged", "aligned"):
            found[f"geometry-{kind}-{element}"] = {
                "rows": size["bulged"], "laps": size["laps"], "threads": 1,
                "element": element, "kind": kind,
            }  # fmt: skip
    return found


def measure(options: dict[str, Any]) -> dict[str, Any]:
    """Measure one row of the table."""
    use_threads(options["threads"])
    view = _view(options)
    nodes, mesh = view.mesh.nodes, view.mesh
    three = np.column_stack([nodes, np.ones(len(nodes))])

    laps = in_turn(
        {
            "locate": lambda: locate(view.deformed, mesh.cells, mesh.element, view.grid),
            "map back": lambda: locate(
                view.deformed, mesh.cells, mesh.element, view.grid, nodal=nodes
            ),
            "riley, three fields": riley_side.nodal(view, three, options["threads"]),
            "riley, one field": riley_side.nodal(view, nodes[:, :1], options["threads"]),
        },
        options["laps"],
    )
    located, ours = laps["locate"].result, laps["map back"].result
    theirs = laps["riley, three fields"].result
    return {
        "mesh": view.name,
        "element": mesh.element,
        "cells": len(mesh.cells),
        "shape": view.grid.shape,
        "threads": options["threads"],
        "seconds": {name: lap.median_s for name, lap in laps.items()},
        "first_s": {name: lap.first_s for name, lap in laps.items()},
        **compare(view, located.mask, ours.values, theirs),
        "residual_px": located.max_residual_px,
    }


def _view(options: dict[str, Any]) -> MeshView:
    if "element" not in options:
        return specimen(options["rows"])
    make = {"bulged": bulged, "aligned": aligned}[options["kind"]]
    return make(options["element"], options["rows"])


def compare(view: MeshView, mask: Any, point: Any, theirs: Any) -> dict[str, Any]:
    """Distance of the points where both see material, and pixels that only one sees."""
    covered = theirs[0] != riley_side.BACKGROUND
    both = mask & covered
    apart = np.hypot(theirs[0] - point[0], theirs[1] - point[1])[both] / view.grid.pixel_size
    return {
        "material_px": int(mask.sum()),
        "apart_max_px": float(apart.max()),
        "apart_rms_px": float(np.sqrt(np.mean(apart**2))),
        "only_ours_px": int((mask & ~covered).sum()),
        "only_riley_px": int((covered & ~mask).sum()),
    }


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of Markdown."""
    lines = [
        "| mesh | image, material | threads | inverse mapping alone | and two fields |"
        " riley, one field | riley, three fields | ours ÷ riley |"
        " apart: largest, rms [px] | px only in ours, only in riley | our residual [px] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found.values():
        speed = {name: row["material_px"] / s / 1e6 for name, s in row["seconds"].items()}
        both, three = speed["map back"], speed["riley, three fields"]
        lines.append(
            f"| {row['element']}, {row['mesh']}, {row['cells']} cells "
            f"| {row['shape'][0]} × {row['shape'][1]}, {row['material_px'] / 1e6:.2f} Mpx "
            f"| {row['threads']} | {speed['locate']:.1f} | {both:.1f} "
            f"| {speed['riley, one field']:.1f} | {three:.1f} | {both / three:.2f} "
            f"| {row['apart_max_px']:.1e}, {row['apart_rms_px']:.1e} "
            f"| {row['only_ours_px']}, {row['only_riley_px']} | {row['residual_px']:.1e} |"
        )
    return lines
