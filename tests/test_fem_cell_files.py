"""Cells of one's own: what is written is read again, what doesn't fit is refused in a line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gmsh
import meshio
import numpy as np
import pytest

from modeharvest.fem.field import Mesh
from modeharvest.fem.hyperelastic import FreeBody
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.files import cell_from_gmsh, read_cell
from modeharvest.fem.materials import TwoTermI1
from modeharvest.util.errors import InputError

SQUARE, HEXAGONAL = square(1.9, 1.5, 0.3), hexagonal(1.386, 1.1, 0.2)

HOLE = """
SetFactory("OpenCASCADE");
Rectangle(1) = {{0, 0, 0, {width}, 2}};
Disk(2) = {{0.9, 1, 0, {radius}}};
BooleanDifference{{ Surface{{1}}; Delete; }}{{ Surface{{2}}; Delete; }}
"""


def area(cell: UnitCell) -> float:
    return 0.5 * float(FreeBody(cell.mesh, TwoTermI1()).mass().sum())


def written(path: Path, mesh: Mesh, **more: Any) -> Path:
    points = np.column_stack([mesh.nodes, np.zeros(len(mesh.nodes))])
    cells = [("triangle6" if mesh.cells.shape[1] == 6 else "triangle", mesh.cells)]
    kind = "gmsh" if path.suffix == ".msh" else None
    meshio.Mesh(points, more.pop("cells", cells), **more).write(path, file_format=kind)
    return path


def geometry(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.fixture
def live() -> Iterator[None]:
    """A gmsh of the user's own."""
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("mine")
    yield
    gmsh.finalize()


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "inp", "xdmf", "msh"])
def test_a_mesh_comes_back_from_any_format(suffix: str, tmp_path: Path) -> None:
    cell = read_cell(written(tmp_path / f"cell.{suffix}", HEXAGONAL.mesh), HEXAGONAL.lattice)
    # Text formats keep some 16 digits.
    assert np.allclose(cell.mesh.nodes, HEXAGONAL.mesh.nodes, rtol=0, atol=1e-12)
    assert np.array_equal(cell.mesh.cells, HEXAGONAL.mesh.cells)
    assert cell.periodicity.count == HEXAGONAL.periodicity.count


def test_a_rectangular_cell_needs_no_lattice_vectors(tmp_path: Path) -> None:
    cell = read_cell(written(tmp_path / "cell.vtu", SQUARE.mesh))
    assert np.allclose(cell.lattice, SQUARE.lattice, atol=1e-12)
    with pytest.raises(
        InputError, match=r"expected lattice vectors.* rectangle of 1.386 x 1.6\d+ mm"
    ):
        read_cell(written(tmp_path / "hexagon.vtu", HEXAGONAL.mesh))


def test_three_node_triangles_get_mid_sides(tmp_path: Path) -> None:
    corners = Mesh(SQUARE.mesh.nodes, SQUARE.mesh.cells[:, :3], "T3")
    cell = read_cell(written(tmp_path / "cell.vtu", corners))
    assert len(cell.mesh.nodes) == len(SQUARE.mesh.nodes)
    assert cell.periodicity.count == SQUARE.periodicity.count
    ends = (
        cell.mesh.nodes[cell.mesh.cells[:, [0, 1, 2]]],
        cell.mesh.nodes[cell.mesh.cells[:, [1, 2, 0]]],
    )
    middles = cell.mesh.nodes[cell.mesh.cells[:, 3:]]
    assert np.allclose(middles, 0.5 * (ends[0] + ends[1]), rtol=0, atol=1e-15)
    # Chords leave out the circle's segments: there is more material, by a share of h^2.
    assert area(SQUARE) < area(cell) < 1.1 * area(SQUARE)


