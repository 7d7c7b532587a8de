"""Equilibrium: patch test, rigid motion, consistent tangent, order of convergence, reaction."""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import pytest
import ufl
from fem_bodies import FloatArray, moved, plate, points_of, vector_of
from mpi4py import MPI
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem import dolfinx_api
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.meshing import REVERSED_T6, mesh_specimen
from modeharvest.fem.path.continuation import PathFollower, State, displacement_at
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.path.newton import STRAIN_TOLERANCE, correct
from modeharvest.fem.specimen import Specimen
from modeharvest.util.errors import InputError

WIDTH, HEIGHT = 3.0, 2.0
MATERIALS = [Ogden(), Ogden((0.7, 0.2), (1.3, -2.0), 4.0), TwoTermI1()]
materials = pytest.mark.parametrize("material", MATERIALS, ids=["ogden", "ogden2", "I1"])


def scattered(nodes: FloatArray) -> FloatArray:
    """Move interior nodes at random, mid-sides too: a distorted mesh with curved edges."""
    inside = np.all(np.abs(nodes) < np.array([0.5 * WIDTH, 0.5 * HEIGHT]) - 1e-9, axis=1)
    shift = np.random.default_rng(5).uniform(-0.04, 0.04, nodes.shape)
    return np.asarray(nodes + inside[:, None] * shift)


def straightened(mesh: Mesh) -> Mesh:
    nodes = mesh.nodes.copy()
    for k in range(3):
        a, b = mesh.cells[:, k], mesh.cells[:, (k + 1) % 3]
        nodes[mesh.cells[:, 3 + k]] = 0.5 * (nodes[a] + nodes[b])
    return Mesh(nodes, mesh.cells, "T6")


CURVED = moved(plate(WIDTH, HEIGHT, 5, 4), scattered)
PATCHES = pytest.mark.parametrize(
    "mesh", [straightened(CURVED), CURVED], ids=["straight", "curved"]
)


def structure_of(mesh: Mesh, material: Material, edges: str = "clamped") -> Structure:
    return Structure(mesh, material, EdgeCompression(0.5 * WIDTH, WIDTH, edges))


def equilibrium(structure: Structure, strain: float) -> State:
    """The state on the primary path at a strain."""
    follower = PathFollower(structure)
    path = [follower.start()]
    assert follower.follow_primary(path, [strain])
    return path[-1]


# Patch test. With T6 the virtual work of a constant stress is a quadratic on the reference
# triangle even where the edges are curved (the cofactors of a plane Jacobian are linear), and
# the three-point rule integrates quadratics exactly. So it holds exactly for curved elements
# too, which would not be so in three dimensions.


@PATCHES
@materials
def test_affine_displacement_leaves_inner_nodes_in_equilibrium(
    mesh: Mesh, material: Material
) -> None:
    structure = structure_of(mesh, material)
    F = np.array([[0.85, 0.1], [-0.07, 1.2]])
    u = vector_of(structure, lambda x: x @ (F - np.eye(2)).T)
    points = points_of(structure)
    inside = np.all(np.abs(points) < [0.5 * WIDTH - 1e-9, 0.5 * HEIGHT - 1e-9], axis=1)
    forces = structure.residual(u).array.reshape(-1, 2)
    scale = np.max(np.abs(forces))
    assert np.count_nonzero(inside) > 20
    assert scale > 0.01  # the free edges do carry forces
    np.testing.assert_allclose(forces[inside], 0.0, atol=1e-13 * scale + 1e-14)


