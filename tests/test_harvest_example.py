"""The experiment file that users start from is complete, true and can be used as it is."""

from __future__ import annotations

import re
import tomllib
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from modeharvest.cli.root import app
from modeharvest.idic.photograph.gauges import Gauge
from modeharvest.idic.photograph.geometry import RegionTable
from modeharvest.runs.case import case_text, checked
from modeharvest.runs.photographs.case import PhotographCase

EXAMPLE = case_text("photographs")
OPTION = re.compile(r"^# (?P<key>\w+) = (?P<value>.*?)\s+# (?P<words>.*)$")


def options() -> dict[str, dict[str, tuple[str, str]]]:
    """Table to key to (value, comment) of every line that is commented out."""
    found: dict[str, dict[str, tuple[str, str]]] = {}
    table = ""
    for line in EXAMPLE.splitlines():
        if header := re.match(r"(?:# )?\[+([\w.]+)\]", line):
            table = header[1]
        elif option := OPTION.match(line):
            found.setdefault(table, {})[option["key"]] = option["value"], option["words"]
    return found


def tables() -> dict[str, type[Any]]:
    kinds = {n: f.annotation for n, f in PhotographCase.model_fields.items() if n != "title"}
    return {**kinds, "specimen.regions": RegionTable, "gauges": Gauge}


def test_the_command_prints_it() -> None:
    ran = CliRunner().invoke(app, ["harvest", "--example"])
    assert ran.exit_code == 0
    assert ran.output == EXAMPLE


def test_it_is_an_experiment() -> None:
    experiment = checked(PhotographCase, tomllib.loads(EXAMPLE), "example")
    assert experiment.specimen.cell_size == 1.9
    # Tables without a key that counts are as if they weren't there.
    assert experiment.correlation == type(experiment.correlation)()


@pytest.mark.parametrize("table", tables())
def test_every_key_is_there_and_no_other(table: str) -> None:
    given = tomllib.loads(EXAMPLE).get(table, {})
    names = {f.name for f in fields(tables()[table])} - {"regions"}  # a table of its own
    assert set(given) | set(options().get(table, {})) == names


def test_the_user_s_guide_tells_of_every_key() -> None:
    page = (Path(__file__).parents[1] / "docs/how-to/harvest.md").read_text("utf-8")
    rows = "".join(line for line in page.splitlines() if line.startswith("|"))
    for kind in tables().values():
        for field in fields(kind):
            assert f"`{field.name}`" in rows or f"specimen.{field.name}" in rows, field.name
    for text in re.findall(r"```toml\n(.*?)```", page, re.DOTALL):
        tomllib.loads(text)


@pytest.mark.parametrize("table", tables())
def test_what_is_called_a_default_is_one(table: str) -> None:
    for field in fields(tables()[table]):
        value, words = options().get(table, {}).get(field.name, ("", "e.g."))
        if words.startswith("e.g."):
            continue
        default = field.default_factory() if field.default is MISSING else field.default
        read = tomllib.loads(f"value = {value}")["value"]
        assert (tuple(read) if isinstance(read, list) else read) == default, field.name
