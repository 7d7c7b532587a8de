"""A case: everything one run needs, read from a TOML file and checked before work begins.

The tables of the file are the project's own dataclasses, so a case file, ``--help`` and the
Python objects use the same names and units::

    title = "..."
    [experiment]              # fem.experiment.Experiment
    strains = [0.078, 0.128]
    [experiment.specimen]     # fem.specimen.Specimen
    [experiment.material]     # kind = "ogden" or "two-term-I1", and its constants
    [imaging]                 # imaging.spec.ImagingSpec
    [imaging.speckle]         # imaging.speckle.SpeckleSpec
    [correlation]             # idic.setup.Identification
"""

from __future__ import annotations

import difflib
import tomllib
from dataclasses import asdict, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from modeharvest.errors import InputError
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.idic.setup import Identification
from modeharvest.imaging.spec import ImagingSpec

MATERIALS = {"ogden": Ogden, "two-term-I1": TwoTermI1}
_SHIPPED = resources.files("modeharvest") / "cases"


class Case(BaseModel):
    """A virtual experiment: what is simulated, how it is imaged, how it is correlated."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    title: str = ""
    experiment: Experiment = Experiment()
    imaging: ImagingSpec = ImagingSpec()
    correlation: Identification = Identification()

    @field_validator("experiment", mode="before")
    @classmethod
    def _with_material(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("material"), dict):
            return table
        constants = dict(table["material"])
        kind = constants.pop("kind", "ogden")
        if kind not in MATERIALS:
            raise InputError(f"expected a material kind among {list(MATERIALS)}, got {kind!r}")
        known = [f.name for f in fields(MATERIALS[kind])]
        for name, value in constants.items():
            if name not in known:
                raise InputError(f"unknown key experiment.material.{name}{_nearest(name, known)}")
            constants[name] = tuple(value) if isinstance(value, list) else value
        return {**table, "material": MATERIALS[kind](**constants)}

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, materials by their kind."""
        content = {name: getattr(self, name) for name in type(self).model_fields}
        content = {k: _as_plain(v) for k, v in content.items()}
        kinds = {cls: kind for kind, cls in MATERIALS.items()}
        content["experiment"]["material"]["kind"] = kinds[type(self.experiment.material)]
        return content


def _as_plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def shipped_cases() -> dict[str, str]:
    """Names and titles of the cases that come with the package."""
    paths = [p for p in _SHIPPED.iterdir() if p.name.endswith(".toml")]
    titles = {p.name[: -len(".toml")]: tomllib.loads(p.read_text("utf-8"))["title"] for p in paths}
    return dict(sorted(titles.items()))


def case_text(name: str) -> str:
    """The TOML text of a shipped case, comments included: a start for one's own."""
    if name not in shipped_cases():
        raise InputError(f"unknown case {name!r}{_nearest(name, list(shipped_cases()))}")
    return (_SHIPPED / f"{name}.toml").read_text("utf-8")


def shipped_solution(name: str) -> Path | None:
    """Where the solution of a shipped case is kept, if one comes with the package."""
    path = Path(str(_SHIPPED / f"{name}.h5"))
    return path if path.is_file() else None


def read_case(name: str | Path) -> Case:
    """Read a case by the name of a shipped one or by the path of a TOML file.

    Raises
    ------
    InputError
        If there is no such case, it is not TOML, a key is unknown (the nearest known one is
        suggested) or a value is out of its range.
    """
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        try:
            text = path.read_text("utf-8")
        except OSError as error:
            raise InputError(f"expected a case file at {path}, got: {error.strerror}") from error
    else:
        text = case_text(str(name))
    try:
        return Case.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not valid TOML: {error}") from error
    except ValidationError as error:
        raise InputError(f"{name}: {_sentence(error)}") from error


def _sentence(error: ValidationError) -> str:
    """The first fault, in one line: where, what came, what was expected."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if isinstance(first.get("ctx", {}).get("error"), InputError):
        return f"[{where}] {first['ctx']['error']}"
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return (
            f"unknown key {where}{_nearest(str(first['loc'][-1]), _known_keys(first['loc'][:-1]))}"
        )
    return f"{where}: {first['msg']}, got {first['input']!r}"


def _known_keys(table: tuple[int | str, ...]) -> list[str]:
    """The keys that the table at this place of a case may have."""
    if not table:
        return list(Case.model_fields)
    place: Any = Case()
    for part in table:
        place = getattr(place, str(part), None)
    return [f.name for f in fields(place)] if is_dataclass(place) else []


def _nearest(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; known are: {', '.join(known)}"
