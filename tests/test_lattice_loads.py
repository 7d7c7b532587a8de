"""Loads at an angle, loads that are stresses, and searches of chosen waves only."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, square
from modeharvest.fem.lattice.options import (
    CriticalSearch,
    MacroLoading,
    equibiaxial,
    simple_shear,
    uniaxial,
)
from modeharvest.fem.materials import TwoTermI1
from modeharvest.report.lattice import lattice_report
from modeharvest.report.model.output import print_report
from modeharvest.runs import run
from modeharvest.runs.lattice.case import DispersionPlan, LatticeCase, SquareLattice
from modeharvest.runs.lattice.loads import Loading, LoadQuantity
from modeharvest.util.errors import InputError

pytestmark = [
    pytest.mark.dolfinx,
    pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures"),
]

SQUARE = square(1.0, 0.8, 0.2)
ANGLE = math.radians(30.0)
TURN = np.array([[math.cos(ANGLE), -math.sin(ANGLE)], [math.sin(ANGLE), math.cos(ANGLE)]])
ONLY_P = (("free", 0.0), (0.0, "free"))


def at(cell: UnitCell, loading: MacroLoading, load: float) -> Any:
    state = CellPath(PeriodicCell(cell, TwoTermI1()), loading).at(load)
    assert state is not None
    return state


@pytest.mark.parametrize("loading", [uniaxial(0), uniaxial(1), simple_shear()])
def test_a_load_at_an_angle_is_that_of_the_lattice_turned_back(loading: MacroLoading) -> None:
    back = UnitCell(Mesh(SQUARE.mesh.nodes @ TURN, SQUARE.mesh.cells, "T6"), SQUARE.lattice @ TURN)
    there = at(back, loading, 0.02)
    turned = MacroLoading(loading.gradient, loading.stress, ANGLE)
    here = at(SQUARE, turned, 0.02)
    assert np.allclose(here.gradient, TURN @ there.gradient @ TURN.T, atol=1e-12)
    assert np.allclose(here.stress, TURN @ there.stress @ TURN.T, atol=1e-11)
    rates = [state.rate[:4].reshape(2, 2) for state in (here, there)]
    assert np.allclose(rates[0], TURN @ rates[1] @ TURN.T, rtol=1e-8, atol=1e-9)
    moduli = np.einsum("ia,jb,kc,ld,abcd->ijkl", TURN, TURN, TURN, TURN, there.moduli)
    assert np.allclose(here.moduli, moduli, rtol=1e-8, atol=1e-8)
    cell = PeriodicCell(SQUARE, TwoTermI1())
    assert cell.negative_eigenvalues(turned, here) == 0
    assert np.linalg.norm(at(SQUARE, loading, 0.02).gradient - here.gradient) > 1e-3


def test_an_angle_is_given_in_degrees_and_named() -> None:
    assert Loading(angle=30.0).macro().angle == pytest.approx(ANGLE)
    assert Loading(angle=30.0).name == "uniaxial along x, axes turned by 30°"
    gradient = ((-1.0, 0.0), (0.0, "free"))
    assert Loading("prescribed", gradient=gradient, angle=90.0).macro().angle == math.pi / 2
    turned = at(SQUARE, Loading(angle=90.0).macro(), 0.02)
    assert np.allclose(turned.gradient, at(SQUARE, uniaxial(1), 0.02).gradient, atol=1e-12)
    with pytest.raises(InputError, match="finite rates"):
        Loading(angle=math.inf)


@pytest.mark.parametrize(
    ("loading", "quantity", "text"),
    [
        (Loading(), LoadQuantity(), "2 %"),
        (Loading("prescribed", gradient=((-1.0, 0.0), (0.0, "free"))), LoadQuantity(), "2 %"),
        (
            Loading("prescribed", gradient=ONLY_P, stress=((0.0, 0.0), (0.0, -0.5))),
            LoadQuantity("stress", "MPa", 0.5),
            "0.01 MPa",
        ),
        (
            Loading(
                "prescribed", gradient=((-1.0, 0.0), (0.0, "free")),
                stress=((0.0, 0.0), (0.0, -0.5)),
            ),
            LoadQuantity("load factor", "", 1.0),
            "e = 0.02",
        ),
    ],
)  # fmt: skip
def test_what_the_load_stands_for(loading: Loading, quantity: LoadQuantity, text: str) -> None:
    assert loading.quantity == quantity
    assert quantity.text(0.02) == text


def case(**changes: Any) -> LatticeCase:
    tables: dict[str, Any] = {
        "lattice": SquareLattice(1.0, 0.87, 0.2),
        "material": TwoTermI1(),
        "loading": Loading("equibiaxial"),
        "search": CriticalSearch(largest=0.1, divisions=2, refine=False),
        "dispersion": DispersionPlan(points=0),
    }
    return LatticeCase(**{**tables, **changes})


def test_a_prescribed_stress_is_called_one_everywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Equal pressure on both sides, 1 MPa at e = 1: what the strain loading meets, as a stress."""
    loading = Loading("prescribed", gradient=ONLY_P, stress=((-1.0, 0.0), (0.0, -1.0)))
    summary = run(case(loading=loading), tmp_path)
    assert summary["load"] == {"name": "stress", "unit": "MPa", "per_load": 1.0}
    load = summary["critical"]["load"]
    same = at(square(1.0, 0.87, 0.2), loading.macro(), load)
    assert same.stress[0, 0] == pytest.approx(-load, rel=1e-6)
    report = lattice_report(summary)
    print_report(report, tmp_path)
    printed = capsys.readouterr().out
    assert f"Critical stress {load:.5g}" in printed
    page = (tmp_path / "report.html").read_text("utf-8")
    # "strain" remains in fixed explanations (of the zone, of families) alone.
    assert "critical stress" in page
    assert "critical strain" not in page
    assert "nominal strain" not in page
    assert (
        "MPa" in " ".join(family["of"] for family in summary["families"]) or not summary["families"]
    )