@PATCHES
def test_uniaxial_compression_is_found_exactly(mesh: Mesh) -> None:
    """Frictionless edges: a homogeneous state with l1 = 1 - e and no lateral stress."""
    modulus, m, kappa, strain = 1.2, 3.0, 5.4, 0.15
    l1 = 1.0 - strain

    def slope(l: float, other: float) -> float:  # noqa: E741
        """dW/dl of the Ogden form with one term."""
        return modulus / m * (l ** (m - 1) - 1 / l) + kappa * (l * other - 1) * other

    l2 = brentq(slope, 1.0, 1.5, args=(l1,), xtol=1e-15)
    energy = modulus / m**2 * (l1**m + l2**m - 2 - m * np.log(l1 * l2))
    energy += 0.5 * kappa * (l1 * l2 - 1) ** 2

    structure = structure_of(mesh, Ogden((modulus,), (m,), kappa), "sliding")
    found = equilibrium(structure, strain)
    expected = mesh.nodes * [l1 - 1, l2 - 1]  # the anchored node is at y = 0
    np.testing.assert_allclose(structure.nodal(found.u), expected, rtol=0, atol=1e-10)
    assert structure.energy(found.u) == pytest.approx(energy * WIDTH * HEIGHT, rel=1e-10)
    assert structure.reaction(found.u, WIDTH) == pytest.approx(-slope(l1, l2) * HEIGHT, rel=1e-8)
    assert structure.smallest_jacobian(found.u) == pytest.approx(l1 * l2, rel=1e-9)


@PATCHES
@materials
@pytest.mark.parametrize("angle", [0.3, np.pi / 2, 3.0])
def test_rigid_motion_stores_no_energy_and_makes_no_forces(
    mesh: Mesh, material: Material, angle: float
) -> None:
    structure = structure_of(mesh, material)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    u = vector_of(structure, lambda x: x @ (turn - np.eye(2)).T + [0.3, -0.2])
    assert structure.energy(u) == pytest.approx(0.0, abs=1e-13)
    np.testing.assert_allclose(structure.residual(u).array, 0.0, atol=1e-12)


@materials
def test_forces_and_stiffness_are_derivatives_of_the_energy(material: Material) -> None:
    structure = structure_of(CURVED, material)
    rng = np.random.default_rng(1)
    u = vector_of(structure, lambda x: 0.1 * np.sin(x + x[:, ::-1]))
    step, other = structure.zero(), structure.zero()
    for vector in (step, other):
        vector.array[:] = rng.normal(size=len(vector.array))
        structure.prescribe(vector, 0.0)

    def at(t: float) -> Any:
        v = u.copy()
        v.axpy(t, step)
        return v

    h = 1e-5  # h^2/6 of a relative third derivative of order 10^2: 1e-9 and more exact
    slope = (structure.energy(at(h)) - structure.energy(at(-h))) / (2 * h)
    assert structure.residual(u).dot(step) == pytest.approx(slope, rel=1e-7)
    difference = (structure.residual(at(h)) - structure.residual(at(-h))) * (0.5 / h)
    product = structure.stiffness(u) * step
    assert (product - difference).norm() < 1e-7 * product.norm()
    K = structure.stiffness(u)
    assert step.dot(K * other) == pytest.approx(other.dot(K * step), rel=1e-12)
    # The load direction is the derivative with respect to the strain.
    fixed = structure.zero()
    structure.prescribe(fixed, 1.0)
    ahead, behind = u.copy(), u.copy()
    ahead.axpy(h, fixed)
    behind.axpy(-h, fixed)
    difference = (structure.residual(ahead) - structure.residual(behind)) * (0.5 / h)
    assert (structure.load(u) - difference).norm() < 1e-7 * difference.norm()


def wavy(x: Any, sin: Any, cos: Any) -> tuple[Any, Any]:
    """A smooth displacement that vanishes on the loaded edges [mm].

    Twice as large, and its compressed free edges would wrinkle: no rate could be told.
    """
    fade = cos(np.pi * x[0] / WIDTH)
    return 0.03 * fade * sin(1.1 * x[1] + x[0]), 0.04 * fade * cos(1.3 * x[1] - 0.5 * x[0])


