"""Unit cells fit onto their copies; periodic cells carry the loads prescribed of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from fem_bodies import FloatArray, moved, plate
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.fem.hyperelastic import FreeBody
from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.options import (
    MacroLoading,
    equibiaxial,
    simple_shear,
    uniaxial,
    uniaxial_strain,
)
from modeharvest.fem.lattice.periodicity import find_periodicity
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.meshing import join, quarter_cell
from modeharvest.util.errors import InputError

SIZE = 1 / 8
SQUARE = square(1.0, 0.8, SIZE)
HEXAGONAL = hexagonal(1.386, 1.1, 1.386 * SIZE)
CELLS = [SQUARE, HEXAGONAL, SQUARE.enlarged(3, 2), HEXAGONAL.enlarged(2, 2)]
cells = pytest.mark.parametrize("cell", CELLS, ids=["square", "hexagonal", "3x2", "4-hole"])
LOADINGS = [uniaxial(), uniaxial(1), uniaxial_strain(), equibiaxial(), simple_shear()]
loadings = pytest.mark.parametrize("loading", LOADINGS)


def between_holes() -> UnitCell:
    """The square lattice once more, cut through four holes about a junction."""
    quarter = quarter_cell(1.0, 0.8, SIZE)
    places = [((1.0 - 2 * x, 1.0 - 2 * y), (x, y)) for x in (0.0, 1.0) for y in (0.0, 1.0)]
    return UnitCell(join([quarter.placed(*p) for p in places], 1e-7), np.eye(2))


def state_at(cell: UnitCell, loading: MacroLoading, load: float) -> tuple[PeriodicCell, CellState]:
    periodic = PeriodicCell(cell, TwoTermI1())
    state = CellPath(periodic, loading).at(load)
    assert state is not None
    return periodic, state


@cells
def test_every_node_is_its_master_moved_by_lattice_vectors(cell: UnitCell) -> None:
    found, nodes = cell.periodicity, cell.mesh.nodes
    origins = nodes - found.shift @ cell.lattice
    for k in range(found.count):
        assert np.ptp(origins[found.master == k], axis=0).max() < 1e-9


@cells
def test_copies_tile_the_plane(cell: UnitCell) -> None:
    # Around a periodic cell without masters counted twice: nodes - sides + elements = 1 - holes
    # - 1, the Euler characteristic of a torus with that many holes.
    master, c = cell.periodicity.master, cell.mesh.cells
    sides = master[np.sort(c[:, 3:].ravel())]
    corners = np.unique(master[c[:, :3]])
    holes = round(cell.area / (SQUARE.area if cell.lattice[1, 0] == 0 else HEXAGONAL.area))
    assert len(corners) - len(np.unique(sides)) + len(c) == -holes


@pytest.mark.parametrize(("cell", "turns"), [(SQUARE, 4), (HEXAGONAL, 6)])
def test_the_mesh_has_the_symmetry_of_the_lattice(cell: UnitCell, turns: int) -> None:
    angle = 2 * math.pi / turns
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    tree = cKDTree(cell.mesh.nodes)
    mirrored = cell.mesh.nodes * [-1.0, 1.0]
    assert tree.query(mirrored)[0].max() < 1e-12
    if turns == 6:  # the square's quarter is not symmetric about its diagonal
        assert tree.query(cell.mesh.nodes @ turn)[0].max() < 1e-12


@pytest.mark.parametrize("make", [square, hexagonal])
def test_the_area_of_material_converges_with_the_fourth_order(
    make: Callable[[float, float, float], UnitCell],
) -> None:
    def error(size: float) -> float:
        cell = make(1.0, 0.8, size)
        material = float(FreeBody(cell.mesh, TwoTermI1()).mass().sum()) / 2
        return abs(material - (cell.area - math.pi * 0.16))

    assert error(1 / 16) < error(1 / 8) / 10  # 16 in the limit


def test_an_boundary_through_holes_is_accepted() -> None:
    cell = between_holes()
    assert cell.periodicity.count == SQUARE.periodicity.count


def test_nodes_without_a_partner_are_named() -> None:
    nodes = SQUARE.mesh.nodes
    edge = np.flatnonzero(np.abs(nodes[:, 0] - 0.5) < 1e-9)
    lost = int(edge[np.argsort(nodes[edge, 1])[2]])

    def shifted(points: FloatArray) -> FloatArray:
        return points + 0.02 * (np.arange(len(points)) == lost)[:, None] * np.array([0.0, 1.0])

    with pytest.raises(InputError, match=rf"expected a partner.* {lost} at \(0.5, ") as error:
        UnitCell(moved(SQUARE.mesh, shifted), np.eye(2))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("lattice", "message"),
    [
        (0.5 * np.eye(2), "overlap at"),
        (np.diag([1.0, 1.1]), "only one direction has partners; without one are"),
        (1.2 * np.eye(2), "no direction has partners"),
        (np.array([[1.0, 0.0], [2.0, 0.0]]), "not parallel"),
        (np.array([[1.0, 0.0], [0.13, 1.0]]), "expected a partner"),
        (np.eye(3), "two lattice vectors"),
    ],
)
def test_lattice_vectors_that_do_not_fit_are_refused(lattice: FloatArray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_periodicity(SQUARE.mesh, lattice)


def test_a_part_that_nothing_holds_is_named() -> None:
    island = plate(0.2, 0.2, 1, 1)  # in the hole
    first = len(SQUARE.mesh.nodes)
    nodes = np.vstack([SQUARE.mesh.nodes, island.nodes])
    mesh = Mesh(nodes, np.vstack([SQUARE.mesh.cells, island.cells + first]), "T6")
    with pytest.raises(InputError, match=rf"one body.* {first} at"):
        UnitCell(mesh, np.eye(2))


def test_bad_cells_are_refused() -> None:
    with pytest.raises(InputError, match="must not touch"):
        square(1.0, 1.0, SIZE)
    with pytest.raises(InputError, match="must not touch"):
        hexagonal(1.0, 1.2, SIZE)
    with pytest.raises(InputError, match="mesh size"):
        square(1.0, 0.8, 0.0)
    with pytest.raises(InputError, match="1 x 1"):
        SQUARE.enlarged(0, 2)
    with pytest.raises(InputError, match="T6"):
        UnitCell(Mesh(SQUARE.mesh.nodes, SQUARE.mesh.cells[:, :3], "T3"), np.eye(2))


def test_bad_loadings_are_refused() -> None:
    with pytest.raises(InputError, match="free to rotate"):
        MacroLoading(((-1.0, None), (None, 0.0)))
    with pytest.raises(InputError, match="finite"):
        MacroLoading(((math.nan, 0.0), (0.0, 0.0)))
    with pytest.raises(InputError, match="other than 0"):
        MacroLoading(((0.0, 0.0), (0.0, 0.0)))
    with pytest.raises(InputError, match="axis"):
        uniaxial(2)


def test_the_tangent_is_the_derivative_of_the_forces() -> None:
    body = FreeBody(HEXAGONAL.mesh, TwoTermI1())
    rng = np.random.default_rng(3)
    u, v = 0.004 * rng.standard_normal((2, *HEXAGONAL.mesh.nodes.shape))
    h = 1e-5
    difference = (body.forces(u + h * v) - body.forces(u - h * v)) / (2 * h)
    tangent = body.stiffness(u) @ v.ravel()
    assert np.allclose(difference, tangent, atol=1e-7 * np.abs(tangent).max())
    work = (body.energy(u + h * v) - body.energy(u - h * v)) / (2 * h)
    assert work == pytest.approx(float(body.forces(u) @ v.ravel()), rel=1e-6)


def test_a_cell_without_holes_deforms_as_the_material_does() -> None:
    material, e = TwoTermI1(), 0.1
    cell = UnitCell(plate(3.0, 2.0, 4, 3), np.diag([3.0, 2.0]))
    _, state = state_at(cell, uniaxial(), e)

    def stress(a: float, b: float) -> float:  # P along the axis with stretch a: dW/da
        slope = material.c1 + 2 * material.c2 * (a**2 + b**2 - 2)
        return 2 * a * slope - 2 * material.c1 / a + material.bulk * (a * b - 1) * b

    across = brentq(lambda b: stress(b, 1 - e), 1.0, 1.5, xtol=1e-14)
    assert np.allclose(state.gradient, np.diag([1 - e, across]), atol=1e-10)
    assert state.stress[0, 0] == pytest.approx(stress(1 - e, across), rel=1e-9)
    assert np.abs(state.fluctuation).max() < 1e-10


@loadings
def test_rates_and_moduli_are_derivatives_along_the_path(loading: MacroLoading) -> None:
    cell = PeriodicCell(SQUARE, TwoTermI1())
    path, e, h = CellPath(cell, loading), 0.02, 1e-4
    before, here, after = path.at(e - h), path.at(e), path.at(e + h)
    assert before is not None
    assert here is not None
    assert after is not None

    def difference(name: str) -> FloatArray:
        return np.asarray((getattr(after, name) - getattr(before, name)) / (2 * h))

    # Central differences: 1e-11 / h from the tolerance of equilibrium, and errors of h^2 with
    # third derivatives of some hundreds.
    assert np.allclose(difference("value"), here.rate, atol=1e-5)
    rate = here.rate[:4].reshape(2, 2)
    stress_rate = np.einsum("ijkl,kl", here.moduli, rate)
    assert np.allclose(difference("stress"), stress_rate, atol=1e-5)
    # Hill-Mandel: the mean stress does the work of the stress.
    stored = [cell.body.energy(cell.displacement(s)) / SQUARE.area for s in (before, after)]
    work = np.sum(here.stress * rate)
    assert (stored[1] - stored[0]) / (2 * h) == pytest.approx(work, rel=1e-6)


@loadings
def test_what_is_prescribed_is_met(loading: MacroLoading) -> None:
    _, state = state_at(HEXAGONAL, loading, 0.01)
    free = loading.free.reshape(2, 2)
    prescribed = np.eye(2) + 0.01 * loading.rate.reshape(2, 2)
    assert np.array_equal(state.gradient[~free], prescribed[~free])
    # Equilibrium is met to what 1e-11 of load would make, times moduli of 1 MPa.
    assert np.abs(state.stress[free]).max(initial=0.0) < 3e-11
    # Moments balance: P F^T is symmetric.
    kirchhoff = state.stress @ state.gradient.T
    assert kirchhoff[0, 1] == pytest.approx(kirchhoff[1, 0], abs=1e-9 * np.abs(kirchhoff).max())


def test_a_prescribed_stress_gives_back_the_strain_that_made_it() -> None:
    _, strained = state_at(SQUARE, uniaxial(), 0.02)
    pull = MacroLoading(((None, 0.0), (0.0, None)), ((float(strained.stress[0, 0]), 0.0), (0, 0)))
    _, loaded = state_at(SQUARE, pull, 1.0)
    assert np.allclose(loaded.gradient, strained.gradient, atol=1e-9)


@pytest.mark.parametrize("other", [between_holes(), SQUARE.enlarged(2, 1)], ids=["cut", "2x1"])
def test_the_state_does_not_depend_on_the_choice_of_the_cell(other: UnitCell) -> None:
    _, here = state_at(SQUARE, uniaxial(), 0.02)
    _, there = state_at(other, uniaxial(), 0.02)
    assert np.allclose(there.gradient, here.gradient, atol=1e-10)
    assert np.allclose(there.stress, here.stress, atol=1e-10)
    assert np.allclose(there.moduli, here.moduli, atol=1e-8)
