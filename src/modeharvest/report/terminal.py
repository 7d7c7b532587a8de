"""What a run found as a short table on the terminal, the file of its report last.

One function for each kind of run: virtual experiment, lattice, photographs, study, benchmark.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from modeharvest.report.model import material_text, short
from modeharvest.runs.lattice.results import combination_name
from modeharvest.util.stages import Stages
from modeharvest.validation.resolution.grading import GRADE_COLUMNS, StarGrading, grade_numbers
from modeharvest.validation.scoring.grading import Grading
from modeharvest.validation.scoring.score import PERCENTILES, Score


def print_grading(grading: Grading, out: Path | str) -> None:
    """Print the ranked table, what is to be kept in mind, and where the report is."""
    console = Console(highlight=False)
    console.print(f"benchmark {grading.truth.id} at {100 * grading.strain:g} %, the best first")
    table = Table()
    table.add_column("errors in px")
    for rank, graded in enumerate(grading.scores, start=1):
        table.add_column(escape(f"{rank}. {graded.source}"), justify="right")
    rows = [_cells(grading, graded) for graded in grading.scores]
    for label in rows[0]:
        table.add_row(label, *(cells[label] for cells in rows))
    console.print(table)
    console.print("rms: per component; 50 % and 95 % of the points err by less (length)")
    for note in grading.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}", soft_wrap=True)
    console.print(f"report: {Path(out) / 'report.html'}", markup=False, soft_wrap=True)


def _cells(grading: Grading, graded: Score) -> dict[str, str]:
    """A field's column of the table, by the rows' names."""
    every = graded.everywhere
    percentiles = dict(zip(PERCENTILES, every.percentiles_px, strict=True))
    cells = {
        "rms": f"{every.rms_px:.3g}",
        "bias x": f"{every.bias_px[0]:.2g}",
        "bias y": f"{every.bias_px[1]:.2g}",
        "50 %": f"{percentiles[50]:.3g}",
        "95 %": f"{percentiles[95]:.3g}",
        "largest": f"{every.max_px:.3g}",
        **{
            f"rms, {name}": f"{part.rms_px:.3g}" if part.points else "-"
            for name, part in graded.by_region.items()
        },
        "points": str(every.points),
        "returned": f"{100 * every.returned:.1f} %",
        "material covered": f"{100 * graded.covered:.1f} %",
    }
    if len(grading.scores) > 1:
        share = f"{100 * grading.common_share:.0f} %"
        cells[f"rms, {share} that all cover"] = f"{grading.common[graded.source].rms_px:.3g}"
    return cells


def print_star_grading(grading: StarGrading, out: Path | str) -> None:
    """Print the ranked table, what is to be kept in mind, and where the report is."""
    console = Console(highlight=False)
    table = Table(title=f"star {grading.star_set.id}, the best first", title_justify="left")
    table.add_column("")
    rows = [grade_numbers(grade) for grade in grading.grades]
    for rank, row in enumerate(rows, start=1):
        table.add_column(escape(f"{rank}. {row['name']}"), justify="right")
    for heading, key in GRADE_COLUMNS.items():
        table.add_row(escape(heading), *(short(row[key]) for row in rows))
    console.print(table)
    for note in grading.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}", soft_wrap=True)
    console.print(f"report: {Path(out) / 'report.html'}", markup=False, soft_wrap=True)


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
    return f"{said}; {material_text(material)}"


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


def print_lattice(summary: dict[str, Any], out: Path) -> None:
    """Print what was found, the file of the report last."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(summary['title'])}[/bold]")
    material = material_text(summary["case"]["material"])
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


Cell = Callable[[dict[str, Any]], str]
"""What a row of the table says of a photograph."""


