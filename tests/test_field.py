"""Solutions on disk: lossless, readable by anyone, whole or absent, and errors that help."""

from __future__ import annotations

import json
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import (
    Mesh,
    Snapshot,
    Solution,
    plane_mesh,
    plane_triangles,
    read_any_mesh,
    read_meshio,
)
from modeharvest.fem.specimen import Specimen
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError

RANDOM = np.random.default_rng(0)
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
MIDDLES = np.array([[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5]])
CENTRE = np.array([[0.5, 0.5]])
# Each element of meshio, from one unit square.
MESHES = {
    "T3": Mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), "T3"),
    "T6": Mesh(
        np.vstack([SQUARE, MIDDLES, CENTRE]),
        np.array([[0, 1, 2, 4, 5, 8], [0, 2, 3, 8, 6, 7]]),
        "T6",
    ),
    "Q4": Mesh(SQUARE, np.array([[0, 1, 2, 3]]), "Q4"),
    "Q8": Mesh(np.vstack([SQUARE, MIDDLES]), np.arange(8)[None], "Q8"),
    "Q9": Mesh(np.vstack([SQUARE, MIDDLES, CENTRE]), np.arange(9)[None], "Q9"),
}
MESHIO_NAMES = {"T3": "triangle", "T6": "triangle6", "Q4": "quad", "Q8": "quad8", "Q9": "quad9"}
elements = pytest.mark.parametrize("element", list(MESHES))


def sample(element: str = "T6") -> Solution:
    mesh = MESHES[element]
    shape = mesh.nodes.shape
    snapshots = (
        Snapshot(0.078, RANDOM.normal(size=shape), 1.25, 0.5, 0, (0.1, 0.2)),
        Snapshot(0.128, RANDOM.normal(size=shape), 1.5, 1.25, 1, (-0.1, 0.2), "primary"),
        Snapshot(0.128, RANDOM.normal(size=shape), branch="buckled-"),
    )
    return Solution(mesh, snapshots, {"seed": 3, "nested": {"strain": 0.1}, "text": "µm"})


@elements
def test_hdf5_round_trip_is_lossless(element: str, tmp_path: Path) -> None:
    solution = sample(element)
    solution.write(tmp_path / "new folder" / "solution.h5")
    back = Solution.read(tmp_path / "new folder" / "solution.h5")
    assert back.mesh.element == element
    assert np.array_equal(back.mesh.nodes, solution.mesh.nodes)
    assert np.array_equal(back.mesh.cells, solution.mesh.cells)
    assert back.info == solution.info
    for a, b in zip(back.snapshots, solution.snapshots, strict=True):
        assert np.array_equal(a.displacement, b.displacement)
        # NaN, of what isn't known, comes back as NaN.
        np.testing.assert_array_equal([a.reaction, a.energy], [b.reaction, b.energy])
        assert (a.nominal_strain, a.negative_pivots) == (b.nominal_strain, b.negative_pivots)
        assert (a.eigenvalues, a.branch) == (b.eigenvalues, b.branch)


def test_snapshots_keep_their_order_beyond_ten(tmp_path: Path) -> None:
    mesh = MESHES["T3"]
    strains = [0.01 * k for k in range(12)]
    snapshots = tuple(Snapshot(e, np.zeros(mesh.nodes.shape)) for e in strains)
    Solution(mesh, snapshots).write(tmp_path / "s.h5")
    assert [s.nominal_strain for s in Solution.read(tmp_path / "s.h5").snapshots] == strains


