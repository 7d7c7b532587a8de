"""JSON schemas and pages of keys of the JSON files that commands write.

``summaries.toml`` beside this file has the type and the meaning of each key. For dataclasses that a
command writes unchanged, these come from the fields and their docstrings.
"""

from __future__ import annotations

import collections.abc
import importlib
import inspect
import json
import re
import tomllib
import types
from collections.abc import Container
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from key_pages import docstrings, escaped
from rst import FOLDER, heading, table, write
from sphinx.application import Sphinx

COMMANDS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("summaries.toml").read_text("utf-8")
)
FILES = {"score": "scores.json"}
"""JSON files of the commands that don't write ``summary.json``."""
none = type(None)
PLAIN: dict[Any, dict[str, Any]] = {
    "text": {"type": "string"}, "number": {"type": ["number", "null"]},
    "integer": {"type": "integer"}, "boolean": {"type": "boolean"}, "table": {"type": "object"},
    "any": {},
    str: {"type": "string"}, float: {"type": ["number", "null"]}, int: {"type": "integer"},
    bool: {"type": "boolean"}, none: {"type": "null"},
}  # fmt: skip
"""Schemas by type name in the table or Python type; null: number unknown or infinite."""
LISTS = (tuple, list, collections.abc.Sequence)
TABLES = (dict, collections.abc.Mapping)


class Schema:
    """The JSON schema of the file that a command writes."""

    def __init__(self, command: str) -> None:
        self.given = COMMANDS[command]
        self.defs: dict[str, Any] = {}
        file = FILES.get(command, "summary.json")
        self.top = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"{file} of modeharvest {command}",
            "description": self.given["about"],
            **self.of_table(self.given),
            "$defs": self.defs,
        }

    def of_table(self, given: dict[str, Any]) -> dict[str, Any]:
        """Schema of a table of ``summaries.toml``."""
        found: dict[str, Any] = {"type": "object", "properties": {}, "required": []}
        for name in given.get("as", ()):
            own = self.of_class(imported(name.rstrip("?")), given)
            found["properties"] |= own["properties"]
            found["required"] += [] if name.endswith("?") else own["required"]
        for key, row in given.items():
            if key not in ("as", "about") and isinstance(row, list):
                name, (kind, text) = key.rstrip("?"), row
                found["properties"][name] = {**self.of_name(kind), "description": text}
                if not key.endswith("?"):
                    found["required"].append(name)
        return {**found, "required": sorted(set(found["required"])), "additionalProperties": False}

    def of_name(self, kind: str) -> dict[str, Any]:
        """Schema of a type in the notation of ``summaries.toml``."""
        if kind.endswith("?"):
            return {"anyOf": [self.of_name(kind[:-1]), PLAIN[none]]}
        if kind.endswith("[]"):
            return {"type": "array", "items": self.of_name(kind[:-2])}
        if kind in PLAIN:
            return dict(PLAIN[kind])
        if ":" in kind:
            return self.of_hint(imported(kind))
        if kind not in self.defs:
            self.defs[kind] = {}
            self.defs[kind] = self.of_table(self.given[kind])
        return {"$ref": f"#/$defs/{kind}"}

    def of_class(self, cls: type[Any], without: Container[str] = ()) -> dict[str, Any]:
        """Schema of a dataclass, except fields ``without``; those with a default may be missing."""
        texts, hints = docstrings(cls), get_type_hints(cls)
        found = {}
        chosen = [f for f in fields(cls) if f.name not in without]
        for f in chosen:
            label, unit = f.metadata.get("label", ""), f.metadata.get("unit", "")
            text = label + (f" [{unit}]" if unit not in ("", "–") else "")
            text = text or " ".join(texts.get(f.name, "").split())
            found[f.name] = {**self.of_hint(hints[f.name]), "description": text}
        needed = [f.name for f in chosen if f.default is f.default_factory is MISSING]
        return {"type": "object", "properties": found, "required": needed,
                "additionalProperties": False}  # fmt: skip

    def of_hint(self, hint: Any) -> dict[str, Any]:
        """Schema of a Python type hint."""
        origin, inner = get_origin(hint), get_args(hint)
        if hint in PLAIN:
            return dict(PLAIN[hint])
        if is_dataclass(hint):
            name = hint.__name__
            if name not in self.defs:
                self.defs[name] = {}
                text = inspect.cleandoc(hint.__doc__ or "").partition("\n\n")[0]
                about = {"description": text.replace("\n", " ")}
                self.defs[name] = {**about, **self.of_class(hint)}
            return {"$ref": f"#/$defs/{name}"}
        if origin in (Union, types.UnionType):
            options = [
                self.of_hint(kind) for kind in inner if not (kind is none and float in inner)
            ]
            return {"anyOf": options} if len(options) > 1 else options[0]
        if origin is np.ndarray:
            return {"type": "array", "items": {}}
        if origin in LISTS:
            kinds = [kind for kind in inner if kind is not Ellipsis]
            items = self.of_hint(kinds[0]) if len(set(kinds)) == 1 else {}
            return {"type": "array", "items": items}
        if origin in TABLES and inner and inner[1] is not Any:
            return {"type": "object", "additionalProperties": self.of_hint(inner[1])}
        return {"type": "object"} if origin in TABLES else {}


