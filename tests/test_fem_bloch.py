"""Bloch waves: the reduction, the eigenvalues, the long-wave limit, the first critical point."""

from __future__ import annotations

import math
import runpy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fem_bodies import FloatArray, plate
from numpy.typing import NDArray
from scipy.linalg import eigh

from modeharvest.fem.bloch.critical import LatticeCritical, Zone, critical_at, first_critical
from modeharvest.fem.bloch.degenerate import folded, is_same
from modeharvest.fem.bloch.dispersion import ZONES, zone_path
from modeharvest.fem.bloch.eigen import BlochWaves, scan
from modeharvest.fem.lattice.bloch_map import Condensation, factorise
from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.options import (
    CriticalSearch,
    MacroLoading,
    Wave,
    equibiaxial,
    uniaxial,
    uniaxial_strain,
)
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.meshing import join, rectangle
from modeharvest.fem.sparse_factor import negative_pivots
from modeharvest.util.errors import InputError

refined = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks/refinement.py"))[
    "refined_cell"
]
M: Wave = (math.pi, math.pi)
GENERAL: Wave = (0.7, -2.1)
HOLES = 0.8696
LOADINGS = {"uniaxial": uniaxial(), "strain": uniaxial_strain(), "equibiaxial": equibiaxial()}


@cache
def cell_of(kind: str, per_pitch: int, copies: int = 1) -> UnitCell:
    made = {
        "square": square(1.0, HOLES, 1 / per_pitch),
        "hexagonal": hexagonal(1.386, 1.28, 1.386 / per_pitch),
    }[kind]
    return made.enlarged(copies, copies) if copies > 1 else made


@cache
def waves_of(kind: str, load: float, copies: int = 1) -> BlochWaves:
    """On a coarse mesh under uniaxial compression; the square lattice buckles at 0.030."""
    cell = PeriodicCell(cell_of(kind, 6, copies), TwoTermI1())
    state = CellPath(cell, uniaxial()).at(load)
    assert state is not None
    return BlochWaves(cell, state)


def columns_with_ties() -> UnitCell:
    """Columns 0.3 mm wide and 1 mm apart, with a tie 0.1 mm thick every millimetre."""
    half, column, tie = 0.45, 0.3, 0.1
    low, middle = rectangle(column, half, 3, 4), rectangle(column, tie, 3, 1)
    beside = rectangle(1.0 - column, tie, 8, 1)
    places = [(low, (0.0, 0.0)), (middle, (0.0, half)), (low, (0.0, half + tie))]
    blocks = [block.placed((1.0, 1.0), at) for block, at in [*places, (beside, (column, half))]]
    return UnitCell(join(blocks, 1e-7), np.eye(2))


def path_of(cell: UnitCell, loading: MacroLoading) -> CellPath:
    return CellPath(PeriodicCell(cell, TwoTermI1()), loading)


@cache
def critical(kind: str, loading: str) -> LatticeCritical:
    return first_critical(path_of(cell_of(kind, 12), LOADINGS[loading]))


def dense(waves: BlochWaves, wave: Wave) -> FloatArray:
    matrices = (waves.stiffness(wave).toarray(), waves.cell.mass(wave).toarray())
    return np.asarray(eigh(*matrices, eigvals_only=True))


def transformation(waves: BlochWaves, wave: Wave) -> NDArray[np.complex128]:
    """T(k), written down node by node."""
    reduction, found = waves.cell.reduction, waves.cell.cell.periodicity
    T = np.zeros((2 * len(found.master), reduction.size), dtype=complex)
    phases = np.exp(1j * (found.shift @ np.array(wave)))
    for axis in (0, 1):
        T[2 * np.arange(len(phases)) + axis, 2 * found.master + axis] = phases
    return T[:, reduction.order]


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
@pytest.mark.parametrize("wave", [(0.0, 0.0), M, GENERAL])
def test_the_reduced_matrix_is_the_product_with_the_transformation(kind: str, wave: Wave) -> None:
    waves = waves_of(kind, 0.02)
    T = transformation(waves, wave)
    product = T.conj().T @ (waves.state.stiffness @ T)
    assert np.allclose(waves.stiffness(wave).toarray(), product, atol=1e-12)
    x = np.random.default_rng(1).standard_normal(T.shape[1])
    moved = waves.cell.reduction.displacement(x, wave)
    assert np.allclose(moved.ravel(), T @ x, atol=1e-13)


