"""Real modes on the commensurate cell: eigenvectors of it, orthonormal, and symmetric."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.critical import LatticeCritical, critical_at, first_critical
from modeharvest.fem.bloch.eigen import BlochWaves
from modeharvest.fem.bloch.modes import ModeSet
from modeharvest.fem.bloch.real_modes import canonical, real_modes
from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.options import MacroLoading, Wave, equibiaxial, uniaxial
from modeharvest.fem.materials import TwoTermI1
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
M: Wave = (math.pi, math.pi)
THIRD: Wave = (2 * math.pi / 3, 0.0)
K: Wave = (4 * math.pi / 3, 2 * math.pi / 3)
LOADINGS = {"square": uniaxial(), "hexagonal": equibiaxial()}


@cache
def cell_of(kind: str, m: int = 1, n: int = 1) -> PeriodicCell:
    cells: dict[str, UnitCell] = {
        "square": square(1.0, 0.7895, 1 / 6),
        "hexagonal": hexagonal(1.386, 1.28, 1.386 / 6),
    }
    return PeriodicCell(
        cells[kind].enlarged(m, n) if (m, n) != (1, 1) else cells[kind], TwoTermI1()
    )


def state_of(cell: PeriodicCell, loading: MacroLoading, load: float) -> CellState:
    state = CellPath(cell, loading).at(load)
    assert state is not None
    return state


@cache
def critical(kind: str) -> LatticeCritical:
    return first_critical(CellPath(cell_of(kind), LOADINGS[kind]))


@cache
def critical_modes(kind: str) -> ModeSet:
    return real_modes(cell_of(kind), critical(kind).state, critical(kind).waves)


def product(cell: PeriodicCell, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m, p) means over the material of a_i . b_j."""
    flat = b.reshape(len(b), -1).T
    material = 0.5 * cell.nodal_mass.sum()
    return np.asarray(a.reshape(len(a), -1) @ (cell.nodal_mass @ flat) / material)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
@pytest.mark.parametrize(
    ("waves", "copies"),
    [
        ([(0.0, 0.0)], (1, 1)),
        ([M], (2, 2)),
        ([(0.0, math.pi)], (1, 2)),
        ([THIRD], (3, 1)),
        ([K], (3, 3)),
        ([THIRD, (0.0, math.pi)], (3, 2)),
    ],
)
def test_modes_are_eigenvectors_of_the_enlarged_cell(
    kind: str, waves: list[Wave], copies: tuple[int, int]
) -> None:
    load = 0.005
    modes = real_modes(cell_of(kind), state_of(cell_of(kind), LOADINGS[kind], load), waves)
    assert modes.info["copies"] == list(copies)
    cell = cell_of(kind, *copies)
    assert np.array_equal(modes.mesh.nodes, cell.cell.mesh.nodes)
    assert np.array_equal(modes.lattice, cell.cell.lattice)
    assert np.allclose(product(cell, modes.shapes, modes.shapes), np.eye(len(modes.waves)))

    stiffness = state_of(cell, LOADINGS[kind], load).stiffness
    restricted = cell.reduction.restricted  # at Γ: what the enlarged cell's periodicity leaves
    for value, shape in zip(modes.eigenvalues, modes.shapes, strict=True):
        forces = restricted(stiffness @ shape.ravel())
        inertia = value * restricted(cell.nodal_mass @ shape.ravel())
        # Relative to the forces of single elements, most of which cancel: the backward error.
        single = np.linalg.norm(abs(stiffness) @ np.abs(shape.ravel()))
        assert np.linalg.norm(forces - inertia) < 1e-10 * single


def test_a_wave_advances_from_cell_to_cell_by_its_phase() -> None:
    state = state_of(cell_of("square"), uniaxial(), 0.02)
    modes = real_modes(cell_of("square"), state, [THIRD])
    tree = cKDTree(modes.mesh.nodes)
    distance, there = tree.query(modes.mesh.nodes + modes.primitive[0])
    is_inside = distance < 1e-9
    assert is_inside.sum() > 0.6 * len(is_inside)
    c, s = math.cos(THIRD[0]), math.sin(THIRD[0])
    real, imaginary = modes.shapes
    moved = modes.shapes[:, there[is_inside]]
    assert np.allclose(moved[0], (c * real - s * imaginary)[is_inside], atol=1e-9)
    assert np.allclose(moved[1], (s * real + c * imaginary)[is_inside], atol=1e-9)