def imported(name: str) -> type[Any]:
    """The dataclass with the name ``module:Class``, imported."""
    module, _, cls = name.partition(":")
    found: type[Any] = getattr(importlib.import_module(module), cls)
    return found


def kind_text(schema: dict[str, Any], command: str) -> str:
    """A type in words; if it is a table of this page, a link to it."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[1]
        return f":ref:`{name} <summary-{command}-{name.lower()}>`"
    if "anyOf" in schema:
        return " or ".join(kind_text(option, command) for option in schema["anyOf"])
    kind = schema.get("type", "any")
    if kind == "array":
        inner = kind_text(schema["items"], command)
        return f"list of {inner}{'s' if inner.endswith('number') else ''}"
    kind = kind[0] if isinstance(kind, list) else kind
    names = {"string": "text", "integer": "whole number", "boolean": "true or false",
             "object": "table"}  # fmt: skip
    return names.get(kind, kind)


def rows(schema: dict[str, Any], command: str) -> list[tuple[str, str, str, str]]:
    """Key, type, unit and meaning of each property."""
    found = []
    for name, about in schema["properties"].items():
        text, unit = about.get("description", ""), ""
        if ending := re.search(r"^(.*?)\s*\[([^\[\]]*)\]\.?$", text, re.DOTALL):
            text, unit = ending[1], "" if ending[2] == "-" else ending[2]
        kind, optional = kind_text(about, command), name not in schema["required"]
        text = escaped(text).replace(r"\`\`", "``").replace(r"\`", "``")
        found.append((f"``{name}``", kind + ", or missing" * optional, escaped(unit), text))
    return found


def page(command: str, schema: dict[str, Any]) -> str:
    """Page of all keys of the file that a command writes."""
    head, widths = ("key", "type", "unit", "meaning"), "24 20 12 44"
    text = f".. _summary-{command}:\n\n" + heading(schema["title"])
    text += re.sub(r"`([^`]*)`", r"``\1``", schema["description"])
    text += f" JSON schema: :download:`{command}.json <../schemas/{command}.json>`.\n\n"
    text += table(head, rows(schema, command), widths)
    for name, part in schema["$defs"].items():
        text += f".. _summary-{command}-{name.lower()}:\n\n" + heading(name, "-")
        text += escaped(part.get("description", "")) + "\n\n"
        text += table(head, rows(part, command), widths)
    return text


def draw(app: Sphinx) -> None:
    """Write schemas and pages into the documentation's source."""
    for command in COMMANDS:
        schema, folder = Schema(command).top, Path(app.srcdir) / FOLDER
        text = json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        write(folder / "schemas" / f"{command}.json", text)
        write(folder / "summaries" / f"{command}.rst", page(command, schema))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension: schemas and pages are written before Sphinx reads any."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
