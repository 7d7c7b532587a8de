"""A specimen that turns, moves, or is lit otherwise as a whole is measured all the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from synthetic_photographs import Displacement, Photographed, lattice_points, of

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.finite_element.files import read_result
from modeharvest.idic.modes import square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.measure import measure
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun

PITCH, PIXEL = 1.9, 0.035
CELLULAR = Box.centred(4 * PITCH, 5 * PITCH)
DOMAIN = Box.centred(4 * PITCH + 1.6, 5 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, 0.0))
SHOWN = Photographed(PixelGrid.centred(560, 560, PIXEL), DOMAIN, HOLES, 1.4, 2)
TURNS = {"turned_3": (3.0, (20.0, -10.0)), "turned_20": (20.0, (70.0, -60.0))}
"""By how much [degrees], and the shift (right, up) [px]."""


def strained(points: np.ndarray) -> np.ndarray:
    """A strain of 6 % with a pattern."""
    ansatz = Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], PITCH)
    return of(ansatz, ansatz.initial_guess(0.06, 2.7))(points)


def turned(name: str) -> Displacement:
    degrees, shift = TURNS[name]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    return lambda X: (X + strained(X)) @ turn.T + PIXEL * np.array(shift) - X


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    SHOWN.save(folder, {name: turned(name) for name in TURNS})
    path = folder / "turned_20.tif"  # the light has changed, too
    tifffile.imwrite(path, (0.85 * tifffile.imread(path)).astype(np.uint8))
    (folder / "experiment.toml").write_text(
        '[images]\nreference = "reference.tif"\ndeformed = ["turned*.tif"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
        "[correlation]\nv0_degree = 2\nv_degree = 1\n"
    )
    return folder


@pytest.fixture(scope="module")
def run(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> HarvestRun:
    case = PhotographCase.read(photographs / "experiment.toml")
    return HarvestRun(case, tmp_path_factory.mktemp("harvest"))


@pytest.mark.parametrize("name", TURNS)
def test_a_harvest_turns_the_specimen_back(run: HarvestRun, name: str) -> None:
    degrees, (right, up) = TURNS[name]
    rigid = run.prepared.rigid[name]
    assert rigid.angle_deg == pytest.approx(degrees, abs=0.02)
    moved = np.array(rigid.after) - rigid.before
    assert moved == pytest.approx([-up, right], abs=3.0)  # of the holes' mean, not of the origin
    result = run.results()[name].result
    # Less what was taken out, the rest is the strain and the pattern, and a small rigid motion.
    u, true = (field[SHOWN.mask] for field in (result.displacement(), strained(SHOWN.points)))
    X = SHOWN.points[SHOWN.mask]
    left = u - true
    columns = np.column_stack([np.ones(len(X)), X])
    left = left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) / PIXEL < 0.05
    strain = run.harvest().timeline[list(TURNS).index(name)]
    assert strain.strain == pytest.approx(0.06, abs=5e-4)
    assert strain.has_pattern


def test_its_strain_is_along_the_axis_in_the_case_without_measuring_again(run: HarvestRun) -> None:
    before = {name: path.stat().st_mtime_ns for name in TURNS
              for path in [run.folder / f"results/{name}.json"] if run.results()}  # fmt: skip
    specimen = replace(run.case.specimen, angle=30.0)
    again = HarvestRun(run.case.model_copy(update={"specimen": specimen}), run.folder)
    expected = 1.0 - np.linalg.norm(np.diag([0.94, 1.0]) @ [np.cos(np.pi / 6), 0.5])
    assert [m.strain for m in again.harvest().timeline] == pytest.approx([expected] * 2, abs=5e-4)
    after = {name: (run.folder / f"results/{name}.json").stat().st_mtime_ns for name in TURNS}
    assert after == before


@pytest.mark.usefixtures("undrawn_pictures")
def test_measure_follows_it_and_skips_what_is_no_photograph_of_it(
    photographs: Path, tmp_path: Path
) -> None:
    pytest.importorskip("gmsh")
    shots = tmp_path / "shots"
    shots.mkdir()
    whole = tifffile.imread(photographs / "turned_20.tif")
    noise = np.random.default_rng(1).integers(0, 256, whole.shape, np.uint8)
    for name, levels in {
        "f_02_dark": (whole > 200).astype(np.uint8),
        "f_03_white": np.where(whole > 12, 255, whole).astype(np.uint8),
        "f_04_noise": noise,
        "f_05_small": whole[:-10],
        "f_07_half": np.where(np.arange(len(whole))[:, None] < 300, whole, 0),
        "f_10": whole,
        "f_11_other": Photographed(SHOWN.grid, DOMAIN, HOLES, 1.4, 8).image(),
    }.items():
        tifffile.imwrite(shots / f"{name}.tif", levels)
    (shots / "f_06_cut.tif").write_bytes((shots / "f_10.tif").read_bytes()[:1000])
    measure(photographs / "reference.tif", [shots], tmp_path / "out", pixel_size=PIXEL)
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    reasons = {row["name"]: row["reason"] for row in summary["skipped"]}
    expected = {
        "f_02_dark": "black", "f_03_white": "saturated", "f_04_noise": "blank",
        "f_05_small": "one size", "f_07_half": "in its last 260 of 560 rows",
        "f_06_cut": "f_06_cut.tif", "f_11_other": "one surface",
    }  # fmt: skip
    assert set(reasons) == set(expected)
    for name, word in expected.items():
        assert word in reasons[name]
    result = read_result(tmp_path / "out/results/f_10.h5")
    off = (result.displacement - turned("turned_20")(result.mesh.nodes)) / PIXEL
    assert np.sqrt(np.mean(off**2)) < 0.2
    (image,) = summary["images"]
    assert image["rotation_deg"] == pytest.approx(20.0, abs=0.2)
    assert image["strain_x"] == pytest.approx(-0.06, abs=0.003)
