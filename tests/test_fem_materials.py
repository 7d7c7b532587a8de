"""Materials: stress and tangent against 60-digit differences, and what any energy must obey.

The reference evaluates W through the principal stretches, as the literature writes it, in 60
digits, where the square root's missing derivative at equal stretches does no harm.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import mpmath
import numpy as np
import pytest
import ufl
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI
from numpy.typing import NDArray

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import Material, Ogden, TwoTermI1, stress_and_tangent
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.util.errors import InputError

mpmath.mp.dps = 60

DEFAULT = Ogden()
SEVERAL_TERMS = Ogden(moduli=(0.7, -0.2, 0.31), exponents=(1.3, -2.0, 4.7), kappa=7.0)
I1 = TwoTermI1()
MATERIALS = [DEFAULT, SEVERAL_TERMS, I1]
EYE = np.eye(2)
# float64 keeps 16 digits; a handful is lost in the powers and the tangent's long sums.
RELATIVE = 2e-13

few = settings(max_examples=20, deadline=None, derandomize=True)
angles = st.floats(-np.pi, np.pi)
stretches = st.floats(0.6, 1.6)
materials = pytest.mark.parametrize("material", MATERIALS, ids=["ogden", "ogden3", "I1"])


def rotation(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@cache
def _evaluator(material: Any) -> Any:
    """W, P and tangent of a material as compiled by dolfinx, at a constant F."""
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    mesh = dolfinx.mesh.create_mesh(
        MPI.COMM_SELF, cells=np.array([[0, 1, 2]]), x=corners, e=element
    )
    constant = dolfinx.fem.Constant(mesh, EYE)
    F = ufl.variable(constant)
    energy = material.energy(F)
    stress = ufl.diff(energy, F)
    tangent = ufl.diff(stress, F)
    pairs = list(product(range(2), repeat=2))
    everything = ufl.as_vector(
        [energy, *(stress[ij] for ij in pairs), *(tangent[ij + kl] for ij in pairs for kl in pairs)]
    )
    return constant, dolfinx.fem.Expression(everything, np.array([[0.25, 0.25]])), mesh


def evaluate(
    material: Material, F: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """W, P (2, 2) and dP/dF (2, 2, 2, 2) by UFL's derivatives [MPa]."""
    constant, expression, mesh = _evaluator(material)
    constant.value[:] = F
    values = np.ravel(expression.eval(mesh, np.array([0], dtype=np.int32)))
    return float(values[0]), values[1:5].reshape(2, 2), values[5:].reshape(2, 2, 2, 2)


def exact_energy(material: Material, F: Any) -> Any:
    """W by the formula of the literature, in 60 digits; F is four mpmath numbers."""
    a, b, c, d = F
    J = a * d - b * c
    sum_of_squares = a * a + b * b + c * c + d * d
    if isinstance(material, TwoTermI1):
        i1 = sum_of_squares + 1
        excess = mpmath.mpf(i1) - 3
        log = 2 * mpmath.mpf(material.c1) * mpmath.log(J)
        volume = mpmath.mpf(material.bulk) / 2 * (J - 1) ** 2
        return material.c1 * excess + material.c2 * excess**2 - log + volume
    assert isinstance(material, Ogden)
    root = mpmath.sqrt((a - d) ** 2 + (b + c) ** 2), mpmath.sqrt((a + d) ** 2 + (b - c) ** 2)
    l1, l2 = (root[1] + root[0]) / 2, (root[1] - root[0]) / 2
    terms = (
        mpmath.mpf(modulus) / mpmath.mpf(m) ** 2 * (l1**m + l2**m - 2 - m * mpmath.log(J))
        for modulus, m in zip(material.moduli, map(mpmath.mpf, material.exponents), strict=True)
    )
    return mpmath.fsum(terms) + mpmath.mpf(material.kappa) / 2 * (J - 1) ** 2


