"""The command that identifies material and supports from images and forces."""

from __future__ import annotations

from typing import Annotated

import typer

from modeharvest.cli.messages import OutFolder, bars


def identify(
    experiment: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT.toml",
            help="Model, unknowns and data; or a shipped case: identify-twin, identify-paper.",
        ),
    ],
    out: OutFolder,
) -> None:
    """Identify material, supports and holes of a test from images and forces (needs dolfinx).

    Integrated digital image correlation with a finite-element model's parameters as unknowns; the
    images may be replaced by a displacement field of any code. Writes the parameters with standard
    deviations and correlations, the model's states, report.html and summary.json to DIR. Begin
    with 'modeharvest cases identify-twin > experiment.toml', a case that simulates its own data.
    """
    from modeharvest.report.identification import identification_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.identification.case import IdentificationCase
    from modeharvest.runs.identification.pipeline import IdentificationRun

    case = IdentificationCase.read(experiment)
    with bars() as progress:
        summary = IdentificationRun(case, out, progress, experiment).all()
    print_report(identification_report(summary), out)
