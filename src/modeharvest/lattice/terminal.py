"""A lattice's ``summary.json`` as a short table on the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from modeharvest.fem.materials import material_in_words
from modeharvest.validation.lattice.plots_branches import combination_name


def print_lattice(summary: dict[str, Any], out: Path) -> None:
    """Print what was found, the file of the report last."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(summary['title'])}[/bold]")
    material = material_in_words(summary["case"]["material"])
    for line in (*_critical(summary["critical"], summary["outcome"]), material):
        console.print(escape(line), soft_wrap=True)
    console.print(_dispersion(summary))
    for part in summary["zone"]:
        console.print(
            f"softest wave of the whole zone at {100 * part['load']:.3f} %: "
            f"{wave_in_pi(part['wave'])}, eigenvalue {part['eigenvalue']:.4g} N/mm⁴"
        )
    if summary["branches"]:
        console.print(_branches(summary["branches"]))
    for family in summary["families"]:
        console.print(escape(_family(family)), soft_wrap=True)
    for line in _study(summary["study"]):
        console.print(escape(line), soft_wrap=True)
    for note in summary["notes"]:
        console.print(f"[yellow]note:[/yellow] {escape(note)}", soft_wrap=True)
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)


def _critical(critical: dict[str, Any], outcome: str) -> list[str]:
    """What is critical first, and how that is proven."""
    load, loading = 100 * critical["load"], critical["loading"]
    if not critical["found"]:
        return [f"{loading}: {outcome}; lowest filling·λ/k² there {critical['value']:.4g} MPa"]
    if critical["long_wave_angle"] is not None:
        along = math.degrees(critical["long_wave_angle"])
        return [f"{loading}: critical strain {load:.4f} %, long waves along {along:.1f}° from x"]
    waves = critical["waves"]
    named = ", ".join(wave_in_pi(wave) for wave in waves)
    sides = zip(critical["below"], critical["above"], strict=True)
    signs = ", ".join(f"{below} → {above}" for below, above in sides)
    earlier = len(critical["earlier"])
    first = "no wave is unstable before" if not earlier else f"{earlier} are unstable before"
    many = f", {len(waves)} waves at once" if len(waves) > 1 else ""
    return [
        f"{loading}: critical strain {load:.4f} %{many}, k·a = {named}",
        f"proof, a millionth below → above: negative eigenvalues {signs}; {first}",
    ]


def _dispersion(summary: dict[str, Any]) -> Table:
    """Lowest eigenvalues at the corners of the zone, by load."""
    table = Table(title=escape("lowest eigenvalue [N/mm⁴]"), title_justify="left")
    table.add_column("at")
    rows = summary["dispersion"]
    for row in rows:
        table.add_column(f"{100 * row['load']:.3f} %", justify="right")
    names = dict.fromkeys(name for name, _ in rows[0]["corners"] if name != "Γ")
    for name in names:
        table.add_row(name, *(f"{dict(row['corners'])[name]:.4g}" for row in rows))
    return table


def _branches(branches: Sequence[dict[str, Any]]) -> Table:
    """Energies of the branches above that of the unbuckled lattice."""
    title = escape("energy beyond the unbuckled lattice's [kPa]; * unstable")
    table = Table(title=title, title_justify="left")
    table.add_column("branch along")
    loads = sorted({state["load"] for branch in branches for state in branch["states"]})
    for load in loads:
        table.add_column(f"{100 * load:.3f} %", justify="right")
    for branch in branches:
        start = combination_name(branch["combination"])
        cells = {state["load"]: _excess(state) for state in branch["states"]}
        table.add_row(start, *(cells.get(load, "–") for load in loads))
    return table


def _excess(state: dict[str, Any]) -> str:
    excess = 1e3 * (state["energy"] - state["primary_energy"])
    return f"{excess:.4g}" + ("" if state["negative_eigenvalues"] == 0 else "*")


def _family(family: dict[str, Any]) -> str:
    return (
        f"{family['of']}: family '{family['family']}', {len(family['waves'])} waves, "
        f"{family['parameters']} parameters, captures {100 * family['captured']:.2f} %"
    )


def _study(study: dict[str, Any] | None) -> list[str]:
    if study is None:
        return []
    low, high = study["overlap"]
    return [
        f"study of {study['lattices']} lattices: overlap with the analytic mode {low:.4f} to "
        f"{high:.4f}",
        *(
            f"  {limit['loading']}: the pattern buckles first from d/l = {limit['with_']:.4g} on; "
            f"at {limit['without']:.4g} {limit['instead']}"
            for limit in study["limits"]
        ),
    ]


def wave_in_pi(wave: Sequence[float]) -> str:
    """Phases in units of π, such as (π, 0.5π)."""
    return "(" + ", ".join(_in_pi(phase) for phase in wave) + ")"


def _in_pi(phase: float) -> str:
    factor = round(phase / math.pi, 4) + 0.0
    if factor == 0:
        return "0"
    return {1.0: "π", -1.0: "−π"}.get(factor, f"{factor:.4g}π".replace("-", "−"))
