"""A study from its case to its report, in one folder that a killed run can go on in.

::

    study.json               which kind of study has this folder
    solution.h5              the exact displacements of the subject
    subjects/ images/        pairs of images, and how they are correlated
    cases/KEY.json           one file for each case, written when it is done
    table.csv                one row for each case
    timings.json             what it took; all else is the same after every run
    *.csv                    the report's tables
    summary.json report.html what it tells
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

from modeharvest import __version__
from modeharvest.errors import InputError
from modeharvest.fem.field import Solution
from modeharvest.files import atomic, read_json, require_writable, write_json
from modeharvest.pipeline import Run
from modeharvest.progress import Progress, named, silent
from modeharvest.stages import Stages, exclusive
from modeharvest.studies.case import StudyCase, read_study
from modeharvest.validation.campaign import Campaign, Workers
from modeharvest.validation.resolution.findings import report_resolution
from modeharvest.validation.resolution.study import Resolution
from modeharvest.validation.studies.modes.findings import report_modes
from modeharvest.validation.studies.modes.study import Modes
from modeharvest.validation.studies.noise.findings import report_noise
from modeharvest.validation.studies.noise.study import Noise
from modeharvest.validation.studies.report import StudyRun, slug, write_study_report
from modeharvest.validation.studies.robustness.findings import report_robustness
from modeharvest.validation.studies.robustness.study import Robustness
from modeharvest.validation.studies.study import Findings, Study
from modeharvest.validation.studies.subject import Subject
from modeharvest.validation.studies.systematic.findings import report_systematic
from modeharvest.validation.studies.systematic.study import Systematic

FINDINGS: dict[type[Any], Callable[[Any, pd.DataFrame, Path], Findings]] = {
    Robustness: report_robustness,
    Noise: report_noise,
    Systematic: report_systematic,
    Resolution: report_resolution,
    Modes: report_modes,
}
"""For each kind of study what reads its table: failed cases have an ``error``, and no result."""


@dataclass(frozen=True)
class StudyPipeline:
    """A study, the folder it leaves its files in, who works and who listens.

    Parameters
    ----------
    case
        What to ask of which specimen.
    folder
        Where; made if it does not exist.
    workers
        Who runs the cases.
    progress
        Listener.
    solution
        A solution file to use instead of simulating.
    command
        What makes it again, for the report.
    """

    case: StudyCase
    folder: Path
    workers: Workers = field(default_factory=Workers)
    progress: Progress = silent
    solution: Path | None = None
    command: str = "modeharvest study STUDY --out DIR"

    def subject(self) -> Subject:
        """What is measured."""
        case = self.case
        return Subject(case.experiment, case.imaging, case.correlation, self._solution)

    def _solution(self) -> Solution:
        """The exact displacements, simulated or read from a file; leaves ``solution.h5``."""
        solution = Run(self.case, self.folder, self.progress, self.solution).solved()
        if self.solution is not None:
            solution.write(self.folder / "solution.h5")
        return solution

    def all(self) -> dict[str, Any]:
        """Run what is missing of the study; returns the content of ``summary.json``.

        Raises
        ------
        InputError
            If no case succeeded, the folder can't be written to, holds anything else or is
            another process's, a scheduler is not there, or its workers can't do the work.
        """
        folder, study = self.folder.resolve(), self.case.study
        with exclusive(folder):
            require_writable(folder)
            _claim(folder, self.case.kind)
            self.workers.require_ready(study.function, folder)
            with self._timed("solution and images"):
                cases = study.prepare(self.subject(), folder, self.progress)
            campaign = Campaign(study.function, cases, folder)
            with self._timed("cases"):
                listener = named(self.progress, f"study: {len(cases)} cases")
                table = campaign.run(self.workers, listener)
            if (table["error"] != "").all():
                first = table["error"].iloc[0]
                raise InputError(f"all {len(table)} cases failed; the first: {first}")
            with self._timed("findings"):
                findings = FINDINGS[type(study)](study, table, folder)
            return self._tell(campaign, table, findings)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Take down what a stage takes."""
        begin = time.perf_counter()
        yield
        Stages(self.folder).took(stage, time.perf_counter() - begin)

    def _tell(self, campaign: Campaign, table: pd.DataFrame, findings: Findings) -> dict[str, Any]:
        """Leave tables, ``summary.json`` and ``report.html``."""
        files = {"table.csv": "every case: its values, error, result"}
        for title, part in {**findings.tables, **findings.attachments}.items():
            name = f"{slug(title)}.csv"
            files[name] = title
            with atomic(self.folder / name) as temporary:
                part.to_csv(temporary, index=False)
        files["summary.json"] = "the findings' numbers and sentences, and the failures"
        files["timings.json"] = "what the stages took [s]"
        summary = self._summary(campaign, table, findings)
        write_json(self.folder / "summary.json", summary)
        study: Study = self.case.study
        run = StudyRun(
            title=summary["title"],
            question=study.question,
            findings=findings,
            command=self.command,
            seeds=study.seeds,
            case=summary["case"],
            notes=_notes(summary),
            files=files,
            versions=summary["versions"],
        )
        write_study_report(self.folder / "report.html", run)
        return summary

    def _summary(
        self, campaign: Campaign, table: pd.DataFrame, findings: Findings
    ) -> dict[str, Any]:
        """The content of ``summary.json``; docs/studies.md tells its keys."""
        failed = table[table["error"] != ""]
        return {
            "title": self.case.title or self.case.kind.capitalize(),
            "kind": self.case.kind,
            "command": self.command,
            "seeds": self.case.study.seeds,
            "sentences": list(findings.sentences),
            "numbers": _plain(dict(findings.numbers)),
            "cases": len(table),
            "failed": [
                {"file": campaign.path(campaign.cases[k]).name, "error": failed["error"][k]}
                for k in failed.index
            ],
            "other_results_by_version": campaign.of_other_versions(),
            "versions": _versions(),
            "case": self.case.plain(),
        }


