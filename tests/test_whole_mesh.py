"""Meshes of the material from masks alone."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from plate_with_hole import GRID, HALF_SIZE, RADIUS, is_material

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.idic.finite_element.mesh import boundaries, mesh_of_mask, meshable, quadratic
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import non_positive_jacobians
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.util.errors import InputError

pytest.importorskip("gmsh")

PLATE = is_material(np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1))


def test_boundary_to_sub_pixel() -> None:
    mesh = mesh_of_mask(PLATE, GRID, 20.0, 10.0).mesh
    edge = mesh.nodes[np.unique(boundary_sides(mesh))]
    radius = np.hypot(*edge.T)
    hole = radius < 0.5
    assert hole.sum() > 30
    off_px = (radius[hole] - RADIUS) / GRID.pixel_size
    # The mask knows pixel centres only.
    assert abs(off_px).max() < 0.6
    assert abs(off_px.mean()) < 0.25
    # Half a pixel beyond the last centre that is inside; corners are sharp.
    distance = (HALF_SIZE - abs(edge[~hole])).min(axis=1) / GRID.pixel_size
    assert abs(distance).max() < 1.0
    for corner in HALF_SIZE * [[1, 1], [1, -1], [-1, 1], [-1, -1]]:
        assert np.linalg.norm(edge - corner, axis=1).min() < 1.5 * GRID.pixel_size


def test_mesh_covers_the_mask() -> None:
    mesh = mesh_of_mask(PLATE, GRID, 20.0, 10.0).mesh
    covered = locate(mesh.nodes, mesh.cells, mesh.element, GRID).mask
    assert (PLATE & ~covered).sum() < 0.002 * PLATE.sum()
    assert (covered & ~PLATE).sum() < 0.01 * PLATE.sum()


def test_a_library_that_gmsh_lacks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = "libGLU.so.1: cannot open shared object file"
    (tmp_path / "gmsh.py").write_text(f"raise OSError({what!r})\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    with pytest.raises(InputError, match=f"got OSError: {what}; install that library, or give a"):
        mesh_of_mask(PLATE, GRID, 20.0, 10.0)


def test_whole_image_without_holes() -> None:
    mesh = mesh_of_mask(np.ones(GRID.shape, dtype=bool), GRID, 30.0, 30.0).mesh
    assert locate(mesh.nodes, mesh.cells, mesh.element, GRID).mask.all()


def test_islands_are_bodies_and_specks_are_left_out() -> None:
    mask = np.zeros(GRID.shape, dtype=bool)
    mask[20:100, 20:120] = mask[120:200, 130:240] = True
    mask[50:70, 50:70] = False  # a hole of the first
    mask[10:14, 200:204] = True  # a speck
    mask[150:154, 160:164] = False  # dirt
    assert sorted(len(part) for part in boundaries(mask, 12.0)) == [1, 2]
    kept, narrowest, changes = meshable(mask, 12.0)
    assert narrowest == pytest.approx(30.0, abs=1.0)  # between the first one's hole and its edge
    assert [text.split(" ")[0] for text in changes] == ["Holes", "1"]
    assert "16 px at row 10, column 200" in changes[1]
    mask[10:14, 200:204], mask[150:154, 160:164] = False, True
    np.testing.assert_array_equal(kept, mask)
    mesh = mesh_of_mask(mask, GRID, 12.0, 12.0).mesh
    covered = locate(mesh.nodes, mesh.cells, mesh.element, GRID).mask
    assert (mask & ~covered).sum() < 100
    assert not covered[55:65, 55:65].any()


def test_narrow_material_is_left_out() -> None:
    mask = PLATE.copy()
    mask[60:120, 30:60] = mask[60:120, 62:80] = False  # 2 px between them
    found = mesh_of_mask(mask, GRID, 24.0, 12.0)
    assert "was left out" in found.changes[0]
    assert not found.mask[70:110, 60:62].any()
    assert (mask & ~found.mask).sum() < 2 * 60 + 40  # and of corners a pixel or so


@pytest.mark.parametrize("width", [2, 4, 5, 8])
def test_slits_have_boundaries_that_do_not_cross(width: int) -> None:
    mask = np.ones(GRID.shape, dtype=bool)
    mask[60:160, 100 : 100 + width] = False
    mesh = mesh_of_mask(mask, GRID, 24.0, 12.0).mesh
    covered = locate(mesh.nodes, mesh.cells, mesh.element, GRID)
    assert covered.doubly_covered == 0
    assert (mask & ~covered.mask).sum() < 100


def test_no_material() -> None:
    mask = np.zeros(GRID.shape, dtype=bool)
    mask[5:9, 5:9] = True
    with pytest.raises(InputError, match="expected a mask with material for elements of 24 px"):
        mesh_of_mask(mask, GRID, 24.0, 24.0)


def test_linear_triangles_become_quadratic() -> None:
    mesh = mesh_of_mask(PLATE, GRID, 40.0, 20.0).mesh
    linear = Mesh(mesh.nodes, mesh.cells[:, :3], "T3")
    found = quadratic(linear)
    assert found.element == "T6"
    np.testing.assert_allclose(
        found.nodes[found.cells[:, 3]], found.nodes[found.cells[:, :2]].mean(axis=1), atol=1e-15
    )
    assert len(np.unique(found.cells)) == len(np.unique(mesh.cells))


def test_any_order_and_loose_nodes() -> None:
    mesh = Mesh([[0, 0], [9, 9], [0, 1], [1, 0], [1, 1]], [[0, 2, 3], [4, 3, 2]], "T3")
    found = quadratic(mesh)
    assert len(found.nodes) == 4 + 5
    assert (found.nodes <= 1.0).all()


def test_other_and_folded_elements_are_refused() -> None:
    square = Mesh([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2, 3]], "Q4")
    with pytest.raises(InputError, match="expected a mesh of T3 or T6 elements"):
        quadratic(square)
    folded = Mesh([[0, 0], [0, 1], [1, 0], [1, 1]], [[0, 1, 2], [1, 2, 3]], "T3")
    with pytest.raises(InputError, match="positive Jacobians"):
        quadratic(folded)


def test_a_notch_whose_curved_sides_fold_an_element_is_meshed() -> None:
    row, col = np.indices((131, 131))
    y, x = row - 65.5, col - 64.6
    notched = (np.hypot(x, y) < 20.0) | ((np.abs(x) < 2.6) & (np.abs(y) < 25.0))
    mask = (np.abs(row - 65) < 50) & (np.abs(col - 65) < 50) & ~notched
    mesh = mesh_of_mask(mask, PixelGrid.centred(131, 131, 1.0), 24.0, 12.0).mesh
    assert not non_positive_jacobians(mesh.nodes, mesh.cells, "T6").size