def test_file_is_readable_with_h5py_alone(tmp_path: Path) -> None:
    """What the module's docstring promises to programs that don't know this project."""
    solution = sample()
    solution.write(tmp_path / "s.h5")
    with h5py.File(tmp_path / "s.h5") as file:
        assert file.attrs["format"] == "modeharvest-solution-1"
        assert file.attrs["element"] == "T6"
        assert json.loads(file.attrs["info"])["seed"] == 3
        assert np.array_equal(file["nodes"][:], solution.mesh.nodes)
        assert np.array_equal(file["cells"][:], solution.mesh.cells)
        assert list(file["snapshots"]) == ["0000", "0001", "0002"]
        second = file["snapshots/0001"]
        assert np.array_equal(second["displacement"][:], solution.snapshots[1].displacement)
        assert second.attrs["nominal_strain"] == 0.128
        assert second.attrs["negative_pivots"] == 1
        assert second.attrs["branch"] == "primary"
        assert second.attrs["reaction"] == 1.5
        assert second.attrs["energy"] == 1.25


def test_a_solution_knows_its_specimen(tmp_path: Path) -> None:
    specimen = Specimen(4, 6, diameter=1.5, stacking="triangular")
    solution = Solution(MESHES["T3"], (), Experiment(specimen).described())
    solution.write(tmp_path / "solution.h5")
    assert Solution.read(tmp_path / "solution.h5").specimen == specimen
    damaged = Solution(MESHES["T3"], (), {"specimen": {"holes_z": 4}})
    with pytest.raises(InputError, match="holes_z"):
        _ = damaged.specimen
    with pytest.raises(InputError, match="of which specimen it is"):
        _ = sample().specimen


def test_at_prefers_the_stable_snapshot() -> None:
    mesh = MESHES["T3"]
    u = np.zeros(mesh.nodes.shape)
    unstable = Snapshot(0.1, u, negative_pivots=1, branch="primary")
    stable = Snapshot(0.1, u, negative_pivots=0, branch="buckled+")
    assert Solution(mesh, (unstable, stable)).at(0.1) is stable
    with pytest.raises(InputError, match=r"snapshot at strain 0.2, have: 0.1000, 0.1000"):
        Solution(mesh, (unstable, stable)).at(0.2)
    with pytest.raises(InputError, match="have: none"):
        Solution(mesh, ()).at(0.2)


@elements
def test_vtu_carries_all_displacements(element: str, tmp_path: Path) -> None:
    solution = sample(element)
    solution.write_vtu(tmp_path / "s.vtu")
    back = meshio.read(tmp_path / "s.vtu")
    assert list(back.point_data) == [
        "u_mm_0000_primary_7.800pct",
        "u_mm_0001_primary_12.800pct",
        "u_mm_0002_buckled-_12.800pct",
    ]
    np.testing.assert_array_equal(back.points[:, :2], solution.mesh.nodes)
    (block,) = back.cells
    assert block.type == MESHIO_NAMES[element]
    np.testing.assert_array_equal(block.data, solution.mesh.cells)
    for values, s in zip(back.point_data.values(), solution.snapshots, strict=True):
        np.testing.assert_array_equal(values[:, :2], s.displacement)
        assert not values[:, 2].any()


@elements
@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
def test_any_solvers_mesh_can_be_taken(element: str, suffix: str, tmp_path: Path) -> None:
    mesh = MESHES[element]
    u = RANDOM.normal(size=(len(mesh.nodes), 3))
    points = np.hstack([mesh.nodes, np.zeros((len(mesh.nodes), 1))])
    # Solvers often list the boundary's lines beside the cells.
    cells = [("line", np.array([[0, 1]])), (MESHIO_NAMES[element], mesh.cells)]
    meshio.Mesh(points, cells, point_data={"U": u}).write(tmp_path / f"other{suffix}")
    solution = read_meshio(tmp_path / f"other{suffix}", "U", 0.05)
    assert solution.mesh.element == element
    np.testing.assert_array_equal(solution.mesh.nodes, mesh.nodes)
    np.testing.assert_array_equal(solution.mesh.cells, mesh.cells)
    np.testing.assert_array_equal(solution.at(0.05).displacement, u[:, :2])


def test_own_vtu_can_be_taken_back(tmp_path: Path) -> None:
    solution = sample()
    solution.write_vtu(tmp_path / "s.vtu")
    back = read_meshio(tmp_path / "s.vtu", "u_mm_0000_primary_7.800pct", 0.078)
    np.testing.assert_array_equal(
        back.snapshots[0].displacement, solution.snapshots[0].displacement
    )