def manufactured_errors(divisions: int) -> tuple[float, float]:
    """L2 [mm^2] and H1 [mm] errors against ``wavy``, on smoothly curved elements.

    The body forces and tractions that ``wavy`` needs enter by their virtual work, which is
    that of its stresses.
    """

    def bent(x: FloatArray) -> FloatArray:
        fade = np.cos(np.pi * x[:, 0] / WIDTH)
        return x + 0.08 * fade[:, None] * np.sin(2.0 * x[:, ::-1])

    mesh = moved(plate(WIDTH, HEIGHT, 3 * divisions, 2 * divisions), bent)
    material = Ogden()
    structure = structure_of(mesh, material)
    V = structure.V
    exact = ufl.as_vector(wavy(ufl.SpatialCoordinate(V.mesh), ufl.sin, ufl.cos))
    F = ufl.variable(ufl.Identity(2) + ufl.grad(exact))
    work = ufl.inner(ufl.diff(material.energy(F), F), ufl.grad(ufl.TestFunction(V)))
    forces = structure.zero()
    measure = ufl.dx(metadata={"quadrature_degree": 8})
    dolfinx_api.assemble_vector(dolfinx.fem.form(work * measure), forces)
    structure.prescribe(forces, 0.0)

    u = vector_of(structure, lambda x: np.stack(wavy(x.T, np.sin, np.cos), axis=1))
    structure.prescribe(u, 0.0)
    for _ in range(6):  # Newton, from the interpolant
        u.axpy(1.0, structure.factor(u).solve(forces - structure.residual(u)))
    assert (forces - structure.residual(u)).norm() < 1e-12
    assert structure.factor(u).negative_pivots == 0

    found = dolfinx.fem.Function(V)
    found.x.array[:] = u.array
    error = found - exact

    def norm(square: Any) -> float:
        return float(dolfinx.fem.assemble_scalar(dolfinx.fem.form(square * measure))) ** 0.5

    return norm(ufl.inner(error, error)), norm(ufl.inner(ufl.grad(error), ufl.grad(error)))


def test_t6_converges_at_its_orders() -> None:
    divisions = np.array([4, 8, 16, 24])
    errors = np.array([manufactured_errors(n) for n in divisions])
    rates = [-np.polyfit(np.log(divisions), np.log(column), 1)[0] for column in errors.T]
    np.testing.assert_allclose(rates, [3.0, 2.0], atol=0.2)


def test_energy_of_a_specimen_converges_with_the_mesh() -> None:
    specimen = Specimen(1, 1)
    loading = EdgeCompression(specimen.half_size[0], specimen.length)

    def energy(size: float) -> float:
        structure = Structure(mesh_specimen(specimen, size), Ogden(), loading)
        affine = vector_of(
            structure, lambda x: x * [-0.01 * loading.length / loading.half_width, 0]
        )
        found = correct(structure, affine, 0.02)
        assert found is not None
        return structure.energy(found.u)

    best = energy(0.05)
    errors = np.array([energy(size) / best - 1 for size in (0.4, 0.2, 0.1)])
    # The corners of the clamped edges are singular, so less than the order 4 of a smooth field;
    # from above, because a finer mesh can only be softer (but for the quadrature).
    assert np.all(errors[:-1] > 2.0 * errors[1:])
    assert 0.0 < errors[-1] < 1e-3


@pytest.mark.parametrize("edges", ["clamped", "sliding"])
def test_reaction_is_the_slope_of_the_energy(edges: str) -> None:
    specimen = Specimen(2, 2)
    mesh = mesh_specimen(specimen, 0.4)
    loading = EdgeCompression(specimen.half_size[0], specimen.length, edges)
    structure = Structure(mesh, Ogden(), loading)
    follower = PathFollower(structure)
    path = [follower.start()]
    h = 1e-4
    assert follower.follow_primary(path, [0.05 - h, 0.05, 0.05 + h])
    low, mid, high = path[-3:]
    slope = (structure.energy(high.u) - structure.energy(low.u)) / (2 * h)
    # h^2/6 E'''/E' with E ~ e^2 up to softening: below 1e-6.
    assert structure.reaction(mid.u, specimen.length) * specimen.length == pytest.approx(
        slope, rel=1e-5
    )
    rate = (high.u - low.u) * (0.5 / h)
    assert (rate - mid.tangent).norm() < 1e-5 * mid.tangent.norm()


