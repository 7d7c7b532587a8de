"""A study from its case to its report, in one folder in which an interrupted run is continued.

For its files see docs/how-to/studies.md. Its TOML file has the tables of a virtual experiment and
``[study]``: a kind ("robustness", "noise", "systematic", "modes", "resolution") and its options.
In Python: ``StudyCase(study=RobustnessStudy(initial_guesses=20, radius=0.2))``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Self

import pandas as pd
from pydantic import model_validator

from modeharvest.fem.field import Solution
from modeharvest.report.model.content import Findings, study_report
from modeharvest.report.model.output import write_page, write_tables
from modeharvest.report.studies.modes import report_modes
from modeharvest.report.studies.noise import report_noise
from modeharvest.report.studies.resolution import report_resolution
from modeharvest.report.studies.robustness import report_robustness
from modeharvest.report.studies.systematic import report_systematic
from modeharvest.runs.case import Case, of_kind, read_tables, with_kind
from modeharvest.runs.experiment import Run
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, require_writable, write_json
from modeharvest.util.progress import named
from modeharvest.util.stages import StagedRun, exclusive, versions
from modeharvest.util.typed import to_plain
from modeharvest.validation.campaign import Campaign
from modeharvest.validation.studies.modes import MeasuredModesStudy
from modeharvest.validation.studies.noise import NoiseStudy
from modeharvest.validation.studies.resolution import ResolutionStudy
from modeharvest.validation.studies.robustness import RobustnessStudy
from modeharvest.validation.studies.study import ImagePairSpec, Study
from modeharvest.validation.studies.systematic import SystematicStudy
from modeharvest.validation.workers import Workers

KINDS: dict[str, type[Any]] = {
    "robustness": RobustnessStudy,
    "noise": NoiseStudy,
    "systematic": SystematicStudy,
    "resolution": ResolutionStudy,
    "modes": MeasuredModesStudy,
}
_QUICK = 2.0
"""Factor by which the pixel size of a quick study is larger."""


class StudyCase(Case):
    """A study's options, and the virtual experiment that is studied."""

    table = "study"

    study: Annotated[Any, of_kind(KINDS, "study")] = RobustnessStudy()

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a study like any other case; InputError if it has no table ``[study]``."""
        if "study" not in read_tables(name, "noise"):
            raise InputError(
                f"{name}: expected a table [study] with a kind among {list(KINDS)}, got none; a "
                f"virtual experiment by itself is run with 'modeharvest run {name} --out DIR'"
            )
        return super().read(name)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        study: Study[Any] = self.study
        study.require(self.correlation)
        strains = list(self.experiment.strains)
        if not any(abs(study.strain - e) < 1e-9 for e in strains):
            got = f"{strains}, got {study.strain}"
            raise InputError(f"study: expected a strain among experiment.strains = {got}")
        if self.imaging.distortion is not None or self.calibration is not None:
            got = "calibration" if self.imaging.distortion is None else "imaging.distortion"
            raise InputError(
                f"study: expected a perfect lens, got {got}; studies measure ideal images"
            )
        return self

    @property
    def kind(self) -> str:
        """The kind of study, such as "noise"."""
        return next(name for name, kind in KINDS.items() if isinstance(self.study, kind))

    def quick(self) -> StudyCase:
        """A quick version: fewer cases, on images with a quarter of the pixels."""
        imaging = replace(self.imaging, pixel_size=_QUICK * self.imaging.pixel_size)
        return self.model_copy(update={"study": self.study.quick(), "imaging": imaging})

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values; study and material have their ``kind``."""
        return {**super().plain(), "study": with_kind(self.study, KINDS)}


FINDINGS: dict[type[Any], Callable[[Any, str], Findings]] = {
    RobustnessStudy: report_robustness,
    NoiseStudy: report_noise,
    SystematicStudy: report_systematic,
    ResolutionStudy: report_resolution,
    MeasuredModesStudy: report_modes,
}
"""For each kind of study, the function that reports its analysis, given a text on the seeds."""


