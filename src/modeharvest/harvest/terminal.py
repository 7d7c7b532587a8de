"""A harvest's ``summary.json`` as a short table on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console


def print_harvest(summary: dict[str, Any], out: Path) -> None:
    """Print what was found, the file of the report last."""
    console = Console(highlight=False)
    console.print(summary["title"])
    console.print(f"report: {out / 'report.html'}")
