"""JSON schemas of summaries, from the dataclasses that they are written from."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from key_pages import docstrings
from pydantic import TypeAdapter
from rst import FOLDER, write
from sphinx.application import Sphinx

from modeharvest.validation import summary
from modeharvest.validation.whole_field import WholeFieldSummary

TYPED = (summary.SnapshotSummary, summary.ModeSummary, summary.Expectation, WholeFieldSummary)
"""Whose fields have labels, units or docstrings that become descriptions."""


def run_schema() -> dict[str, Any]:
    """Of what ``modeharvest run`` leaves; what is not known, or infinite, is null."""
    schema = TypeAdapter(summary.ExperimentSummary).json_schema()
    described(schema, summary.ExperimentSummary)
    for cls in TYPED:
        described(schema["$defs"][cls.__name__], cls)
    snapshot, mode = (schema["$defs"][n]["properties"] for n in ("SnapshotSummary", "ModeSummary"))
    # A single mode's parameters stand in the snapshot, those of several in ``modes``.
    snapshot |= {key: mode[name] for key, name in summary._SINGLE.items()}
    left_out = {*summary._OPTIONAL, "modes"}
    needed = schema["$defs"]["SnapshotSummary"]["required"]
    schema["$defs"]["SnapshotSummary"]["required"] = [k for k in needed if k not in left_out]
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "summary.json of modeharvest run"
    return dict(nullable(schema))


def described(schema: dict[str, Any], cls: type[Any]) -> None:
    """Give each property what its field says: label, unit, docstring."""
    texts = docstrings(cls)
    for f in fields(cls):
        if (about := schema["properties"].get(f.name)) is None:
            continue
        label, unit = f.metadata.get("label", ""), f.metadata.get("unit", "")
        text = label + (f" [{unit}]" if unit not in ("", "–") else "")
        if text := text or " ".join(texts.get(f.name, "").split()):
            about["description"] = text


def nullable(schema: Any) -> Any:
    """The same with numbers that may be null, and without titles that repeat names."""
    if isinstance(schema, list):
        return [nullable(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    found = {k: nullable(v) for k, v in schema.items()}
    if isinstance(found.get("title"), str) and "type" in found and "properties" not in found:
        del found["title"]
    if found.get("type") == "number":
        found["type"] = ["number", "null"]
    return found


def draw(app: Sphinx) -> None:
    """Write the schema."""
    text = json.dumps(run_schema(), indent=2, ensure_ascii=False) + "\n"
    write(Path(app.srcdir) / FOLDER / "schemas" / "run.json", text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Have it written before any page is read."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