def test_order_of_nodes_unused_nodes_and_lines_do_not_matter(tmp_path: Path) -> None:
    mesh = SQUARE.mesh
    clockwise = mesh.cells[:, [0, 2, 1, 5, 4, 3]]
    nodes = np.vstack([[[7.0, 7.0]], mesh.nodes])
    cells = [
        ("line", [[0, 1]]),
        ("triangle6", clockwise[::2] + 1),
        ("triangle6", clockwise[1::2] + 1),
    ]
    path = written(tmp_path / "cell.vtu", Mesh(nodes, mesh.cells + 1, "T6"), cells=cells)
    cell = read_cell(path)
    assert np.array_equal(cell.mesh.nodes, mesh.nodes)
    assert area(cell) == pytest.approx(area(SQUARE), rel=1e-14)


@pytest.mark.parametrize("size", [0.5, 0.25])
def test_a_geometry_is_meshed_with_sides_alike(size: float, tmp_path: Path) -> None:
    # The hole is off the middle; a finer edge on one side would not be periodic by itself.
    text = HOLE.format(width=2, radius=0.6) + "MeshSize {2} = 0.1;"
    cell = read_cell(geometry(tmp_path / "cell.geo", text), size=size)
    assert np.allclose(cell.lattice, 2 * np.eye(2), atol=1e-12)
    # Parabolas through three points of a circle: h^4 / 720 r^3 a length, with h up to 0.5.
    assert area(cell) == pytest.approx(4 - math.pi * 0.36, rel=1e-3)
    sides = cell.mesh.nodes[cell.mesh.cells[:, [1, 2, 0]]] - cell.mesh.nodes[cell.mesh.cells[:, :3]]
    assert np.linalg.norm(sides, axis=2).max() < 1.6 * size


def test_a_skew_cell_that_cuts_holes_is_meshed_too(tmp_path: Path) -> None:
    # Four quarters (two of 60, two of 120 degrees) of holes at the corners of a rhombus.
    text = """
    SetFactory("OpenCASCADE");
    Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0};
    Point(3) = {1.5, Sqrt(0.75), 0}; Point(4) = {0.5, Sqrt(0.75), 0};
    Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
    Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
    Disk(2) = {0, 0, 0, 0.4}; Disk(3) = {1, 0, 0, 0.4};
    Disk(4) = {1.5, Sqrt(0.75), 0, 0.4}; Disk(5) = {0.5, Sqrt(0.75), 0, 0.4};
    BooleanDifference{ Surface{1}; Delete; }{ Surface{2:5}; Delete; }
    """
    lattice = [[1.0, 0.0], [0.5, math.sqrt(0.75)]]
    cell = read_cell(geometry(tmp_path / "cell.geo", text), lattice, size=0.1)
    assert area(cell) == pytest.approx(math.sqrt(0.75) - math.pi * 0.16, rel=1e-5)


@pytest.mark.parametrize("suffix", ["step", "brep"])
def test_a_drawing_is_meshed(suffix: str, tmp_path: Path, live: None) -> None:
    plate = gmsh.model.occ.addRectangle(0, 0, 0, 3, 2)
    hole = gmsh.model.occ.addDisk(1, 1, 0, 0.7, 0.7)
    gmsh.model.occ.cut([(2, plate)], [(2, hole)])
    gmsh.model.occ.synchronize()
    gmsh.write(str(tmp_path / f"cell.{suffix}"))
    cell = read_cell(tmp_path / f"cell.{suffix}", size=0.4)
    # STEP files keep no more than 1e-7 mm.
    assert np.allclose(cell.lattice, np.diag([3.0, 2.0]), atol=2e-7)
    assert area(cell) == pytest.approx(6 - math.pi * 0.49, rel=1e-4)
    assert gmsh.model.getCurrent() == "mine"


def test_the_live_model_is_taken_and_kept(live: None, capfd: pytest.CaptureFixture[str]) -> None:
    plate = gmsh.model.occ.addRectangle(0, 0, 0, 3, 2)
    gmsh.model.occ.synchronize()
    cell = cell_from_gmsh(size=0.5)
    assert area(cell) == pytest.approx(6.0)
    again = cell_from_gmsh([[3, 0], [0, 2]])  # it has a mesh by now
    assert np.array_equal(again.mesh.nodes, cell.mesh.nodes)
    square(1.0, 0.8, 0.2)  # a model of our own comes and goes
    assert gmsh.model.getCurrent() == "mine"
    assert gmsh.model.getEntities(2) == [(2, plate)]
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")