def study(
    name: str | Path | StudyCase,
    folder: Path | str,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Run a study; what ``modeharvest study`` does.

    Parameters
    ----------
    name
        A shipped study's name, the path of a TOML file, or a StudyCase.
    folder
        Where to leave the files.
    workers
        Who runs the cases; two processes of this machine by default.
    progress
        Listener.

    Returns
    -------
    dict
        The content of ``summary.json``.
    """
    case = name if isinstance(name, StudyCase) else read_study(name)
    return StudyPipeline(case, Path(folder), workers or Workers(), progress).all()


def _claim(folder: Path, kind: str) -> None:
    """Take a folder for a kind of study; InputError if it holds anything else."""
    path, holds = folder / "study.json", f"a {kind} study"
    if path.is_file():
        holds = f"a {_kind_in(path, kind)} study"
    elif (folder / "summary.json").exists():
        holds = "something that is no study (it has a summary.json, but no study.json)"
    if holds != f"a {kind} study":
        raise InputError(
            f"expected an empty folder or one with a {kind} study, got {folder}, which holds "
            f"{holds}; take another with --out"
        )
    write_json(path, {"kind": kind})


def _kind_in(path: Path, kind: str) -> str:
    """The kind that a folder's ``study.json`` says; the one asked for if that is damaged."""
    try:
        return str(read_json(path)["kind"])
    except (InputError, KeyError, TypeError):
        return kind


def _notes(summary: dict[str, Any]) -> tuple[str, ...]:
    """What to keep in mind of how the study went."""
    said = []
    if summary["failed"]:
        first = summary["failed"][0]
        said.append(
            f"{len(summary['failed'])} of {summary['cases']} cases failed; their tracebacks are "
            f"in cases/. The first, {first['file']}: {first['error']}"
        )
    for other, count in summary["other_results_by_version"].items():
        of = "other options" if other == __version__ else f"modeharvest {other}"
        said.append(f"Stored results of {of}, {count} in number, were left alone and not mixed in.")
    said.append(
        "A virtual experiment: what a real one adds (a lens, light, friction, a specimen that is "
        "not plane) is not in it."
    )
    return tuple(said)


def _plain(value: Any) -> Any:
    """Values as JSON knows them: NaN as null, numpy's numbers as numbers."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and value != value else value


def _versions() -> dict[str, str]:
    libraries = ("numpy", "scipy", "numba", "distributed")
    return {"modeharvest": __version__} | {name: version(name) for name in libraries}