def write_meshio(path: Path, cells: list[Any], points: Any = None, **data: Any) -> None:
    points = np.hstack([SQUARE, np.zeros((4, 1))]) if points is None else points
    meshio.Mesh(points, cells, point_data=data).write(path)


def test_foreign_meshes_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.vtu"
    u = np.zeros((4, 3))
    write_meshio(path, [("quad", np.array([[0, 1, 2, 3]]))], U=u)
    with pytest.raises(InputError, match=r"nodal field 'u' in .*m.vtu, got \['U'\]"):
        read_meshio(path, "u", 0.1)
    write_meshio(path, [("tetra", np.array([[0, 1, 2, 3]]))], U=u)
    with pytest.raises(InputError, match=r"cells of one of the types .*got tetra"):
        read_meshio(path, "U", 0.1)
    write_meshio(path, [("quad", np.array([[0, 1, 2, 3]]))], U=u[:, 0])
    with pytest.raises(InputError, match=r"2 or 3 components"):
        read_meshio(path, "U", 0.1)
    write_meshio(path, [("quad", np.array([[0, 1, 2, 3]]))], U=u * np.nan)
    with pytest.raises(InputError, match=r"finite"):
        read_meshio(path, "U", 0.1)
    with pytest.raises(InputError, match="meshio reads at"):
        read_meshio(tmp_path / "absent.vtu", "U", 0.1)
    (tmp_path / "no mesh.vtu").write_text("no mesh")
    with pytest.raises(InputError, match="meshio reads at") as caught:
        read_meshio(tmp_path / "no mesh.vtu", "U", 0.1)
    assert "\n" not in str(caught.value)