def test_named_surfaces_are_the_material(live: None, tmp_path: Path) -> None:
    plate = gmsh.model.occ.addRectangle(0, 0, 0, 2, 2)
    disk = gmsh.model.occ.addDisk(1, 1, 0, 0.6, 0.6)
    parts, _ = gmsh.model.occ.fragment([(2, plate)], [(2, disk)])
    gmsh.model.occ.synchronize()
    around = max(parts, key=lambda part: gmsh.model.occ.getMass(*part))
    gmsh.model.addPhysicalGroup(2, [around[1]], name="material")
    assert area(cell_from_gmsh(size=0.4)) == pytest.approx(4 - math.pi * 0.36, rel=1e-3)
    gmsh.write(str(tmp_path / "cell.msh"))
    assert area(read_cell(tmp_path / "cell.msh")) == pytest.approx(4 - math.pi * 0.36, rel=1e-3)


def test_without_gmsh_running_there_is_no_live_model() -> None:
    with pytest.raises(InputError, match="got none: call"):
        cell_from_gmsh()


def replaced(nodes: Any = None, cells: Any = None, z: Any = 0.0, **kinds: Any) -> meshio.Mesh:
    """The square cell with something changed."""
    nodes = SQUARE.mesh.nodes if nodes is None else nodes
    points = np.column_stack([nodes, np.broadcast_to(z, len(nodes))])
    return meshio.Mesh(
        points, {"triangle6": SQUARE.mesh.cells, **kinds} if cells is None else cells
    )


def slid() -> np.ndarray[Any, Any]:
    """The nodes of one side moved along it."""
    x, y = SQUARE.mesh.nodes.T
    return np.stack([x, y + (x > 0.949) * 0.02 * np.cos(0.5 * np.pi * y / 0.95)], axis=1)


def folded() -> np.ndarray[Any, Any]:
    nodes = SQUARE.mesh.nodes.copy()
    a, b, c, m = SQUARE.mesh.cells[len(SQUARE.mesh.cells) // 2, [0, 1, 2, 3]]
    nodes[m] += 2.0 * (nodes[c] - 0.5 * (nodes[a] + nodes[b]))
    return nodes


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (replaced(cells={"line": [[0, 1]]}), "three or of six nodes and nothing else, got no elem"),
        (replaced(cells={"quad": [[0, 1, 2, 3]]}), "nothing else, got quad"),
        (replaced(triangle=[[0, 1, 2]]), "nothing else, got triangle and triangle6"),
        (replaced(tetra=[[0, 1, 2, 3]]), "nothing else, got tetra and triangle6"),
        (replaced(z=0.1 * SQUARE.mesh.nodes[:, 0]), r"plane mesh, z = const, got z from -0.095 to"),
        (replaced(folded()), "neither flat nor folded, got"),
        (
            replaced(cells={"triangle6": np.vstack([SQUARE.mesh.cells, SQUARE.mesh.cells[:1]])}),
            "sides of one or two elements, got one of 3",
        ),
        (replaced(SQUARE.mesh.nodes * [1.0, np.nan]), "finite"),
        (replaced(slid()), r"periodic cell: expected a partner.* at \("),
    ],
)
def test_bad_meshes_are_refused_in_one_line(
    mesh: meshio.Mesh, message: str, tmp_path: Path
) -> None:
    mesh.write(tmp_path / "bad.vtk")
    with pytest.raises(InputError, match=message) as caught:
        read_cell(tmp_path / "bad.vtk")
    assert "\n" not in str(caught.value)
    assert "bad.vtk" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense(", "a file that gmsh reads"),
        ("Point(1) = {0, 0, 0};", "expected a surface, got none"),
        (HOLE.format(width=2, radius=1.0), "periodic cell: expected a partner"),
        (HOLE.format(width=1.5, radius=0.95), "periodic cell: expected a partner"),
        # A hole drawn across another: the curves of a plane surface must not cross.
        (
            """
            Point(1) = {0, 0, 0}; Point(2) = {2, 0, 0}; Point(3) = {2, 2, 0}; Point(4) = {0, 2, 0};
            Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
            Point(5) = {0.4, 0.4, 0}; Point(6) = {1.2, 0.4, 0}; Point(7) = {0.8, 1.4, 0};
            Line(5) = {5, 6}; Line(6) = {6, 7}; Line(7) = {7, 5};
            Point(8) = {0.7, 0.7, 0}; Point(9) = {1.6, 0.7, 0}; Point(10) = {1.6, 1.4, 0};
            Line(8) = {8, 9}; Line(9) = {9, 10}; Line(10) = {10, 8};
            Curve Loop(1) = {1:4}; Curve Loop(2) = {5:7}; Curve Loop(3) = {8:10};
            Plane Surface(1) = {1, 2, 3};
            """,
            "holes must neither overlap each other",
        ),
    ],
)
def test_bad_geometries_are_refused_in_one_line_and_silently(
    text: str, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_cell(geometry(tmp_path / "bad.geo", text), size=0.3)
    assert "\n" not in str(caught.value)
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")
    assert not gmsh.isInitialized()


def test_what_is_asked_for_must_make_sense(tmp_path: Path) -> None:
    path = written(tmp_path / "cell.vtu", SQUARE.mesh)
    with pytest.raises(InputError, match="found no such file"):
        read_cell(tmp_path / "missing.vtu")
    with pytest.raises(InputError, match="a mesh that meshio reads"):
        read_cell(geometry(tmp_path / "cell.xyz", "nothing"))
    with pytest.raises(InputError, match="size is for geometries"):
        read_cell(path, size=0.2)
    with pytest.raises(InputError, match="positive length in mm, got -1"):
        read_cell(geometry(tmp_path / "cell.geo", HOLE.format(width=2, radius=0.5)), size=-1)
    for lattice in ([[1.9, 0]], [[1.9, 0], [0]], [[1.9, 0], [0, math.inf]], "square"):
        with pytest.raises(InputError, match="two lattice vectors of two numbers"):
            read_cell(path, lattice)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="overlap"):
        read_cell(path, [[1.0, 0.0], [0.0, 1.9]])


