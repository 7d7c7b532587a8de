"""Regularisation with a material law: stresses by jets, the imbalance of a body."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from perforated import OBLIQUE, holed_cell
from plate_with_hole import GRID, HALF_SIZE, plate_pair

from modeharvest.fem.field import boundary_sides
from modeharvest.fem.materials import JetMatrix, Ogden, TwoTermI1, stress_and_tangent
from modeharvest.idic.finite_element.cutoff import Deviations, contradicted
from modeharvest.idic.finite_element.equations.system import Imbalance
from modeharvest.idic.finite_element.measure import FiniteElementOptions, Law, measure_displacement

MATERIALS = [Ogden(), Ogden((0.5, 0.3), (1.5, -2.0), 3.0), TwoTermI1()]
STATES = np.array([np.eye(2), [[0.7, 0.1], [-0.2, 1.1]], 1.2 * np.eye(2), [[1.3, 0.0], [0.4, 0.8]]])


@pytest.mark.parametrize("material", MATERIALS)
def test_stress_and_tangent_against_finite_differences(material: Any) -> None:
    P, A = stress_and_tangent(material, STATES)
    step = 1e-5
    for i in (0, 1):
        for j in (0, 1):
            change = np.zeros((2, 2))
            change[i, j] = step
            ahead, behind = STATES + change, STATES - change
            W = [material.energy(JetMatrix(F)).value for F in (ahead, behind)]
            np.testing.assert_allclose(P[:, i, j], (W[0] - W[1]) / (2 * step), atol=1e-8)
            stress = [stress_and_tangent(material, F)[0] for F in (ahead, behind)]
            np.testing.assert_allclose(
                A[..., i, j], (stress[0] - stress[1]) / (2 * step), rtol=1e-6, atol=1e-6
            )


@pytest.mark.parametrize("material", MATERIALS)
def test_the_undeformed_state_is_free_of_stress(material: Any) -> None:
    P, A = stress_and_tangent(material, np.eye(2)[None])
    np.testing.assert_allclose(P, 0.0, atol=1e-14)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(np.einsum("ijkl,kl->ij", A[0], turn), 0.0, atol=1e-13)


def test_forces_of_a_homogeneous_state_act_on_the_boundary_alone() -> None:
    mesh = holed_cell(OBLIQUE, 6)
    law = Imbalance(mesh, Ogden(), np.zeros(len(mesh.nodes), dtype=bool))
    u = mesh.nodes @ (STATES[1] - np.eye(2)).T
    f = law.forces(u.ravel())[0].reshape(-1, 2)
    edge = np.unique(boundary_sides(mesh))
    inner = np.setdiff1d(np.arange(len(f)), edge)
    # Three points integrate straight elements exactly; this mesh has curved ones at the hole.
    assert abs(f[inner]).max() < 2e-3 * abs(f[edge]).max()
    np.testing.assert_allclose(f.sum(axis=0), 0.0, atol=1e-12)


def test_derivatives_of_the_forces() -> None:
    mesh = holed_cell(OBLIQUE, 4)
    law = Imbalance(mesh, Ogden(), np.zeros(len(mesh.nodes), dtype=bool))
    random = np.random.default_rng(0)
    u = 0.01 * random.standard_normal(mesh.nodes.size)
    step = 1e-6 * random.standard_normal(u.size)
    K = law.forces(u)[1]
    change = 0.5 * (law.forces(u + step)[0] - law.forces(u - step)[0])
    np.testing.assert_allclose(K @ step, change, atol=1e-7 * abs(change).max())


def shear(points: np.ndarray) -> np.ndarray:
    """A field that no force balances: shear that varies along the plate."""
    x, y = np.moveaxis(points, -1, 0)
    return np.stack([0.02 * y * np.sin(4.0 * x), 0.03 * x * x], axis=-1)


def test_a_law_that_does_not_fit_is_noticed() -> None:
    pytest.importorskip("gmsh")
    pair = plate_pair(shear, 0.005)

    def nowhere(points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points), dtype=bool)

    options = FiniteElementOptions(30.0, 15.0, law=Law(Ogden(), nowhere))
    free = measure_displacement(pair, np.zeros_like, options=FiniteElementOptions(30.0, 15.0))
    assert free.warnings == ()
    forced = measure_displacement(
        pair, np.zeros_like,
        options=FiniteElementOptions(30.0, 15.0, law=options.law, cutoff_px=400.0),
    )  # fmt: skip
    assert any("law doesn't fit" in message for message in forced.warnings)
    assert forced.contradicted is not None
    assert forced.contradicted > 0.2
    assert forced.grid == GRID


def test_a_law_that_fits_is_not_blamed() -> None:
    """A homogeneous state is in equilibrium, with forces on all edges."""
    pytest.importorskip("gmsh")
    F = np.array([[0.97, 0.01], [0.02, 1.02]])
    pair = plate_pair(lambda points: points @ (F - np.eye(2)).T, 0.02)
    law = Law(Ogden(), lambda p: (abs(p) > HALF_SIZE - 0.02).any(axis=1) | (np.hypot(*p.T) < 0.4))
    found, free = (
        measure_displacement(
            pair, np.zeros_like, options=FiniteElementOptions(30.0, 15.0, law=given)
        )
        for given in (law, None)
    )
    assert found.warnings == ()
    assert found.contradicted is not None
    assert found.contradicted < 0.02
    assert free.contradicted is None
    assert pair.truth is not None
    mask = pair.masks[0]
    error = (found.displacement_on() - pair.truth.displacement)[mask]
    assert np.mean(abs(error) < 1.96 * found.standard_deviation_on()[mask]) > 0.9


def test_what_is_in_both_solutions_does_not_contradict() -> None:
    mesh = holed_cell(OBLIQUE, 4)
    n, random = len(mesh.nodes), np.random.default_rng(0)
    samples = random.standard_normal((n, 2, 16))
    none = np.zeros((n, 2))
    free = Deviations(samples, samples[..., :0], samples[..., :0], none + 0.1, np.zeros((n, 4, 4)))
    lawful = free._replace(samples=samples.copy(), bias=none)
    nodes = np.arange(n)
    assert contradicted(none + 0.29, free, lawful, nodes) == 0.0
    assert contradicted(none + 0.31, free, lawful, nodes) == 1.0
    # Independent noise hides as much.
    other = lawful._replace(samples=random.standard_normal((n, 2, 16)))
    assert contradicted(none + 0.31, free, other, nodes) == 0.0


def test_bias_by_a_linear_change() -> None:
    mesh = holed_cell(OBLIQUE, 4)
    n = len(mesh.nodes)
    noise, bias = np.full((n, 2, 4), 0.1), np.full((n, 2), 3.0)
    bare = Deviations(noise, noise[..., :0], noise[..., :0], bias, np.zeros((n, 4, 4)))
    slope = np.array([[0.1, 0.2], [0.0, -0.3]])
    found = bare.with_bias(mesh, 0.0 * mesh.nodes + [4.0, 0.0])
    np.testing.assert_allclose(found.bias, np.broadcast_to([5.0, 3.0], (n, 2)), rtol=1e-12)
    own = (found.roots**2).sum(axis=2)  # elements' own error isn't carried to other nodes
    np.testing.assert_allclose(own, np.broadcast_to([16.01, 0.01], (n, 2)), rtol=1e-12)
    lost = np.random.default_rng(0).standard_normal((n, 2, 4))  # by what smoothing takes away it is
    own = (found._replace(lost=lost).roots ** 2).sum(axis=2)
    np.testing.assert_allclose(own, np.broadcast_to([41.01, 9.01], (n, 2)), rtol=1e-12)
    found = bare.with_bias(mesh, mesh.nodes @ slope.T)
    expected = np.outer(slope.ravel(), slope.ravel())
    np.testing.assert_allclose(found.gradient, np.broadcast_to(expected, (n, 4, 4)), atol=1e-9)
