"""Case files: TOML tables turned into checked objects, with faults told in one line.

A case is a pydantic model whose fields are the project's frozen dataclasses; the keys of a
table are theirs. This module reads such files and finds the ones that come with the package.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from modeharvest.errors import InputError
from modeharvest.fem.materials import Ogden, TwoTermI1

MATERIALS: dict[str, type[Any]] = {"ogden": Ogden, "two-term-I1": TwoTermI1}
_SHIPPED = resources.files("modeharvest") / "cases"


class CaseModel(BaseModel):
    """What all kinds of cases have in common: no unknown keys, unchangeable, a title."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

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
        try:
            text = path.read_text("utf-8")
        except OSError as error:
            raise InputError(f"expected a case file at {path}, got: {error.strerror}") from error
    else:
        text = case_text(str(name))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not valid TOML: {error}") from error


def checked(model: type[CaseType], tables: Mapping[str, Any], name: str | Path) -> CaseType:
    """The case that tables describe.

    Raises
    ------
    InputError
        If a key is unknown (the nearest known one is suggested) or a value is out of its range.
    """
    try:
        return model.model_validate(dict(tables))
    except ValidationError as error:
        raise InputError(f"{name}: {_sentence(error, model)}") from error


def of_kind(table: Mapping[str, Any], kinds: Mapping[str, type[Any]], where: str) -> Any:
    """The dataclass that a table's ``kind`` names (by default the first), made of its other keys.

    Raises
    ------
    InputError
        If there is no such kind, a key is unknown, or a value out of its range.
    """
    constants = dict(table)
    kind = constants.pop("kind", next(iter(kinds)))
    if kind not in kinds:
        raise InputError(f"expected a {where} kind among {list(kinds)}, got {kind!r}")
    known = [f.name for f in fields(kinds[kind])]
    for name in constants:
        if name not in known:
            raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")
    try:
        return TypeAdapter(kinds[kind]).validate_python(constants)
    except ValidationError as error:
        raise InputError(_sentence(error, None)) from error


def kind_of(thing: object, kinds: Mapping[str, type[Any]]) -> dict[str, Any]:
    """The table of which ``of_kind`` makes this thing again."""
    names = {cls: kind for kind, cls in kinds.items()}
    return {"kind": names.get(type(thing), type(thing).__name__), **plain(thing)}


def plain(value: Any) -> Any:
    """A dataclass as plain JSON values; anything else as it is."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def _sentence(error: ValidationError, model: type[CaseModel] | None) -> str:
    """The first fault, in one line: where, what came, what was expected."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if isinstance(first.get("ctx", {}).get("error"), InputError):
        return f"[{where}] {first['ctx']['error']}" if where else str(first["ctx"]["error"])
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _known_keys(model, first["loc"][:-1])
        return f"unknown key {where}{nearest(str(first['loc'][-1]), known)}"
    if first["type"] == "missing":
        return f"expected {where}, got none"
    return f"{where}: {first['msg']}, got {first['input']!r}"


def _known_keys(model: type[Any] | None, table: tuple[int | str, ...]) -> list[str]:
    """The keys that the table at this place of a case may have."""
    place = model
    for part in table:
        if not isinstance(part, int):  # a place in a list of tables
            place = _table_type(place, part)
    if place is None:
        return []
    return [f.name for f in fields(place)] if is_dataclass(place) else list(place.model_fields)


def _table_type(place: type[Any] | None, name: str) -> type[Any] | None:
    """The dataclass of a table within another; None if it has none of its own."""
    hint = None if place is None else get_type_hints(place).get(name)
    return next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind)), None)  # type: ignore[return-value]


def nearest(name: str, known: list[str]) -> str:
    """A hint at what was probably meant, or at all there is."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; known are: {', '.join(known)}"