def test_the_recipes_work_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pages = ("lattices.md", "own_cell.md")
    folder = Path(__file__).parents[1] / "docs/how-to"
    text = "".join((folder / page).read_text("utf-8") for page in pages)
    monkeypatch.chdir(tmp_path)
    space: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, space)
    assert "Poisson's ratio -0.84" in capfd.readouterr().out
    assert area(space["again"]) == pytest.approx(area(space["oval"]), rel=1e-12)
    assert area(space["oval"]) == pytest.approx(3.2 - math.pi * 0.4, rel=1e-3)
    assert area(space["slotted"]) == pytest.approx(3.2 - 0.48 + (4 - math.pi) * 0.15**2, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Exit;", "got: a file that ends gmsh"),
        ('Error("unfinished");', "got: unfinished"),
        ("Box(;", "syntax error"),
        ('Printf("read");\nAbort;', "expected a surface, got none"),
        ('Printf("read");\nExit;', "got: a file that ends gmsh"),
    ],
)
def test_a_geometry_that_ends_gmsh_does_not_end_the_program(
    text: str, message: str, tmp_path: Path
) -> None:
    """And one that is refused leaves nothing behind that spoils the next one."""
    path = tmp_path / "cell.geo"
    path.write_text(text, "utf-8")
    with pytest.raises(InputError, match=message):
        read_cell(path, size=0.5)
    path.write_text('SetFactory("OpenCASCADE"); Rectangle(1) = {0, 0, 0, 2, 2};', "utf-8")
    assert area(read_cell(path, size=0.5)) == pytest.approx(4.0)


def test_a_file_that_crashes_gmsh_is_reported_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modeharvest.fem.lattice.files._PROBE", "import os; os.abort()")
    (tmp_path / "cell.msh").write_text("$MeshFormat\n")
    with pytest.raises(InputError, match=r"cell\.msh, got: a file that makes gmsh crash"):
        read_cell(tmp_path / "cell.msh")
