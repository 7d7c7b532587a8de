"""Measured modes: projections, overlaps, scaling, what is told of specimens that differ."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from html_page import frame
from numpy.typing import NDArray

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.modes import square_family
from modeharvest.idic.spectra.mode_family import wave_sum
from modeharvest.report.studies.modes import report_modes
from modeharvest.runs.case import shipped_solution
from modeharvest.runs.study import StudyCase
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.validation.studies import modes as modes_specimen
from modeharvest.validation.studies.lattice import EQ_MODE, ModeRow, PatternMode
from modeharvest.validation.studies.modes import MeasuredModesStudy, likeness, one_specimen
from modeharvest.validation.studies.modes_specimen import (
    PatternCells,
    SpecimenSpec,
    buckle,
    nearest_aspect,
    overlap_on_specimen,
)
from modeharvest.validation.studies.study import ImagePairSpec

FloatArray = NDArray[np.float64]
PAPER = shipped_solution("paper-virtual")
SOLID = Specimen(4, 6, bulk_x=0.0, bulk_y=0.0)
"""Its meshes here have no holes, which projections don't ask for."""


def plate(specimen: Specimen, per_cell: int = 8) -> Mesh:
    """Biquadratic elements over a specimen's rectangle, or over one cell about a hole's centre."""
    return rectangle(specimen.half_size, (specimen.holes_x * per_cell, specimen.holes_y * per_cell))


def rectangle(half: tuple[float, float], count: tuple[int, int]) -> Mesh:
    x, y = (np.linspace(-h, h, 2 * n + 1) for h, n in zip(half, count, strict=True))
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    first = (2 * np.arange(count[0])[:, None] * len(y) + 2 * np.arange(count[1])).ravel()
    place = np.array([(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1), (1, 1)])
    return Mesh(nodes, first[:, None] + place @ [len(y), 1], "Q9")


def mode_of(pitch: float, aspect: float = 1.0) -> PatternMode:
    """Eq. (6) itself with a1 = ``aspect``, posing as a numerical mode."""
    mesh = rectangle((0.5 * pitch, 0.5 * pitch), (8, 8))
    ideal = wave_sum(EQ_MODE.waves(EQ_MODE.start), mesh.nodes, pitch)
    row = ModeRow("", "uniaxial", pitch, 0.79, 8, True, 0.074, "pattern", 0.074, 0.074, 0.0, 1.0,
                  1.0, 2)  # fmt: skip
    return PatternMode(row, mesh, ideal * [aspect, 1.0], ideal)


# -- projections and overlaps -------------------------------------------------------------


def test_likeness_is_that_of_the_shape() -> None:
    """1 for a field and itself whatever its size, sign and translation, 0 for a right angle."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(500, 2))
    assert likeness(u, -3.0 * u + [1.0, 2.0]) == pytest.approx(1.0, abs=1e-12)
    turned = np.column_stack([-u[:, 1], u[:, 0]])
    assert likeness(u, turned) < 0.15  # uncorrelated: 1/sqrt(1000) = 0.03 is one sd


def test_the_pattern_s_amplitude_is_seen_through_everything_else() -> None:
    """Neither a compression nor a field of the lattice's own period has any."""
    mesh = plate(SOLID)
    cells, pattern = PatternCells(mesh, SOLID), SOLID.pattern(mesh.nodes)
    x, y = mesh.nodes.T
    turn = 2.0 * np.pi / SOLID.pitch
    else_ = np.column_stack([-0.1 * x, 0.04 * y]) + 0.05 * np.sin(turn * mesh.nodes) + 0.3
    # Biquadratic elements of l/8 follow a wave of length 2 l to (2 pi / 16)^3 / 60 = 1e-3.
    assert cells.amplitude(else_) < 1e-3
    assert cells.amplitude(else_ - 0.3 * pattern) == pytest.approx(0.3, rel=2e-3)
    assert cells.share(2.0 * pattern) == pytest.approx(1.0, abs=1e-3)
    assert cells.share(-pattern) == pytest.approx(-1.0, abs=1e-3)
    assert abs(cells.share(np.column_stack([pattern[:, 1], pattern[:, 0]]))) < 0.01


