"""Micromorphic homogenization: RVEs against Bloch waves and differences, bodies, paths."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, square
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.elements import rectangle_mesh
from modeharvest.fem.lattice.micromorphic.options import PlateLoading
from modeharvest.fem.lattice.micromorphic.path import Homogenized, homogenize
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves, rotation_pattern, snapped
from modeharvest.fem.lattice.micromorphic.rve import RVE, centred_cell
from modeharvest.fem.lattice.options import CriticalSearch, MacroLoading, uniaxial, uniaxial_strain
from modeharvest.fem.materials import Ogden
from modeharvest.fem.specimen import Specimen
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
PITCH, JUNCTION = 1.9, (0.95, 0.95)
PATTERN = rotation_pattern(PITCH)
HELD = PlateLoading(sides="periodic", pattern_at_plates="free")
LOOSE = PlateLoading(plates="sliding", pattern_at_plates="free")
CELL_LOADS = {HELD: uniaxial_strain(), LOOSE: uniaxial()}


@cache
def cell(size: float = 0.4) -> UnitCell:
    return square(PITCH, 1.5, size).enlarged(2, 2)


@cache
def rve(size: float = 0.4) -> RVE:
    return RVE(cell(size), Ogden(), [PATTERN], JUNCTION)


def lattice_body(
    element: RVE, loading: PlateLoading, holes: int = 2, parts: int = 1
) -> HomogenizedBody:
    specimen = Specimen(holes, 2, bulk_x=0.0, bulk_y=0.0)
    return HomogenizedBody.of_specimen(specimen, element, loading, divisions=(parts, 1))


@cache
def bloch_critical(loading: MacroLoading) -> float:
    path = CellPath(PeriodicCell(square(PITCH, 1.5, 0.4), Ogden()), loading)
    return float(first_critical(path, CriticalSearch(divisions=2)).state.load)


@cache
def homogeneous(loading: PlateLoading) -> Homogenized:
    return homogenize(lattice_body(rve(), loading), [0.04, 0.1])


def relaxed(
    element: RVE, q: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stresses, moduli and w in equilibrium."""
    for _ in range(20):
        at = element.condensed(q, w)
        if np.linalg.norm(at.forces) < 1e-13:
            return at.macro_forces / element.area, at.condensed / element.area, w
        w = w + at.relaxed
    raise AssertionError


@pytest.mark.parametrize("loading", [HELD, LOOSE])
def test_a_homogeneous_pattern_grows_from_the_load_that_bloch_waves_say(
    loading: PlateLoading,
) -> None:
    found = homogeneous(loading).critical
    assert found is not None
    assert found.kind == "pattern"
    assert (found.negative_before, found.negative_after) == (0, 1)
    assert found.load == pytest.approx(bloch_critical(CELL_LOADS[loading]), rel=1e-6)


@pytest.mark.parametrize("loading", [HELD, LOOSE])
def test_a_homogeneous_branch_is_that_of_the_periodic_cell(loading: PlateLoading) -> None:
    load = CELL_LOADS[loading]
    primitive = PeriodicCell(square(PITCH, 1.5, 0.4), Ogden())
    critical = first_critical(CellPath(primitive, load), CriticalSearch(divisions=2))
    modes = real_modes(primitive, critical.state, critical.waves)
    branch = follow(CellPath(PeriodicCell(cell(), Ogden()), load), modes, (1,), [0.1])
    state = homogeneous(loading).states[-1]
    assert state.branch == "buckled"
    assert state.stresses[0, 0] == pytest.approx(branch.states[0].stress[0, 0], rel=1e-9)
    assert state.energy == pytest.approx(4 * PITCH**2 * branch.states[0].energy, rel=1e-9)
    assert state.force == pytest.approx(-2 * PITCH * state.stresses[0, 0], rel=1e-9)
    # The mode's own amplitude: rms over the material, as is the normalisation of both.
    assert abs(state.amplitudes[0, 0]) == pytest.approx(
        abs(branch.states[0].amplitudes[0]), rel=0.02
    )


