"""Conversion between dataclasses and plain values, as stored in files.

Plain values are validated by pydantic, whose first error is reported in one line. Numbers must be
finite. A boolean or a text is not accepted as a number, though pydantic would take ``true`` for 1
and ``"3"`` for 3.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from modeharvest.util.errors import InputError

if TYPE_CHECKING:
    from pydantic import ConfigDict, ValidationError

CHECKS: ConfigDict = {
    "extra": "forbid",
    "frozen": True,
    "arbitrary_types_allowed": True,
    "allow_inf_nan": False,
}
"""pydantic's options: unknown keys and infinite numbers are refused, nested ones too."""

_LARGEST = 1e15
"""Largest number accepted, in any unit: no real input is larger, and squares don't overflow."""
T = TypeVar("T")


def made(kind: type[T], values: object) -> T:
    """Make a dataclass from plain values.

    Raises InputError if a key is unknown (the nearest known key is suggested) or missing, or a
    value is of another type or out of range; the message names the place as ``table.key``.
    """
    from pydantic import TypeAdapter, ValidationError  # here: the import takes 0.2 s

    try:
        (thing,) = TypeAdapter(tuple[kind], config=CHECKS).validate_python((values,))  # type: ignore[valid-type]
    except ValidationError as error:
        raise InputError(described(error, kind, 1)) from error
    require_types(values, thing)
    found: T = thing
    return found


def require_types(given: object, found: object, where: str = "") -> None:
    """Compare the values given with those that pydantic made of them, one by one.

    Raises InputError if a boolean or a text became a number, a number became a boolean, or a
    number is larger than ``_LARGEST``.
    """
    if isinstance(given, Mapping):
        for key, value in given.items():
            nested = found.get(key) if isinstance(found, Mapping) else getattr(found, key, None)
            require_types(value, nested, f"{where}.{key}".lstrip("."))
    elif isinstance(given, (list, tuple)) and isinstance(found, (list, tuple)):
        for k, (value, nested) in enumerate(zip(given, found, strict=False)):
            require_types(value, nested, f"{where}.{k}")
    elif _kind(given) and _kind(found) and _kind(given) != _kind(found):
        raise InputError(f"{where}: expected {_kind(found)}, got {given!r}")
    elif _kind(given) == "a number" and abs(given) > _LARGEST:  # type: ignore[arg-type]
        raise InputError(f"{where}: expected a number below {_LARGEST:g}, got {given}")


def _kind(value: object) -> str:
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, (int, float)):
        return "a number"
    return "a text" if isinstance(value, str) else ""


def to_plain(value: Any) -> Any:
    """Plain JSON values: dataclasses and mappings as dictionaries, arrays and tuples as lists.

    Numbers that are not finite become null.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(nested) for key, nested in value.items()}
    if hasattr(value, "tolist"):  # arrays and numbers of numpy
        return to_plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [to_plain(nested) for nested in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def picked(thing: object, names: str) -> dict[str, Any]:
    """Attributes of an object as a dictionary; ``names``: one text, separated by spaces."""
    return {name: getattr(thing, name) for name in names.split()}


def quantity(label: str, unit: str = "", **options: Any) -> Any:
    """A dataclass field with label and unit for readers; ``options``: those of ``field``."""
    return field(metadata={"label": label, "unit": unit}, **options)


def quantities(kind: type[Any]) -> Iterator[tuple[str, str, str]]:
    """Label, unit and name of each quantity of a dataclass."""
    for f in fields(kind):
        if "label" in f.metadata:
            yield f.metadata["label"], f.metadata["unit"], f.name


def headings(*kinds: type[Any]) -> dict[str, str]:
    """Headings of a table: by name, label and unit of each quantity of these dataclasses."""
    found: dict[str, str] = {}
    for label, unit, name in (quantity for kind in kinds for quantity in quantities(kind)):
        found.setdefault(name, f"{label} [{unit}]" if unit not in ("", "–") else label)
    return found


def described(error: ValidationError, model: type[Any] | None, skipped: int = 0) -> str:
    """The first error, in one line: place, expected and given value.

    ``skipped``: number of leading parts of pydantic's place that the user does not know.
    """
    errors = error.errors()
    first, place, expected = errors[0], errors[0]["loc"][skipped:], errors[0]["msg"]
    if place and str(place[-1]).startswith("literal["):  # one of several alternatives
        *at, _ = first["loc"]
        kinds = (str(e["loc"][len(at)]) for e in errors if [*e["loc"][: len(at)]] == at)
        place, expected = place[:-1], f"expected {' or '.join(dict.fromkeys(kinds))}"
    where = ".".join(str(part) for part in place)
    if isinstance(first.get("ctx", {}).get("error"), InputError):
        return f"[{where}] {first['ctx']['error']}" if where else str(first["ctx"]["error"])
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _known_keys(model, place[:-1])
        return f"unknown key {where}{nearest(str(place[-1]), known)}"
    if first["type"] == "missing":
        return f"expected {where}, got none"
    what = _EXPECTED.get(first["type"], expected.replace("Input should be", "expected"))
    what = what.format(**first.get("ctx", {}))
    return f"{where}: {what}, got {first['input']!r:.80}".removeprefix(": ")


_EXPECTED = {
    "tuple_type": "expected a list",
    "list_type": "expected a list",
    "dataclass_type": "expected a table",
    "string_type": "expected a text",
    "too_long": "expected at most {max_length} values",
}
"""Descriptions of pydantic's errors by type, where its own speak of Python."""


def _known_keys(model: type[Any] | None, table: tuple[int | str, ...]) -> list[str]:
    """The keys that the table at this place of a case may have."""
    place = model
    for part in table:
        if not isinstance(part, int):  # an index in a list of tables is skipped
            place = _table_type(place, part)
    if place is None:
        return []
    return [f.name for f in fields(place)] if is_dataclass(place) else list(place.model_fields)


def _table_type(place: type[Any] | None, name: str) -> type[Any] | None:
    """The dataclass of a table within another; None if it is not a dataclass."""
    hint = None if place is None else get_type_hints(place).get(name)
    return next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind)), None)  # type: ignore[return-value]


def nearest(name: str, known: list[str]) -> str:
    """Hint for an error message: the most similar known name, or else all known names."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; known are: {', '.join(known)}"
