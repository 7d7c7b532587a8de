"""Introductory texts of the command line, and ``modeharvest demo``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.messages import bars, folder_option

CASE = "paper-virtual"
PIXEL_SIZE = 0.02
"""Pixel size [mm]: twice the case's, so that images have a quarter of its pixels."""

ABOUT = (
    "A virtual laboratory for integrated digital image correlation (IDIC) on mechanical "
    "metamaterials: buckle a cellular elastomer, make speckle images whose truth is known at "
    "every pixel, measure them, and see the errors of the measurement and their causes.\n\n"
    "Start with: [bold]modeharvest demo[/bold], then [bold]modeharvest run paper-virtual --out "
    "out/demo[/bold], or [bold]modeharvest harvest --example[/bold] for your own photographs."
)
EXIT_CODES = (
    "Exit codes: 0 done, 2 the input can't be used (one line says why), 70 a fault in the "
    "program (one line names a log file), 130 interrupted."
)
FIRST = """\
modeharvest {version}: integrated digital image correlation on mechanical metamaterials

  modeharvest demo                 begin here: measure a buckled specimen, and see the errors
  modeharvest doctor               check the installation, and what each command needs

Then, with your own:

  modeharvest harvest --example    photographs of a test: a commented case file to start from
  modeharvest measure REFERENCE DEFORMED... --out DIR     the displacement of any speckled surface
  modeharvest benchmark make paper-virtual --out DIR      images to grade a DIC code with
  modeharvest run paper-virtual --out DIR                 the paper's virtual experiment

All commands: modeharvest --help"""

NEXT = """\
Next:
  modeharvest cases {case} > mine.toml       change anything: every option, with units
  modeharvest run mine.toml --out out/mine
  modeharvest harvest --example              your own photographs"""


def demo(
    out: Annotated[Path, folder_option("--out", "Folder for the demo's results.")] = Path(
        "modeharvest-demo"
    ),
) -> None:
    """Make and measure images of a buckled specimen, and see the errors; needs no dolfinx.

    Uses the solution of the paper's specimen that comes with the package, and larger pixels than
    the paper; writes report.html to DIR. The first run compiles kernels, which are kept on disk.
    """
    from modeharvest.runs.case import Case, shipped_solution
    from modeharvest.runs.experiment import Run

    case = Case.read(CASE)
    title = "Demo: the paper's virtual experiment, with larger pixels"
    imaging = replace(case.imaging, pixel_size=PIXEL_SIZE)
    case = case.model_copy(update={"title": title, "imaging": imaging})
    with bars() as progress:
        summary = Run(case, out, progress, shipped_solution(CASE)).all()
    # The run has loaded these modules while kernels were compiled.
    from modeharvest.report.experiment import experiment_report
    from modeharvest.report.model.output import print_report

    print_report(experiment_report(summary), out)
    typer.echo("\n" + NEXT.format(case=CASE))
