"""Cases: a TOML file is turned into validated objects, each error is reported in one line.

A case is a pydantic model whose fields are the project's frozen dataclasses, so a case file,
``--help`` and the Python objects use the same names and units. This module has what all kinds of
cases share, and the virtual experiment. A virtual experiment with a table ``[calibration]`` is the
twin of a real one: its photographs are taken through a lens that must be calibrated before they are
harvested. Infinite lattices, photographs and studies are defined in other modules.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ValidationError

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import MATERIALS
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.distortion.target import CalibrationTarget
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.whole_field import VirtualWholeFieldOptions
from modeharvest.util.errors import InputError
from modeharvest.util.files import reading
from modeharvest.util.typed import CHECKS, described, made, nearest, require_types, to_plain

_SHIPPED = resources.files("modeharvest") / "cases"
_KINDS = {
    "homogenization": ("a homogenized specimen", "modeharvest homogenize {}", "paper-homogenized"),
    "unknowns": ("an identification", "modeharvest identify {}", "identify-twin"),
    "lattice": (
        "an infinite lattice",
        "modeharvest modes {} --out DIR', or 'modeharvest bloch {}",
        "square-lattice",
    ),
    "study": ("a study", "modeharvest study {}", "noise"),
    "design": ("the design of a test", "modeharvest design {}", "paper-virtual"),
    "images": ("photographs of a test", "modeharvest harvest {}", "photographs"),
    "experiment": ("a virtual experiment", "modeharvest run {}", "paper-virtual"),
}
"""For each kind of case, by the table that only this kind has (searched in this order): what it is,
the command that runs it, and the shipped case that a new one can be started from."""


class CaseModel(BaseModel):
    """Base of all kinds of cases: immutable, with a title; unknown keys are refused."""

    model_config = CHECKS
    table: ClassVar[str]
    """The TOML table by which this kind of case is recognised, see ``_KINDS``."""

    title: str = ""

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case, given by the name of a shipped case or the path of a TOML file.

        Raises InputError if there is no such case, it is of another kind, it is not TOML, a key is
        unknown (the nearest known key is suggested) or a value is out of range.
        """
        wanted, _, start = _KINDS[cls.table]
        tables = read_tables(name, start)
        got = table_of_kind(tables)
        if got not in ("", cls.table):
            found, command, _ = _KINDS[got]
            command = f"{command} --out DIR".replace("{}", str(name))
            raise InputError(f"{name}: expected {wanted}, got {found}; run '{command}'")
        return checked(cls, tables, name)

    @classmethod
    def of(cls, case: CaseModel | str | Path) -> Self:
        """Return a case as given, or read it by name; InputError if it is of another kind."""
        if isinstance(case, CaseModel) and not isinstance(case, cls):
            raise InputError(f"expected {_KINDS[cls.table][0]}, got {_KINDS[case.table][0]}")
        return case if isinstance(case, cls) else cls.read(str(case))

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values."""
        return {name: to_plain(getattr(self, name)) for name in type(self).model_fields}


CaseType = TypeVar("CaseType", bound=CaseModel)


def table_of_kind(tables: Mapping[str, Any]) -> str:
    """The table that defines a case's kind, such as "lattice"; "" if there is none."""
    return next((name for name in _KINDS if name in tables), "")


def shipped_cases(kind: str = "") -> dict[str, str]:
    """Names and titles of the cases shipped with the package: all, or those of one kind."""
    found = {name: tomllib.loads(path.read_text("utf-8")) for name, path in _shipped().items()}
    return {n: str(t["title"]) for n, t in found.items() if kind in ("", table_of_kind(t))}


def case_text(name: str) -> str:
    """The TOML text of a shipped case with its comments, as a template for a new case.

    Raises InputError, which suggests the nearest name, if no shipped case has this name.
    """
    known = _shipped()
    if name not in known:
        raise InputError(f"unknown case {name!r}{nearest(name, list(known))}")
    return known[name].read_text("utf-8")


