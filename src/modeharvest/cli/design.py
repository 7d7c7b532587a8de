"""The command that predicts the errors of a test before it is made."""

from __future__ import annotations

from modeharvest.cli.messages import CaseName, OutFolder, SolutionFile, bars


def design(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Predict the errors of v1, wave numbers and phases in a test before it is made.

    Uses the Cramér–Rao bound and no images. Finds standard deviations by camera noise, the pixel
    size, speckle, noise, exposures and light for wanted errors, and the effect of polynomial
    degrees and strain. Writes report.html with tables and a map, and summary.json. CASE is a
    virtual experiment; its table "design" states the wanted errors (docs/how-to/design.md).
    """
    from modeharvest.report.design import design_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.design import DesignCase

    checked = DesignCase.read(case)
    from modeharvest.runs.design import DesignRun

    with bars() as progress:
        summary = DesignRun(checked, out, progress, solution, case).all()
    print_report(design_report(summary), out)