@dataclass(frozen=True)
class StudyAnalysis(StagedRun[StudyCase]):
    """Runs a study: makes images, runs its cases with ``workers``, reports findings."""

    workers: Workers = field(default_factory=Workers)
    solution: Path | None = None
    """A solution file (HDF5) to use instead of simulating."""
    command: str = "modeharvest study STUDY --out DIR"
    """The command that reproduces the report, shown in it."""

    def pair_spec(self) -> ImagePairSpec:
        """Specification of the image pair that is measured."""
        case = self.case
        return ImagePairSpec(case.experiment, case.imaging, case.correlation, self._solution)

    def _solution(self) -> Solution:
        """The exact displacements, simulated or read from a file; writes ``solution.h5``."""
        solution = Run(self.case, self.folder, self.progress, self.solution).solved()
        if self.solution is not None:
            solution.write(self.folder / "solution.h5")
        return solution

    def all(self) -> dict[str, Any]:
        """Run all unfinished parts of the study; returns the content of ``summary.json``.

        Raises InputError if no case succeeded; the folder can't be written to, holds other files or
        is used by another process; a scheduler can't be reached, or its workers can't do the work.
        """
        folder, study = self.folder.resolve(), self.case.study
        with exclusive(folder):
            require_writable(folder)
            _claim(folder, self.case.kind)
            self.workers.require_ready(study.function, folder)
            with self.timed("solution and images"):
                cases = study.prepare(self.pair_spec(), folder, self.progress)
            campaign = Campaign(study.function, cases, folder)
            with self.timed("cases"):
                listener = named(self.progress, f"study: {len(cases)} cases")
                table = campaign.run(self.workers, listener)
            if (table["error"] != "").all():
                first = table["error"].iloc[0]
                raise InputError(f"all {len(table)} cases failed; the first: {first}")
            with self.timed("findings"):
                findings = FINDINGS[type(study)](study.analyse(table, folder), study.seeds)
            return self._write_report(campaign, table, findings)

    def _write_report(
        self, campaign: Campaign, table: pd.DataFrame, findings: Findings
    ) -> dict[str, Any]:
        """Write tables, ``summary.json`` and ``report.html``."""
        tables = [*findings.tables, *findings.attachments]
        files = {
            "table.csv": "every case: its values, error, result",
            **{table.file: table.title for table in tables},
            "summary.json": "the findings' numbers and text, and the failures",
            "timings.json": "what the stages took [s]",
        }
        summary = self._summary(campaign, table, findings)
        write_tables(tables, self.folder)
        write_json(self.folder / "summary.json", summary)
        write_page(study_report(summary, findings, files), self.folder / "report.html")
        return summary

    def _summary(
        self, campaign: Campaign, table: pd.DataFrame, findings: Findings
    ) -> dict[str, Any]:
        """The content of ``summary.json``; for its keys see docs/how-to/studies.md."""
        failed = table[table["error"] != ""]
        return {
            "title": self.case.title or self.case.kind.capitalize(),
            "kind": self.case.kind,
            "command": self.command,
            "seeds": self.case.study.seeds,
            "question": self.case.study.question,
            "text": list(findings.text),
            "numbers": to_plain(findings.numbers),
            "cases": len(table),
            "failed": [
                {"file": campaign.path(campaign.cases[k]).name, "error": failed["error"][k]}
                for k in failed.index
            ],
            "other_results_by_version": campaign.of_other_versions(),
            "versions": versions("numpy", "scipy", "numba", "distributed"),
            "case": self.case.plain(),
        }


def _claim(folder: Path, kind: str) -> None:
    """Mark a folder as that of a kind of study; InputError if it holds anything else."""
    path, wanted = folder / "study.json", f"a {kind} study"
    holds = wanted
    if path.is_file():
        with suppress(InputError, KeyError, TypeError):  # ignored if damaged
            holds = f"a {read_json(path)['kind']} study"
    elif (folder / "summary.json").exists():
        holds = "something that is no study (it has a summary.json, but no study.json)"
    if holds != wanted:
        raise InputError(
            f"expected an empty folder or one with {wanted}, got {folder}, which holds {holds}; "
            "take another with --out"
        )
    write_json(path, {"kind": kind})
