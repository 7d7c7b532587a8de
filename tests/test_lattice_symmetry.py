"""Symmetries of a lattice that its mesh lacks: primitive cells, sets of modes, branches."""

from __future__ import annotations

import math
import re
from pathlib import Path

import foreign_cells as made
import meshio
import numpy as np
import pytest
from fem_bodies import plate

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.degenerate import Degeneracy, Transport, distinct_combinations
from modeharvest.fem.bloch.eigen import BlochModes, BlochWaves
from modeharvest.fem.bloch.mesh_error import elements_across, ligament_notes, load_error, refined
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.field import Mesh, with_mid_sides
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, chiral, hexagonal, square
from modeharvest.fem.lattice.options import CriticalSearch, MacroLoading, equibiaxial, uniaxial
from modeharvest.fem.lattice.primitive import primitive_cell
from modeharvest.fem.lattice.symmetry import Symmetry
from modeharvest.fem.materials import TwoTermI1
from modeharvest.runs.lattice.case import FileLattice
from modeharvest.util.errors import InputError

pytestmark = pytest.mark.dolfinx

SQUARE, HEXAGONAL = square(1.0, 0.87, 0.2), hexagonal(1.0, 0.9, 0.15)
SHEARED = ((1.0, 0.0), (1.0, 1.0))
QUICK = CriticalSearch(largest=0.05, divisions=4)


def path_of(cell: UnitCell, loading: MacroLoading) -> CellPath:
    return CellPath(PeriodicCell(cell, TwoTermI1()), loading)


# -- what the geometry is --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "count", "turns", "mirrors"),
    [
        (SQUARE, 1, 3, 4),
        (SQUARE.enlarged(2, 3), 6, 3, 4),
        (made.square_four(), 4, 3, 4),
        (made.foreign(SHEARED, made.many(1, 1), 0.6, 0.15), 1, 3, 4),
        (HEXAGONAL.enlarged(2, 1), 2, 5, 6),
        (made.hexagonal_one(), 1, 5, 6),
        (made.hexagonal_two(), 2, 5, 6),
        (made.hexagonal_four(), 4, 5, 6),
        (chiral(1.9, 0.1, 6), 1, 5, 0),
        (chiral(1.9, 0.1, 4), 1, 3, 0),
    ],
)
def test_symmetries_are_the_geometry_s_and_not_the_mesh_s(
    cell: UnitCell, count: int, turns: int, mirrors: int
) -> None:
    found = cell.symmetry
    assert len(found.translations) == count
    signs = [round(float(np.linalg.det(by.turn))) for by in found.operations]
    assert (signs.count(1), signs.count(-1)) == (turns, mirrors)
    assert abs(np.linalg.det(found.primitive)) == pytest.approx(cell.area / count)


def test_a_hole_that_differs_by_a_percent_makes_another_cell() -> None:
    """Two cells side by side, in one of which all is drawn a percent towards the hole."""
    nodes, cells = SQUARE.enlarged(2, 1).mesh.nodes.copy(), SQUARE.enlarged(2, 1).mesh.cells
    arm = nodes - [1.0, 0.0]
    distance = np.linalg.norm(arm, axis=1)
    nodes[distance < 0.44] -= 0.01 * arm[distance < 0.44]
    cell = UnitCell(Mesh(nodes, cells, "T6"), SQUARE.enlarged(2, 1).lattice)
    assert len(cell.symmetry.translations) == 1
    assert primitive_cell(cell) is cell


# -- supercells ------------------------------------------------------------------------------


@pytest.mark.parametrize(("m", "n"), [(2, 2), (3, 1), (1, 2)])
def test_the_primitive_cell_of_copies_is_part_of_their_mesh(m: int, n: int, tmp_path: Path) -> None:
    copies = HEXAGONAL.enlarged(m, n)
    points = np.column_stack([copies.mesh.nodes, np.zeros(len(copies.mesh.nodes))])
    meshio.Mesh(points, {"triangle6": copies.mesh.cells}).write(tmp_path / "cell.vtu")
    vectors = tuple(map(tuple, copies.lattice.tolist()))
    lattice = FileLattice(str(tmp_path / "cell.vtu"), 1.0, vectors)
    cell = lattice.cell()
    assert len(cell.mesh.cells) == len(HEXAGONAL.mesh.cells)
    assert cell.area == pytest.approx(HEXAGONAL.area, rel=1e-9)
    assert cell.origin is not None
    assert np.array_equal(cell.mesh.nodes, copies.mesh.nodes[cell.origin])
    assert f"holds {m * n} primitive ones" in cell.notes[-1]
    as_it_is = FileLattice(str(tmp_path / "cell.vtu"), 1.0, vectors, primitive=False).cell()
    assert len(as_it_is.mesh.cells) == m * n * len(cell.mesh.cells)
    assert f"holds {m * n} primitive ones" in as_it_is.notes[-1]
    same = [path_of(c, equibiaxial()).at(0.005) for c in (cell, HEXAGONAL)]
    assert np.allclose(same[0].moduli, same[1].moduli, rtol=1e-9)  # type: ignore[union-attr]