def shipped_solutions() -> dict[str, Path]:
    """Paths of the solutions that are shipped with the package, by the names of their cases."""
    return {path.stem: path for path in sorted(Path(str(_SHIPPED)).glob("*.h5"))}


def shipped_solution(name: str) -> Path:
    """Path of the solution of a shipped case; InputError if the package contains none."""
    known = shipped_solutions()
    if name not in known:
        raise InputError(f"expected a case with a shipped solution among {list(known)}, got {name}")
    return known[name]


def _shipped() -> dict[str, Path]:
    """The TOML files of the shipped cases, by case name; studies come last."""
    folder = Path(str(_SHIPPED))
    return {p.stem: p for where in ("", "studies") for p in sorted((folder / where).glob("*.toml"))}


def read_tables(name: str | Path, start: str = "NAME") -> dict[str, Any]:
    """The tables of a shipped case (by its name) or of a TOML file (by its path).

    ``start``: the shipped case that the error message for a missing file offers as a template.
    Raises InputError if there is no such case or file, or it isn't TOML.
    """
    path = Path(name)
    if path.suffix == ".toml" or path.is_file() or (path.is_dir() and str(path) not in _shipped()):
        with reading(path, "a case file", f"'modeharvest cases {start}' prints one"):
            return _tables(path)
    return tomllib.loads(case_text(str(name)))


def _tables(path: Path) -> dict[str, Any]:
    """The content of a TOML file; a byte order mark at its beginning is accepted."""
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
    """Make a validated case from its tables; InputError, whose message begins with ``name``."""
    try:
        case = model.model_validate(dict(tables))
        require_types(tables, case)
    except ValidationError as error:
        raise InputError(f"{name}: {described(error, model)}") from error
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return case


def of_kind(kinds: Mapping[str, type[Any]], where: str, key: str = "") -> BeforeValidator:
    """Turn a table, or its sub-table ``key``, into the dataclass that its entry ``kind`` names.

    Without ``kind`` the first of ``kinds`` is used. ``where`` is the table's name in an InputError.
    """

    def choose(table: Any) -> Any:
        if not key or not isinstance(table, Mapping):
            return choose_kind(table)
        return {**table, key: choose_kind(table[key])} if key in table else table

    def choose_kind(table: Any) -> Any:
        if not isinstance(table, Mapping):
            return table
        constants = dict(table)
        kind = constants.pop("kind", next(iter(kinds)))
        if not isinstance(kind, str) or kind not in kinds:
            raise InputError(f"expected a {where} kind among {list(kinds)}, got {kind!r}")
        known = [f.name for f in fields(kinds[kind])]
        for name in constants:
            if name not in known:
                raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")
        return made(kinds[kind], constants)

    return BeforeValidator(choose)


def with_kind(thing: object, kinds: Mapping[str, type[Any]]) -> dict[str, Any]:
    """The table from which ``of_kind`` makes an equal object, with its ``kind``."""
    names = {cls: kind for kind, cls in kinds.items()}
    return {"kind": names.get(type(thing), type(thing).__name__), **to_plain(thing)}


class Case(CaseModel):
    """A virtual experiment, or a twin: what is simulated, how it is imaged and correlated."""

    table = "experiment"

    experiment: Annotated[Experiment, of_kind(MATERIALS, "experiment.material", "material")] = (
        Experiment()
    )
    imaging: Annotated[
        ImagingSpec, of_kind({"camera": CameraDistortion}, "imaging.distortion", "distortion")
    ] = ImagingSpec()
    correlation: SquareLatticeOptions = SquareLatticeOptions()
    whole_field: VirtualWholeFieldOptions = VirtualWholeFieldOptions()
    calibration: CalibrationTarget | None = None

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values; the material has its ``kind``."""
        content = super().plain()
        content["experiment"]["material"] = with_kind(self.experiment.material, MATERIALS)
        content["experiment"]["specimen"] = self.experiment.specimen.plain()
        for name in ("tilt", "guided"):  # unset: keys of older, finished runs stay valid
            if not content["experiment"][name]:
                del content["experiment"][name]
        if self.calibration is None:
            del content["calibration"]
        return content
