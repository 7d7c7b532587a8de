"""The command that designs a test before anything is cut or photographed."""

from __future__ import annotations

from modeharvest.cli.messages import CaseName, OutFolder, SolutionFile, bars


def design(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Predict how well a test will measure v1, wave numbers and phases, before it is made.

    By the Cramér–Rao bound, without an image: standard deviations by the camera's noise; which
    pixel size, speckle, noise, exposures and light a wanted error needs; how degrees and strains
    change it. Leaves report.html with tables and a map, and summary.json. CASE is a virtual
    experiment; its table "design" states the wanted errors (docs/how-to/design.md).
    """
    from modeharvest.report.design import design_report
    from modeharvest.report.model import print_report
    from modeharvest.runs.design import DesignCase

    checked = DesignCase.read(case)
    from modeharvest.runs.design import DesignRun

    with bars() as progress:
        summary = DesignRun(checked, out, progress, solution, case).all()
    print_report(design_report(summary), out)
