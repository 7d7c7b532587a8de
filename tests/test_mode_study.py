"""The mode study's bookkeeping: its table, its bisection, its names; no dolfinx needed.

Guards: what a table has is not computed again, and comes back as it was; the place where the
pattern stops being first is bracketed; bad lattices and tables are refused.
"""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_lattice import row

from modeharvest.fem.lattice.options import simple_shear
from modeharvest.fem.materials import MATERIALS, Ogden, TwoTermI1
from modeharvest.runs.lattice.loads import Loading
from modeharvest.util.errors import InputError
from modeharvest.util.typed import made
from modeharvest.validation.studies import lattice as mode_study
from modeharvest.validation.studies.lattice import (
    LOADINGS,
    STUDIED_MATERIALS,
    ModeRow,
    ModeTable,
    StudiedLattice,
    first_mode_limit,
    name_of,
    ogden,
    read_rows,
    write_rows,
)

LIMIT = 0.671  # of the made-up lattices


def lattices(*ratios: float) -> list[StudiedLattice]:
    return [StudiedLattice(ratio) for ratio in ratios]


def made_up(lattice: StudiedLattice) -> ModeRow:
    kind = "pattern" if lattice.ratio > LIMIT else "long waves"
    material, loading, pitch, ratio, divisions = lattice.key
    return row(ratio, loading, material=material, pitch=pitch, divisions=divisions, kind=kind)


@given(st.floats(0.01, 0.99), st.floats(1e-6, 0.3) | st.just(math.nan), st.integers(1, 99))
def test_rows_come_back_from_their_table_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, ratio: float, strain: float, count: int
) -> None:
    path = tmp_path_factory.mktemp("table") / "study.csv"
    rows = (row(ratio, pattern=strain, waves=count), row(0.5, found=False, kind="none"))
    write_rows(path, rows)
    assert repr(read_rows(path)) == repr(rows)  # NaN is not equal to itself


def test_every_column_states_its_unit(tmp_path: Path) -> None:
    write_rows(tmp_path / "study.csv", [row()])
    with (tmp_path / "study.csv").open(encoding="utf-8") as file:
        heads, values = csv.reader(file)
    for head, value in zip(heads, values, strict=True):
        is_number = value.replace(".", "").replace("e-", "").replace("nan", "0").isdigit()
        assert ("[" in head) is is_number, head


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "CUT"])
def test_a_table_of_something_else_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "study.csv"
    write_rows(path, [row()])
    whole = path.read_text("utf-8")
    path.write_text(whole[:-20] if text == "CUT" else text, "utf-8")
    with pytest.raises(InputError, match=r"expected.*remove it to begin anew"):
        read_rows(path)


def test_without_a_file_there_are_no_rows(tmp_path: Path) -> None:
    assert read_rows(tmp_path / "none.csv") == ()


def test_a_study_goes_on_where_it_was_broken_off(tmp_path: Path) -> None:
    asked: list[float] = []

    def work(lattice: StudiedLattice) -> ModeRow:
        if len(asked) == 2:
            raise KeyboardInterrupt
        asked.append(lattice.ratio)
        return made_up(lattice)

    path = tmp_path / "study.csv"
    with pytest.raises(KeyboardInterrupt):
        ModeTable(path).rows(lattices(0.3, 0.5, 0.7), work)
    assert len(read_rows(path)) == 2
    rows = ModeTable(path).rows(lattices(0.3, 0.5, 0.7), made_up)
    assert [r.ratio for r in rows] == [0.3, 0.5, 0.7]
    asked.clear()
    assert len(ModeTable(path).rows(lattices(0.3, 0.5, 0.7), work)) == 3
    assert asked == []


def test_where_the_pattern_stops_being_first_is_bracketed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mode_study, "pattern_row", made_up)
    base = StudiedLattice()
    table = ModeTable()
    rows = table.rows(lattices(0.3, 0.5, 0.9), made_up)
    limit = first_mode_limit(base, "uniaxial", rows, table)
    assert limit is not None
    assert limit.without <= LIMIT < limit.with_ <= limit.without + 0.005
    assert limit.instead == "long waves"
    assert first_mode_limit(base, "equibiaxial", rows, table) is None
    assert first_mode_limit(base, "uniaxial", rows[:2], table) is None  # never the first
    assert first_mode_limit(base, "uniaxial", rows[2:], table) is None  # always


def test_a_path_that_ends_says_nothing_about_what_comes_first() -> None:
    rows = (row(0.5, kind="path ends", found=False), row(0.9))
    assert first_mode_limit(StudiedLattice(), "uniaxial", rows, ModeTable()) is None


@given(st.floats(0.01, 0.495), st.floats(0.05, 5.0))
def test_an_ogden_material_has_the_constants_asked_for(nu: float, shear: float) -> None:
    material = ogden(3.0, nu, shear)
    mu = 0.5 * sum(material.moduli)
    assert mu == pytest.approx(shear)
    assert material.kappa / (2.0 * (material.kappa + mu)) == pytest.approx(nu, abs=1e-6)


def test_a_study_calls_materials_and_loadings_as_cases_do() -> None:
    assert MATERIALS[name_of(TwoTermI1(), STUDIED_MATERIALS)] is TwoTermI1
    for name, loading in LOADINGS.items():
        assert made(Loading, {"kind": name}).macro() == loading


def test_materials_and_loadings_are_known_by_name_or_by_their_values() -> None:
    assert name_of(Ogden(), STUDIED_MATERIALS) == "Ogden m=3, nu=0.45"  # the default
    assert "kappa=2.5" in name_of(Ogden(kappa=2.5), STUDIED_MATERIALS)
    assert name_of(LOADINGS["equibiaxial"], LOADINGS) == "equibiaxial"
    assert name_of(simple_shear(), LOADINGS).startswith("MacroLoading")
    keys = {
        replace(StudiedLattice(), material=material).key for material in STUDIED_MATERIALS.values()
    }
    assert len(keys) == len(STUDIED_MATERIALS)


@pytest.mark.parametrize(
    "bad", [{"ratio": 1.0}, {"ratio": 0.0}, {"pitch": -1.0}, {"divisions": 0}, {"largest": 0.0}]
)
def test_a_lattice_that_cannot_be_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match="expected 0 < d/l < 1"):
        StudiedLattice(**bad)  # type: ignore[arg-type]  # only numbers
