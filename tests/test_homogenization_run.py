"""Homogenized specimens from a case to a report, and what is refused."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import loadmat
from summary_schemas import faults

from modeharvest.cli.root import main
from modeharvest.fem.lattice.micromorphic.patterns import rotation_pattern
from modeharvest.fem.lattice.options import equibiaxial
from modeharvest.fem.materials import Ogden
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.modes import square_family
from modeharvest.idic.result import Covariance, Result
from modeharvest.idic.spectra.mode_family import FoundFamily, write_family
from modeharvest.report.homogenization import homogenization_report
from modeharvest.report.model.output import print_report
from modeharvest.runs.homogenization.case import FileMode, HomogenizationCase
from modeharvest.runs.homogenization.pipeline import HomogenizationRun
from modeharvest.runs.homogenization.results import aligned, not_reached
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.validation.homogenization import ModeParameters

FloatArray = NDArray[np.float64]
SMALL = """
title = "A small specimen"
[homogenization]
mesh_size = 0.5
[mode]
kind = "measured"
[experiment]
strains = [0.03, 0.13]
mesh_size = 0.5
[experiment.specimen]
holes_x = 4
holes_y = 6
diameter = 1.65
[imaging]
pixel_size = 0.03
[correlation]
v0_degree = 4
v_degree = 3
"""


def test_a_pattern_and_its_mirror_image_are_one() -> None:
    v = np.array([1.0, 2.0, np.nan])
    measured = np.array([-1.1, -1.9, 4.0])
    np.testing.assert_array_equal(aligned(v, measured)[0], -v)
    np.testing.assert_array_equal(aligned(-v, measured)[0], -v)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"experiment.specimen": {"stacking": "rectangular", "pitch_y": 2.0}},
            "square or triangular stacking, got rectangular",
        ),
        ({"experiment.specimen": {"diameter_y": 1.4}}, "round holes"),
        (
            {
                "experiment.specimen": {"stacking": "triangular"},
                "homogenization": {"quarter": True},
            },
            "quarter = false except for square stacking",
        ),
        ({"homogenization": {"quarter": True}, "loading": {"shear": 1.0}}, "= false except"),
        ({"mode": {"numbers": [2]}}, "numbers from 1 to 1 in square"),
        (
            {"experiment.specimen": {"stacking": "triangular"}, "mode": {"numbers": [1, 1]}},
            "different numbers from 1 to 3",
        ),
        ({"loading": {"compression": 0.0}}, "one of them not 0"),
        ({"loading": {"sides": "held"}}, "sides: expected one of"),
        ({"loading": {"lateral": 1.0}}, "with lateral, got 'free'"),
        ({"loading": {"sheer": 1.0}}, "did you mean 'shear'"),
        ({"homogenization": {"quarter": False}, "experiment": {"guided": True}}, "straight"),
        ({"experiment.specimen": {"grading_x": 0.001}}, "without grading, scatter and tilt"),
        ({"mode": {"strain": 0.2}}, "expected a strain among"),
        ({"mode": {"kind": "guessed"}}, "expected a mode kind among"),
        ({"homogenization": {"mesh_size": 0.0}}, "mesh_size"),
        ({"homogenization": {"centre": "ligament"}}, "centre"),
        ({"homogenization": {"centre": [1e9, 0.0]}}, r"a centre \[mm\] of -3.8 to 3.8, got 1"),
        ({"homogenization": {"quater": True}}, "did you mean 'quarter'"),
        ({"homogenization": {"mesh": "b.msh", "edge_shifts": [0.1, 0.0]}}, "not for a mesh"),
        ({"homogenization": {"edge_shifts": [0.1]}}, r"\['find'\] or tuple.*, got \[0.1\]$"),
        ({"homogenization": {"edge_shifts": [-4.0, 0.0]}}, r"edge_shifts \[mm\] of -0.95 to 0.95"),
    ],
)
def test_what_can_not_be_homogenized_is_refused(
    change: dict[str, dict[str, Any]], message: str, tmp_path: Path, capsys: Any
) -> None:
    lines = ["[homogenization]", "[mode]", "[experiment]", "[experiment.specimen]"]
    lines += ["[loading]"] * ("loading" in change)
    for table, values in change.items():
        at = lines.index(f"[{table}]") + 1
        for key, value in values.items():
            text = f'"{value}"' if isinstance(value, str) else str(value).lower()
            lines.insert(at, f"{key} = {text}")
    path = tmp_path / "case.toml"
    path.write_text("\n".join(lines), "utf-8")
    with pytest.raises(InputError, match=message):
        HomogenizationCase.read(path)


def test_the_number_of_a_mode_may_be_large() -> None:
    """It is compared with what there is, and takes no memory: 10^13 once took all there was."""
    tracemalloc.start()
    try:
        HomogenizationCase(mode=FileMode(path="modes.h5", numbers=(10**6,)))
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_states_that_were_not_reached_are_warned_of() -> None:
    response = {"states": [{}], "outcome": "no equilibrium beyond the load 0.1"}
    assert not_reached(response, 1) == []
    assert not_reached(response, 3) == [
        "2 of 3 states were not reached: no equilibrium beyond the load 0.1"
    ]


@pytest.mark.dolfinx
@pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")
def test_a_measured_mode_predicts_the_specimen_that_it_was_measured_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    case, out = tmp_path / "small.toml", tmp_path / "out"
    case.write_text(SMALL, "utf-8")
    monkeypatch.setattr("sys.argv", ["modeharvest", "homogenize", str(case), "--out", str(out)])
    main_exit(0)
    summary = read_json(out / "summary.json")
    assert "critical strain" in (out / "report.html").read_text("utf-8")
    direct = summary["direct"]["critical_strain"]
    # Four holes are few: homogenization_studies.md has the series over sizes.
    assert summary["critical_strain"] == pytest.approx(direct, rel=0.15)
    assert summary["first_order_critical_strain"] < 0.75 * direct
    for state, exact in zip(summary["states"], summary["direct"]["states"], strict=True):
        assert state["force_N_per_mm"] == pytest.approx(exact["force_N_per_mm"], rel=0.05)
        assert state["energy_N"] == pytest.approx(exact["energy_N"], rel=0.05)
    assert 0 < summary["critical_strain_sd"] < 0.02 * summary["critical_strain"]
    assert [e["snapped"] for e in summary["sensitivities"]] == [False, *6 * [True]]
    before = (out / "homogenized.json").stat().st_mtime_ns
    again = HomogenizationRun(HomogenizationCase.read(case), out, source=str(case)).all()
    assert again == summary
    assert (out / "homogenized.json").stat().st_mtime_ns == before
    print_report(homogenization_report(again), out)
    amplitude = summary["amplitude"]
    assert amplitude["homogenized_rms_mm"] == pytest.approx(amplitude["measured_rms_mm"], rel=0.3)
    means = summary["displacement"]
    assert means["difference_rms_mm"] < 0.25 * means["measured_rms_mm"]
    for both in (amplitude, means):
        assert 0 < both["measured_sd_rms_mm"] < 0.5 * both["measured_rms_mm"]
        ratio = both["difference_over_sd"] * both["measured_sd_rms_mm"] / both["difference_rms_mm"]
        assert 0.2 < ratio < 5.0
    assert "Mean displacement v₀ at 13\u00a0%" in (out / "report.html").read_text("utf-8")
    assert summary["mode"]["errors"] == "model error"
    assert "phi1 is not observable" in summary["warnings"][0], "four holes are few"
    assert {s["negative_eigenvalues"] for s in summary["states"]} == {0}
    require_exported(out, summary)
    assert faults(summary, "homogenize") == []
    assert summary["edge_shifts"]["source"] == "found"
    assert summary["edge_shifts"]["mm"][0] > 0 > summary["edge_shifts"]["mm"][1]
    # The same mode from its file: without the images it was measured in, and their strain.
    result = out / "experiment/correlation/result_1300.json"
    one = SMALL.replace('"measured"', f'"file"\nsnap_anyway = true\npath = "{result}"')
    one = one.replace("mesh_size = 0.5\n[mode]", "mesh_size = 0.5\nfirst_order = false\n[mode]")
    from_file = HomogenizationRun(case_of(tmp_path / "file.toml", one), tmp_path / "file").all()
    assert from_file["critical_strain"] == pytest.approx(summary["critical_strain"], rel=1e-9)
    assert from_file["mode"]["errors"] == "noise"
    assert from_file["mode"]["wave_deviation"] is None
    assert from_file["critical_strain_sd_model_error"] is None
    assert from_file["critical_strain_sd_noise"] == from_file["critical_strain_sd"]
    assert summary["critical_strain_sd_noise"] < 0.5 * summary["critical_strain_sd_model_error"]
    assert summary["critical_strain_sd_model_error"] == summary["critical_strain_sd"]
    for s in summary["states"][1:]:
        assert 0 < s["force_sd_noise_N_per_mm"] < s["force_sd_model_error_N_per_mm"]
        assert 0 < s["energy_sd_noise_N"] < s["energy_sd_model_error_N"] == s["energy_sd_N"]
    assert 0 < summary["mode"]["wave_deviation"][0] < 3.44
    # With the error bars that a harvest leaves, those of the images themselves.
    known = read_json(out / "mode.json")["parameters"]
    measured = Result.read(result)
    by_model_error = np.zeros_like(measured.inverse)
    at = np.arange(len(by_model_error))[measured.ansatz.phi_slice(0)]
    by_model_error[np.ix_(at, at)] = known["by_model_error"]
    errors = Covariance(measured.covariance(), by_model_error)
    replace(measured, errors=errors).write(tmp_path / "harvested.json")
    other = SMALL.replace('"measured"', '"file"\npath = "harvested.json"')
    run = HomogenizationRun(case_of(tmp_path / "other.toml", other), tmp_path / "other")
    _, parameters, _ = run._found_modes()
    assert parameters is not None
    assert parameters.deviations == pytest.approx(summary["mode"]["wave_deviation"])
    assert from_file["critical_strain_sd"] < 0.5 * summary["critical_strain_sd"]
    assert from_file["amplitude"] is from_file["displacement"] is None
    before_buckling = SMALL.replace('"measured"', '"measured"\nstrain = 0.03')
    early = HomogenizationRun(case_of(tmp_path / "early.toml", before_buckling), out)
    with pytest.raises(InputError, match=r"expected an image of the buckled .* not observable"):
        early.all()


@pytest.mark.dolfinx
@pytest.mark.parametrize(("centre", "middle"), [("junction", 0.5), ("hole", 0.0)])
@pytest.mark.parametrize("positions", [1, 2, 5, 8])
def test_positions_are_spread_evenly_over_a_cell(
    tmp_path: Path, centre: str, middle: float, positions: int
) -> None:
    table = f'[homogenization]\ncentre = "{centre}"\npositions = {positions}\n'
    text = SMALL.replace("[homogenization]\n", table)
    case = case_of(tmp_path / "case.toml", text)
    pitch = case.experiment.specimen.pitch
    body = HomogenizationRun(case, tmp_path)._body([rotation_pattern(pitch)])
    centres = np.array([rve.centre for rve in body.rves]) / pitch
    assert centres.shape == (positions, 2)
    assert centres.mean(axis=0) == pytest.approx([middle, middle])
    # Waves of a cell's period shorter than the number of positions vanish in the mean.
    for order in range(1, positions):
        mean = np.exp(2j * np.pi * order * centres).mean(axis=0)
        assert np.abs(mean) == pytest.approx([0.0, 0.0], abs=1e-12)


ONE_ELEMENT = (
    SMALL.replace("measured", "analytic")
    .replace("[0.03, 0.13]", "[0.03]")
    .replace("[homogenization]", "[homogenization]\nfirst_order = false\ndivisions = [1, 1]")
)


@pytest.mark.dolfinx
def test_each_position_has_its_file_and_their_mean_counts(tmp_path: Path) -> None:
    text = ONE_ELEMENT.replace("[homogenization]", "[homogenization]\npositions = 2")
    text = text.replace("[0.03]", "[0.03, 0.13]")
    run = HomogenizationRun(case_of(tmp_path / "case.toml", text), tmp_path / "out")
    run.homogenize()
    centres, found = [], []
    for k in range(2):
        with h5py.File(tmp_path / f"out/rve{k + 1 if k else ''}.h5") as rve:
            assert (rve.attrs["position"], rve.attrs["positions"]) == (k + 1, 2)
            centres.append(rve["centre"][:])
            found.append(rve["states/stresses"][:])
    body = run._body([rotation_pattern(run.case.experiment.specimen.pitch)])
    np.testing.assert_allclose(centres, [rve.centre for rve in body.rves])
    with h5py.File(tmp_path / "out/homogenized.h5") as fields:
        # The specimen's are linearised from a state that is 1e-7 off.
        stresses = np.concatenate([fields[f"states/{k:03d}/stresses"][:] for k in (0, 1)])
    count = len(stresses) // 2
    of_states = np.r_[:count, -count:0]  # between them is the one before the critical point
    np.testing.assert_allclose(np.mean(found, axis=0)[of_states], stresses, atol=1e-7)
    assert np.ptp(found, axis=0).max() > 1e-4, "positions differ"


def require_exported(out: Path, summary: dict[str, Any]) -> None:
    """The RVE's file has the specimen's states and the mode with its error bars."""
    with h5py.File(out / "rve.h5") as rve, h5py.File(out / "homogenized.h5") as fields:
        loads, places = rve["states/loads"][:], rve["states/points"][:]
        wanted = [s["nominal_strain"] for s in summary["states"]]
        before = [e for e in np.unique(loads) if e not in wanted]
        assert before == pytest.approx([summary["critical_strain"]], abs=1e-4)
        for k, strain in enumerate(wanted):
            here = np.isclose(loads, strain)
            np.testing.assert_array_equal(places[here], fields["points"][:])
            assert set(rve["states/buckled"][:][here]) == {k == 1}
            for name in ("strains", "stresses"):
                # The specimen's are linearised from a state that is 1e-7 off.
                near = fields[f"states/{k:03d}/{name}"][:]
                np.testing.assert_allclose(rve[f"states/{name}"][:][here], near, atol=1e-7)
        # No pattern yet; near the critical point rounding grows.
        assert np.abs(rve["states/strains"][:, 4][loads < min(before) + 1e-9]).max() < 1e-6
        assert set(rve["states/negative_eigenvalues"]) == {0}
        known, mode = read_json(out / "mode.json")["parameters"], rve["waves/0"]
        measured = rve["measured"]
        np.testing.assert_array_equal(measured["parameters"], known["values"])
        np.testing.assert_array_equal(measured["by_model_error"], known["by_model_error"])
        assert list(measured["parameters"].attrs["names"]) == known["names"]
        assert list(measured["parameters"].attrs["units"]) == known["units"]
        assert np.trace(mode["covariance"]) > 0
        change = np.linalg.norm(mode["vectors"][:] - mode["measured/vectors"], axis=1)
        k = np.linalg.norm(mode["measured/vectors"], axis=1)
        np.testing.assert_allclose(change / k, summary["mode"]["wave_change"])
    assert loadmat(out / "rve.mat")["RVEmesh"]["nNodes"].item() > 0
    assert {"rve.h5", "rve.mat"} <= set(summary["files"])


def case_of(path: Path, text: str) -> HomogenizationCase:
    path.write_text(text, "utf-8")
    return HomogenizationCase.read(path)


def main_exit(code: int) -> None:
    with pytest.raises(SystemExit) as outcome:
        main()
    assert outcome.value.code == code


@pytest.mark.dolfinx
@pytest.mark.usefixtures("coarse_pictures")
def test_computed_modes_are_alternatives(tmp_path: Path) -> None:
    found = []
    for kind in ("analytic", "bloch"):
        case = tmp_path / f"{kind}.toml"
        text = SMALL.replace("measured", kind).replace("[0.03, 0.13]", "[0.1]")
        case.write_text(text + "fixed_mode = true", "utf-8")
        out = tmp_path / kind
        found.append(HomogenizationRun(HomogenizationCase.read(case), out).homogenize())
    analytic, bloch = (content["response"]["critical_strain"] for content in found)
    # The lattice's own mode has what Eq. (6) leaves to w, which plates then hold less.
    assert 0.85 * analytic < bloch < analytic
    assert found[0]["effects"] == [] == found[1]["effects"]
    for kind, has_waves in (("analytic", True), ("bloch", False)):
        with h5py.File(tmp_path / kind / "rve.h5") as rve:
            assert ("waves/0/sine" in rve, "waves/0/covariance" in rve) == (has_waves, False)
    assert not (tmp_path / "bloch" / "experiment").exists(), "no images are needed"


FLOWER = """
title = "A flower"
[homogenization]
mesh_size = 0.5
first_order = false
pattern_at_plates = "free"
divisions = [1, 1]
[mode]
kind = "bloch"
[loading]
lateral = 1.0
sides = "periodic"
loads = [0.025]
[experiment]
path = { first_step = 0.005, largest_step = 0.005 }
[experiment.specimen]
stacking = "triangular"
holes_x = 2
holes_y = 2
diameter = 1.7
bulk_x = 0.0
bulk_y = 0.0
"""


@pytest.mark.dolfinx
def test_of_three_modes_the_flower_wins(tmp_path: Path) -> None:
    from modeharvest.fem.bloch.critical import critical_at
    from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
    from modeharvest.fem.lattice.cells import hexagonal

    found = {}
    for kind in ("bloch", "analytic"):
        case, out = case_of(tmp_path / "case.toml", FLOWER.replace("bloch", kind)), tmp_path / kind
        found[kind] = HomogenizationRun(case, out).all()
        assert "Branches of the critical point" in (out / "report.html").read_text("utf-8")
        assert not (out / "experiment").exists(), "no direct simulation is of this load"
    for summary in found.values():
        branches = summary["branches"]
        assert branches[0]["pattern"] == [1, 1, 1]
        assert [sum(v != 0 for v in b["pattern"]) for b in branches] == 4 * [3] + 6 * [2] + 3 * [1]
        assert [b["negative_eigenvalues"] for b in branches] == 4 * [0] + 6 * [1] + 3 * [2]
        assert summary["states"][0]["energy_N"] == pytest.approx(branches[0]["energy"], rel=1e-8)
        assert summary["direct"]["states"] == []
        energies = [summary["branches"][k]["energy"] for k in range(13)]
        exact_energies = [b["energy"] for b in found["bloch"]["branches"]]
        np.testing.assert_allclose(energies, exact_energies, rtol=1e-9)
    cell = PeriodicCell(hexagonal(1.9, 1.7, 0.5), Ogden())
    exact = critical_at(CellPath(cell, equibiaxial()), (math.pi, math.pi)).load
    critical = {kind: summary["critical_strain"] for kind, summary in found.items()}
    assert critical["bloch"] == pytest.approx(exact, rel=1e-6)
    # With v the same everywhere w makes good what a mode's waves leave out.
    assert critical["analytic"] == pytest.approx(exact, rel=1e-6)


BENT = """
title = "A plate of one's own, bent"
[homogenization]
mesh = "plate.vtu"
mesh_size = 0.5
first_order = false
[mode]
kind = "analytic"
[loading]
compression = 0.5
bending = 1.0
plates = "sliding"
loads = [0.01, 0.02]
[experiment]
"""


def plate(path: Path, corners: list[list[float]]) -> None:
    """Two T6 elements."""
    nodes = np.array(corners)
    a, b, c, d = nodes
    middles = [(a + b) / 2, (b + c) / 2, (c + d) / 2, (d + a) / 2, (a + c) / 2]
    cells = [[0, 1, 2, 4, 5, 8], [0, 2, 3, 8, 6, 7]]
    points = np.pad(np.vstack([nodes, middles]), ((0, 0), (0, 1)))
    meshio.Mesh(points, {"triangle6": cells}).write(path)


@pytest.mark.dolfinx
def test_a_mesh_of_one_s_own_is_bent(tmp_path: Path) -> None:
    plate(tmp_path / "plate.vtu", [[0, 0], [8, 0], [8, 5], [0, 5]])
    case, out = case_of(tmp_path / "case.toml", BENT), tmp_path / "out"
    summary = HomogenizationRun(case, out).all()
    assert summary["direct"] == {"critical_strain": None, "states": []}
    assert [s["nominal_strain"] for s in summary["states"]] == [0.01, 0.02]
    energies = [s["energy_N"] for s in summary["states"]]
    assert energies[1] == pytest.approx(4 * energies[0], rel=0.1)
    assert not (out / "experiment").exists()
    # The stage knows its mesh: another one is another specimen.
    plate(tmp_path / "plate.vtu", [[0, 0], [8, 0], [8, 6], [0, 6]])
    larger = HomogenizationRun(case, out).homogenize()["response"]["states"]
    assert larger[0]["energy_N"] > 1.1 * energies[0]


@pytest.mark.dolfinx
@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([[0, 0], [4, -3], [8, 0], [4, 3]], "expected supports that leave no rigid motion"),
        ([[0, 0], [0, 5], [8, 5], [8, 0]], "expected elements with positive Jacobians"),
        ([[0, 0], [8e-3, 0], [8e-3, 5e-3], [0, 5e-3]], "got 0.005 mm; is it in metres?"),
        ([], "plate.vtu, found no such file"),
    ],
)
def test_a_mesh_that_will_not_do_is_refused_in_one_line(
    corners: list[list[float]], message: str, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    case = tmp_path / "case.toml"
    case.write_text(BENT, "utf-8")
    if corners:
        plate(tmp_path / "plate.vtu", corners)
    monkeypatch.setattr("sys.argv", ["modeharvest", "homogenize", str(case), "--out", "out"])
    monkeypatch.chdir(tmp_path)
    main_exit(2)
    error = capsys.readouterr().err
    assert message in " ".join(error.split())
    assert "Traceback" not in error


def test_a_folder_is_no_mode(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    """An empty path, which is the case's own folder, was once a fault of the program."""
    text = SMALL.replace('"measured"', '"file"\npath = ""')
    (tmp_path / "case.toml").write_text(text, "utf-8")
    monkeypatch.setattr("sys.argv", ["modeharvest", "homogenize", "case.toml", "--out", "out"])
    monkeypatch.chdir(tmp_path)
    main_exit(2)
    assert "expected a JSON file at ., found a folder" in " ".join(capsys.readouterr().err.split())