@pytest.mark.parametrize("load", [0.0, 0.04])
@pytest.mark.parametrize("wave", [M, GENERAL, (0.3, 0.1)])
def test_lowest_eigenvalues_and_their_signs_are_those_of_the_dense_matrix(
    load: float, wave: Wave
) -> None:
    waves, exact = waves_of("square", load), dense(waves_of("square", load), wave)
    found = waves.lowest(wave, count=4)
    assert np.allclose(found.eigenvalues, exact[:4], rtol=1e-7, atol=1e-9)
    assert waves.unstable(wave) == np.sum(exact < 0)
    K, mass = waves.stiffness(wave), waves.cell.mass(wave)
    residual = K @ found.vectors[:, 0] - found.eigenvalues[0] * (mass @ found.vectors[:, 0])
    assert np.linalg.norm(residual) < 1e-4 * np.linalg.norm(K @ found.vectors[:, 0] + 1.0)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
@pytest.mark.parametrize("wave", [M, GENERAL])
def test_condensing_the_interior_leaves_the_inverse_as_it_is(kind: str, wave: Wave) -> None:
    waves = waves_of(kind, 0.01)
    solver = Condensation(waves.state.stiffness, waves.cell.reduction.boundary).at(np.array([wave]))
    assert solver is not None
    K = waves.stiffness(wave)
    x = np.random.default_rng(2).standard_normal((K.shape[0], 3)).astype(K.dtype)
    assert np.allclose(solver.solve((K @ x)[:, None])[:, 0], x, atol=1e-9)


def test_cholesky_finds_the_unstable_waves() -> None:
    waves = waves_of("square", 0.04)
    points = Zone(waves.cell, 6).grid
    negative = tuple(wave for wave in points if dense(waves, wave)[0] < 0)
    assert 0 < len(negative) < len(points)
    assert waves.unstable_among(points) == negative


def test_at_the_centre_the_translations_are_left_out() -> None:
    waves = waves_of("square", 0.02)
    exact = dense(waves, (0.0, 0.0))
    assert np.abs(exact[:2]).max() < 1e-8
    assert np.allclose(waves.lowest((0.0, 0.0), 3).eigenvalues, exact[2:5], rtol=1e-7)


def test_the_slope_is_the_derivative_of_the_eigenvalue() -> None:
    waves, h = waves_of("square", 0.02), 1e-3

    def value(p: float, q: float) -> float:
        return float(waves.lowest((GENERAL[0] + p, GENERAL[1] + q)).eigenvalues[0])

    differences = [(value(h, 0) - value(-h, 0)) / (2 * h), (value(0, h) - value(0, -h)) / (2 * h)]
    assert np.allclose(waves.slope(waves.lowest(GENERAL)), differences, rtol=1e-4)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_long_waves_see_the_effective_medium(kind: str) -> None:
    waves = waves_of(kind, 0.01)
    for angle in (0.0, 0.5, 2.2):
        k = 0.02 / 1.386 * np.array([math.cos(angle), math.sin(angle)])
        wave = tuple(waves.cell.cell.lattice @ k)
        value = waves.lowest((wave[0], wave[1])).eigenvalues[0] * waves.cell.filling / (k @ k)
        assert value == pytest.approx(waves.acoustic(angle), rel=1e-3)  # corrections of k^2


def test_nested_meshes_converge_at_the_rate_of_quadratic_elements() -> None:
    # Twice the elements' degree, four, for eigenvalues and for the area; the geometry is good to
    # that order because a side's middle lies on the circle. The eigenvalue still rises to it.
    cell, areas, values = square(1.0, HOLES, 1 / 6), [], []
    for _ in range(3):
        made = PeriodicCell(cell, TwoTermI1(bulk=1.0))
        state = made.equilibrium(uniaxial(), 0.0)
        assert state is not None
        areas.append(made.filling - (1.0 - math.pi / 4 * HOLES**2))
        values.append(float(BlochWaves(made, state).lowest(M).eigenvalues[0]))
        cell = refined(cell, HOLES)
    area_rates = np.log2(np.divide(areas[:-1], areas[1:]))
    assert np.all(area_rates > 3.9)
    assert values[0] > values[1] > values[2]
    assert math.log2((values[0] - values[1]) / (values[1] - values[2])) > 3.4


def test_waves_of_the_enlarged_cell_are_those_that_fold_onto_them() -> None:
    small, large = waves_of("square", 0.02), waves_of("square", 0.02, 2)
    together = [
        dense(small, (GENERAL[0] / 2 + p, GENERAL[1] / 2 + q))[:4]
        for p in (0.0, math.pi)
        for q in (0.0, math.pi)
    ]
    expected = np.sort(np.concatenate(together))[:4]
    assert np.allclose(large.lowest(GENERAL, 4).eigenvalues, expected, rtol=1e-7)