def print_harvest(summary: dict[str, Any], out: Path) -> None:
    """Print what was found, the file of the report last."""
    console = Console(highlight=False)
    table = Table(title=escape(summary["title"]), title_justify="left")
    table.add_column("quantity")
    frames = summary["frames"]
    for frame in frames:
        table.add_column(escape(frame["name"]), justify="right")
    for label, cell in _rows(frames).items():
        table.add_row(escape(label), *(cell(frame) for frame in frames))
    console.print(table)
    console.print("± noise of the images / ± what the ansatz leaves over; standard deviations")
    buckling = summary.get("buckling") or {}
    console.print(escape(buckling.get("text", "")))
    for row in summary.get("truth") or []:
        mark = "[green]✓[/green]" if row["ok"] else "[red]✗[/red]"
        obtained = row["obtained"]
        value = f"{obtained:.3g}" if isinstance(obtained, float) else str(obtained)
        console.print(
            f"{mark} {escape(row['quantity'])}: {value} {row['unit']} ({escape(row['expected'])})",
            soft_wrap=True,
        )
    for name, reason in _skipped(summary):
        console.print(f"[yellow]skipped:[/yellow] {escape(name)}: {escape(reason)}")
    for frame in frames:
        for warning in frame["warnings"]:
            console.print(
                f"[yellow]warning:[/yellow] {escape(frame['name'])}: {escape(warning)}",
                soft_wrap=True,
            )
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)


def _skipped(summary: dict[str, Any]) -> list[tuple[str, str]]:
    found = summary.get("skipped", [])
    return [(s["name"], s["reason"]) if isinstance(s, dict) else (s[0], s[1]) for s in found]


def _rows(frames: Sequence[dict[str, Any]]) -> dict[str, Cell]:
    """What is printed of every photograph, the same for each of its modes."""
    rows: dict[str, Cell] = {"compression along x, y [%]": _strain}
    for i in range(max((len(frame["modes"]) for frame in frames), default=0)):
        n = i + 1
        rows[f"v{n} phi{n}"] = partial(_pattern, i=i)
        rows[f"largest v{n} phi{n} [px]"] = partial(_largest, i=i)
        rows[f"largest v{n} [mm]"] = partial(_amplitude, i=i)
        rows[f"wave vectors of phi{n} [1/l]"] = partial(_waves, i=i)
    rows["left over (w), rms [px]"] = lambda frame: f"{frame['model_error_px']:.3g}"
    rows["iterations, all levels"] = lambda frame: str(frame["iterations_all_levels"])
    rows["outcome"] = lambda frame: str(frame["outcome"])
    return rows


def _strain(frame: dict[str, Any]) -> str:
    return f"{100 * frame['strain_x']:.3f}, {100 * frame['strain_y']:.3f}"


def _mode(frame: dict[str, Any], i: int) -> dict[str, Any]:
    """Mode number i, from 0; empty if the photograph has fewer."""
    modes = frame["modes"]
    return dict(modes[i]) if i < len(modes) else {}


def _pattern(frame: dict[str, Any], i: int) -> str:
    mode = _mode(frame, i)
    if not mode:
        return "no mode"
    seen = "seen" if mode["observable"] else "not seen"
    return f"{seen}, fixed" if mode["fixed"] else seen


def _largest(frame: dict[str, Any], i: int) -> str:
    mode = _mode(frame, i)
    return f"{mode['largest_px']:.3g}" if mode else "–"


def _amplitude(frame: dict[str, Any], i: int) -> str:
    mode = _mode(frame, i)
    if not mode:
        return "–"
    parts = [mode["v_max_mm"], mode["v_max_sd_noise_mm"], mode["v_max_sd_model_error_mm"]]
    value, noise, leftover = ("–" if p is None else f"{p:.3g}" for p in parts)
    return f"{value} ± {noise} / {leftover}"


def _waves(frame: dict[str, Any], i: int) -> str:
    waves = _mode(frame, i).get("waves", [])
    return " ".join(f"({wave['xi'][0]:.4f}, {wave['xi'][1]:.4f})" for wave in waves) or "–"


def print_study(summary: dict[str, Any], out: Path) -> None:
    """Print a study's findings, its failures, and the file of the report last."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(summary['title'])}[/bold]", soft_wrap=True)
    for sentence in summary["text"]:
        console.print(f"- {escape(sentence)}", soft_wrap=True)
    for failure in summary["failed"]:
        console.print(
            f"[yellow]failed:[/yellow] cases/{failure['file']}: {escape(str(failure['error']))}",
            soft_wrap=True,
        )
    took = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in Stages(out).timings.items())
    console.print(f"{summary['cases']} cases; {took}", soft_wrap=True, markup=False)
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)