class Modes:
    """A result with some modes."""

    def __init__(self, ansatz: Ansatz) -> None:
        self.ansatz = ansatz
        self.unknowns = np.zeros(ansatz.size)


@pytest.mark.dolfinx
def test_three_measured_modes_are_snapped_each(tmp_path: Path) -> None:
    """Their parameters a little off; of the third a wave lies between two of the lattice's."""
    text = FLOWER.replace('"bloch"', '"measured"').replace("holes_x = 2", "holes_x = 7")
    case = case_of(tmp_path / "case.toml", text.replace("holes_y = 2", "holes_y = 7"))
    run = HomogenizationRun(case, tmp_path / "out")
    ansatz = Ansatz.of_specimen(case.experiment.specimen)
    object.__setattr__(run, "result", Modes(ansatz))
    guesses = [mode.family.start for mode in ansatz.modes]
    off = np.concatenate(guesses) + np.tile([0.01, 0.02, 0.03, -0.02, 0.05, -0.05], 3)
    modes = run._modes_of(off)
    assert [mode.wave_change.max() < 0.06 for mode in modes] == 3 * [True]
    points = np.random.default_rng(0).uniform(-5, 5, (20, 2))
    lattice = run._cell.lattice
    for mode in modes:
        there = mode.snapped(points + lattice[0] - 2 * lattice[1])
        np.testing.assert_allclose(there, mode.snapped(points), atol=1e-9)
    quarter = 0.5 * case.experiment.specimen.pitch  # of a wave: the pattern of another parity
    with pytest.raises(InputError, match=r"all of them to be odd .* or all even, got odd, even, o"):
        run._modes_of(off + np.repeat([0.0, quarter, 0.0], [10, 2, 6]))
    off[12:16] += [0.0, 0.0, 0.3, 0.0]
    with pytest.raises(InputError, match=r"phi3: mode: expected wave vectors within 10%"):
        run._modes_of(off)


