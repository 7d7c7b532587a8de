"""A harvest's ``summary.json`` as a short table on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

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
    console.print(escape(buckling.get("sentence", "")))
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
    rows["left over (w), rms [px]"] = lambda frame: f"{frame['leftover_px']:.3g}"
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
    return f"{seen}, held" if mode["held"] else seen


def _largest(frame: dict[str, Any], i: int) -> str:
    mode = _mode(frame, i)
    return f"{mode['largest_px']:.3g}" if mode else "–"


def _amplitude(frame: dict[str, Any], i: int) -> str:
    mode = _mode(frame, i)
    if not mode:
        return "–"
    parts = [mode["v_max_mm"], mode["v_max_sd_noise_mm"], mode["v_max_sd_leftover_mm"]]
    value, noise, leftover = ("–" if p is None else f"{p:.3g}" for p in parts)
    return f"{value} ± {noise} / {leftover}"


def _waves(frame: dict[str, Any], i: int) -> str:
    waves = _mode(frame, i).get("waves", [])
    return " ".join(f"({wave['xi'][0]:.4f}, {wave['xi'][1]:.4f})" for wave in waves) or "–"
