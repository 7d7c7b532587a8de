"""A stranger's meshes: in other units, numbered otherwise, clockwise; what is kept and said."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from test_examples import ROOT, load

from modeharvest.fem.bloch.modes import read_modes, write_modes, write_vtu
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, square
from modeharvest.fem.lattice.files import read_cell
from modeharvest.fem.lattice.foreign import NUMBERINGS
from modeharvest.fem.lattice.options import equibiaxial
from modeharvest.fem.materials import TwoTermI1
from modeharvest.runs.lattice.case import FileLattice
from modeharvest.util.errors import InputError

pytestmark = pytest.mark.dolfinx

SQUARE = square(1.9, 1.5, 0.3)


def written(path: Path, nodes: Any, cells: Any) -> Path:
    points = np.column_stack([nodes, np.zeros(len(nodes))])
    meshio.Mesh(points, {"triangle6": cells}).write(path)
    return path


# -- units -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "per_mm", "looks"), [("m", 1e-3, "metres"), ("um", 1e3, "micro")])
def test_an_unlikely_unit_is_asked_for(
    unit: str, per_mm: float, looks: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "cell.vtu", per_mm * SQUARE.mesh.nodes, SQUARE.mesh.cells)
    with pytest.raises(InputError, match=f"looks like {looks}.*state the unit.*unit = '{unit}'"):
        read_cell(path)
    assert np.allclose(read_cell(path, unit=unit).mesh.nodes, SQUARE.mesh.nodes, rtol=1e-14)
    assert read_cell(path, unit="mm").area == pytest.approx(SQUARE.area * per_mm**2)


def test_vectors_in_another_unit_than_the_mesh_are_noticed(tmp_path: Path) -> None:
    path = written(tmp_path / "cell.vtu", 1e-3 * 19.0 * SQUARE.mesh.nodes, SQUARE.mesh.cells)
    with pytest.raises(InputError, match=r"0.0361 wide beside lattice vectors of 36.1 mm.*metres"):
        read_cell(path, 19.0 * SQUARE.lattice)
    assert read_cell(path, 19.0 * SQUARE.lattice, unit="m").area == pytest.approx(36.1**2)
    with pytest.raises(InputError, match="one of m, cm, mm"):
        read_cell(path, unit="metre")
    with pytest.raises(InputError, match=r"expected the pitch l in mm.*36.1 mm long, got 0.0361"):
        FileLattice(str(path), 0.0361, unit="m").cell()


def test_a_geometry_in_metres_is_meshed_by_a_size_in_mm(tmp_path: Path) -> None:
    (tmp_path / "cell.geo").write_text(
        'SetFactory("OpenCASCADE"); Rectangle(1) = {0, 0, 0, 0.002, 0.002};\n'
        "Disk(2) = {0.0009, 0.001, 0, 0.0006};\n"
        "BooleanDifference{ Surface{1}; Delete; }{ Surface{2}; Delete; }\n"
    )
    with pytest.raises(InputError, match="looks like metres"):
        read_cell(tmp_path / "cell.geo", size=0.0003)
    cell = read_cell(tmp_path / "cell.geo", [[2.0, 0.0], [0.0, 2.0]], size=0.3, unit="m")
    material = 0.5 * PeriodicCell(cell, TwoTermI1()).nodal_mass.sum()
    assert material == pytest.approx(4.0 - math.pi * 0.36, rel=1e-3)
    assert 50 < len(cell.mesh.cells) < 500


# -- numbering, orientation, order of nodes ------------------------------------------------------


def numbered(cells: Any, order: tuple[int, ...]) -> Any:
    """The cells as a program writes them that has our node k of an element at place order[k]."""
    found = np.empty_like(cells)
    found[:, list(order)] = cells
    return found


@pytest.mark.parametrize("name", NUMBERINGS)
@pytest.mark.parametrize("clockwise", [False, True])
def test_other_numberings_are_recognised_and_named(
    name: str, clockwise: bool, tmp_path: Path
) -> None:
    cells = SQUARE.mesh.cells[:, [0, 2, 1, 5, 4, 3]] if clockwise else SQUARE.mesh.cells
    path = written(tmp_path / "cell.vtu", SQUARE.mesh.nodes, numbered(cells, NUMBERINGS[name]))
    cell = read_cell(path)
    assert {frozenset(row) for row in cell.mesh.cells.tolist()} == {
        frozenset(row) for row in SQUARE.mesh.cells.tolist()
    }
    mass = PeriodicCell(cell, TwoTermI1()).nodal_mass.sum()
    assert mass == pytest.approx(PeriodicCell(SQUARE, TwoTermI1()).nodal_mass.sum(), rel=1e-13)
    (note,) = [note for note in cell.notes if "numbered" in note]
    assert name in note


def test_a_mesh_in_order_needs_no_notes_and_a_hopeless_one_is_refused(tmp_path: Path) -> None:
    assert read_cell(written(tmp_path / "good.vtu", *vars_of(SQUARE.mesh))).notes == ()
    shuffled = SQUARE.mesh.cells[:, [0, 3, 1, 2, 4, 5]]
    with pytest.raises(InputError, match="an order that isn't recognised"):
        read_cell(written(tmp_path / "bad.vtu", SQUARE.mesh.nodes, shuffled))


def vars_of(mesh: Mesh) -> tuple[Any, Any]:
    return mesh.nodes, mesh.cells


def test_nodes_upon_each_other_are_reported(tmp_path: Path) -> None:
    """One element has its own copy of a mid-side inside: the mesh is cut open there."""
    nodes, cells = SQUARE.mesh.nodes, SQUARE.mesh.cells.copy()
    inside = next(
        k for k in np.unique(cells[:, 3:]) if (cells == k).sum() == 2
        and np.abs(nodes[k]).max() < 0.94
    )  # fmt: skip
    row, column = np.argwhere(cells == inside)[0]
    cells[row, column] = len(nodes)
    cell = read_cell(written(tmp_path / "cell.vtu", np.vstack([nodes, nodes[inside]]), cells))
    (note,) = cell.notes
    assert note.startswith("1 pairs of nodes lie upon each other")


def test_nodes_keep_the_file_s_order_as_far_as_the_modes(tmp_path: Path) -> None:
    """Shuffled, with unused nodes between: ``origin`` leads back to the file, in every output."""
    random = np.random.default_rng(3)
    n = len(SQUARE.mesh.nodes)
    place = np.sort(random.permutation(n + 7)[:n])[
        random.permutation(n)
    ]  # of our nodes in the file
    nodes = np.full((n + 7, 2), 0.1)
    nodes[place] = SQUARE.mesh.nodes
    cell = read_cell(written(tmp_path / "cell.vtu", nodes, place[SQUARE.mesh.cells]))
    assert cell.origin is not None
    assert np.array_equal(cell.origin, np.sort(place))
    assert np.array_equal(cell.mesh.nodes, nodes[cell.origin])
    body = PeriodicCell(cell, TwoTermI1())
    state = CellPath(body, equibiaxial()).at(0.005)
    assert state is not None
    modes = real_modes(body, state, [(math.pi, math.pi)])
    assert modes.origin is not None
    first = modes.origin[: len(cell.origin)]
    assert np.array_equal(first, cell.origin)  # the first copy is the file's cell, in its order
    apart = (modes.mesh.nodes - nodes[modes.origin]) / 1.9
    assert np.allclose(apart, np.rint(apart), atol=1e-9)
    write_modes(tmp_path / "modes.h5", modes)
    again, _ = read_modes(tmp_path / "modes.h5")
    assert again.origin is not None
    assert np.array_equal(again.origin, modes.origin)
    write_vtu(tmp_path / "modes.vtu", modes)
    found = meshio.read(tmp_path / "modes.vtu").point_data["node_in_file"]
    assert np.array_equal(np.ravel(found), modes.origin)


def test_three_node_triangles_say_so_and_their_mid_sides_have_no_number(tmp_path: Path) -> None:
    points = np.column_stack([SQUARE.mesh.nodes, np.zeros(len(SQUARE.mesh.nodes))])
    meshio.Mesh(points, {"triangle": SQUARE.mesh.cells[:, :3]}).write(tmp_path / "cell.vtu")
    cell = read_cell(tmp_path / "cell.vtu")
    corners = np.unique(SQUARE.mesh.cells[:, :3])
    assert cell.origin is not None
    assert np.array_equal(cell.origin[: len(corners)], corners)
    assert set(cell.origin[len(corners) :]) == {-1}
    assert "stays the polygon" in cell.notes[0]


# -- copies ----------------------------------------------------------------------------------


@pytest.mark.parametrize("copies", [(2, 1), (2, 2), (3, 2)])
def test_what_passes_the_check_of_periodicity_can_be_enlarged(copies: tuple[int, int]) -> None:
    """Partners 6e-7 of the cell off each other, more than what used to be joined."""
    x, y = SQUARE.mesh.nodes.T
    nodes = np.stack([x, y + 6e-7 * 1.9 * (x > 0.949)], axis=1)
    cell = UnitCell(Mesh(nodes, SQUARE.mesh.cells, "T6"), SQUARE.lattice)
    assert cell.enlarged(*copies).periodicity.count == math.prod(copies) * cell.periodicity.count


# -- the whole way ---------------------------------------------------------------------------


@pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")
def test_the_example_in_metres_runs_and_its_nodes_are_the_file_s(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = load(ROOT / "examples" / "own_cell.py").main(tmp_path)
    assert summary["critical"]["found"]
    assert summary["modes"]["copies"]
    mesh = read_cell(tmp_path / "cell.msh", unit="m")
    with h5py.File(tmp_path / "out" / "modes.h5") as file:
        nodes, origin = file["nodes"][:], file["origin"][:]
    assert mesh.origin is not None
    assert np.array_equal(origin[: len(mesh.origin)], mesh.origin)
    assert np.allclose(nodes[: len(mesh.origin)], mesh.mesh.nodes, atol=1e-9)
    assert f"node {mesh.origin[0]}: mode (" in capsys.readouterr().out


def test_the_docs_show_the_example_s_case_and_help_names_the_kind() -> None:
    page = (ROOT / "docs/how-to/own_cell.md").read_text("utf-8")
    case = load(ROOT / "examples" / "own_cell.py").CASE
    assert case.strip() in page
    reported = subprocess.run(
        [sys.executable, "-m", "modeharvest", "bloch", "--help"],
        capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200"},
    ).stdout  # fmt: skip
    assert 'kind = "file"' in reported
