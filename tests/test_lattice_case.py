"""Cases of infinite lattices: what the shipped ones are, and a wrong one is told in one line."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from modeharvest.fem.bloch.dispersion import ZONES
from modeharvest.fem.lattice.options import equibiaxial, simple_shear, uniaxial, uniaxial_strain
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.runs.case import Case, shipped_cases
from modeharvest.runs.lattice.case import (
    ChiralLattice,
    DispersionPlan,
    FileLattice,
    HexachiralLattice,
    HexagonalLattice,
    LatticeCase,
    Loading,
    ModesPlan,
    SquareLattice,
)
from modeharvest.util.errors import InputError
from modeharvest.validation.studies.lattice import StudyPlan

SHIPPED = ("chiral-lattice", "hexagonal-lattice", "mode-study", "square-lattice")


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, "utf-8")
    return path


def test_the_shipped_lattices_can_be_read() -> None:
    assert tuple(sorted(shipped_cases("lattice"))) == SHIPPED
    for name in SHIPPED:
        case = LatticeCase.read(name)
        assert case.title
        assert LatticeCase.model_validate(case.plain()) == case


def test_the_square_case_spells_out_the_defaults_of_its_tables() -> None:
    """So that the file is a complete list of options but for [study]."""
    case = LatticeCase.read("square-lattice")
    assert case == LatticeCase(
        title=case.title, lattice=SquareLattice(mesh_size=0.12), material=TwoTermI1()
    )


def test_the_study_case_studies_what_the_paper_and_the_defaults_do() -> None:
    case = LatticeCase.read("mode-study")
    plan, default = case.study, StudyPlan()
    assert plan is not None
    assert (plan.ratios, plan.loadings, plan.overlays) == (
        default.ratios,
        default.loadings,
        default.overlays,
    )
    assert {0.25, 0.7895, 0.95} <= set(plan.overlays)  # Fig. 8: 0.25, 0.79, 0.95


@pytest.mark.parametrize(
    ("loading", "same"),
    [
        (Loading(), uniaxial()),
        (Loading("uniaxial", "y"), uniaxial(1)),
        (Loading("uniaxial-strain", "y"), uniaxial_strain(1)),
        (Loading("equibiaxial"), equibiaxial()),
        (Loading("shear"), simple_shear()),
        (Loading("prescribed", gradient=((-1.0, 0.0), (0.0, "free"))), uniaxial()),
    ],
)
def test_loadings_by_kind(loading: Loading, same: object) -> None:
    assert loading.macro() == same


def test_a_free_component_is_read_from_toml(tmp_path: Path) -> None:
    text = """
    [lattice]
    [loading]
    kind = "prescribed"
    gradient = [[-1.0, 0.0], [0, "free"]]
    stress = [[0.0, 0.0], [0.0, -0.1]]
    """
    macro = LatticeCase.read(written(tmp_path, text)).loading.macro()
    assert macro.gradient == ((-1.0, 0.0), (0.0, None))
    assert macro.dead.tolist() == [0.0, 0.0, 0.0, -0.1]


def test_a_file_s_path_is_relative_to_the_case(tmp_path: Path) -> None:
    case = LatticeCase.read(
        written(tmp_path, '[lattice]\nkind = "file"\npath = "cell.msh"\npitch = 2.0')
    )
    assert case.lattice == FileLattice(str(tmp_path / "cell.msh"), 2.0)


def test_the_tour_suits_the_lattice_and_its_load() -> None:
    plan, both, one = DispersionPlan(), Loading("equibiaxial"), Loading("uniaxial")
    assert plan.tour(SquareLattice(), both) == ZONES["square"]
    assert plan.tour(SquareLattice(), one) == ZONES["oblique"]
    assert plan.tour(HexagonalLattice(), both) == ZONES["hexagonal"]
    assert plan.tour(HexachiralLattice(), one) == ZONES["rhombic"]
    assert plan.tour(ChiralLattice(), Loading("shear")) == ZONES["oblique"]
    assert plan.tour(FileLattice("x.msh", 1.0), both) == ZONES["oblique"]
    own = DispersionPlan(corners=(("Γ", (0.0, 0.0)), ("here", (0.5, 1.0))))
    assert own.tour(SquareLattice(), one)[1] == ("here", (0.5 * math.pi, math.pi))
    assert ModesPlan(waves=((1.0, 0.5),)).phases == ((math.pi, 0.5 * math.pi),)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[lattice]\nkind = "sqare"', "lattice kind among"),
        ("[lattice]\ndiametre = 1.0", "did you mean 'diameter'?"),
        ('[lattice]\ndiameter = "x"', "'x'"),
        ("[lattice]\ndiameter = 2.5", "0 < diameter < pitch [mm], got 2.5 and 1.9"),
        ('[lattice]\nkind = "hexagonal"\nmesh_size = 0.0', "mesh_size [mm] above 0, got 0.0"),
        ('[lattice]\nkind = "hexachiral"\nring_radus = 1.0', "did you mean 'ring_radius'?"),
        ('[lattice]\nkind = "hexachiral"\nring_radius = -1.0', "ring_radius [mm] above 0"),
        ('[lattice]\nkind = "tetrachiral"\nhandedness = "left"', "'clockwise'"),
        ('[lattice]\nkind = "file"\npath = "a.msh"\npitch = 0.0', "pitch [mm] above 0"),
        ('[lattice]\nkind = "file"\npath = "a.msh"', "pitch"),
        ("latice = 1", "did you mean 'lattice'?"),
        ("[serch]\nlargest = 0.1", "did you mean 'search'?"),
        ("[search]\nlargest = 2.0", "0 < largest < 1"),
        ("[search]\nlargst = 2.0", "did you mean 'largest'?"),
        ('[loading]\nkind = "uniaxal"', "'uniaxal'"),
        ('[loading]\nkind = "prescribed"', "expected the gradient"),
        ("[loading]\ngradient = [[1.0, 0.0], [0.0, 1.0]]", 'with kind = "prescribed"'),
        ('[loading]\nkind = "prescribed"\ngradient = [[-1.0, 0.0], [0.0, "fre"]]', "'fre'"),
        (
            '[loading]\nkind = "prescribed"\ngradient = [[-1.0, "free"], ["free", 0.0]]',
            "set one of them to 0",
        ),
        ("[material]\nmodul = [1.0]", "did you mean 'moduli'?"),
        ('[dispersion]\ncorners = [["G", [0, 0]], ["M", [1, 1, 1]]]', "in the lattice's plane"),
        ('[dispersion]\ncorners = [["G", [0, 0]]]', "two corners or more"),
        ("[dispersion]\nmap_divisions = 7", "even number"),
        ("[dispersion]\nloads = [-0.1]", "loads of 0 or more"),
        ("[modes]\nwaves = [[1]]", "in the lattice's plane"),
        ("[modes]\ncombinations = [[0, 0]]", "not all 0"),
        ('[lattice]\n[study]\nloadings = ["equi"]', "did you mean 'equibiaxial'?"),
        ("[lattice]\n[study]\nratio = [0.5]", "did you mean 'ratios'?"),
        ("[lattice]\n[study]\nratios = [1.5]", "0 < d/l < 1"),
        ('[lattice]\nkind = "hexagonal"\n[study]', "expected a square lattice"),
    ],
)
def test_a_wrong_case_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        LatticeCase.read(written(tmp_path, text))
    message = str(caught.value)
    assert expected in message
    assert "\n" not in message
    assert "mine.toml" in message


def test_each_kind_of_case_says_what_to_run_for_the_other() -> None:
    with pytest.raises(InputError, match="run 'modeharvest modes square-lattice"):
        Case.read("square-lattice")
    with pytest.raises(InputError, match="run 'modeharvest run paper-virtual"):
        LatticeCase.read("paper-virtual")


def test_the_material_is_ogden_s_unless_named() -> None:
    assert LatticeCase().material == Ogden()
