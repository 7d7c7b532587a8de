"""Runs that are killed, run out of disk or meet another process end like undisturbed ones."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import disturbed
import pytest
import synthetic_benchmark

from modeharvest.fem.field import Solution
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import shipped_solution

PASSING = ("timings.json", ".lock")
"""What two runs leave different, and what one that is killed leaves behind for the next."""
CASE = f"""{synthetic_benchmark.CASE}
[correlation]
v0_degree = 3
v_degree = 2
[whole_field]
measure = false
"""
HARVEST = """
title = "A test"
[images]
reference = "reference.tif"
deformed = ["frame_1.tif"]
[scale]
pixel_size = 0.06
[specimen]
cell_size = 1.9
"""
LATTICE = """
[lattice]
kind = "square"
pitch = 1.0
diameter = 0.8696
mesh_size = 0.3
[loading]
kind = "equibiaxial"
[search]
divisions = 2
[dispersion]
points = 8
map_divisions = 0
[modes]
branch_loads = [0.012]
"""
FEM = """
[experiment]
strains = [0.02]
mesh_size = 0.5
[experiment.specimen]
holes_x = 2
holes_y = 2
"""
STUDY = """
[study]
kind = "robustness"
initial_guesses = 2
radii = []
strain_errors = []
[imaging]
pixel_size = 0.07
"""


def write_case(folder: Path) -> None:
    (folder / "case.toml").write_text(CASE, "utf-8")
    synthetic_benchmark.solution().write(folder / "given.h5")


def write_photographs(folder: Path) -> None:
    path = shipped_solution("paper-virtual")
    spec = ImagingSpec(pixel_size=0.06, background=0.1, sensor=Sensor(read_noise=0.01))
    made = make_images(Solution.read(path), spec, folder / "made", (0.128,))
    shutil.copy(made.folder / "reference_8bit.tif", folder / "reference.tif")
    shutil.copy(made.folder / "deformed_1280_8bit.tif", folder / "frame_1.tif")
    (folder / "test.toml").write_text(HARVEST, "utf-8")


def write_study(folder: Path) -> None:
    path = shipped_solution("paper-virtual")
    shutil.copy(path, folder / "given.h5")
    (folder / "study.toml").write_text(STUDY, "utf-8")


def write_fem(folder: Path) -> None:
    (folder / "fem.toml").write_text(FEM, "utf-8")


def write_lattice(folder: Path) -> None:
    (folder / "cell.toml").write_text(LATTICE, "utf-8")


@dataclass(frozen=True)
class Pipeline:
    """A command, what it needs beside it, and bytes of disk: where to begin, how much more."""

    command: str
    write_inputs: Callable[[Path], None]
    disk: tuple[int, int]


GIVEN = "--solution given.h5"
PIPELINES = {
    "run": Pipeline(f"run case.toml {GIVEN}", write_case, (40_000, 400_000)),
    "make": Pipeline(f"benchmark make case.toml {GIVEN}", write_case, (40_000, 500_000)),
    "harvest": Pipeline("harvest test.toml", write_photographs, (40_000, 1_400_000)),
    "study": Pipeline(f"study study.toml {GIVEN} --workers 1", write_study, (40_000, 1_500_000)),
    "fem": Pipeline("fem fem.toml", write_fem, (8_192, 40_000)),
    "modes": Pipeline("modes cell.toml", write_lattice, (8_192, 300_000)),
}
NEEDS_DOLFINX = ("fem", "modes")


@pytest.fixture(scope="module")
def forks() -> Iterator[subprocess.Popen[str]]:
    """A process that has imported what takes long, for all the commands here."""
    command, pipe = [sys.executable, disturbed.__file__], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        yield process
        process.communicate(timeout=60)


def attempts(
    forks: subprocess.Popen[str], folder: Path, pipeline: Pipeline, **ways: tuple[object, ...]
) -> list[list[Any]]:
    """Every attempt at a command, for each way in a folder of its name, the last a success.

    The output is in ``folder/NAME/disk``. No attempt on a disk where none of one's own can be had.
    """
    (folder / "inputs").mkdir()
    pipeline.write_inputs(folder / "inputs")
    for name in ways:
        shutil.copytree(folder / "inputs", folder / name)
    where = "disk/set" if "make" in pipeline.command else "disk/out"
    command = [*pipeline.command.split(), "--out", where]
    listed = [[str(folder / name), *way] for name, way in ways.items()]
    assert forks.stdin is not None
    assert forks.stdout is not None
    print(json.dumps([listed, "disk", command]), file=forks.stdin, flush=True)
    every = []
    while isinstance(reported := json.loads(forks.stdout.readline()), dict):
        every.append(reported)
    assert reported in (0, disturbed.NO_DISK)
    return [[a for a in every if a["folder"] == str(folder / name)] for name in ways]


def lasting(files: Mapping[str, str]) -> dict[str, str]:
    return {name: digest for name, digest in files.items() if Path(name).name not in PASSING}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.dolfinx] * (n in NEEDS_DOLFINX)) for n in PIPELINES]
)
def test_disturbed_runs_end_like_an_undisturbed_one(
    name: str, forks: subprocess.Popen[str], tmp_path: Path
) -> None:
    pipeline = PIPELINES[name]
    plain, killed, full = attempts(
        forks, tmp_path, pipeline,
        plain=("kill", 0), killed=("kill", 1), full=("disk", *pipeline.disk),
    )  # fmt: skip
    (undisturbed,) = plain
    expected = lasting(undisturbed["files"])
    (timings,) = (tmp_path / "plain" / "disk").rglob("timings.json")

    assert [a["code"] for a in killed] == [-signal.SIGKILL] * (len(killed) - 1) + [0]
    assert len(killed) > len(json.loads(timings.read_text()))  # once in every stage
    assert lasting(killed[-1]["files"]) == expected

    if not full:
        pytest.skip("no disk of one's own can be had here")
    assert [a["code"] for a in full] == [2] * (len(full) - 1) + [0]
    assert len(full) > 1
    assert lasting(full[-1]["files"]) == expected
    for failed in full[:-1]:
        (line,) = [row for row in failed["message"].splitlines() if "error:" in row]
        assert "No space left on device" in line
        assert "Traceback" not in failed["message"]
        for path, digest in lasting(failed["files"]).items():
            if Path(path).name != "stages.json":  # every file is whole that is there at all
                assert digest == expected[path], path