def test_a_scan_finds_modes_that_the_wave_before_has_no_part_of() -> None:
    # On the zone's boundary mirror symmetry keeps modes apart.
    waves = waves_of("square", 0.04)
    points, stops = zone_path(ZONES["square"], waves.cell.cell.lattice, 21)
    assert [points[k] for k in stops] == [wave for _, wave in ZONES["square"]]
    waves.factorisations = 0
    values = scan(waves, points)[:, 0]
    assert values[0] == values[-1] == pytest.approx(dense(waves, points[0])[2], rel=1e-6)
    exact = [dense(waves, wave)[0] for wave in points[1:-1]]
    assert np.allclose(values[1:-1], exact, rtol=1e-6, atol=1e-8)
    assert min(values) < 0  # buckled at 0.030
    assert waves.factorisations <= 3  # of the interior: one for each shift that was too small


@pytest.mark.parametrize(
    "wave", [(0.1,), (0.1, 0.2, 0.3), (0.1, math.nan), (0.1 + 0.2j, 0.0), ("Γ", "M")]
)
def test_wave_vectors_out_of_the_plane_are_refused(wave: Any) -> None:
    waves = waves_of("square", 0.02)
    path = CellPath(waves.cell, uniaxial())
    corners = [("Γ", (0.0, 0.0)), ("?", wave)]
    for asked in (
        lambda: waves.lowest(wave),
        lambda: waves.unstable(wave),
        lambda: waves.unstable_among([wave]),
        lambda: scan(waves, [M, wave]),
        lambda: critical_at(path, wave),
        lambda: zone_path(corners, np.eye(2), 10),
    ):
        with pytest.raises(InputError, match="wave vector: expected its phases"):
            asked()


def test_the_corners_of_the_hexagonal_zone_are_where_geometry_has_them() -> None:
    inverse = np.linalg.inv(cell_of("hexagonal", 6).lattice)
    m, k = (np.linalg.norm(inverse @ wave) * 1.386 for _, wave in ZONES["hexagonal"][1:3])
    assert m == pytest.approx(2 * math.pi / math.sqrt(3))
    assert k == pytest.approx(4 * math.pi / 3)


def test_inertia_counts_negative_eigenvalues_and_refuses_to_guess() -> None:
    waves = waves_of("square", 0.02)
    K, mass = waves.stiffness(GENERAL), waves.cell.mass(GENERAL)
    middle = float(dense(waves, GENERAL)[6:8].mean())
    assert negative_pivots(factorise(K - middle * mass)) == 7


# d/l = 0.8696 in percent, from an independent calculation with a mesh error of 2 to 3 %.
@pytest.mark.parametrize(
    ("loading", "expected"), [("uniaxial", 3.0), ("strain", 2.3), ("equibiaxial", 1.15)]
)
def test_the_square_lattice_buckles_at_m(loading: str, expected: float) -> None:
    found = critical("square", loading)
    assert found.found
    assert 100 * found.load == pytest.approx(expected, rel=0.03)
    assert found.waves == (M,)
    assert (found.below, found.above) == ((0,), (1,))
    assert found.unstable_before == ()