def test_the_lattice_s_mode_lies_on_the_specimen_s_holes() -> None:
    """Eq. (6) about a hole, copied to all of them, is Eq. (6) about a junction."""
    mode, family = mode_of(1.9), square_family("junction")
    assert overlap_on_specimen(mode, SOLID, family, family.start) == pytest.approx(1.0, abs=1e-4)
    tilted = family.start.copy()
    tilted[1] += 0.05  # over half of 4 cells a phase of 0.05 pi 2 = 0.3 rad
    assert 0.9 < overlap_on_specimen(mode, SOLID, family, tilted) < 0.999
    assert (
        overlap_on_specimen(mode, SOLID, square_family("hole"), square_family("hole").start) < 0.01
    )
    assert nearest_aspect(mode) == pytest.approx(1.0, abs=1e-12)
    assert nearest_aspect(mode_of(1.9, 0.97)) == pytest.approx(0.97, abs=1e-12)
    narrow = family.start.copy()
    narrow[0] = 0.97
    assert overlap_on_specimen(mode_of(1.9, 0.97), SOLID, family, narrow) == pytest.approx(
        1.0, abs=1e-4
    )


# -- specimens ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spec() -> ImagePairSpec:
    """The paper's specimen on images of 0.05 mm/px, which take a tenth of a second."""
    case = StudyCase()
    imaging = replace(case.imaging, pixel_size=0.05)
    return ImagePairSpec(case.experiment, imaging, case.correlation, lambda: Solution.read(PAPER))


def scaled(solution: Solution, factor: float) -> Solution:
    """The same in other millimetres: neither equations nor material have a length."""
    mesh = Mesh(factor * solution.mesh.nodes, solution.mesh.cells, solution.mesh.element)
    (snapshot,) = (s for s in solution.snapshots if s.nominal_strain == 0.128)
    moved = replace(snapshot, displacement=factor * snapshot.displacement)
    return Solution(mesh, (moved,), solution.info)


def stable(specimen: Specimen) -> Solution:
    """A specimen that never buckles."""
    mesh = plate(specimen, 1)
    snapshot = Snapshot(0.28, -0.1 * mesh.nodes, 0.0, 0.0, 0, (), "primary")
    return Solution(mesh, (snapshot,), {"critical": None, "outcome": "stable up to 28 %"})


@pytest.fixture(scope="module")
def measured(spec: ImagePairSpec, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ...]:
    """A study of the base, of it twice as large, and of one that stays stable, without dolfinx."""
    folder = tmp_path_factory.mktemp("modes")

    def simulated(experiment: Experiment, wanted: float, largest: float) -> Solution:
        if experiment.specimen.pitch == 3.8:
            assert wanted == pytest.approx(2 * 0.287, abs=0.003)  # facts of the paper's specimen
            return scaled(spec.solution, 2.0)
        return stable(experiment.specimen)

    study = MeasuredModesStudy(
        ratios=(0.6,), pitches=(3.8,), materials=(), gradings_x=(), gradings_y=(), divisions=8
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modes_specimen, "buckle", simulated)
        patch.setattr(
            modes_specimen,
            "lattice_mode",
            lambda specimen, material, divisions: mode_of(specimen.pitch),
        )
        cases = study.prepare(spec, folder)
        rows = [{**case, "error": "", **one_specimen(case, folder)}
                for case in cases]  # fmt: skip
    return study, pd.DataFrame(rows), folder


def test_the_size_of_the_cells_changes_nothing(measured: tuple[Any, ...]) -> None:
    """With pixels in proportion the images are the same, and so is all that is measured in l.

    What rounding does to the images' edges and to the path of the minimiser is below its tolerance,
    1e-4 px or 3e-6 l; a parameter moves by no more than the standard deviations' thousandth.
    """
    _, table, _ = measured
    base, large = (table[table["varied"] == v].iloc[0] for v in ("base", "l"))
    assert (base["pitch_mm"], large["pitch_mm"]) == (1.9, 3.8)
    for name in modes_specimen.PARAMETERS:
        assert large[name] == pytest.approx(base[name], abs=1e-5), name
        assert large[f"{name}_sd_model_error"] == pytest.approx(
            base[f"{name}_sd_model_error"], rel=1e-3
        )
    for name in (
        "w_px",
        "model_error_px",
        "measurement_error_px",
        "overlap_truth",
        "overlap_lattice",
        "amplitude",
    ):
        assert large[name] == pytest.approx(base[name], rel=1e-4), name


def test_what_is_measured_of_the_paper_s_specimen(measured: tuple[Any, ...]) -> None:
    """The best fit is the best; parameters lie within their error bars of its."""
    _, table, _ = measured
    base = table.iloc[0]
    assert base["model_error_px"] < base["w_px"]
    assert base["w_px"] < base["model_error_px"] + base["measurement_error_px"]
    assert base["overlap_truth"] < base["best_overlap_truth"] < 1.0
    apart = [(base[n] - base[f"best_{n}"]) / base[f"{n}_sd_model_error"]
             for n in modes_specimen.PARAMETERS]  # fmt: skip
    assert np.abs(apart).max() < 4.0
    assert 0.0 < base["a2_sd_noise"] < base["a2_sd_model_error"]