def test_a_search_at_chosen_waves_finds_those_and_says_so() -> None:
    path = CellPath(PeriodicCell(square(1.0, 0.87, 0.2), TwoTermI1()), equibiaxial())
    every = first_critical(path, CriticalSearch(largest=0.1, divisions=4))
    pattern = first_critical(path, CriticalSearch(largest=0.1, waves=((1.0, 1.0),)))
    assert pattern.load == pytest.approx(every.load, rel=1e-9)
    assert pattern.outcome.endswith("; looked for at the 1 wave(s) asked for only")
    other = first_critical(path, CriticalSearch(largest=0.1, waves=((1.0, 0.0), (0.0, 0.0))))
    assert other.load > 1.5 * every.load
    with pytest.raises(InputError, match="in the lattice's plane"):
        CriticalSearch(waves=((1.0,),))


def test_without_points_there_is_no_dispersion(tmp_path: Path) -> None:
    summary = run(case(search=CriticalSearch(0.1, 2, waves=((1.0, 1.0),))), tmp_path)
    assert summary["critical"]["found"]
    assert summary["dispersion"] == summary["zone"] == []
    assert not (tmp_path / "dispersion.h5").exists()
    assert summary["modes"]["copies"] == [2, 2]
    # One refinement of the mesh, by default.
    assert 0 < summary["critical"]["error"] < 0.2 * summary["critical"]["load"]
    assert summary["critical"]["order"] == 2.0
    assert "elements across the ligament" in summary["notes"][0]


def test_a_text_of_an_analysis_has_its_loads_with_units() -> None:
    outcome = "the load falls from e = 0.0963 on; followed to e = 1.2e-05; not met: e = 0.2, e = 1"
    assert LoadQuantity().in_units(outcome) == (
        "the load falls from 9.63 % on; followed to 0.0012 %; not met: 20 %, 100 %"
    )
    assert LoadQuantity("stress", "MPa", 0.5).in_units("stable up to e = 0.2, the") == (
        "stable up to 0.1 MPa, the"
    )
    assert LoadQuantity("load factor", "", 1.0).in_units("at e = 0.2 for") == "at e = 0.2 for"