@pytest.mark.dolfinx
@pytest.mark.parametrize("anyway", [False, True])
def test_a_wave_vector_far_from_the_lattice_s_is_refused_unless_wanted(
    anyway: bool, tmp_path: Path
) -> None:
    """By its standard deviations where the model error is known, else by a hundredth of itself."""
    text = SMALL.replace('"measured"', f'"measured"\nsnap_anyway = {str(anyway).lower()}')
    run = HomogenizationRun(case_of(tmp_path / "case.toml", text), tmp_path / "out")
    ansatz = Ansatz.of_specimen(run.case.experiment.specimen)
    object.__setattr__(run, "result", Modes(ansatz))
    family, noise, error = ansatz.modes[0].family, 1e-8 * np.eye(7), 1e-4 * np.eye(7)

    def far(off: float, by_model_error: FloatArray | None) -> list[str]:
        values = family.start + off * np.array([0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        given = ModeParameters(family.names, family.units, values, noise, by_model_error)
        found = run._modes_of(values)
        try:
            return list(run._far_waves(found, run._deviations(found, given)))
        except InputError as refused:
            return ["refused", str(refused)]

    assert [far(0.005, None), far(0.02, error)] == [[], []]
    for off, by, words in ((0.02, None, "within 1%"), (0.04, error, "5.7 of them")):
        texts = far(off, by)
        assert (texts[0] == "refused") != anyway
        assert words in texts[-1]
        assert "is this its lattice?" in texts[-1]
        assert ("snap_anyway = true in [mode]" in texts[-1]) != anyway


@pytest.mark.dolfinx
def test_families_of_modes_are_snapped_and_have_the_specimen_s_pitch(tmp_path: Path) -> None:
    """A file each; the origin is a hole's centre, as that of the cells that they were found on."""
    ideal, points = rotation_pattern(1.9), np.random.default_rng(0).uniform(-4, 4, (20, 2))
    for k, pitch in ((1, 1.9), (2, 1.91)):
        family = FoundFamily(square_family("hole"), pitch, 0.1, 1.0, (), ())
        write_family(tmp_path / f"family_{k}.json", family)
    text = SMALL.replace('"measured"', '"file"\npath = "family_*.json"')
    case = case_of(tmp_path / "case.toml", text)
    modes, parameters, _ = HomogenizationRun(case, tmp_path / "out")._found_modes()
    assert parameters is None
    assert [mode.wave_change.max() < 0.01 for mode in modes] == [True, True]
    np.testing.assert_allclose(modes[0].snapped(points), -2 * ideal(points), atol=1e-12)
    (tmp_path / "list.json").write_text("[]", "utf-8")
    other = case_of(tmp_path / "case.toml", text.replace("family_*", "list"))
    with pytest.raises(InputError, match="expected modeharvest-result-"):
        HomogenizationRun(other, tmp_path / "out")._found_modes()
    write_family(tmp_path / "family_3.json", replace(family, pitch=2.0))
    with pytest.raises(InputError, match=r"specimen's pitch, 1.9 mm, got 3 with 1.9, 1.91, 2 mm"):
        HomogenizationRun(case, tmp_path / "out")._found_modes()


@pytest.mark.dolfinx
def test_modes_of_a_cell_come_with_it(tmp_path: Path) -> None:
    """As ``modeharvest modes`` leaves them; what belongs to another cell is refused."""
    from modeharvest.fem.bloch.critical import critical_at
    from modeharvest.fem.bloch.modes import write_modes
    from modeharvest.fem.bloch.real_modes import real_modes
    from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
    from modeharvest.fem.lattice.cells import square

    cell = PeriodicCell(square(1.9, 1.7, 0.5), Ogden())
    found = critical_at(CellPath(cell, equibiaxial()), (math.pi, math.pi))
    modes = real_modes(cell, found.state, [(math.pi, math.pi)])
    write_modes(tmp_path / "modes.h5", modes)
    write_modes(tmp_path / "gap.h5", replace(modes, lattice=1.01 * modes.lattice))
    text = FLOWER.replace('stacking = "triangular"', "").replace(
        '"bloch"', '"file"\npath = "modes.h5"'
    )
    text = text.replace("divisions", "centre = [0.95, 0.95]\ndivisions")
    run = HomogenizationRun(case_of(tmp_path / "case.toml", text), tmp_path / "out")
    summary = run.all()
    assert summary["critical_strain"] == pytest.approx(found.load, rel=1e-6)
    assert summary["case"]["homogenization"]["centre"] == [0.95, 0.95]
    for change, message in (
        (("diameter = 1.7", "diameter = 1.6"), r"modes of the specimen's lattice, 44.3% solid"),
        (("diameter = 1.7", "diameter = 1.7\npitch = 2.0"), r"cell with vectors \[\[1.9, 0.0\]"),
        (('path = "modes.h5"', 'path = "modes.h5"\nnumbers = [2]'), "expected 2 modes, got 1"),
        (("modes.h5", "gap.h5"), "no direction has partners"),
    ):
        other = case_of(tmp_path / "other.toml", text.replace(*change))
        with pytest.raises(InputError, match=message):
            HomogenizationRun(other, tmp_path / "other").all()