def test_a_specimen_without_a_pattern_says_so(measured: tuple[Any, ...]) -> None:
    study, table, folder = measured
    row = table[table["varied"] == "d/l"].iloc[0]
    assert (row["first"], row["ratio"]) == ("none", 0.6)
    assert math.isnan(row["a1"])
    found = report_modes(study.analyse(table, folder), study.seeds)
    assert any("d/l 0.6: no pattern, stable up to 28 %" in s for s in found.text)
    assert len(frame(found.tables, "Buckling")) == 3
    assert list(frame(found.tables, "Parameters")["level"]) == ["", "3.8 mm"]
    assert len(frame(found.attachments, "Every parameter")) == 2 * 7
    assert list(found.figures) == ["parameters", "overlaps", "patterns", "others"]
    assert all(draw().axes for draw in found.figures.values())


def test_other_ends_are_reported_and_left_out(measured: tuple[Any, ...]) -> None:
    study, table, folder = measured
    odd = table.copy()
    odd["unstable_pivots"] = odd["unstable_pivots"].astype(float)
    odd.loc[0, "unstable_pivots"] = 2.0
    odd.loc[1, ["first", "simulation"]] = ["other", "the branch could be followed to 0.1 l only"]
    odd.loc[1, "pattern_share"] = 0.2
    odd.loc[2, "outcome"] = "local_minimum"
    message = " ".join(report_modes(study.analyse(odd, folder), "seed 0").text)
    assert "On 1 specimen with d/l" in message
    assert "base: measured in a state that is not stable" in message
    assert "d/l 0.6: buckles into something else first (the pattern is 4 %" in message
    assert "the branch could be followed to 0.1 l only" in message
    assert "l 3.8 mm: the correlation ended local_minimum" in message


def test_a_description_comes_back_as_it_was(measured: tuple[Any, ...]) -> None:
    _, table, folder = measured
    for name in table["specimen"]:
        path = folder / "specimens" / name / "specimen.json"
        again = json.loads(json.dumps(SpecimenSpec.read(path).plain()))
        assert again == read_json(path)


# -- simulation ---------------------------------------------------------------------------


@pytest.mark.dolfinx
def test_a_specimen_is_compressed_to_the_pattern_asked_for() -> None:
    """Its critical strain is that of another walk; the pattern is as large as asked."""
    from mpi4py import MPI

    from modeharvest.fem.path.bifurcation import PATTERN_TOLERANCE
    from modeharvest.fem.simulate import simulate

    specimen = Specimen(2, 2, diameter=1.6, bulk_x=0.9, bulk_y=0.9)
    experiment = Experiment(specimen, mesh_size=0.4, branches=("primary",))
    found = buckle(experiment, 0.1, 0.28)
    beyond = found.info["critical"]["strain"] + 0.002
    walked = simulate(replace(experiment, strains=(0.02, beyond)), comm=MPI.COMM_SELF)
    assert found.info["outcome"] == "complete"
    assert found.info["critical"]["strain"] == pytest.approx(
        walked.info["critical"]["strain"], abs=2 * experiment.path.critical_tolerance
    )
    reached = PatternCells(found.mesh, specimen).amplitude(found.snapshots[0].displacement)
    assert reached == pytest.approx(0.1, rel=PATTERN_TOLERANCE)


# -- bad input ----------------------------------------------------------------------------


def test_the_shipped_study_spells_out_the_defaults() -> None:
    assert StudyCase.read("modes").study == MeasuredModesStudy()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ratios": (0.7, 1.0)}, "ratios d/l between 0 and 1"),
        ({"ratios": (0.7, 0.7)}, "ratios that differ"),
        ({"pitches": (0.0,)}, "pitches above 0 mm"),
        ({"materials": ("steel",)}, "materials among"),
        ({"gradings_x": (0.0,)}, "gradings other than 0"),
        ({"largest": 0.7}, "largest between 0 and 0.5"),
    ],
)
def test_wrong_options_are_reported_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        MeasuredModesStudy(**options)
    assert "\n" not in str(caught.value)


def test_a_base_that_has_not_buckled_is_reported(spec: ImagePairSpec, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"buckled at 7.8 %, got one with 9.6\d* % as its"):
        MeasuredModesStudy(strain=0.078).prepare(spec, tmp_path)
    tilted = replace(spec, experiment=replace(spec.experiment, tilt=0.01))
    with pytest.raises(InputError, match="perfect specimen"):
        MeasuredModesStudy().prepare(tilted, tmp_path)


def test_gradings_too_steep_are_reported(spec: ImagePairSpec, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="make diameters or gradings smaller"):
        MeasuredModesStudy(gradings_x=(0.2,)).prepare(spec, tmp_path)