def test_the_triple_of_a_supercell_is_resolved_at_its_three_m_points() -> None:
    """On the 2 x 2 cell itself all three are at Γ, mixed at will."""
    path = path_of(primitive_cell(HEXAGONAL.enlarged(2, 2)), equibiaxial())
    found = first_critical(path, QUICK)
    halves = {tuple(round(p / math.pi) % 2 for p in wave) for wave in found.waves}
    assert halves == {(1, 0), (0, 1), (1, 1)}
    modes = real_modes(path.cell, found.state, found.waves)
    cell = PeriodicCell(path.cell.cell.enlarged(2, 2), TwoTermI1())
    counts = [np.count_nonzero(row) for row in distinct_combinations(cell, modes)]
    assert counts == [1, 2, 3]  # rows, two of them, and the flower: the stable one is among them


def test_a_supercell_that_is_meshed_anew_for_each_hole_is_refused_with_what_to_do() -> None:
    with pytest.raises(InputError, match=r"supercell of 4 .*vectors = \[\[1, 0\], \[0, 1\]\] mm"):
        primitive_cell(made.square_four())
    with pytest.raises(InputError, match=r"supercell of 2 .*\[0.5, 0.866025404\]\] mm, or set pr"):
        primitive_cell(made.hexagonal_two())
    (note,) = primitive_cell(made.square_four(), wanted=False).notes
    assert note.endswith("without bifurcation: each is meshed differently")


# -- sets that the mesh splits ---------------------------------------------------------------


def test_a_triple_split_by_the_mesh_is_recognised_and_its_splitting_bounded() -> None:
    """gmsh's mesh of the rhombus has none of the lattice's turns; before, one M point was found."""
    found = first_critical(path_of(made.hexagonal_one(), equibiaxial()), QUICK)
    assert len(found.waves) == 3
    assert 1e-5 < found.splitting < found.splitting_bound < 0.2
    exact = first_critical(path_of(HEXAGONAL, equibiaxial()), QUICK)
    assert len(exact.waves) == 3
    assert exact.splitting < 1e-8
    assert exact.splitting_bound < 1e-8


def test_branches_of_several_modes_that_a_mesh_splits_say_what_to_do() -> None:
    cell = made.hexagonal_one()
    path = path_of(cell, equibiaxial())
    found = first_critical(path, QUICK)
    modes = real_modes(path.cell, found.state, found.waves)
    copies, loads = path_of(cell.enlarged(2, 2), equibiaxial()), [1.2 * modes.load]
    single = follow(copies, modes, (0, 1, 0), loads)  # not the lowest one, and followed too
    assert len(single.states) == 1
    assert single.states[0].energy < single.states[0].primary_energy
    flower = follow(copies, modes, (1, 1, 1), loads)
    assert flower.states == ()
    reason = r"the mesh splits these modes by 0\.\d+ of the load.*mesh one sector of the cell"
    assert re.search(reason, flower.outcome)


def test_the_bound_is_one_and_a_symmetric_mesh_attains_it() -> None:
    for cell, exact in ((HEXAGONAL, True), (made.hexagonal_one(), False)):
        state = path_of(cell, equibiaxial()).at(0.005)
        assert state is not None
        waves = BlochWaves(PeriodicCell(cell, TwoTermI1()), state)
        lowest = waves.lowest((math.pi, 0.0))
        bound = Degeneracy(waves).bound(lowest)
        every = [waves.lowest(w).eigenvalues[0] for w in ((0.0, math.pi), (math.pi, math.pi))]
        assert max(every) <= bound * (1 + 1e-9)
        assert (bound == pytest.approx(max(every), rel=1e-6)) == exact


def test_only_symmetries_that_the_load_keeps_make_modes_equal() -> None:
    """Uniaxial along x or y: two of the three M points are mirror images, (0, π) stands alone."""
    for axis in (0, 1):
        path = path_of(made.hexagonal_one(), uniaxial(axis))
        state = path.at(0.01)
        assert state is not None
        degeneracy = Degeneracy(BlochWaves(path.cell, state))
        assert len(degeneracy.waves((math.pi, 0.0))) == 2
        assert len(degeneracy.waves((math.pi, math.pi))) == 2
        assert len(degeneracy.waves((0.0, math.pi))) == 1


