"""Case files: defaults are the paper's, and a wrong one is told in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.speckle.pattern import Ink
from modeharvest.runs.case import (
    Case,
    CaseModel,
    case_text,
    read_tables,
    shipped_cases,
    shipped_solution,
    table_of_kind,
)
from modeharvest.runs.lattice.case import LatticeCase
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.study import StudyCase
from modeharvest.util.errors import InputError


def written(folder: Path, text: str) -> Path:
    path = folder / "case.toml"
    path.write_text(text, "utf-8")
    return path


def test_a_solution_that_is_not_shipped_is_refused_with_those_that_are() -> None:
    assert shipped_solution("paper-virtual").is_file()
    with pytest.raises(InputError, match=r"among \['paper-real-twin', 'paper-virtual'\], got mine"):
        shipped_solution("mine")


def test_shipped_paper_case_spells_out_the_defaults() -> None:
    """So the file is a complete list of options, and 'defaults are the paper's' stays true."""
    case = Case.read("paper-virtual")
    assert case == Case(title=case.title)
    assert case.title == shipped_cases()["paper-virtual"]


def test_every_option_of_the_paper_case_is_in_its_text() -> None:
    text = case_text("paper-virtual")
    plain = Case().plain()
    tables = [plain["experiment"], plain["imaging"], plain["correlation"]]
    tables += [table[key] for table in tables for key in table if isinstance(table[key], dict)]
    names = {name for table in tables for name in table}
    # For those who read the docstring:
    left_out = {"path", *plain["experiment"]["path"]}
    left_out |= {"affine_distortion"}  # paper-real-twin shows it
    assert {name for name in names - left_out if name not in text} == set()


def test_the_options_that_are_off_in_the_paper_case_can_be_had(tmp_path: Path) -> None:
    text, count = re.subn(r"^# (?=\[|\w+ = )", "", case_text("paper-virtual"), flags=re.MULTILINE)
    assert count >= 15
    case = Case.read(written(tmp_path, text))
    assert case.imaging.speckle.ink == Ink()
    assert isinstance(case.imaging.distortion, CameraDistortion)
    assert case.imaging.shape is not None
    assert case.correlation.brightness == "none"


def test_materials_by_kind(tmp_path: Path) -> None:
    two = Case.read(written(tmp_path, '[experiment.material]\nkind = "two-term-I1"\nbulk = 40.0'))
    assert two.experiment.material == TwoTermI1(bulk=40.0)
    ogden = Case.read(
        written(tmp_path, "[experiment.material]\nmoduli = [1.0, 0.2]\nexponents = [2.0, -2.0]")
    )
    assert ogden.experiment.material == Ogden((1.0, 0.2), (2.0, -2.0))


def test_plain_values_make_the_same_case_again() -> None:
    case = Case()
    assert Case.model_validate(case.plain()) == case


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[experiment.specimen]\ndiametre = 1.0", "did you mean 'diameter'?"),
        ("[experiment]\nmesh_sise = 0.1", "did you mean 'mesh_size'?"),
        ("[imagin]\nbits = 8", "did you mean 'imaging'?"),
        ("[imaging.speckle]\nblur = 3.0", "did you mean 'blur_px'?"),
        ('[experiment.material]\nkind = "ogdn"', "kind among"),
        ("[experiment.material]\nmodul = [1.0]", "did you mean 'moduli'?"),
        ("[experiment.specimen]\ndiameter = 2.5", "0 < diameter < pitch"),
        ("[experiment.specimen]\nholes_x = 0", "expected 1 x 1 to 1000 x 1000 holes"),
        ('[experiment.specimen]\nholes_x = "six"', "'six'"),
        ("[experiment.specimen]\nbulk_x = -1.0", "bulk edges of 0 mm or more"),
        ("[experiment]\nstrains = [0.1, 0.05]", "ascending"),
        ("[experiment]\nstrains = [12.8]", "below 0.5"),
        ('[experiment]\nedges = "glued"', "'glued'"),
        ("[correlation]\norder = 4", "order 3, 5 or 11"),
        ("[imaging]\npixel_size = 0", "pixel size [mm] above 0"),
        ("[experiment", "not valid TOML"),
    ],
)
def test_a_wrong_case_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Case.read(written(tmp_path, text))
    message = str(caught.value)
    assert expected in message
    assert "\n" not in message
    assert "case.toml" in message


def test_a_misspelt_case_name_is_met_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'paper-virtual'"):
        Case.read("paper-virtal")


@pytest.mark.parametrize(
    ("kind", "start"),
    [
        (Case, "paper-virtual"),
        (LatticeCase, "square-lattice"),
        (PhotographCase, "photographs"),
        (StudyCase, "noise"),
    ],
)
def test_a_missing_file_is_named_and_what_it_could_begin_as(
    tmp_path: Path, kind: type[CaseModel], start: str
) -> None:
    with pytest.raises(InputError, match=rf"nothing\.toml.*'modeharvest cases {start}'"):
        kind.read(tmp_path / "nothing.toml")
    assert table_of_kind(read_tables(start)) == kind.table


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "[imaging.distortion]\nk9 = 1.0",
            r"unknown key imaging.distortion.k9; did you mean 'k\d'",
        ),
        ("[imaging.distortion]\nfx = 1.0", "expected fy, got none"),
        ("[imaging.distortion]\nkind = 'fish-eye'", "kind among .'camera'., got 'fish-eye'"),
        ("[imaging.speckle.ink]\ncovrage = 0.3", "did you mean 'coverage'?"),
        ("[calibration]\nstage_sd = 0.3", "did you mean 'stage_sd_px'?"),
        ("[calibration]\nshifts_px = []", "expected finite shifts"),
        ("[experiment]\ntilt = 5.0", "tilt: expected at most 1.0 rad"),
    ],
)
def test_what_a_twin_has_is_checked_too(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        Case.read(written(tmp_path, text))


def test_a_calibration_makes_a_case_a_twin(tmp_path: Path) -> None:
    lens = "[imaging.distortion]\nfx = 10.0\nfy = 10.0\ncx = 0.0\ncy = 0.0\n"
    assert Case.read(written(tmp_path, lens)).calibration is None
    twin = Case.read(written(tmp_path, lens + "[calibration]\nseed = 3"))
    assert twin.calibration is not None
    assert twin.calibration.seed == 3
    assert type(twin).model_validate(twin.plain()) == twin