def test_the_hexagonal_lattice_has_three_modes_at_once() -> None:
    found = critical("hexagonal", "equibiaxial")
    # 0.7 % from the same calculation; one more digit isn't known.
    assert 100 * found.load == pytest.approx(0.7, abs=0.05)
    assert sorted(found.waves) == [(0.0, math.pi), (math.pi, 0.0), M]
    assert (found.below, found.above) == ((0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize(
    ("kind", "loading", "modes"),
    [("square", "uniaxial", 1), ("square", "equibiaxial", 1), ("hexagonal", "equibiaxial", 3)],
)
def test_the_2_x_2_cell_has_the_same_critical_point_by_itself(
    kind: str, loading: str, modes: int
) -> None:
    once, twice = (path_of(cell_of(kind, 6, copies), LOADINGS[loading]) for copies in (1, 2))
    found = critical_at(twice, (0.0, 0.0))
    assert found.load == pytest.approx(first_critical(once).load, rel=1e-6)
    assert (found.below, found.above) == ((0,), (modes,))


def test_the_first_critical_point_does_not_depend_on_the_cell() -> None:
    once = first_critical(path_of(cell_of("square", 4), uniaxial()))
    search = CriticalSearch(divisions=2)
    twice = first_critical(path_of(cell_of("square", 4, 2), uniaxial()), search)
    assert twice.load == pytest.approx(once.load, rel=1e-6)
    assert twice.waves == ((0.0, 0.0),)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_a_critical_wave_between_the_points_of_the_grid_is_found(kind: str) -> None:
    path = path_of(cell_of(kind, 4), equibiaxial())
    on = first_critical(path)
    off = first_critical(path, CriticalSearch(divisions=3))  # no M among its points
    assert off.load == pytest.approx(on.load, rel=1e-6)  # stationary: of second order in k
    assert any(is_same(off.waves[0], wave) for wave in on.waves)


def test_columns_with_slender_ties_sway_together() -> None:
    # The effective medium loses ellipticity first: known of frames, e.g. Triantafyllidis &
    # Schnaidt, J. Mech. Phys. Solids 41 (1993) 1533-1565.
    path = path_of(columns_with_ties(), uniaxial(1))
    found = first_critical(path)
    assert found.waves == ()
    angle = found.least_stable.angle
    assert angle is not None
    assert abs(math.sin(angle)) == pytest.approx(1.0, abs=1e-4)  # k along the columns
    before, after = path.at(0.99 * found.load), path.at(1.01 * found.load)
    assert before is not None
    assert after is not None
    long: Wave = (0.0, 0.02)
    assert BlochWaves(path.cell, before).unstable(long) == 0
    assert BlochWaves(path.cell, after).unstable(long) == 1


def test_a_stable_lattice_is_an_outcome_not_a_failure() -> None:
    found = first_critical(path_of(cell_of("square", 6), uniaxial()), CriticalSearch(largest=0.01))
    assert not found.found
    assert found.load == 0.01
    assert found.least_stable.value > 0
    assert "stable up to e = 0.01" in found.outcome


class EndingPath(CellPath):
    """A path that can't be followed beyond a load, as where a hole's edge folds."""

    end = 0.0

    def at(self, load: float) -> CellState | None:
        """Go as far as there is a path."""
        found = super().at(min(load, self.end))
        return found if load <= self.end else None


@pytest.mark.parametrize("end", [0.024, 0.02])
def test_a_path_that_ends_is_looked_at_up_to_there(end: float) -> None:
    """The critical strain is 2.27 %; the step that would pass it fails."""
    cell = PeriodicCell(cell_of("square", 8), TwoTermI1())
    path = EndingPath(cell, uniaxial_strain())
    path.end = end
    found = first_critical(path)
    assert found.found == (end > 0.0227)
    if found.found:
        whole = first_critical(CellPath(cell, uniaxial_strain()))
        assert found.load == pytest.approx(whole.load, rel=1e-8)
        assert 0.02 < whole.load < end
    else:
        assert found.load == end
        assert "did not converge beyond e = 0.02" in found.outcome
        assert found.least_stable.value > 0


def test_a_lattice_that_is_a_mechanism_is_refused() -> None:
    # Squares that touch at their corners, as on a chessboard: all turn, every other one the
    # other way round, at no cost.
    squares = UnitCell(plate(1.0, 1.0, 2, 2), np.array([[1.0, 1.0], [1.0, -1.0]]))
    with pytest.raises(InputError, match=r"mechanism: a wave of phases \(3.14\d*, 3.14\d*\)"):
        first_critical(path_of(squares, equibiaxial()))


def test_bad_searches_are_refused() -> None:
    with pytest.raises(InputError, match="a largest load above 0"):
        CriticalSearch(largest=0.0)
    with pytest.raises(InputError, match="zone path"):
        zone_path(ZONES["square"][:1], np.eye(2), 10)


def test_the_grid_has_every_wave_once() -> None:
    grid = Zone(waves_of("square", 0.0).cell, 4).grid
    assert len(grid) == (16 - 4) // 2 + 3  # halves of the pairs k, -k, and M, X, Y, without Γ
    assert all(not is_same(a, b) for k, a in enumerate(grid) for b in grid[:k])
    assert folded((3 * math.pi, -math.pi)) == pytest.approx((math.pi, math.pi))


def test_the_recipe_works_as_printed() -> None:
    page = (Path(__file__).parent.parent / "docs/explanation/bloch.md").read_text(encoding="utf-8")
    recipe = page.split("```python\n")[1].split("```")[0]
    namespace: dict[str, Any] = {}
    exec(compile(recipe, "docs/explanation/bloch.md", "exec", dont_inherit=True), namespace)
    found = namespace["found"]
    # The size of the cell is of no account: the same as for a pitch of 1 on a similar mesh.
    assert found.load == pytest.approx(critical("square", "uniaxial").load, rel=0.01)
