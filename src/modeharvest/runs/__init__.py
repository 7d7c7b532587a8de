"""Runs: a case from its TOML file to a folder of results, in stages that can be resumed.

Each kind of case has a module or a folder: virtual experiments, lattices, homogenized specimens,
photographs and the twin of a real experiment, studies, designs of tests, benchmarks for DIC codes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from modeharvest.util.progress import Progress, silent

if TYPE_CHECKING:
    from modeharvest.runs.case import CaseModel


def run(
    case: str | Path | CaseModel, folder: Path | str, progress: Progress = silent
) -> dict[str, Any]:
    """Run a case of any kind, from its options to its report; finished stages are not repeated.

    ``case``: a shipped case's name, the path of a TOML file, or the case itself: a virtual
    experiment, the twin of a real one, a lattice, a homogenized specimen, a design, a study, or
    photographs. ``folder``: where files are written. Returns the content of ``summary.json``.
    """
    from modeharvest.runs.case import Case, CaseModel, read_tables, table_of_kind

    known = isinstance(case, CaseModel)
    kind = case.table if isinstance(case, CaseModel) else table_of_kind(read_tables(case))
    source, folder = "CASE" if known else str(case), Path(folder)
    if kind == "lattice":
        from modeharvest.runs.lattice.case import LatticeCase
        from modeharvest.runs.lattice.pipeline import LatticeAnalysis

        return LatticeAnalysis(LatticeCase.of(case), folder, progress, source).all()
    if kind == "homogenization":
        from modeharvest.runs.homogenization.case import HomogenizationCase
        from modeharvest.runs.homogenization.pipeline import HomogenizationRun

        return HomogenizationRun(HomogenizationCase.of(case), folder, progress, source).all()
    if kind == "study":
        from modeharvest.runs.study import StudyAnalysis, StudyCase

        return StudyAnalysis(StudyCase.of(case), folder, progress).all()
    if kind == "design":
        from modeharvest.runs.design import DesignCase, DesignRun

        return DesignRun(DesignCase.of(case), folder, progress, source=source).all()
    if kind == "images":
        from modeharvest.runs.photographs.pipeline import harvest

        return harvest(case, folder, progress)
    experiment = Case.of(case)
    if experiment.calibration is not None:
        from modeharvest.runs.photographs.twin import TwinRun

        return TwinRun(experiment, folder, progress).all()
    from modeharvest.runs.experiment import Run

    return Run(experiment, folder, progress).all()
