"""A virtual experiment as a case: a TOML file turned into checked objects, faults told in one line.

A case is a pydantic model whose fields are the project's frozen dataclasses, so a case file,
``--help`` and the Python objects use the same names and units::

    title = "..."
    [experiment]              # fem.experiment.Experiment
    strains = [0.078, 0.128]
    [experiment.specimen]     # fem.specimen.Specimen
    [experiment.material]     # kind = "ogden" or "two-term-I1", and its constants
    [imaging]                 # imaging.spec.ImagingSpec
    [imaging.speckle]         # imaging.speckle.SpeckleSpec
    [imaging.distortion]      # imaging.distortion.CameraDistortion
    [correlation]             # idic.setup.Identification

A table ``[calibration]`` (imaging.calibration_target.CalibrationTarget) makes it the twin of a
real experiment: photographs through a lens that has to be calibrated first, to be harvested.
What all kinds of cases share is here too; infinite lattices, photographs and studies have modules
of their own.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError, field_validator

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import MATERIALS
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.distortion.target import CalibrationTarget
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.util.errors import InputError
from modeharvest.util.files import reading
from modeharvest.util.typed import CHECKS, made, nearest, plain, require_types, sentence

_SHIPPED = resources.files("modeharvest") / "cases"


class CaseModel(BaseModel):
    """What all kinds of cases have in common: no unknown keys, unchangeable, a title."""

    model_config = CHECKS

    title: str = ""


CaseType = TypeVar("CaseType", bound=CaseModel)


def shipped_cases() -> dict[str, str]:
    """Names and titles of the cases that come with the package."""
    return {name: str(tables["title"]) for name, tables in _shipped_tables().items()}


def case_text(name: str) -> str:
    """The TOML text of a shipped case, comments included: a start for one's own.

    Raises
    ------
    InputError
        If no case of that name is shipped; the nearest name is suggested.
    """
    if name not in shipped_cases():
        raise InputError(f"unknown case {name!r}{nearest(name, list(shipped_cases()))}")
    return (_SHIPPED / f"{name}.toml").read_text("utf-8")


def shipped_solution(name: str) -> Path | None:
    """Where the solution of a shipped case is kept, if one comes with the package."""
    path = Path(str(_SHIPPED / f"{name}.h5"))
    return path if path.is_file() else None


def is_lattice(tables: Mapping[str, Any]) -> bool:
    """Whether tables describe an infinite lattice rather than a virtual experiment."""
    return "lattice" in tables


def lattice_cases() -> list[str]:
    """Names of the shipped cases that are infinite lattices."""
    return [name for name, tables in _shipped_tables().items() if is_lattice(tables)]


def _shipped_tables() -> dict[str, dict[str, Any]]:
    paths = sorted(Path(str(p)) for p in _SHIPPED.iterdir() if p.name.endswith(".toml"))
    return {path.stem: tomllib.loads(path.read_text("utf-8")) for path in paths}


def read_tables(name: str | Path) -> dict[str, Any]:
    """The tables of a shipped case (by its name) or of a TOML file (by its path).

    Raises
    ------
    InputError
        If there is no such case or file, or it isn't TOML.
    """
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        with reading(path, "a case file", "'modeharvest cases NAME' prints one"):
            return _tables(path)
    return tomllib.loads(case_text(str(name)))


def _tables(path: Path) -> dict[str, Any]:
    """What a TOML file holds; the mark that some editors put at its beginning is all right."""
    content = path.read_bytes()
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}: expected UTF-8, as TOML has to be, got a byte 0x{content[error.start]:02x} "
            f"in line {line}; save it as UTF-8"
        ) from error


def checked(model: type[CaseType], tables: Mapping[str, Any], name: str | Path) -> CaseType:
    """The case that tables describe.

    Raises
    ------
    InputError
        If a key is unknown (the nearest known one is suggested) or a value is out of its range.
    """
    try:
        case = model.model_validate(dict(tables))
        require_types(tables, case)
    except ValidationError as error:
        raise InputError(f"{name}: {sentence(error, model)}") from error
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return case


def of_kind(table: Mapping[str, Any], kinds: Mapping[str, type[Any]], where: str) -> Any:
    """The dataclass that a table's ``kind`` names (by default the first), made of its other keys.

    Raises
    ------
    InputError
        If there is no such kind, a key is unknown, or a value out of its range.
    """
    constants = dict(table)
    kind = constants.pop("kind", next(iter(kinds)))
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"expected a {where} kind among {list(kinds)}, got {kind!r}")
    known = [f.name for f in fields(kinds[kind])]
    for name in constants:
        if name not in known:
            raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")
    return made(kinds[kind], constants)


def kind_of(thing: object, kinds: Mapping[str, type[Any]]) -> dict[str, Any]:
    """The table of which ``of_kind`` makes this thing again."""
    names = {cls: kind for kind, cls in kinds.items()}
    return {"kind": names.get(type(thing), type(thing).__name__), **plain(thing)}


_LENSES = {"camera": CameraDistortion}


class Case(CaseModel):
    """A virtual experiment: what is simulated, how it is imaged, how it is correlated."""

    experiment: Experiment = Experiment()
    imaging: ImagingSpec = ImagingSpec()
    correlation: SquareLatticeOptions = SquareLatticeOptions()

    @field_validator("experiment", mode="before")
    @classmethod
    def _with_material(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("material"), dict):
            return table
        return {**table, "material": of_kind(table["material"], MATERIALS, "experiment.material")}

    @field_validator("imaging", mode="before")
    @classmethod
    def _with_lens(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("distortion"), dict):
            return table
        lens = of_kind(table["distortion"], _LENSES, "imaging.distortion")
        return {**table, "distortion": lens}

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, materials by their kind."""
        content = {name: plain(getattr(self, name)) for name in type(self).model_fields}
        content["experiment"]["material"] = kind_of(self.experiment.material, MATERIALS)
        content["experiment"]["specimen"] = self.experiment.specimen.plain()
        for name in ("tilt", "guided"):  # as before there were any: what is finished stays so
            if not content["experiment"][name]:
                del content["experiment"][name]
        return content


class TwinCase(Case):
    """The twin of a real experiment: its specimen, its photographs, those of the calibration."""

    calibration: CalibrationTarget = CalibrationTarget()


def is_twin(tables: Mapping[str, Any]) -> bool:
    """Whether tables describe the twin of a real experiment."""
    return "calibration" in tables


def read_case(name: str | Path) -> Case:
    """Read a case by the name of a shipped one or by the path of a TOML file.

    The twin of a real experiment is a :class:`TwinCase`.

    Raises
    ------
    InputError
        If there is no such case, it is an infinite lattice, it is not TOML, a key is unknown (the
        nearest known one is suggested) or a value is out of its range.
    """
    tables = read_tables(name)
    if is_lattice(tables):
        raise InputError(
            f"{name}: expected a virtual experiment, got an infinite lattice; run 'modeharvest "
            f"modes {name} --out DIR', or 'modeharvest bloch {name} --out DIR' for its stability"
        )
    return checked(TwinCase if is_twin(tables) else Case, tables, name)