@pytest.mark.parametrize(("kind", "count"), [("square", 1), ("hexagonal", 3)])
def test_critical_modes_are_the_lowest_of_the_enlarged_cell(kind: str, count: int) -> None:
    modes, cell = critical_modes(kind), cell_of(kind, 2, 2)
    assert len(modes.waves) == count
    own = critical_at(CellPath(cell, LOADINGS[kind]), (0.0, 0.0))
    assert own.load == pytest.approx(modes.load, rel=1e-6)
    lowest = BlochWaves(cell, own.state).lowest((0.0, 0.0), count)
    root = math.sqrt(0.5 * cell.nodal_mass.sum())
    vectors = [
        root * cell.reduction.displacement(vector, (0.0, 0.0)) for vector in lowest.vectors.T
    ]
    # The same space: all of each mode is in the other set.
    overlap = product(cell, modes.shapes, np.stack(vectors))
    assert np.allclose(overlap @ overlap.T, np.eye(count), atol=1e-7)


def test_a_turn_by_60_degrees_permutes_the_modes_of_the_hexagonal_lattice() -> None:
    modes, cell = critical_modes("hexagonal"), cell_of("hexagonal", 2, 2)
    c, s = 0.5, 0.5 * math.sqrt(3.0)
    turn = np.array([[c, -s], [s, c]])
    # The field at X of the turned mode is that at R^-1 X, turned; found modulo the lattice.
    sought = modes.mesh.nodes @ turn
    wrapped = [
        cKDTree(modes.mesh.nodes).query(sought + np.array([i, j]) @ modes.lattice)
        for i in range(-2, 3)
        for j in range(-2, 3)
    ]
    distances = np.stack([distance for distance, _ in wrapped])
    assert distances.min(axis=0).max() < 1e-9  # the mesh has the symmetry, too
    numbers = np.stack([number for _, number in wrapped])
    number = numbers[distances.argmin(axis=0), np.arange(len(sought))]
    turned = modes.shapes[:, number] @ turn.T
    overlap = np.abs(product(cell, modes.shapes, turned))
    assert np.allclose(np.sort(overlap, axis=None), [0] * 6 + [1] * 3, atol=1e-6)
    assert np.allclose(overlap.sum(axis=0), 1.0, atol=1e-6)
    assert np.trace(overlap) < 1e-6  # none stays where it is


def test_signs_are_fixed_by_the_first_large_component() -> None:
    for kind in ("square", "hexagonal"):
        for shape in critical_modes(kind).shapes:
            values = shape.ravel()
            first = np.argmax(np.abs(values) > 0.9 * np.abs(values).max())
            assert values[first] > 0
    once, again = (
        real_modes(cell_of("square"), critical("square").state, waves)
        for waves in ([M], [(-math.pi, 3 * math.pi), M])
    )
    assert np.array_equal(once.shapes, again.shapes)  # the same wave, named twice


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("imaginary", [0.0, 1.0])
def test_the_basis_depends_on_the_space_only(count: int, imaginary: float) -> None:
    random = np.random.default_rng(5)

    def noise(*shape: int) -> NDArray[np.complex128]:
        return random.normal(size=shape) + 1j * imaginary * random.normal(size=shape)

    space = np.linalg.qr(noise(40, count))[0]
    mixed = space @ np.linalg.qr(noise(count, count))[0]
    basis = canonical(space)
    assert np.allclose(canonical(mixed), basis, atol=1e-12)
    assert np.allclose(basis.conj().T @ basis, np.eye(count))
    assert np.allclose(space @ (space.conj().T @ basis), basis)  # still that space


def test_waves_near_a_fraction_are_taken_for_it() -> None:
    state = critical("hexagonal").state
    found = real_modes(cell_of("hexagonal"), state, [(math.pi - 1e-5, 1e-6)])
    assert found.waves == ((math.pi, 0.0),)


def test_waves_without_a_finite_cell_are_refused() -> None:
    cell, state = cell_of("square"), critical("square").state
    with pytest.raises(InputError, match=r"phases \(1, 0\) rad; take a fraction of 2π nearby"):
        real_modes(cell, state, [(1.0, 0.0)])
    with pytest.raises(InputError, match="at most 12 x 12 copies, got 35 x 1"):
        real_modes(cell, state, [(2 * math.pi / 5, 0.0), (2 * math.pi / 7, 0.0)])
    with pytest.raises(InputError, match="modes of no finite cell"):
        real_modes(cell, state, [])
    for outside in ((math.pi,), (math.pi, math.nan), (1.0, 2.0, 3.0)):
        with pytest.raises(InputError, match="wave vector: expected its phases"):
            real_modes(cell, state, [outside])  # type: ignore[list-item]
