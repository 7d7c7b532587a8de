"""The bare command, ``demo`` and ``doctor``: what a newcomer sees first."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from modeharvest.cli import demo, doctor
from modeharvest.cli.root import app, main
from modeharvest.util.files import read_json

ROOT = Path(__file__).parents[1]


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["modeharvest", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0)


def test_the_bare_command_says_what_to_do_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch) == 0
    text = capsys.readouterr().out
    assert text.index("modeharvest demo") < text.index("modeharvest harvest")
    commands = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    assert set(re.findall(r"^  modeharvest (\w+)", text, re.MULTILINE)) <= commands
    assert max(map(len, text.splitlines())) <= 100


def test_doctor_knows_every_command_and_dependency() -> None:
    commands = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    assert set(doctor.NEEDS) == commands, "say in cli/doctor.py what a new command needs"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert doctor._required() == [re.split(r"[<>=]", d)[0] for d in project["dependencies"]]


def test_doctor_says_what_is_missing_and_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = doctor.found_version
    gone = ("fenics-dolfinx", "gmsh")
    monkeypatch.setattr(doctor, "found_version", lambda n: "" if n in gone else there(n))
    assert called(monkeypatch, "doctor") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line[2:]}
    assert "missing" in lines["gmsh"]
    assert "pip install gmsh" in lines["gmsh"]
    assert "needs fenics-dolfinx" in lines["bloch"]
    assert "needs gmsh" in lines["measure"]
    assert "ready" in lines["demo"]
    assert "ready" in lines["harvest"]
    assert "kernels" in lines


def test_doctor_names_a_cache_that_is_there_and_how_to_remove_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The command removes that folder only, whatever its name."""
    cache = tmp_path / "my cache"
    (cache / "modeharvest").mkdir(parents=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache / "numba"))
    rows = {name: (value, remark) for name, value, remark in doctor.caches()}
    assert rows["scripts/env"][0] == str(cache / "modeharvest")
    assert rows["scripts/env"][1].endswith(f"rm -r '{cache / 'modeharvest'}'")
    assert f"find -L '{cache / 'numba'}' -name" in rows["kernels"][1]
    assert "dolfinx" not in rows


def test_the_demo_needs_no_finite_elements_and_leaves_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(demo, "PIXEL_SIZE", 0.04)  # its own, 0.02, takes longer
    monkeypatch.setitem(sys.modules, "dolfinx", None)
    assert called(monkeypatch, "demo", "--out", str(tmp_path / "demo")) == 0
    text = capsys.readouterr().out
    assert "report.html" in text
    assert "modeharvest cases paper-virtual > mine.toml" in text
    summary = read_json(tmp_path / "demo/summary.json")
    assert [s["outcome"] for s in summary["snapshots"]] == ["converged", "converged"]
    assert (tmp_path / "demo/report.html").stat().st_size > 1e5
