"""Summaries are what the documentation's JSON schemas say; other commands' tests check theirs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from summary_schemas import faults, schema_of

from modeharvest.fem.experiment import Experiment
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.experiment import Run
from modeharvest.util.files import read_json

ROOT = Path(__file__).parents[1]
COMMANDS = ("run", "harvest", "measure", "identify", "homogenize", "modes", "design", "study",
            "score")  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a run leaves."""
    folder = tmp_path_factory.mktemp("run")
    case = Case(experiment=Experiment(), imaging=ImagingSpec(pixel_size=0.05))
    Run(case, folder, solution=shipped_solution("paper-virtual")).all()
    return dict(read_json(folder / "summary.json"))


@pytest.mark.dolfinx
def test_a_summary_is_as_its_schema_says(written: dict[str, Any]) -> None:
    assert faults(written, "run") == []


@pytest.mark.dolfinx
def test_the_schema_refuses_what_is_wrong(written: dict[str, Any]) -> None:
    wrong = {**written, "critical_strain": "9.6 %", "surplus": 1}
    del wrong["versions"]
    assert len(faults(wrong, "run")) == 3


@pytest.mark.dolfinx
def test_lengths_have_their_unit_in_the_schema() -> None:
    rms = schema_of("run")["$defs"]["Snapshot"]["properties"]["rms_w_px"]
    assert rms == {"type": ["number", "null"], "description": "w = truth − IDIC, rms [px]"}


@pytest.mark.dolfinx
@pytest.mark.parametrize("command", COMMANDS)
def test_every_key_says_what_it_is(command: str) -> None:
    schema = schema_of(command)
    for part in (schema, *schema["$defs"].values()):
        for name, about in part["properties"].items():
            assert about["description"] or name in ("unit", "source", "observable"), (command, name)


def test_a_summary_of_each_command_is_checked() -> None:
    tests = "".join(path.read_text("utf-8") for path in (ROOT / "tests").glob("test_*.py"))
    assert set(re.findall(r'faults\(\w+(?:\[1\])?, "(\w+)"\)', tests)) == set(COMMANDS)