def test_where_no_node_is_at_mid_height_sliding_edges_are_fixed_by_the_nearest() -> None:
    """An even number of staggered rows: the specimen and its mirror image behave alike.

    In both the upper one of the two nearest nodes is held; it is not the same one of the specimen.
    """
    specimen = Specimen(3, 4, bulk_x=0.9, bulk_y=0.3, stacking="triangular")
    mesh = mesh_specimen(specimen, 0.45)
    on_edge = mesh.nodes[mesh.nodes[:, 0] < 1e-9 - specimen.half_size[0], 1]
    assert np.abs(on_edge).min() > 0.05
    turned = Mesh(mesh.nodes * [1.0, -1.0], mesh.cells[:, REVERSED_T6], mesh.element)
    loading = EdgeCompression(specimen.half_size[0], specimen.length, "sliding")
    found = []
    for body in (mesh, turned):
        structure = Structure(body, Ogden(), loading)
        u = structure.nodal(equilibrium(structure, 0.02).u)
        left = np.abs(body.nodes[:, 0] + specimen.half_size[0]) < 1e-9
        fixed = left & (np.abs(u[:, 1]) < 1e-14)
        assert body.nodes[fixed, 1] == pytest.approx([np.abs(on_edge).min()])
        found.append(u)
    apart = found[0] - found[1] * [1.0, -1.0]
    np.testing.assert_allclose(apart - apart[0], 0.0, atol=1e-9)  # but for a translation
    assert abs(apart[0, 1]) > 1e-4


def test_nodal_values_come_in_the_order_of_the_mesh() -> None:
    structure = structure_of(CURVED, Ogden())
    u = vector_of(structure, lambda x: np.stack([x[:, 0] * x[:, 1], x[:, 1] - 2.0], axis=1))
    x, y = CURVED.nodes.T
    np.testing.assert_allclose(structure.nodal(u), np.stack([x * y, y - 2.0], axis=1), atol=1e-15)


def test_factor_solves_and_counts() -> None:
    structure = structure_of(CURVED, Ogden())
    u = structure.zero()
    factor = structure.factor(u)
    rhs = structure.load(u)
    assert (structure.stiffness(u) * factor.solve(rhs) - rhs).norm() < 1e-10 * rhs.norm()
    assert factor.negative_pivots == 0
    assert structure.factorisations == 1


def test_half_of_the_tangent_is_kept_and_none_of_it_lost() -> None:
    structure = structure_of(CURVED, Ogden())
    u = vector_of(structure, lambda x: 0.02 * np.stack([x[:, 1] ** 2, x[:, 0] * x[:, 1]], axis=1))
    upper = structure.stiffness(u)
    whole = dolfinx_api.assemble_matrix(structure._forms.stiffness, structure._bcs, 1.0)
    difference = upper.convert("dense", PETSc.Mat()) - whole.convert("dense", PETSc.Mat())
    assert np.abs(difference.getDenseArray()).max() < 1e-14 * whole.norm()
    assert upper.getType() == "seqsbaij"
    assert upper.getInfo()["mallocs"] == 0


def test_a_correction_from_nearby_needs_the_load_once(monkeypatch: pytest.MonkeyPatch) -> None:
    follower = PathFollower(structure_of(CURVED, Ogden()))
    start = follower.start()
    counted: list[Any] = []
    load = follower.structure.load
    monkeypatch.setattr(follower.structure, "load", lambda u: counted.append(u) or load(u))
    found = follower.equilibrium(1e-3, displacement_at([start], 1e-3))
    assert found is not None
    assert len(counted) == 1
    residual = follower.structure.residual(found.u).norm()
    assert residual <= STRAIN_TOLERANCE * load(found.u).norm()


def test_newton_says_when_it_fails() -> None:
    structure = structure_of(CURVED, TwoTermI1())
    assert correct(structure, structure.zero(), 0.9) is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EdgeCompression(1.0, 1.0, "glued"), "'clamped' or 'sliding', got 'glued'"),
        (lambda: Structure(CURVED, Ogden(), EdgeCompression(9.0, 1.0)), "nodes on the edges"),
        (
            lambda: Structure(
                Mesh(CURVED.nodes, CURVED.cells[:, :3], "T3"), Ogden(), EdgeCompression(1.5, 3.0)
            ),
            "expected a T6 mesh, got T3",
        ),
    ],
)
def test_bad_input_is_refused(make: Any, message: str) -> None:
    assert MPI.COMM_WORLD.size == 1
    with pytest.raises(InputError, match=message):
        make()