def test_moduli_and_stresses_are_derivatives() -> None:
    modes = [PATTERN, lambda X: np.sin(np.pi * X / PITCH)[:, ::-1]]
    element = RVE(cell(), Ogden(), modes, JUNCTION)
    random = np.random.default_rng(1)
    q = element.at_rest + 0.01 * random.standard_normal(10)
    stresses, moduli, w = relaxed(element, q, np.zeros(element.cell.reduction.size))
    np.testing.assert_allclose(moduli, moduli.T, atol=1e-10)
    step, slopes, rates = 1e-4, np.empty((10, 10)), np.empty(10)
    for k in range(10):
        # Fourth order, so that neither truncation nor rounding shows at 1e-8.
        found = [
            relaxed(element, q + h * np.eye(10)[k], w) for h in step * np.array([-2, -1, 1, 2])
        ]
        weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * step)
        slopes[:, k] = sum(a * s for a, (s, _, _) in zip(weights, found, strict=True))
        shifts = step * np.array([-2, -1, 1, 2])
        energies = [
            element.energy(q + h * np.eye(10)[k], ww)
            for h, (_, _, ww) in zip(shifts, found, strict=True)
        ]
        rates[k] = weights @ energies
    assert np.abs(slopes - moduli).max() < 1e-8 * np.abs(moduli).max()
    assert np.abs(rates - stresses).max() < 1e-8 * np.abs(stresses).max()


def test_fluctuations_have_nothing_of_the_modes() -> None:
    element = rve()
    q = element.at_rest + np.array([-0.05, 0.02, 0.01, 0.01, 0.1, 0.02, -0.01])
    w = relaxed(element, q, np.zeros(element.cell.reduction.size))[2]
    zero = element.displacement(element.at_rest, w).ravel()
    mass, X = element.cell.nodal_mass, element.cell.cell.mesh.nodes
    phi = element.shapes[0]
    size = math.sqrt(zero @ (mass @ zero))
    assert size > 1e-3
    for field in (phi, phi * X[:, :1], phi * X[:, 1:], np.ones_like(phi) * [1, 0]):
        assert abs(field.ravel() @ (mass @ zero)) < 1e-12 * size


def test_a_turned_rve_has_no_stress() -> None:
    element, angle = rve(), 0.3
    turn = [math.cos(angle), -math.sin(angle), math.sin(angle), math.cos(angle)]
    q = np.concatenate([turn, np.zeros(3)])
    assert np.abs(relaxed(element, q, np.zeros(element.cell.reduction.size))[0]).max() < 1e-12


def test_without_modes_it_is_first_order_homogenization() -> None:
    """The first RVE to become unstable does so where Bloch waves of its period say."""
    found = homogenize(lattice_body(RVE(cell(), Ogden(), [], JUNCTION), HELD), [0.06])
    assert found.critical is not None
    assert found.critical.kind == "RVE"
    assert found.critical.load == pytest.approx(bloch_critical(uniaxial_strain()), rel=1e-5)


def test_the_body_s_stiffness_is_the_derivative_of_its_forces() -> None:
    body = lattice_body(rve(), PlateLoading(sides="free"), holes=4, parts=2)
    random, n = np.random.default_rng(2), body.free_count
    value, load = body.start, 0.02
    value[:n] = 0.01 * random.standard_normal(n)
    for _ in range(6):  # RVEs into equilibrium, at given y
        value = value + LinearisedBody(body, load, value).moved(np.zeros(n), 0.0)
    at, along = LinearisedBody(body, load, value), random.standard_normal(n)
    step, residuals = 1e-4, []
    for h in step * np.array([-2, -1, 1, 2]):
        there = value + at.moved(h * along, 0.0, relax=False)
        for _ in range(4):
            there = there + LinearisedBody(body, load, there).moved(np.zeros(n), 0.0)
        residuals.append(LinearisedBody(body, load, there).residual)
    slope = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * step) @ np.array(residuals)
    expected = at.stiffness @ along
    assert np.abs(slope - expected).max() < 1e-8 * np.abs(expected).max()


def test_a_strip_between_plates_buckles_as_an_independent_calculation_found() -> None:
    """Six cells, sideways periodic: 5.948 %, by another code (T6, 0.2 mm, its own mesh)."""
    strip = lattice_body(rve(0.2), PlateLoading(sides="periodic"), holes=6, parts=3)
    found = homogenize(strip, [0.1])
    assert found.critical is not None
    assert found.critical.load == pytest.approx(0.05948, rel=5e-4)
    assert found.states[0].branch == "buckled"
    assert found.states[0].negative_eigenvalues == 0


