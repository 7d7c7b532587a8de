"""The root of the command line: its commands, and what becomes of errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer

from modeharvest import __version__
from modeharvest.cli import benchmark, cases, experiment, lattice, messages, photographs, study
from modeharvest.errors import InputError, MissingDependencyError
from modeharvest.ranks import is_first

app = typer.Typer(
    help=(
        "A virtual laboratory for integrated digital image correlation (IDIC) on mechanical "
        "metamaterials: buckle a cellular elastomer, make speckle images whose truth is known at "
        "every pixel, measure them, and see how wrong the measurement was, and why.\n\n"
        "Start with: [bold]modeharvest run paper-virtual --out out/demo[/bold], or, for the modes "
        "of an infinite lattice, [bold]modeharvest modes square-lattice --out out/square[/bold]"
    ),
    epilog="Exit codes: 0 done, 2 the input can't be used (one line says why), 130 interrupted.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
benchmark_app = typer.Typer(
    help="Image sets for any DIC code, whose truth is kept apart.", no_args_is_help=True
)

_FAMILIES: dict[str, tuple[Callable[..., None], ...]] = {
    "A virtual experiment": (
        experiment.run,
        experiment.fem,
        experiment.image,
        experiment.correlate,
        experiment.validate,
    ),
    "An infinite lattice": (lattice.bloch, lattice.modes),
    "Photographs of a test": (photographs.harvest,),
    "How good a measurement is": (study.study, benchmark.score),
    "To begin with": (cases.cases,),
}
for family, commands in _FAMILIES.items():
    for command in commands:
        app.command(rich_help_panel=family)(command)
for command in (benchmark.make, benchmark.star, benchmark.resolution):
    benchmark_app.command()(command)
app.add_typer(benchmark_app, name="benchmark", rich_help_panel="How good a measurement is")


def _version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point of the ``modeharvest`` command."""
    if is_first():
        _run()
    else:  # under mpirun one speaks for all
        messages.console.quiet = True
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            _run()


def _run() -> None:
    try:
        app()
    except (InputError, MissingDependencyError) as error:
        messages.tell_error(error)
        sys.exit(2)
    except messages.InterruptionError:
        messages.console.print(
            "interrupted; run the same command again to continue where it stopped"
        )
        sys.exit(130)
