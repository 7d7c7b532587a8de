"""The whole displacement in photographs of a test: measured beside the modes, up to the edges."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from summary_schemas import faults
from synthetic_photographs import Displacement, Photographed, lattice_points, of
from test_cli import called, error_line

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.finite_element.files import read_result
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.modes import free_family, square_family
from modeharvest.idic.photograph.measure import measure_whole
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun, harvest
from modeharvest.runs.photographs.twin import whole_checks
from modeharvest.util.errors import InputError
from modeharvest.validation.whole_field import WholeField, compare_whole, v_percent, waves_percent

pytest.importorskip("gmsh")
pytestmark = pytest.mark.usefixtures("coarse_pictures")

PITCH, PIXEL = 1.9, 0.042
W_PX = 0.8
CELLULAR, DOMAIN = Box.centred(4 * PITCH, 4 * PITCH), Box.centred(4 * PITCH + 1.6, 4 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, PITCH / 2))
ANSATZ = Ansatz.on(DOMAIN, [(square_family("junction"), CELLULAR)], PITCH)
PHOTOGRAPHED = Photographed(PixelGrid.centred(260, 260, PIXEL), DOMAIN, HOLES, 1.4)
STATES = {"frame_1": 0.03, "frame_2": 0.05}
FloatArray = NDArray[np.float64]


def w(points: FloatArray) -> FloatArray:
    """Two waves per cell, which no ansatz of a pattern of two cells can describe [mm]."""
    x, y = np.moveaxis(2.0 * np.pi * points / PITCH, -1, 0)
    return W_PX * PIXEL * np.stack([np.sin(y), np.sin(x)], axis=-1)


def truth(strain: float) -> Displacement:
    known = of(ANSATZ, ANSATZ.initial_guess(strain, 3.0))
    return lambda points: known(points) + strain / 0.05 * w(points)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    PHOTOGRAPHED.save(folder, {name: truth(strain) for name, strain in STATES.items()})
    return folder


GAUGES = """
[[gauges]]
name = "middle"
point = [0.0, 0.0]
[[gauges]]
name = "along"
line = [[-1.9, 0.0], [1.9, 0.0]]
"""


def experiment(
    folder: Path, more: str = "", formulation: str = "total", frames: str = "frame*.tif"
) -> Path:
    path = folder / "experiment.toml"
    path.write_text(
        f'[images]\nreference = "reference.tif"\ndeformed = ["{frames}"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
        f"[correlation]\nv0_degree = 2\nv_degree = 1\nformulation = '{formulation}'\n"
        f"brightness = 0\n{more}"
    )
    return path


def rms_px(field: FloatArray, inside: NDArray[np.bool_]) -> float:
    return float(np.sqrt(np.mean(field[inside] ** 2)) / PIXEL)


@pytest.fixture(scope="module")
def harvested(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    harvest(experiment(photographs, GAUGES), out, whole_field=True)
    return out


def summary(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "summary.json").read_text()))


@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_what_the_ansatz_cannot_describe_is_measured(
    photographs: Path, harvested: Path, formulation: str, tmp_path: Path
) -> None:
    folder = harvested
    if formulation == "updated":
        folder, text = tmp_path, "[whole_field]\nmeasure = true\n"
        run = HarvestRun(PhotographCase.read(experiment(photographs, text, formulation)), folder)
        assert [name for name, found in run.results().items() if found.whole] == list(STATES)
    for name, strain in STATES.items():
        measured = read_result(folder / "whole_field" / f"{name}.h5")
        error = measured.displacement_on() - truth(strain)(PHOTOGRAPHED.points)
        there = PHOTOGRAPHED.mask & np.isfinite(error[..., 0])
        assert there.sum() > 0.999 * PHOTOGRAPHED.mask.sum()
        correlated = Result.read(folder / "results" / f"{name}.json")
        by_idic = correlated.displacement() - truth(strain)(PHOTOGRAPHED.points)
        # Noise of 1 % and masks found to a pixel leave 0.1 px; the ansatz leaves w.
        assert rms_px(error, there) < 0.12
        assert rms_px(error, there) < 0.4 * rms_px(by_idic, there)
        assert (folder / "whole_field" / f"{name}.vtu").is_file()


def test_gauges_read_the_truth_and_are_in_the_report(harvested: Path) -> None:
    rows = summary(harvested)["gauges"]
    read = {(row["image"], row["gauge"], row["reads"]): row for row in rows}
    for name, strain in STATES.items():
        left, middle, right = truth(strain)(np.array([[-1.9, 0.0], [0.0, 0.0], [1.9, 0.0]]))
        for what, value in zip("uv", middle, strict=True):
            row = read[name, "middle", what]
            assert row["unit"] == "mm"
            assert row["value"] == pytest.approx(value, abs=4.0 * row["sd"] + 0.02 * PIXEL)
        length = np.linalg.norm(np.array([3.8, 0.0]) + right - left)
        assert read[name, "along", "length"]["value"] == pytest.approx(length, abs=0.3 * PIXEL)
    page = (harvested / "report.html").read_text()
    assert "What gauges read in frame_2" in page
    assert "<h2>Gauges</h2>" in page or ">Gauges<" in page
    assert (harvested / "gauges.csv").read_text().count("\n") == 3


def test_the_summary_has_the_whole_displacement_and_both_modes(harvested: Path) -> None:
    found = summary(harvested)
    assert faults(found, "harvest") == []
    last = found["frames"][-1]["whole_field"]
    expected = rms_px(w(PHOTOGRAPHED.points), PHOTOGRAPHED.mask)
    assert last["w_rms_px"] == pytest.approx(expected, rel=0.1)
    assert last["w_rms_px"] < last["w_max_px"]
    assert last["coverage"] > 0.999
    assert last["start"] == "the result of its correlation"
    local = found["frames"][-1]["local"]
    assert local["source"] == "the whole displacement"
    assert local["w_rms_px"] == pytest.approx(last["w_rms_px"], rel=0.05)
    (mode,) = last["modes"]
    assert [p["name"] for p in mode["parameters"]] == list(square_family("junction").names)
    refit = Result.read(harvested / "whole_field" / "frame_2_refit.json")
    assert [p["refitted"] for p in mode["parameters"]] == pytest.approx(
        list(refit.mode_parameters())
    )
    assert [p["deviation"] for p in mode["parameters"]] == pytest.approx(
        list(refit.standard_errors()[refit.ansatz.phi_slice(0)])
    )
    true = truth(STATES["frame_2"])(PHOTOGRAPHED.points)
    best = fit_displacement(
        true, PHOTOGRAPHED.grid, refit.ansatz, refit.unknowns, PHOTOGRAPHED.mask
    )
    apart = rms_px(refit.displacement() - best.displacement(), PHOTOGRAPHED.mask)
    # What noise of 1 % and masks found to a pixel leave; w pulls IDIC away from it.
    assert apart < 0.02
    correlated = Result.read(harvested / "results" / "frame_2.json")
    assert apart < 0.3 * rms_px(correlated.displacement() - best.displacement(), PHOTOGRAPHED.mask)
    page = (harvested / "report.html").read_text("utf-8")
    for words in (
        "Microfluctuation field, measured", "Principal strain", "Modes of both fits",
        "Spectral density along x, w",
    ):  # fmt: skip
        assert words in page


def test_against_the_truth(harvested: Path) -> None:
    measured = read_result(harvested / "whole_field" / "frame_2.h5")
    refit = Result.read(harvested / "whole_field" / "frame_2_refit.json")
    true = np.where(
        PHOTOGRAPHED.mask[..., None], truth(STATES["frame_2"])(PHOTOGRAPHED.points), np.nan
    )
    best = fit_displacement(
        true, PHOTOGRAPHED.grid, refit.ansatz, refit.unknowns, PHOTOGRAPHED.mask
    )
    specimen = Specimen(holes_x=4, holes_y=4, diameter=1.4, pitch=PITCH)
    errors = compare_whole(WholeField(measured, refit), true, best, PHOTOGRAPHED.mask, specimen)
    error = true - measured.displacement_on()
    assert errors.rms_px == pytest.approx(rms_px(error, np.isfinite(error[..., 0])))
    assert errors.rms_edges_px is not None
    assert errors.rms_px < errors.rms_edges_px < errors.max_px
    rows = whole_checks("frame_2", refit, best, errors, PHOTOGRAPHED.mask)
    found = [row.obtained for row in rows]
    assert found == [errors.rms_px, errors.rms_edges_px, v_percent(refit, best),
                     waves_percent(refit, best)]  # fmt: skip
    # What has no limit is only reported.
    assert [row.ok for row in rows] == [None, None, found[2] <= 0.5, found[3] <= 0.05]


def test_deviations_of_a_mode_from_the_best_fit() -> None:
    a = ANSATZ.initial_guess(0.05, 3.0)
    best = fit_displacement(
        ANSATZ.displacement(a, PHOTOGRAPHED.grid.x, PHOTOGRAPHED.grid.y),
        PHOTOGRAPHED.grid,
        ANSATZ,
        a,
        PHOTOGRAPHED.mask,
    )
    larger, turned = best.unknowns.copy(), best.unknowns.copy()
    larger[ANSATZ.v_slice(0)] *= 1.01
    turned[ANSATZ.phi_slice(0)][1] += 1e-3
    assert v_percent(replace(best, unknowns=larger), best) == pytest.approx(1.0)
    # One component of a wave vector (1, 1).
    expected = 100.0 * 1e-3 / np.sqrt(2.0)
    assert waves_percent(replace(best, unknowns=turned), best) == pytest.approx(expected, rel=1e-3)


def test_again_repeats_nothing(photographs: Path, harvested: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in harvested.glob("whole_field/*")}
    text = "[whole_field]\nmeasure = true\n"
    run = HarvestRun(PhotographCase.read(experiment(photographs, text)), harvested)
    assert [bool(found.whole) for found in run.results().values()] == [True, True]
    assert {p: p.stat().st_mtime_ns for p in harvested.glob("whole_field/*")} == before


def test_a_correlation_that_went_astray_is_done_again(photographs: Path, harvested: Path) -> None:
    """From the whole displacement, which then starts from the images alone."""
    case = PhotographCase.read(experiment(photographs, "[whole_field]\nmeasure = true\n"))
    run = HarvestRun(case, harvested)
    first, true = run.results()["frame_2"], truth(STATES["frame_2"])(PHOTOGRAPHED.points)
    right, on_mesh = first.result, FiniteElementOptions(edge_px=2)
    lost = replace(right, outcome=Outcome.LOCAL_MINIMUM, unknowns=0.0 * right.unknowns)
    still = replace(first.local, u=0.0 * first.local.u)
    found = measure_whole(
        run.prepared.pair("frame_2"), run.geometry, PITCH, case.correlation,
        replace(first, result=lost, local=still),
        on_mesh.body(run.geometry.mask, PHOTOGRAPHED.grid), on_mesh, run.prepared.noise,
    )  # fmt: skip
    assert found.whole is not None
    assert found.whole.start == "blocks of the speckle"
    error = found.whole.measured.displacement_on() - true
    assert rms_px(error, PHOTOGRAPHED.mask & np.isfinite(error[..., 0])) < 0.12
    assert found.result.outcome is Outcome.CONVERGED
    assert rms_px(found.result.displacement() - right.displacement(), PHOTOGRAPHED.mask) < 0.01
    assert "started from the ansatz fitted to the whole displacement" in found.text[-2]


def test_a_family_with_fewer_parameters_takes_the_place_of_free_waves(
    photographs: Path, harvested: Path
) -> None:
    case = PhotographCase.read(experiment(photographs, "[whole_field]\nmeasure = true\n"))
    run = HarvestRun(case, harvested)
    first = run.results()["frame_2"]
    square, on_mesh = first.result, FiniteElementOptions(edge_px=2)
    mode = square.ansatz.modes[0]
    waves = free_family(mode.family.waves(square.mode_parameters()))
    ansatz = replace(square.ansatz, modes=(replace(mode, family=waves),))
    guess = ansatz.initial_guess()
    guess[: ansatz.phi_offset(0)] = square.unknowns[: ansatz.phi_offset(0)]
    free = fit_displacement(
        square.displacement(), PHOTOGRAPHED.grid, ansatz, guess, PHOTOGRAPHED.mask
    )
    assert free.outcome is Outcome.CONVERGED
    found = measure_whole(
        run.prepared.pair("frame_2"), run.geometry, PITCH, case.correlation,
        replace(first, result=free),
        on_mesh.body(run.geometry.mask, PHOTOGRAPHED.grid), on_mesh, run.prepared.noise,
    )  # fmt: skip
    assert [mode.family.size for mode in found.result.ansatz.modes] == [7]
    assert found.result.outcome is Outcome.CONVERGED
    assert rms_px(found.result.displacement() - square.displacement(), PHOTOGRAPHED.mask) < 0.01


@pytest.mark.usefixtures("undrawn_pictures")
def test_where_every_correlation_is_in_a_local_minimum_the_refitted_ansatz_is_the_result(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def local_minimum(*given: Any, **named: Any) -> Result:
        right = correlate(*given, **named)
        return replace(right, outcome=Outcome.LOCAL_MINIMUM, unknowns=0.9 * right.unknowns)

    for module in ("photograph.measure", "finite_element.result"):
        monkeypatch.setattr(f"modeharvest.idic.{module}.correlate", local_minimum)
    found = harvest(experiment(photographs), tmp_path, whole_field=True)
    for frame in found["frames"]:
        name = frame["name"]
        assert frame["outcome"] == "refitted"
        assert frame["whole_field"]["start"] == "blocks of the speckle"
        assert any("the result is the ansatz refitted" in text for text in frame["warnings"])
        assert frame["errors_px"]["model_error"] is None
        assert frame["errors_px"]["noise"]["displacement"] < 0.02
        result = Result.read(tmp_path / "results" / f"{name}.json")
        refit = Result.read(tmp_path / "whole_field" / f"{name}_refit.json")
        assert rms_px(result.displacement() - refit.displacement(), PHOTOGRAPHED.mask) < 1e-6
        true = truth(STATES[name])(PHOTOGRAPHED.points)
        best = fit_displacement(
            true, PHOTOGRAPHED.grid, refit.ansatz, refit.unknowns, PHOTOGRAPHED.mask
        )
        # As after a correlation that ends in no local minimum.
        assert rms_px(result.displacement() - best.displacement(), PHOTOGRAPHED.mask) < 0.02
        # w makes the residual what it is: 0.8 px beside speckles of 12 px.
        assert 0.5 < frame["model_error_px"] / (STATES[name] / 0.05 * W_PX / np.sqrt(2.0)) < 1.5


def test_it_is_left_out_unless_asked_for(photographs: Path, tmp_path: Path) -> None:
    run = HarvestRun(PhotographCase.read(experiment(photographs, frames="frame_2.tif")), tmp_path)
    assert run.harvest().frames[0].whole is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("element_px = 2.0", "element_px"),
        ("material_law = true", "unknown key whole_field.material_law"),
        ("mesure = true", "did you mean 'measure'"),
        ("[[gauges]]\nname = 'a'\npoint = [0, 0]", "gauges: expected whole displacements"),
        ("[[gauges]]\nname = 'a'\npoint = [0, 0]\n" * 2, "different names, got 'a' again"),
        ("measure = true\n[[gauges]]\nname = 'a'\npoint = [99, 0]", "'a': expected it on the mat"),
    ],
)
def test_bad_input(
    photographs: Path, tmp_path: Path, line: str, message: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = experiment(photographs, f"[whole_field]\n{line}\n")
    assert called(monkeypatch, "harvest", path, "--out", tmp_path / "out") == 2
    assert message in error_line(capsys)
    assert not list(tmp_path.rglob("frame*.h5"))  # before anything is measured


def test_where_there_is_no_mesh_the_modes_are_harvested_all_the_same(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError("expected wider ligaments")

    monkeypatch.setattr("modeharvest.idic.finite_element.measure.mesh_of_mask", fail)
    text = "[whole_field]\nmeasure = true\n"
    found = HarvestRun(PhotographCase.read(experiment(photographs, text)), tmp_path).harvest()
    assert len(found.frames) == 2
    for frame in found.frames:
        assert frame.whole is None
        assert frame.result.outcome is Outcome.CONVERGED
        message = frame.warnings[-1]
        assert f"whole displacement, {frame.name}: expected wider ligaments" in message
        assert "--no-whole-field" in message
