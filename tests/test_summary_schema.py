"""A real summary is what the documentation's JSON schema says."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from modeharvest.fem.experiment import Experiment
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.experiment import Run
from modeharvest.util.files import read_json

DOCS = Path(__file__).parents[1] / "docs"
TYPES: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
    "number": (int, float), "null": type(None),
}  # fmt: skip


def faults(value: Any, schema: dict[str, Any], top: dict[str, Any], at: str = "") -> Iterator[str]:
    """Where a value is not as a schema wants it; of JSON Schema what pydantic writes."""
    if "$ref" in schema:
        schema = top["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    if "anyOf" in schema:
        tried = [list(faults(value, option, top, at)) for option in schema["anyOf"]]
        yield from min(tried, key=len)
        return
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    fits = any(isinstance(value, TYPES[kind]) for kind in kinds)
    if kinds and (not fits or (isinstance(value, bool) and "boolean" not in kinds)):
        yield f"{at}: expected {kinds}, got {value!r:.60}"
        return
    if isinstance(value, dict) and "properties" in schema:
        for name in schema.get("required", ()):
            if name not in value:
                yield f"{at}: no {name}"
        for name, part in value.items():
            if name not in schema["properties"]:
                yield f"{at}: unknown key {name}"
            else:
                yield from faults(part, schema["properties"][name], top, f"{at}.{name}")
    if isinstance(value, list):
        for k, part in enumerate(value):
            yield from faults(part, schema.get("items", {}), top, f"{at}[{k}]")


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        import schema_pages
    finally:
        sys.path.remove(str(DOCS / "_ext"))
    found: dict[str, Any] = schema_pages.run_schema()
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a run leaves."""
    folder = tmp_path_factory.mktemp("run")
    case = Case(experiment=Experiment(), imaging=ImagingSpec(pixel_size=0.04))
    Run(case, folder, solution=shipped_solution("paper-virtual")).all()
    return dict(read_json(folder / "summary.json"))


@pytest.mark.dolfinx
def test_a_summary_is_as_its_schema_says(schema: dict[str, Any], written: dict[str, Any]) -> None:
    assert list(faults(written, schema, schema)) == []


@pytest.mark.dolfinx
def test_the_schema_refuses_what_is_wrong(schema: dict[str, Any], written: dict[str, Any]) -> None:
    wrong = {**written, "critical_strain": "9.6 %", "surplus": 1}
    del wrong["versions"]
    assert len(list(faults(wrong, schema, schema))) == 3


@pytest.mark.dolfinx
def test_lengths_have_their_unit_in_the_schema(schema: dict[str, Any]) -> None:
    rms = schema["$defs"]["SnapshotSummary"]["properties"]["rms_w_px"]
    assert rms == {"type": ["number", "null"], "description": "w = truth − IDIC, rms [px]"}
