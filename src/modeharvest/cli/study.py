"""The command that studies how good the measurement is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.arguments import SolutionFile, folder_option
from modeharvest.cli.messages import bars


def study(
    name: Annotated[
        str,
        typer.Argument(
            metavar="STUDY",
            help="robustness, noise, systematic, modes or resolution; or a TOML file of your own.",
        ),
    ],
    out: Annotated[Path, folder_option("--out", "Folder for everything the study leaves.")],
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; 2 by default.", metavar="N")
    ] = None,
    memory: Annotated[
        str, typer.Option(help="Most that each of them may take.", metavar="BYTES")
    ] = "4GiB",
    scheduler: Annotated[
        str | None,
        typer.Option(help="A dask scheduler instead, e.g. tcp://host:8786.", metavar="ADDRESS"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer cases, larger pixels: a first look.")
    ] = False,
    solution: SolutionFile = None,
) -> None:
    """Study how good the measurement is: many cases, run by several processes.

    Leaves table.csv, report.html and summary.json in DIR. Run the same command again after an
    interruption: finished cases are not repeated.
    """
    from modeharvest.studies.terminal import print_study, run

    with bars() as progress:
        summary = run(name, out, workers, memory, scheduler, quick, solution, progress)
    print_study(summary, out)
