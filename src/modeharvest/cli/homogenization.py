"""The command that homogenizes a specimen with modes."""

from __future__ import annotations

from modeharvest.cli.messages import CaseName, OutFolder, bars


def homogenize(case: CaseName, out: OutFolder) -> None:
    """Homogenize a specimen with modes, measured or computed (needs dolfinx).

    Micromorphic homogenization: finite elements for u and the modes' amplitudes v, with an RVE at
    each quadrature point. Writes the critical strain, forces and energies, with standard deviations
    due to a measured mode's error bars, and a comparison with a direct simulation of all holes
    (report.html, summary.json, homogenized.h5), and the RVE with its modes and moduli for other
    codes (rve.h5, rve.mat). The mode of 'paper-homogenized' is measured in the images of the
    paper's virtual experiment, which is run in DIR/experiment.
    """
    from modeharvest.report.homogenization import homogenization_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.homogenization.case import HomogenizationCase

    checked = HomogenizationCase.read(case)
    from modeharvest.runs.homogenization.pipeline import HomogenizationRun

    with bars() as progress:
        summary = HomogenizationRun(checked, out, progress, case).all()
    print_report(homogenization_report(summary), out)
