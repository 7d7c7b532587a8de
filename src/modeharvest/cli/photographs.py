"""The command that harvests modes from photographs of a test."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.arguments import OutFolder
from modeharvest.cli.messages import bars


def _example(wanted: bool) -> None:
    if wanted:
        from modeharvest.harvest.example import EXAMPLE

        print(EXAMPLE, end="")
        raise typer.Exit


def harvest(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT.toml", help="What there are photographs of.")
    ],
    out: OutFolder,
    example: Annotated[
        bool,
        typer.Option(
            "--example",
            callback=_example,
            is_eager=True,
            help="Print a commented EXPERIMENT.toml with every option, and stop.",
        ),
    ] = False,
) -> None:
    """Harvest modes from photographs of a test: v0, v1 and phi1 with error bars.

    The TOML file names the reference and the deformed images, the pixel size and the cell size;
    all else is found or has a default. Begin with 'modeharvest harvest --example >
    experiment.toml'. Leaves results/, report.html and summary.json in DIR. Run the same command
    again after an interruption: finished photographs are not measured again.
    """
    from modeharvest.harvest.pipeline import harvest as harvest_photographs
    from modeharvest.harvest.terminal import print_harvest

    with bars() as progress:
        summary = harvest_photographs(experiment, out, progress)
    print_harvest(summary, out)
