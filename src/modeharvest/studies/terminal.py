"""The command ``modeharvest study``: its options, and what is printed at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from modeharvest.errors import InputError
from modeharvest.progress import Progress
from modeharvest.stages import Stages
from modeharvest.studies.case import read_study
from modeharvest.studies.pipeline import StudyPipeline
from modeharvest.validation.campaign import Workers


def run(
    name: str,
    out: Path,
    workers: int | None,
    memory: str,
    scheduler: str | None,
    quick: bool,
    solution: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """Run a study as the command line says; returns the content of ``summary.json``.

    Raises
    ------
    InputError
        If options contradict each other, or the study can't be read or run.
    """
    if scheduler is not None and workers is not None:
        raise InputError(
            "expected --workers or --scheduler, got both: a scheduler has workers of its own"
        )
    case = read_study(name)
    crew = Workers(2 if workers is None else workers, memory, scheduler)
    words = ["modeharvest study", name, "--out DIR"]
    words += ["--quick"] if quick else []
    words += ["--solution FILE"] if solution else []
    return StudyPipeline(
        case.quick() if quick else case, out, crew, progress, solution, " ".join(words)
    ).all()


def print_study(summary: dict[str, Any], out: Path) -> None:
    """Print a study's sentences, its failures, and the file of the report last."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(summary['title'])}[/bold]", soft_wrap=True)
    for sentence in summary["sentences"]:
        console.print(f"- {escape(sentence)}", soft_wrap=True)
    for failure in summary["failed"]:
        console.print(
            f"[yellow]failed:[/yellow] cases/{failure['file']}: {escape(str(failure['error']))}",
            soft_wrap=True,
        )
    took = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in Stages(out).timings.items())
    console.print(f"{summary['cases']} cases; {took}", soft_wrap=True, markup=False)
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)
