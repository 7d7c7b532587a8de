"""A virtual experiment's ``summary.json`` as a short table on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from modeharvest.fem.materials import material_in_words

_ROWS = {
    "negative pivots of the tangent": "negative_pivots",
    "pattern amplitude [px]": "pattern_amplitude_px",
    "w = truth - IDIC, rms [px]": "rms_w_px",
    "best possible fit, rms [px]": "rms_best_fit_px",
    "IDIC - best fit, rms [px]": "rms_idic_to_best_fit_px",
    "grey-level residual, rms": "rms_residual",
    "iterations": "iterations",
    "outcome": "outcome",
}


def print_experiment(summary: dict[str, Any], out: Path) -> None:
    """Print what was measured and how wrong it was, the file of the report last."""
    console = Console(highlight=False)
    console.print(_snapshots(summary))
    console.print("rms: per component, over all material pixels")
    material = summary["case"]["experiment"]["material"]
    console.print(escape(critical_line(summary["critical_strain"], material)), soft_wrap=True)
    for warning in summary["warnings"]:
        console.print(f"[yellow]warning:[/yellow] {escape(warning)}", highlight=False)
    if summary["expected"]:
        missed = [row["quantity"] for row in summary["expected"] if not row["ok"]]
        console.print(f"expected values missed: {', '.join(missed) or 'none'}")
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)


def critical_line(strain: float | None, material: Mapping[str, Any]) -> str:
    """A sentence on the critical strain [-], None if the path has no bifurcation, and of what."""
    said = "no bifurcation on the path (stable, imperfect, or odd numbers of holes both ways)"
    if strain is not None:
        said = f"critical strain {100 * strain:.4f} %"
    return f"{said}; {material_in_words(material)}"


def _snapshots(summary: dict[str, Any]) -> Table:
    """What was found at each strain, a column each."""
    table = Table(title=escape(str(summary.get("title", ""))), title_justify="left")
    table.add_column("quantity")
    for s in summary["snapshots"]:
        table.add_column(f"{100 * s['nominal_strain']:.2f} %", justify="right")
    for label, key in _ROWS.items():
        table.add_row(escape(label), *(_cell(s.get(key)) for s in summary["snapshots"]))
    return table


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
