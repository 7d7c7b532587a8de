"""Where a summary is not as the documentation's JSON schema of its command says."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

EXTENSIONS = Path(__file__).resolve().parents[1] / "docs" / "_ext"
TYPES: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
    "number": (int, float), "null": type(None),
}  # fmt: skip


@cache
def schema_of(command: str) -> dict[str, Any]:
    """As the site shows it."""
    sys.path.insert(0, str(EXTENSIONS))
    try:
        from schema_pages import Schema  # type: ignore[import-not-found]
    finally:
        sys.path.remove(str(EXTENSIONS))
    found: dict[str, Any] = Schema(command).top
    return found


def faults(summary: Any, command: str) -> list[str]:
    """All of them; of a summary, or of the plain values that it is written from."""
    schema = schema_of(command)
    return list(_faults(json.loads(json.dumps(summary)), schema, schema))


def _faults(value: Any, schema: dict[str, Any], top: dict[str, Any], at: str = "") -> Iterator[str]:
    """Of JSON Schema what the site's schemas use."""
    if "$ref" in schema:
        schema = top["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    if "anyOf" in schema:
        tried = [list(_faults(value, option, top, at)) for option in schema["anyOf"]]
        yield from min(tried, key=len)
        return
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    fits = any(isinstance(value, TYPES[kind]) for kind in kinds)
    if kinds and (not fits or (isinstance(value, bool) and "boolean" not in kinds)):
        yield f"{at}: expected {kinds}, got {value!r:.60}"
        return
    if isinstance(value, dict) and "properties" in schema:
        for name in schema["required"]:
            if name not in value:
                yield f"{at}: no {name}"
        for name, part in value.items():
            if name not in schema["properties"]:
                yield f"{at}: unknown key {name}"
            else:
                yield from _faults(part, schema["properties"][name], top, f"{at}.{name}")
    if isinstance(value, dict) and isinstance(schema.get("additionalProperties"), dict):
        for name, part in value.items():
            yield from _faults(part, schema["additionalProperties"], top, f"{at}.{name}")
    if isinstance(value, list):
        for k, part in enumerate(value):
            yield from _faults(part, schema.get("items", {}), top, f"{at}[{k}]")
