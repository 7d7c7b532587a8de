"""A study as a case: a TOML file, or a few lines of Python, checked beforehand.

::

    title = "..."
    [study]        # kind = "robustness", "noise", "systematic", "modes" or "resolution"; options
    [experiment]   # the subject, as in every virtual experiment: see modeharvest.case
    [imaging]
    [correlation]

The table ``[study]`` is one of the dataclasses in :mod:`modeharvest.validation.studies`. In
Python::

    case = StudyCase(study=Robustness(starts=20, radius=0.2))
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, Self

from pydantic import field_validator, model_validator

from modeharvest.case import Case
from modeharvest.case_file import checked, kind_of, of_kind, read_tables
from modeharvest.errors import InputError
from modeharvest.typed import nearest
from modeharvest.validation.resolution.study import Resolution
from modeharvest.validation.studies.modes.study import Modes
from modeharvest.validation.studies.noise.study import Noise
from modeharvest.validation.studies.robustness.study import Robustness
from modeharvest.validation.studies.study import Study
from modeharvest.validation.studies.systematic.study import Systematic

KINDS: dict[str, type[Any]] = {
    "robustness": Robustness,
    "noise": Noise,
    "systematic": Systematic,
    "resolution": Resolution,
    "modes": Modes,
}
_SHIPPED = resources.files("modeharvest") / "studies"
_QUICK = 2.0
"""A quick study's pixels are that much larger."""


class StudyCase(Case):
    """A question, and the virtual experiment that it is asked of."""

    study: Any = Robustness()

    @field_validator("study", mode="before")
    @classmethod
    def _of_kind(cls, table: Any) -> Any:
        return of_kind(table, KINDS, "study") if isinstance(table, Mapping) else table

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        study: Study = self.study
        study.require(self.correlation)
        strains = self.experiment.strains
        if not any(abs(study.strain - e) < 1e-9 for e in strains):
            raise InputError(
                f"study: expected a strain among experiment.strains = {list(strains)}, got "
                f"{study.strain}"
            )
        if self.imaging.distortion is not None:
            raise InputError(
                "study: expected a perfect lens, got imaging.distortion; studies measure ideal "
                "images"
            )
        return self

    @property
    def kind(self) -> str:
        """The name of the question."""
        return next(name for name, kind in KINDS.items() if isinstance(self.study, kind))

    def quick(self) -> StudyCase:
        """A first look: fewer cases, on images of a quarter of the pixels."""
        imaging = replace(self.imaging, pixel_size=_QUICK * self.imaging.pixel_size)
        changed = {"study": self.study.quick(), "imaging": imaging}
        return StudyCase(**{n: getattr(self, n) for n in type(self).model_fields} | changed)

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, the study and materials by their kinds."""
        return {**super().plain(), "study": kind_of(self.study, KINDS)}


def shipped_studies() -> dict[str, str]:
    """Names and titles of the studies that come with the package."""
    paths = sorted(Path(str(p)) for p in _SHIPPED.iterdir() if p.name.endswith(".toml"))
    return {p.stem: str(tomllib.loads(p.read_text("utf-8"))["title"]) for p in paths}


def read_study(name: str | Path) -> StudyCase:
    """Read a study by the name of a shipped one or by the path of a TOML file.

    Raises
    ------
    InputError
        If there is no such study, it is not TOML, a key is unknown (the nearest known one is
        suggested), a value is out of its range, or options contradict each other.
    """
    path = Path(name)
    if path.suffix != ".toml" and not path.is_file():
        known = list(shipped_studies())
        if str(name) not in known:
            raise InputError(f"unknown study {str(name)!r}{nearest(str(name), known)}")
        path = Path(str(_SHIPPED / f"{name}.toml"))
    tables = read_tables(path)
    if "study" not in tables:
        raise InputError(
            f"{name}: expected a table [study] with a kind among {list(KINDS)}, got none; a "
            f"virtual experiment by itself is run with 'modeharvest run {name} --out DIR'"
        )
    return checked(StudyCase, tables, name)