def test_mixed_meshes_are_refused(tmp_path: Path) -> None:
    """Taking only one of two types would leave a hole in the body, unnoticed."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.0]])
    cells = [("quad", np.array([[0, 1, 2, 3]])), ("triangle", np.array([[1, 4, 2]]))]
    write_meshio(tmp_path / "m.vtu", cells, points, U=np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"cells of one of the types .*got quad, triangle; export"):
        read_meshio(tmp_path / "m.vtu", "U", 0.1)


def test_quadrilaterals_are_split_to_measure_on() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.0]])
    cells = {"line": [[0, 1]], "quad": [[0, 1, 2, 3]], "triangle": [[1, 4, 2]]}
    found = plane_triangles(meshio.Mesh(points, cells), "m.vtu")
    assert found.element == "T3"
    np.testing.assert_array_equal(found.cells, [[1, 4, 2], [0, 1, 2], [0, 2, 3]])
    for wrong in ({"line": [[0, 1]]}, {"triangle6": [[0, 1, 2, 3, 4, 3]], "quad": [[0, 1, 2, 3]]}):
        with pytest.raises(
            InputError, match=r"in m\.vtu, got .*; export a plane mesh of one order"
        ):
            plane_triangles(meshio.Mesh(points, wrong), "m.vtu")


def test_quadratic_quadrilaterals_are_split_through_their_centre() -> None:
    """With curved sides; an element without a centre gets the node that its shape gives."""
    corners, middles = [[0, 0], [4, 0], [5, 4], [0, 3]], [[2, -1], [4, 2], [2, 4], [-1, 2]]
    points = np.pad(np.array([*corners, *middles], dtype=float), ((0, 0), (0, 1)))
    found = plane_triangles(meshio.Mesh(points, {"quad8": [range(8)]}), "m.vtu")
    assert found.element == "T6"
    np.testing.assert_array_equal(found.cells, [[0, 1, 2, 4, 5, 8], [0, 2, 3, 8, 6, 7]])
    centre = shape_functions("Q8", [0.0, 0.0]) @ points[:, :2]
    np.testing.assert_allclose(found.nodes[8], centre)
    nine = meshio.Mesh(np.pad(found.nodes, ((0, 0), (0, 1))), {"quad9": [range(9)]})
    np.testing.assert_array_equal(plane_triangles(nine, "m.vtu").cells, found.cells)


@pytest.mark.parametrize("kind", ["CPE4", "CPE4RH", "CPS4I", "S4R"])
def test_plane_elements_of_abaqus_are_read(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.inp").write_text(
        f"*Node\n1, 0, 0\n2, 1, 0\n3, 1, 1\n4, 0, 1\n*Element, type={kind}\n1, 1, 2, 3, 4\n"
    )
    mesh = plane_mesh(read_any_mesh(tmp_path / "a.inp"), "a.inp")
    assert (mesh.element, mesh.cells.tolist()) == ("Q4", [[0, 1, 2, 3]])


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_file_is_refused(share: float, tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    sample().write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"expected a solution \(HDF5\) at .*modeharvest fem"):
        Solution.read(path)


def test_what_is_no_solution_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a solution"):
        Solution.read(tmp_path / "absent.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = "another-1"
    with pytest.raises(
        InputError, match=r"modeharvest-solution-1 file at .*got format 'another-1'"
    ):
        Solution.read(tmp_path / "other.h5")
    sample().write(tmp_path / "s.h5")
    with h5py.File(tmp_path / "s.h5", "a") as file:
        del file["cells"]
    with pytest.raises(InputError, match="expected a solution"):
        Solution.read(tmp_path / "s.h5")


@pytest.mark.parametrize("attribute", ["info", "element"])
def test_damaged_attributes_are_refused(attribute: str, tmp_path: Path) -> None:
    sample().write(tmp_path / "s.h5")
    with h5py.File(tmp_path / "s.h5", "a") as file:
        file.attrs[attribute] = "{"
    with pytest.raises(InputError):
        Solution.read(tmp_path / "s.h5")


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond ``size`` bytes: what a full disk looks like to a program."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def big() -> Solution:
    """Noise, which doesn't compress: 160 kB."""
    nodes = RANDOM.normal(size=(5000, 2))
    mesh = Mesh(nodes, np.array([[0, 1, 2]]), "T3")
    return Solution(mesh, (Snapshot(0.1, RANDOM.normal(size=nodes.shape)),))


@pytest.mark.parametrize("writer", ["write", "write_vtu"])
def test_full_disk_leaves_what_was_there(writer: str, tmp_path: Path) -> None:
    path = tmp_path / "s.out"
    path.write_text("an earlier result")
    with largest_file(20_000), pytest.raises(InputError, match=r"could not write .*s.out"):
        getattr(big(), writer)(path)
    assert path.read_text() == "an earlier result"
    assert list(tmp_path.iterdir()) == [path]


def test_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(h5py.File, "create_group", interrupt)
    with pytest.raises(KeyboardInterrupt):
        sample().write(tmp_path / "s.h5")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"element": "T9"}, "element among .*got T9"),
        ({"nodes": np.zeros((4, 3))}, r"nodes of shape \(n, 2\), got \(4, 3\)"),
        ({"cells": np.array([[0, 1, 2, 3]])}, r"T3 cells of shape \(m, 3\), got \(1, 4\)"),
        ({"nodes": SQUARE * np.nan}, "finite node positions"),
        ({"cells": np.array([[0, 1, 4]])}, r"outside 0 ... 3"),
        ({"cells": np.array([[-1, 1, 2]])}, r"outside 0 ... 3"),
    ],
)
def test_impossible_meshes_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        "nodes": SQUARE,
        "cells": np.array([[0, 1, 2]]),
        "element": "T3",
    } | changes
    with pytest.raises(InputError, match=message):
        Mesh(**arguments)


def test_displacements_must_fit_the_mesh() -> None:
    with pytest.raises(InputError, match=r"strain 0.1: expected .*\(4, 2\), got \(3, 2\)"):
        Solution(MESHES["T3"], (Snapshot(0.1, np.zeros((3, 2))),))
