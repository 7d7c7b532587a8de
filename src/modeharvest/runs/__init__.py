"""Runs: a case from its TOML file to a folder of results, in stages that can be resumed.

A module, or a folder, for each kind: virtual experiments, lattices, photographs, studies,
benchmarks for DIC codes, and the twin of a real experiment.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from modeharvest.util.progress import Progress, silent

if TYPE_CHECKING:
    from modeharvest.runs.case import Case
    from modeharvest.runs.lattice.case import LatticeCase


def run(
    case: str | Path | Case | LatticeCase, folder: Path | str, progress: Progress = silent
) -> dict[str, Any]:
    """Run a case of any kind, from its options to its report; what is finished is not done again.

    Parameters
    ----------
    case
        A shipped case's or study's name, the path of a TOML file, or the case itself: a virtual
        experiment, the twin of a real one, an infinite lattice, or a study.
    folder
        Where to leave the files.
    progress
        Listener.

    Returns
    -------
    dict
        The content of ``summary.json``.
    """
    from modeharvest.runs.case import Case, TwinCase, read_case, read_tables
    from modeharvest.runs.lattice.case import LatticeCase, read_lattice_case
    from modeharvest.runs.study import StudyAnalysis, StudyCase, read_study, shipped_studies

    folder, source = Path(folder), "CASE"
    if not isinstance(case, (Case, LatticeCase)):
        source, study = str(case), str(case) in shipped_studies()
        tables = {"study": {}} if study else read_tables(case)
        if "lattice" in tables:
            case = read_lattice_case(case)
        else:
            case = read_study(case) if "study" in tables else read_case(case)
    if isinstance(case, LatticeCase):
        from modeharvest.runs.lattice.pipeline import LatticeAnalysis

        return LatticeAnalysis(case, folder, progress, source).all()
    if isinstance(case, StudyCase):
        return StudyAnalysis(case, folder, progress=progress).all()
    if isinstance(case, TwinCase):
        from modeharvest.runs.twin import TwinRun

        return TwinRun(case, folder, progress).all()
    from modeharvest.runs.experiment import Run

    return Run(case, folder, progress).all()