def test_an_rve_cut_about_a_point_is_the_same_lattice() -> None:
    about, originals = centred_cell(cell(), np.array([0.3, -0.2]))
    assert about.area == pytest.approx(cell().area)
    offset = cell().mesh.nodes[originals] - about.mesh.nodes - [0.3, -0.2]
    turns = offset / (2 * PITCH)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
    reach = np.abs(about.mesh.nodes).max()
    assert reach < 1.2 * PITCH


def test_snapped_waves_repeat_on_the_cell() -> None:
    exact = PATTERN.moved((0.1, 0.2))
    points = np.random.default_rng(3).uniform(-1, 1, (20, 2))
    measured = PlaneWaves(1.01 * exact.vectors, exact.cosine, exact.sine)
    found = snapped(measured, 2 * PITCH * np.eye(2))
    np.testing.assert_allclose(found(points), exact(points), atol=1e-12)
    # With the phases of a lattice that has a hole's centre there.
    found = snapped(measured, 2 * PITCH * np.eye(2), inversion_centre=(0.0, 0.0))
    both = np.stack([found(points), found(-points)])
    assert np.abs(both[0] + both[1]).max() < 1e-12
    paper = PlaneWaves.of_sines([[0.5, -0.5, 1, 1, 0], [0.5, 0.5, 1, -1, 0]], PITCH)
    np.testing.assert_allclose(paper(points), PATTERN(points), atol=1e-12)
    with pytest.raises(InputError, match="larger cell"):
        snapped(PlaneWaves(0.7 * exact.vectors, exact.cosine, exact.sine), PITCH * np.eye(2))


def test_modes_that_will_not_do_are_refused() -> None:
    with pytest.raises(InputError, match="linearly independent"):
        RVE(cell(), Ogden(), [PATTERN, lambda X: -2.0 * PATTERN(X)], JUNCTION)
    with pytest.raises(InputError, match="cell's period"):
        RVE(cell(), Ogden(), [PlaneWaves(1.01 * PATTERN.vectors, PATTERN.cosine, PATTERN.sine)])
    with pytest.raises(InputError, match="a constant one"):
        RVE(cell(), Ogden(), [lambda X: np.ones_like(X)])
    with pytest.raises(InputError, match="other than 0"):
        RVE(cell(), Ogden(), [np.zeros_like(cell().mesh.nodes)])
    with pytest.raises(InputError, match="finite values"):
        RVE(cell(), Ogden(), [np.zeros((3, 2))])
    with pytest.raises(InputError, match="normalisation"):
        RVE(cell(), Ogden(), [PATTERN], normalisation="unit")


def test_bodies_and_loadings_that_will_not_do_are_refused() -> None:
    square_one = rectangle_mesh([0, 1], [0, 1])
    nodes, cells = square_one.nodes, square_one.cells
    on_tips = Mesh(nodes @ np.array([[1.0, 1.0], [-1.0, 1.0]]), cells, "Q8")
    inside_out = Mesh(nodes, cells[:, [0, 3, 2, 1, 7, 6, 5, 4]], "Q8")
    with pytest.raises(InputError, match="no rigid motion"):
        HomogenizedBody(on_tips, rve(), LOOSE)
    with pytest.raises(InputError, match="positive Jacobians"):
        HomogenizedBody(inside_out, rve(), LOOSE)
    with pytest.raises(InputError, match="as many modes"):
        HomogenizedBody(square_one, [rve(), RVE(cell(), Ogden())], LOOSE)
    two = rectangle_mesh([0, 1, 2], [0, 1])
    with pytest.raises(InputError, match="material of the bulk"):
        HomogenizedBody(two, rve(), LOOSE, is_lattice=np.array([True, False]))
    for bad in ({"sides": "held"}, {"compression": 0.0}, {"pattern_at_bulk": "one"}):
        with pytest.raises(InputError):
            PlateLoading(**bad)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="ascending"):
        homogenize(lattice_body(rve(), HELD), [0.1, 0.05])