def test_a_pair_of_one_wave_split_by_the_mesh_is_counted_as_two() -> None:
    """At K of hexagonal stacking: a mode, then a pair, which eigenvalues alone do not tell."""
    cell = PeriodicCell(made.hexagonal_one(), TwoTermI1())
    state = CellPath(cell, equibiaxial()).at(0.001)
    assert state is not None
    waves = BlochWaves(cell, state)
    found = waves.lowest((2 * math.pi / 3, 4 * math.pi / 3), 5)
    assert 1e-4 < found.eigenvalues[2] / found.eigenvalues[1] - 1.0 < 1e-2
    degeneracy = Degeneracy(waves)
    assert degeneracy.count(found, 1) == 1
    pair = BlochModes(found.wave, found.eigenvalues[1:], found.vectors[:, 1:])
    assert degeneracy.count(pair, 1) == 2


def test_fields_are_carried_to_their_images() -> None:
    """A smooth periodic field, turned by 60 degrees on a mesh without that symmetry."""
    cell = PeriodicCell(made.hexagonal_one(), TwoTermI1())
    turn = next(by for by in cell.cell.symmetry.operations if np.trace(by.turn) > 0.9)
    inverse = np.linalg.inv(cell.cell.lattice)

    def smooth(x: np.ndarray) -> np.ndarray:
        p, q = 2.0 * np.pi * (x @ inverse).T
        return np.stack([np.sin(p) + np.cos(q), np.cos(p - q)], axis=1)

    first = np.unique(cell.reduction.periodicity.master, return_index=True)[1]
    places = cell.cell.mesh.nodes[first]
    vector = smooth(places).ravel()[cell.reduction.order][:, None]
    image, wave = Transport(cell).image(vector, (0.0, 0.0), turn)
    expected = smooth((places - turn.move) @ turn.turn) @ turn.turn.T
    assert np.allclose(wave, 0.0)
    assert np.abs(image[:, 0] - expected.ravel()[cell.reduction.order]).max() < 0.05
    same, _ = Transport(cell).image(vector, (0.0, 0.0), Symmetry(np.eye(2), cell.cell.lattice[0]))
    assert np.allclose(same, vector, atol=1e-12)


# -- the mesh's own error --------------------------------------------------------------------


def test_one_refinement_bounds_the_critical_load_s_error() -> None:
    """Against two refinements more, whose error is smaller by an order and more."""
    path = path_of(SQUARE, equibiaxial())
    found = first_critical(path, QUICK)
    error = load_error(found, path, TwoTermI1(), QUICK)
    assert error is not None
    assert error[1] == 2.0
    cell = SQUARE
    for _ in range(2):
        cell = UnitCell(refined(cell.mesh, 1e-7), cell.lattice)
    best = first_critical(path_of(cell, equibiaxial()), CriticalSearch(0.05, 2, waves=((1, 1),)))
    actual = found.load - best.load
    assert 0 < actual < error[0] < 1.6 * actual
    assert load_error(found, path, TwoTermI1(), CriticalSearch(refine=False)) is None


def test_a_refined_mesh_fills_the_same_curved_boundary() -> None:
    finer = UnitCell(refined(SQUARE.mesh, 1e-7), SQUARE.lattice)
    assert len(finer.mesh.cells) == 4 * len(SQUARE.mesh.cells)
    masses = [PeriodicCell(cell, TwoTermI1()).nodal_mass.sum() for cell in (SQUARE, finer)]
    assert masses[1] == pytest.approx(masses[0], rel=1e-4)  # three points a triangle
    assert len(finer.symmetry.operations) == 7


def test_a_cell_without_holes_has_no_ligaments_and_no_primitive_cell() -> None:
    cell = UnitCell(plate(2.0, 1.0, 4, 2), np.diag([2.0, 1.0]))
    assert primitive_cell(cell) is cell
    assert ligament_notes(cell) == []
    assert cell.symmetry.operations == ()


def test_holes_that_touch_at_corners_are_no_fault() -> None:
    """A diamond in a square: the lattice of rotating squares."""
    corners = np.array([[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5], [0.5, 0.5]])
    cells = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    cell = UnitCell(Mesh(*with_mid_sides(corners, cells), "T6"), np.eye(2))
    assert len(cell.symmetry.translations) == 1
    assert elements_across(cell)[0] >= 1


@pytest.mark.parametrize(
    ("cell", "count"),
    [
        (square(1.9, 1.5, 0.3), 2),
        (square(1.9, 1.5, 0.12), 4),
        (square(1.9, 1.5, 0.3).enlarged(2, 1), 2),
        (chiral(1.9, 0.095, 6), 1),
        (chiral(1.9, 0.0475, 6), 2),
    ],
)
def test_elements_across_ligaments_are_counted(cell: UnitCell, count: int) -> None:
    found, place = elements_across(cell)
    assert found == count
    assert (len(ligament_notes(cell)) == 1) == (count < 3)
    near = np.linalg.norm(cell.mesh.nodes - place, axis=1).min()
    assert near < 0.1
