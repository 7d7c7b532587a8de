"""Stability: inertia and modes against dense algebra, and the buckling of a column."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from fem_bodies import FloatArray, column, vector_of
from petsc4py import PETSc

from modeharvest.fem.experiment import PathOptions
from modeharvest.fem.materials import Material, Ogden
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.path.bifurcation import Critical, follow_branch, locate_critical
from modeharvest.fem.path.continuation import PathFollower, State, hermite_weights
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.path.stability import lowest_modes
from modeharvest.fem.specimen import Specimen

SMALL = Specimen(2, 1)
# Poisson's ratio 0, so that clamping doesn't hold the ends' width: an ideal column.
NO_POISSON = Ogden(moduli=(1.2,), exponents=(2.0,), kappa=1e-9)


@cache
def small_structure() -> Structure:
    loading = EdgeCompression(SMALL.half_size[0], SMALL.length)
    return Structure(mesh_specimen(SMALL, 0.5), Ogden(), loading)


def compressed(structure: Structure, strain: float) -> Any:
    """A homogeneously compressed state: no equilibrium, but any state has an inertia."""
    length = SMALL.length
    u = vector_of(structure, lambda x: x * [-strain * length / (2 * SMALL.half_size[0]), 0.0])
    structure.prescribe(u, strain)
    return u


def dense(matrix: Any) -> FloatArray:
    converted = matrix.convert("dense", PETSc.Mat())  # named: its array doesn't keep it alive
    return np.array(converted.getDenseArray())


@pytest.mark.parametrize(
    ("strain", "unstable"), [(0.0, False), (0.05, False), (0.15, True), (0.4, True)]
)
def test_inertia_counts_the_negative_eigenvalues(strain: float, unstable: bool) -> None:
    structure = small_structure()
    u = compressed(structure, strain)
    factor = structure.factor(u)
    expected = int(np.sum(np.linalg.eigvalsh(dense(structure.tangent)) < 0))
    assert factor.negative_pivots == expected
    assert (expected > 0) == unstable


@pytest.mark.parametrize("strain", [0.0, 0.15, 0.4])
def test_modes_are_those_of_the_dense_problem(strain: float) -> None:
    structure = small_structure()
    factor = structure.factor(compressed(structure, strain))
    mass = structure.mass()
    modes = lowest_modes(factor, mass, 6)
    K, M = dense(structure.tangent), dense(mass)
    free = np.flatnonzero(M.diagonal())
    all_values = scipy.linalg.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)
    negative, positive = all_values[all_values < 0][-24:], all_values[all_values > 0]
    lowest = np.append(negative, positive[: max(6 - len(negative), 1)])
    assert (len(negative) > 0) == (strain > 0)
    np.testing.assert_allclose([mode.eigenvalue for mode in modes], lowest, rtol=1e-7)
    for mode in modes:
        x = mode.vector.array
        assert x @ M @ x == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_allclose(mode.weighted.array, M @ x, atol=1e-14)
        miss = np.linalg.norm(K @ x - mode.eigenvalue * (M @ x))
        assert miss < 1e-6 * np.linalg.norm(K @ x)
    overlaps = [[a.overlap(b.vector) for b in modes] for a in modes]
    np.testing.assert_allclose(overlaps, np.eye(len(modes)), atol=1e-6)
    assert modes[0].reversed().overlap(modes[0].vector) == pytest.approx(-1.0)


@dataclass(frozen=True, eq=False)
class Buckled:
    """A column followed to its critical point."""

    follower: PathFollower
    path: list[State]
    critical: Critical
    euler: float


@cache
def buckled_column(slenderness: float, material: Material = NO_POISSON) -> Buckled:
    """A clamped column of height 1 mm; Euler: e = 4 pi^2 I/(A L^2) = pi^2 h^2/(3 L^2)."""
    euler = np.pi**2 / (3 * slenderness**2)
    mesh = column(slenderness, 1.0, round(2 * slenderness), 2)
    structure = Structure(mesh, material, EdgeCompression(0.5 * slenderness, slenderness))
    follower = PathFollower(structure, PathOptions(0.4 * euler, 0.4 * euler))
    path = [follower.start()]
    assert follower.follow_primary(path, [1.5 * euler], until_unstable=True)
    critical = locate_critical(follower, path[-2], path[-1])
    assert critical is not None
    return Buckled(follower, path, critical, euler)


def test_slender_column_buckles_at_eulers_strain() -> None:
    """e/e_Euler = 1 + a (h/L)^2 + b (h/L)^4: finite strain and shear vanish with h/L."""
    slendernesses = np.array([8.0, 12.0, 16.0])
    columns = [buckled_column(s) for s in slendernesses]
    ratios = [c.critical.strain / c.euler for c in columns]
    limit = np.linalg.solve(np.vander(slendernesses**-2.0, increasing=True), ratios)[0]
    assert limit == pytest.approx(1.0, abs=1e-3)
    # Even by itself each one is near: e_Euler is 5 % to 1.3 %, and so are its corrections.
    np.testing.assert_allclose(ratios, 1.0, atol=0.1)


def test_inertia_proves_the_critical_strain() -> None:
    critical = buckled_column(12.0).critical
    assert (critical.below, critical.above) == (0, 1)
    strains, values = np.array(sorted(critical.eigenvalues)).T
    assert np.all(np.diff(values) < 0)
    assert abs(critical.modes[0].eigenvalue) < 1e-4 * abs(values[0] - values[-1])
    assert strains[0] < critical.strain < strains[-1]


def test_column_mode_is_the_clamped_cosine() -> None:
    c = buckled_column(16.0)
    structure = c.follower.structure
    mode = structure.nodal(c.critical.modes[0].vector)
    axis = np.abs(structure.mesh.nodes[:, 1]) < 1e-9
    x, v = structure.mesh.nodes[axis, 0], mode[axis, 1]
    v = v / v[np.argmin(np.abs(x))]
    expected = 0.5 * (1 + np.cos(2 * np.pi * x / 16.0))
    np.testing.assert_allclose(v, expected, atol=0.02)  # shear: of the order of e


def test_buckled_column_is_stable_lower_and_as_deep_as_the_elastica() -> None:
    """v = A/2 (1 + cos 2 pi x/L) takes up the shortening beyond: A = 2 L/pi sqrt(e - e_c)."""
    length = 16.0
    c = buckled_column(length)
    follower, structure = c.follower, c.follower.structure
    targets = [1.2 * c.euler, 1.8 * c.euler]  # the next mode comes at 2.05
    up = follow_branch(follower, c.critical, targets, 1, 1.0)
    down = follow_branch(follower, c.critical, targets, -1, 1.0)
    straight = [follower.start()]
    assert follower.follow_primary(straight, targets)
    middle = np.argmin(np.linalg.norm(structure.mesh.nodes, axis=1))
    for k, strain in enumerate(targets):
        on_path = next(s for s in straight if abs(s.strain - strain) < 1e-12)
        assert on_path.negative_pivots == 1
        for state in (up[k], down[k]):
            assert state.strain == pytest.approx(strain, abs=1e-14)
            assert state.negative_pivots == 0
            assert structure.energy(state.u) < structure.energy(on_path.u)
        assert structure.energy(up[k].u) == pytest.approx(structure.energy(down[k].u), rel=1e-9)
        depths = [structure.nodal(s.u)[middle, 1] for s in (up[k], down[k])]
        assert depths[0] == pytest.approx(-depths[1], rel=1e-6)
        elastica = 2 * length / np.pi * np.sqrt(strain - c.critical.strain)
        assert abs(depths[0]) == pytest.approx(elastica, rel=3 * strain)


def test_critical_strain_does_not_depend_on_the_steps() -> None:
    reference = buckled_column(8.0)
    follower = PathFollower(reference.follower.structure, PathOptions(0.7 * reference.euler, 1.0))
    path = [follower.start()]
    follower.follow_primary(path, [1.5 * reference.euler], until_unstable=True)
    critical = locate_critical(follower, path[-2], path[-1])
    assert critical is not None
    assert critical.strain == pytest.approx(reference.critical.strain, abs=2e-7)


def test_critical_strain_is_found_where_the_negative_mode_is_hidden() -> None:
    """At a state that is critical for another mode the eigensolver may lose the negative one."""
    reference = buckled_column(8.0)
    follower = PathFollower(reference.follower.structure, PathOptions(0.7 * reference.euler, 1.0))
    path = [follower.start()]
    follower.follow_primary(path, [1.5 * reference.euler], until_unstable=True)
    follower.modes = [mode for mode in follower.modes if mode.eigenvalue > 0]
    critical = locate_critical(follower, path[-2], path[-1])
    assert critical is not None
    assert critical.strain == pytest.approx(reference.critical.strain, abs=2e-7)
    assert (critical.below, critical.above) == (0, 1)


def test_tangent_is_the_derivative_of_the_path_and_predicts_with_order_four() -> None:
    structure = small_structure()
    follower = PathFollower(structure)
    centre, steps = 0.06, np.array([0.02, 0.01, 0.005])
    strains = sorted({centre + s * h for h in steps for s in (-1, 0, 1)})
    path = [follower.start()]
    assert follower.follow_primary(path, strains)
    at = {round(s.strain, 9): s for s in path}
    middle = at[centre]
    slopes, predictions = [], []
    for h in steps:
        low, high = at[round(centre - h, 9)], at[round(centre + h, 9)]
        slopes.append(((high.u - low.u) * (0.5 / h) - middle.tangent).norm())
        w = hermite_weights(low.strain, high.strain, centre)
        guess = low.u * w[0] + low.tangent * w[1] + high.u * w[2] + high.tangent * w[3]
        predictions.append((guess - middle.u).norm())
    np.testing.assert_allclose(np.log2(np.divide(slopes[:-1], slopes[1:])), 2.0, atol=0.2)
    np.testing.assert_allclose(np.log2(np.divide(predictions[:-1], predictions[1:])), 4.0, atol=0.3)


def test_hermite_weights_reproduce_cubics() -> None:
    value = np.polynomial.Polynomial([0.3, -1.2, 0.7, 2.0])
    slope = value.deriv()
    a, b = 0.4, 1.1
    for at in (0.4, 0.7, 1.1, 1.6):
        w = hermite_weights(a, b, at)
        got = w[0] * value(a) + w[1] * slope(a) + w[2] * value(b) + w[3] * slope(b)
        assert got == pytest.approx(value(at), rel=1e-12)
