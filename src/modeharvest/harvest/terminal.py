"""A harvest's ``summary.json`` as a short table on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table


def print_harvest(summary: dict[str, Any], out: Path) -> None:
    """Print what was found, the file of the report last."""
    console = Console(highlight=False)
    table = Table(title=escape(summary["title"]), title_justify="left")
    table.add_column("quantity")
    frames = summary["frames"]
    for frame in frames:
        table.add_column(escape(frame["name"]), justify="right")
    for label, cell in _ROWS.items():
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
    console.print(f"report: {out / 'report.html'}")


def _skipped(summary: dict[str, Any]) -> list[tuple[str, str]]:
    found = summary.get("skipped", [])
    return [(s["name"], s["reason"]) if isinstance(s, dict) else (s[0], s[1]) for s in found]


def _mode(frame: dict[str, Any]) -> dict[str, Any]:
    """The first mode; empty without one."""
    modes = frame["modes"]
    return dict(modes[0]) if modes else {}


def _strain(frame: dict[str, Any]) -> str:
    return f"{100 * frame['strain_x']:.3f}, {100 * frame['strain_y']:.3f}"


def _pattern(frame: dict[str, Any]) -> str:
    mode = _mode(frame)
    if not mode:
        return "no mode"
    seen = "seen" if mode["observable"] else "not seen"
    return f"{seen}, held" if mode["held"] else seen


def _largest(frame: dict[str, Any]) -> str:
    return f"{_mode(frame).get('largest_px', 0.0):.3g}"


def _amplitude(frame: dict[str, Any]) -> str:
    mode = _mode(frame)
    if not mode:
        return "–"
    parts = [mode["v_max_mm"], mode["v_max_sd_noise_mm"], mode["v_max_sd_leftover_mm"]]
    value, noise, leftover = ("–" if p is None else f"{p:.3g}" for p in parts)
    return f"{value} ± {noise} / {leftover}"


def _waves(frame: dict[str, Any]) -> str:
    waves = _mode(frame).get("waves", [])
    return " ".join(f"({wave['xi'][0]:.4f}, {wave['xi'][1]:.4f})" for wave in waves)


_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "compression along x, y [%]": _strain,
    "pattern": _pattern,
    "largest v1 phi1 [px]": _largest,
    "largest v1 [mm]": _amplitude,
    "wave vectors [1/l]": _waves,
    "left over (w), rms [px]": lambda frame: f"{frame['leftover_px']:.3g}",
    "iterations, all levels": lambda frame: str(frame["iterations_all_levels"]),
    "outcome": lambda frame: str(frame["outcome"]),
}