def exact_derivatives(
    material: Material, F: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P and dP/dF by central differences with a step of 1e-12: exact to 1e-24."""
    h = mpmath.mpf(10) ** -12
    base = [mpmath.mpf(float(v)) for v in F.ravel()]

    def moved(*steps: tuple[int, int]) -> Any:
        point = list(base)
        for index, sign in steps:
            point[index] += sign * h
        return exact_energy(material, point)

    stress = np.array([float((moved((i, 1)) - moved((i, -1))) / (2 * h)) for i in range(4)])
    tangent = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            corners = [s * t * moved((i, s), (j, t)) for s in (1, -1) for t in (1, -1)]
            tangent[i, j] = float(mpmath.fsum(corners) / (4 * h * h))
    return stress.reshape(2, 2), tangent.reshape(2, 2, 2, 2)


def check(material: Material, F: NDArray[np.float64]) -> None:
    energy, stress, tangent = evaluate(material, F)
    expected_stress, expected_tangent = exact_derivatives(material, F)
    scale = float(np.max(np.abs(expected_tangent)))
    exact = float(exact_energy(material, [mpmath.mpf(float(v)) for v in F.ravel()]))
    # The terms of W cancel near F = I, so its error is measured by the stiffness too.
    assert abs(energy - exact) < RELATIVE * scale
    np.testing.assert_allclose(stress, expected_stress, rtol=0, atol=RELATIVE * scale)
    np.testing.assert_allclose(tangent, expected_tangent, rtol=0, atol=RELATIVE * scale)


@materials
@pytest.mark.parametrize("stretch", [1.0, 1.1, 0.8])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_stress_and_tangent_at_equal_stretches(
    material: Material, stretch: float, angle: float
) -> None:
    check(material, stretch * rotation(angle))


@materials
@pytest.mark.parametrize("apart", [1e-12, 1e-8, 1e-6, 1e-3, 0.1])
def test_stress_and_tangent_at_nearly_equal_stretches(material: Material, apart: float) -> None:
    check(material, 1.05 * rotation(0.4) @ np.diag([1.0 + apart, 1.0]) @ rotation(-1.1))


@pytest.mark.parametrize("material", [DEFAULT, SEVERAL_TERMS], ids=["ogden", "ogden3"])
@pytest.mark.parametrize("s", [0.0199, 0.02 - 1e-9, 0.02 + 1e-9, 0.0201])
def test_series_and_closed_form_meet(material: Material, s: float) -> None:
    """Both sides of the switch at s = sinh(eta)^2 = 0.02 with l1/l2 = exp(2 eta)."""
    eta = np.arcsinh(np.sqrt(s))
    check(material, rotation(0.3) @ np.diag([np.exp(eta), np.exp(-eta)]))


@pytest.mark.parametrize("exponent", [10.0, -10.0, 0.5, 2.0])
def test_series_is_long_enough_for_large_exponents(exponent: float) -> None:
    eta = np.arcsinh(np.sqrt(0.019999))
    check(Ogden((1.0,), (exponent,), 2.0), np.diag([np.exp(eta), np.exp(-eta)]))


@materials
@few
@given(l1=stretches, l2=stretches, left=angles, right=angles)
def test_stress_and_tangent_at_any_deformation(
    material: Material, l1: float, l2: float, left: float, right: float
) -> None:
    check(material, rotation(left) @ np.diag([l1, l2]) @ rotation(right))


@materials
@few
@given(l1=stretches, l2=stretches, left=angles, right=angles, turn=angles)
def test_objectivity_and_isotropy(
    material: Material, l1: float, l2: float, left: float, right: float, turn: float
) -> None:
    F, R = rotation(left) @ np.diag([l1, l2]) @ rotation(right), rotation(turn)
    energy, stress, _ = evaluate(material, F)
    turned, turned_stress, _ = evaluate(material, R @ F)
    same, same_stress, _ = evaluate(material, F @ R)
    scale = RELATIVE * np.max(np.abs(evaluate(material, F)[2]))
    np.testing.assert_allclose([turned, same], energy, rtol=0, atol=scale)
    np.testing.assert_allclose(turned_stress, R @ stress, rtol=0, atol=10 * scale)
    np.testing.assert_allclose(same_stress, stress @ R, rtol=0, atol=10 * scale)


@pytest.mark.parametrize(
    ("material", "shear", "lame"),
    [
        (DEFAULT, 0.6, 5.4),
        (SEVERAL_TERMS, 0.5 * (0.7 - 0.2 + 0.31), 7.0),
        # W'' of the I1 form at F = I: shear modulus 2 c1; c2 adds 8 c2 to lambda.
        (I1, 2 * 0.55, 55.0 + 8 * 0.3),
    ],
    ids=["ogden", "ogden3", "I1"],
)
def test_undeformed_state_is_stress_free_with_the_stated_moduli(
    material: Material, shear: float, lame: float
) -> None:
    energy, stress, tangent = evaluate(material, EYE)
    hooke = (
        lame * np.einsum("ij,kl->ijkl", EYE, EYE)
        + shear * np.einsum("ik,jl->ijkl", EYE, EYE)
        + shear * np.einsum("il,jk->ijkl", EYE, EYE)
    )
    assert energy == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(stress, 0.0, atol=1e-14)
    np.testing.assert_allclose(tangent, hooke, rtol=1e-13, atol=1e-13)


def test_recipe_of_the_documentation_works() -> None:
    page = (Path(__file__).parent.parent / "docs/explanation/fem.md").read_text("utf-8")
    recipe = page.partition("## Add a material")[2].partition("```python")[2].partition("```")[0]
    namespace: dict[str, Any] = {"__name__": "recipe"}
    exec(compile(recipe, "docs/explanation/fem.md", "exec", dont_inherit=True), namespace)
    material = namespace["NeoHooke"]()
    energy, stress, tangent = evaluate(material, EYE)
    assert energy == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(stress, 0.0, atol=1e-14)
    assert tangent[0, 1, 0, 1] == pytest.approx(material.mu)
    assert tangent[0, 0, 1, 1] == pytest.approx(material.lam)
    by_jets = stress_and_tangent(material, EYE[None])
    np.testing.assert_allclose(by_jets[1][0], tangent, atol=1e-14)
    solution = simulate(Experiment(Specimen(1, 1), material, strains=(0.05,), mesh_size=0.5))
    assert solution.info["outcome"] == "complete"
    assert solution.info["material"] == {"kind": "NeoHooke", "mu": 0.6, "lam": 5.4}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ogden((1.0,), (2.0, 3.0)), "as many moduli as exponents"),
        (lambda: Ogden((), ()), "as many moduli as exponents"),
        (lambda: Ogden((1.0,), (0.0,)), "nonzero exponents"),
        (lambda: Ogden((-1.0,), (2.0,)), "positive sum of moduli"),
        (lambda: Ogden(kappa=0.0), "positive kappa"),
        (lambda: TwoTermI1(c1=0.0), "c1 > 0"),
        (lambda: TwoTermI1(bulk=-1.0), "bulk > 0"),
    ],
)
def test_impossible_constants_are_refused(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()
