"""Micromorphic homogenization: RVEs against Bloch waves and differences, bodies, paths."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gmsh
import meshio
import numpy as np
import pytest
from foreign_cells import hexagonal_one
from numpy.typing import NDArray

from modeharvest.fem.bloch.critical import LatticeCritical, critical_at, first_critical
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.experiment import Experiment, PathOptions
from modeharvest.fem.field import NODES_PER_CELL, Mesh
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.micromorphic.body import (
    PlateLoading,
    quadrature,
    read_body_mesh,
    rectangle_mesh,
    specimen_mesh,
)
from modeharvest.fem.lattice.micromorphic.branches import (
    Homogenized,
    follow_branch,
    homogenize,
    ranked_branches,
)
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.edges import edge_shifts
from modeharvest.fem.lattice.micromorphic.path import HomogenizedPath, HomogenizedState
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves, rotation_pattern, snapped
from modeharvest.fem.lattice.micromorphic.rve import RVE, centred_cell
from modeharvest.fem.lattice.options import CriticalSearch, MacroLoading, uniaxial, uniaxial_strain
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.fem.meshing import quiet_gmsh
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.util import machine
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
PITCH, JUNCTION = 1.9, (0.95, 0.95)
PATTERN = rotation_pattern(PITCH)
FIXED = PlateLoading(sides="periodic", pattern_at_plates="free")
LOOSE = PlateLoading(plates="sliding", pattern_at_plates="free")
CELL_LOADS = {FIXED: uniaxial_strain(), LOOSE: uniaxial()}


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
def first_of_bloch(loading: MacroLoading) -> tuple[PeriodicCell, LatticeCritical]:
    primitive = PeriodicCell(square(PITCH, 1.5, 0.4), Ogden())
    return primitive, first_critical(CellPath(primitive, loading), CriticalSearch(divisions=2))


def bloch_critical(loading: MacroLoading) -> float:
    return float(first_of_bloch(loading)[1].state.load)


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


@pytest.mark.parametrize("loading", [FIXED, LOOSE])
def test_a_homogeneous_pattern_grows_from_the_load_that_bloch_waves_say(
    loading: PlateLoading,
) -> None:
    found = homogeneous(loading).critical
    assert found is not None
    assert found.kind == "pattern"
    assert (found.negative_before, found.negative_after) == (0, 1)
    assert found.load == pytest.approx(bloch_critical(CELL_LOADS[loading]), rel=1e-6)


@pytest.mark.parametrize("loading", [FIXED, LOOSE])
def test_a_homogeneous_branch_is_that_of_the_periodic_cell(loading: PlateLoading) -> None:
    load = CELL_LOADS[loading]
    primitive, critical = first_of_bloch(load)
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
    found = homogenize(lattice_body(RVE(cell(), Ogden(), [], JUNCTION), FIXED), [0.06])
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


def test_three_degenerate_modes_make_a_flower() -> None:
    """As on the branches of the periodic cell (docs/explanation/modes.md), with their energies."""
    lattice, material = hexagonal(1.386, 1.28, 1.386 / 4), TwoTermI1()
    primitive = PeriodicCell(lattice, material)
    loading = MacroLoading(((-1.0, 0.0), (0.0, -1.0)))
    critical = first_critical(CellPath(primitive, loading), CriticalSearch(divisions=2))
    modes = real_modes(primitive, critical.state, critical.waves)
    assert len(modes.shapes) == 3
    four = UnitCell(modes.mesh, modes.lattice)
    element = RVE(four, material, list(modes.shapes), (0.0, 0.0))
    pressed = PlateLoading(sides="periodic", lateral=1.0, pattern_at_plates="free")
    body = HomogenizedBody(rectangle_mesh([0, 1], [0, 1]), element, pressed)
    path = HomogenizedPath(body, PathOptions(first_step=0.006, largest_step=0.006))
    path.follow_primary(0.02, "all")
    found = path.critical()
    assert found is not None
    assert (found.kind, len(found.modes), found.negative_after) == ("pattern", 3, 3)
    assert found.load == pytest.approx(modes.load, rel=1e-6)
    ranked = ranked_branches(path, found, 1.2 * found.load)
    waves = [sum(v != 0 for v in pattern) for pattern, _ in ranked]
    assert waves == 4 * [3] + 6 * [2] + 3 * [1]
    cell_path = CellPath(PeriodicCell(four, material), loading)
    for at, combination, negative in ((0, (1, 1, 1), 0), (4, (0, 1, 1), 1), (12, (0, 0, 1), 2)):
        branch = follow(cell_path, modes, combination, [1.2 * found.load])
        assert ranked[at][1].energy == pytest.approx(branch.states[0].energy, rel=1e-8)
        assert ranked[at][1].negative_eigenvalues == negative


def test_modes_that_a_mesh_splits_are_each_followed() -> None:
    """gmsh's mesh of a rhombus has none of the hexagonal lattice's turns: M points 1 % apart."""
    lattice, material = hexagonal_one(0.18), TwoTermI1()
    primitive = PeriodicCell(lattice, material)
    loading, waves = MacroLoading(((-1.0, 0.0), (0.0, -1.0))), [(np.pi, 0.0), (0.0, np.pi)]
    points = [critical_at(CellPath(primitive, loading), wave) for wave in waves]
    loads = [point.load for point in points]
    assert 1e-4 < abs(loads[0] / loads[1] - 1.0) < 0.02
    first = min(points, key=lambda point: point.load)
    modes = real_modes(primitive, first.state, waves)
    element = RVE(UnitCell(modes.mesh, modes.lattice), material, list(modes.shapes), (0.0, 0.0))
    pressed = PlateLoading(sides="periodic", lateral=1.0, pattern_at_plates="free")
    body = HomogenizedBody(rectangle_mesh([0, 1], [0, 1]), element, pressed)
    found = homogenize(body, [1.2 * first.load], PathOptions(first_step=0.005, largest_step=0.005))
    assert found.critical is not None
    assert found.critical.load == pytest.approx(first.load, rel=1e-6)
    assert (len(found.critical.modes), found.critical.negative_after) == (2, 1)
    patterns = [pattern for pattern, _ in found.ranked]
    assert {(1.0, 0.0), (0.0, 1.0)} <= set(patterns)  # what isn't on its own branch is left out
    for pattern, state in found.ranked:
        v = np.linalg.norm(state.amplitudes, axis=0)
        assert (v > 0.1 * v.max()).tolist() == [x != 0 for x in pattern]


def test_more_points_than_there_is_memory_for_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before their arrays are made: a case may divide a specimen into a million elements."""
    monkeypatch.setattr(machine, "available_bytes", lambda: 5e6)
    with pytest.raises(InputError, match=r"a homogenized body of 1.44e\+03 points to fit"):
        HomogenizedBody(rectangle_mesh(range(20), range(20)), rve(), FIXED)


def test_of_two_critical_modes_no_branch_is_followed_twice() -> None:
    """Under uniaxial strain along x two of the three are critical: each, their sum, difference."""
    lattice, material = hexagonal(1.9, 1.7, 0.5), Ogden()
    modes = rve_modes(lattice, material)
    element = RVE(lattice.enlarged(2, 2), material, modes, (0.0, 0.0))
    body = HomogenizedBody(rectangle_mesh([0, 1], [0, 1]), element, FIXED)
    found = homogenize(body, [0.04], PathOptions(first_step=0.01, largest_step=0.01))
    assert found.critical is not None
    assert (len(found.critical.modes), found.critical.negative_after) == (2, 2)
    assert [pattern for pattern, _ in found.ranked] == [(1, 0, 1), (1, 0, -1), (0, 0, 1), (1, 0, 0)]
    assert found.states[0].energy == pytest.approx(found.ranked[0][1].energy, rel=1e-9)


def rve_modes(lattice: UnitCell, material: Ogden) -> list[FloatArray]:
    """At all three M points, of the lattice's first critical state under uniaxial strain."""
    cell = PeriodicCell(lattice, material)
    state = critical_at(CellPath(cell, uniaxial_strain()), (np.pi, np.pi)).state
    return list(real_modes(cell, state, [(np.pi, 0.0), (0.0, np.pi), (np.pi, np.pi)]).shapes)


@pytest.mark.parametrize(
    ("loading", "free_ends", "free_sides"),
    [
        (PlateLoading(), False, False),
        (PlateLoading(pattern_at_plates="free"), True, False),
        (PlateLoading(pattern_at_bulk="free"), False, True),
    ],
)
def test_v_is_fixed_before_the_plates_and_along_other_solids_apart(
    loading: PlateLoading, free_ends: bool, free_sides: bool
) -> None:
    """The lattice meets no plate itself: solid strips are between."""
    body = HomogenizedBody.of_specimen(Specimen(4, 4), rve(), loading, divisions=(2, 2))
    moves = np.abs(body.T).sum(axis=1).reshape(-1, 3)[:, 2] > 0
    half, at = 2 * PITCH, np.abs(body.mesh.nodes)
    is_lattice, near = (at < half + 1e-9).all(axis=1), np.abs(at - half) < 1e-9
    inside = is_lattice & ~near.any(axis=1)
    ends, sides = (is_lattice & near[:, k] & ~near[:, 1 - k] for k in (0, 1))
    assert inside.any()
    assert moves[inside].all()
    assert set(moves[ends]) == {free_ends}
    assert set(moves[sides]) == {free_sides}
    assert not moves[~is_lattice].any()


def test_a_quarter_is_as_the_whole_on_the_primary_path() -> None:
    quarter, whole = (
        homogenize(
            HomogenizedBody.of_specimen(
                Specimen(4, 4), rve(), PlateLoading(quarter=is_quarter), divisions=(2, 2)
            ),
            [0.05],
        ).states[0]
        for is_quarter in (True, False)
    )
    assert quarter.energy == pytest.approx(whole.energy, rel=1e-10)
    assert quarter.force == pytest.approx(whole.force, rel=1e-10)
    assert np.isnan(whole.amplitudes).any()  # in the bulk


class Recorded(HomogenizedPath):
    """A path that keeps the states of its branches as they are met."""

    def __init__(self, body: HomogenizedBody, options: PathOptions) -> None:
        self.met: list[HomogenizedState] = []
        super().__init__(body, options)

    def equilibrium(self, *args: Any, **kwargs: Any) -> HomogenizedState | None:
        found = super().equilibrium(*args, **kwargs)
        if found is not None and found.branch == "buckled":
            self.met.append(found)
        return found


def test_a_branch_is_followed_where_its_load_turns() -> None:
    """Before long elastic blocks: the lattice softens faster than they unload, and stiffens later.

    So the load has a maximum and then a minimum, with unstable states between them.
    """
    a, b, block = 3 * PITCH, PITCH, 500.0
    mesh = rectangle_mesh([0, a, a + block], [0, b])
    is_lattice = mesh.nodes[mesh.cells[:, :4]].mean(axis=1)[:, 0] < a
    loading = PlateLoading(
        plates="sliding", pattern_at_plates="free", pattern_at_bulk="free", quarter=True
    )
    body = HomogenizedBody(mesh, rve(), loading, None, is_lattice)
    path = Recorded(body, PathOptions(first_amplitude=0.03, growth=1.2))
    path.follow_primary(0.05, "all")
    critical = path.critical()
    assert critical is not None
    (last,), _ = follow_branch(path, critical, [0.028])
    met = [state for state in path.met if state.load < last.load] + [last]
    loads, forces, energies, unstable = np.array(
        [(s.load, s.force, s.energy, s.negative_eigenvalues) for s in met]
    ).T
    top, bottom = int(np.argmax(loads[:10])), int(np.argmin(loads))
    assert critical.load < loads[top] < last.load == pytest.approx(0.028)
    assert loads[bottom] < 0.985 * critical.load
    folds = [np.diff(part) for part in (loads[: top + 1], loads[top : bottom + 1], loads[bottom:])]
    assert [np.sign(part).tolist() for part in folds] == [
        len(part) * [sign] for part, sign in zip(folds, (1, -1, 1), strict=True)
    ]
    assert set(unstable[top + 2 : bottom - 1]) == {1}
    assert set(unstable[: top - 1]) == set(unstable[bottom + 2 :]) == {0}
    # What the plates do is what is stored, around both turns.
    work = 0.5 * (forces[1:] + forces[:-1]) * np.diff(loads) * body.length
    there_and_back = float(np.abs(work).sum())
    assert work.sum() == pytest.approx(energies[-1] - energies[0], abs=0.01 * there_and_back)


def test_a_critical_point_of_u_alone_does_not_hide_the_pattern_s() -> None:
    """A long strip between sliding plates bows before its pattern grows."""
    loading = PlateLoading(plates="sliding")
    specimen = Specimen(16, 2, bulk_x=0.0, bulk_y=0.0)
    body = HomogenizedBody.of_specimen(specimen, rve(), loading, divisions=(6, 1))
    found = homogenize(body, [0.09])
    assert [c.kind for c in found.criticals] == ["displacement", "pattern"]
    assert found.criticals[0].load < found.criticals[1].load
    assert found.critical is found.criticals[1]
    assert found.states[0].branch == "buckled"
    assert found.states[0].negative_eigenvalues > 0  # bowing is not followed


def test_an_unstable_rve_does_not_hide_that_the_pattern_grows_before() -> None:
    """One long step, at whose end RVEs are unstable, too."""
    thin = RVE(
        square(1.9, 1.65, 0.5).enlarged(2, 2), Ogden(), [rotation_pattern(1.9)], (0.95, 0.95)
    )
    body = HomogenizedBody.of_specimen(
        Specimen(3, 4, diameter=1.65), thin, PlateLoading(quarter=True)
    )
    path = HomogenizedPath(body)
    assert path.follow_primary(0.1, "all")
    assert path.states[-1].rve_negative > 0
    found = path.critical()
    assert found is not None
    assert (found.kind, found.negative_before, found.negative_after) == ("pattern", 0, 1)


def test_a_critical_mode_that_is_not_of_v_alone_is_located_too() -> None:
    """With what w does under shear as a second mode u takes part; one long step to behind it."""
    about, one = RVE(cell(0.5), Ogden(), [PATTERN], JUNCTION), (-JUNCTION[0], -JUNCTION[1])
    at = about.condensed(about.at_rest, np.zeros(about.cell.reduction.size))
    sheared = about.cell.reduction.displacement(at.response[:, 1] + at.response[:, 2])
    both = RVE(about.cell.cell, Ogden(), [PATTERN.moved(one), sheared])
    body = HomogenizedBody.of_specimen(Specimen(4, 6), both, PlateLoading(), divisions=(2, 3))
    path = HomogenizedPath(body, PathOptions(first_step=0.035))
    assert path.follow_primary(0.128, "all")
    found = path.critical()
    assert found is not None
    assert (found.kind, found.negative_before, found.negative_after) == ("pattern", 0, 1)


def test_a_plate_s_force_is_the_derivative_of_the_energy() -> None:
    """In bending, shear and compression, on the buckled branch too."""
    for loading in (PlateLoading(), PlateLoading(0, 1), PlateLoading(0.5, 0, 1, plates="sliding")):
        body = lattice_body(rve(), loading, holes=4, parts=2)
        path, step = HomogenizedPath(body), 1e-4
        loads = [0.03 - step, 0.03 + step, 0.03]
        assert path.follow_primary(0.03)
        below, above, at = (path.equilibrium(e, path.states[-1].value) for e in loads)
        assert below is not None
        assert above is not None
        assert at is not None
        slope = (above.energy - below.energy) / (2 * step)
        assert at.force * body.length == pytest.approx(slope, rel=1e-6)
        assert at.negative_eigenvalues == 0


@pytest.mark.parametrize(
    ("loading", "gradient"),
    [
        (PlateLoading(sides="clamped", pattern_at_plates="free"), ((-1, 0), (0, 0))),
        (PlateLoading(sides="guided", lateral=1.0, pattern_at_plates="free"), ((-1, 0), (0, -1))),
        (PlateLoading(1, 0.5, sides="periodic", pattern_at_plates="free"), ((-1, 0), (0.5, 0))),
        (
            PlateLoading(1, -0.5, lateral=0.3, sides="clamped", pattern_at_plates="free"),
            ((-1, 0), (-0.5, -0.3)),
        ),
    ],
)
def test_plates_and_sides_make_the_strain_that_they_say(
    loading: PlateLoading, gradient: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    """A homogeneous strain, under which the lattice buckles where Bloch waves say."""
    body = lattice_body(rve(), loading, holes=4)
    path = HomogenizedPath(body)
    assert path.follow_primary(0.02)
    F = path.states[-1].strains[:, :4]
    expected = np.eye(2).ravel() + 0.02 * np.ravel(gradient)
    np.testing.assert_allclose(F, np.tile(expected, (4, 1)), atol=1e-12)
    lattice = CellPath(PeriodicCell(square(PITCH, 1.5, 0.4), Ogden()), MacroLoading(gradient))
    exact = critical_at(lattice, (np.pi, np.pi)).load
    found = homogenize(body, [1.1 * exact])
    assert found.critical is not None
    assert found.critical.load == pytest.approx(exact, rel=1e-6)


def test_a_bent_beam_has_the_stiffness_of_the_rve_s_moduli() -> None:
    """Energy E b e^2 L / 3 of a beam of height 2 b, e in its outermost fibre."""
    load, element = 1e-3, rve()
    bent = PlateLoading(0, 0, 1, plates="sliding")
    body = lattice_body(element, bent, holes=6, parts=2)
    path = HomogenizedPath(body)
    assert path.follow_primary(load)
    D = relaxed(element, element.at_rest, np.zeros(element.cell.reduction.size))[1]
    modulus = D[0, 0] - D[0, 3] ** 2 / D[3, 3]
    energy = modulus * PITCH * load**2 * body.length / 3
    assert path.states[-1].energy == pytest.approx(energy, rel=1e-5)
    assert path.states[-1].force * body.length == pytest.approx(2 * energy / load, rel=1e-5)


def test_positions_of_the_rve_are_averaged() -> None:
    """A pitch further the mode has the other sign; the mean is about neither."""
    there = RVE(cell(), Ogden(), [PATTERN], (0.95 + PITCH, 0.95))
    specimen = Specimen(2, 2, bulk_x=0.0, bulk_y=0.0)
    both = HomogenizedBody.of_specimen(specimen, [rve(), there], FIXED, divisions=(1, 1))
    found = homogenize(both, [0.06])
    assert found.critical is not None
    assert found.critical.load == pytest.approx(bloch_critical(uniaxial_strain()), rel=1e-6)
    state = found.states[0]
    u, moved = (both.microstructure(state.value, state.strains, k) for k in (0, 1))
    v = state.strains[0, 4]
    assert abs(v) > 0.05
    for element, displacement in ((rve(), u), (there, moved)):
        X = element.cell.cell.mesh.nodes
        fluctuation = displacement - X @ (state.strains[0, :4].reshape(2, 2) - np.eye(2)).T
        mass, phi = element.cell.nodal_mass, element.shapes[0].ravel()
        mean = phi @ (mass @ fluctuation.ravel()) / (0.5 * mass.sum())
        assert mean == pytest.approx(v, rel=1e-9)


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


@pytest.mark.parametrize("stacking", ["square", "triangular"])
def test_as_much_of_a_specimen_is_lattice_as_its_holes_cells_fill(stacking: str) -> None:
    specimen = Specimen(8, 5, stacking=stacking)
    mesh, is_lattice = specimen_mesh(specimen)
    areas = quadrature(mesh, 2).weights.sum(axis=1)
    cells = len(specimen.hole_centres) * abs(np.linalg.det(specimen.vectors))
    assert areas[is_lattice].sum() == pytest.approx(cells)
    assert areas.sum() == pytest.approx(4 * np.prod(specimen.half_size))
    # Without edges there is nothing else.
    assert specimen_mesh(Specimen(8, 5, bulk_x=0, bulk_y=0, stacking=stacking))[1].all()


def test_a_lattice_s_extent_may_make_up_for_its_edges() -> None:
    """Longer and higher by so much at each end, strips as wide as before, the load's length too."""
    specimen, shifts = Specimen(4, 6), np.array([0.03, -0.02])
    for quarter in (False, True):
        mesh, is_lattice = specimen_mesh(specimen, (2, 3), quarter, shifts)
        ends = mesh.nodes[np.unique(mesh.cells[is_lattice])].max(axis=0)
        assert ends == pytest.approx(specimen.cellular_half_size + shifts)
        assert mesh.nodes.max(axis=0) == pytest.approx(specimen.half_size + shifts)
    first_order = RVE(square(PITCH, 1.5, 0.4), Ogden())
    bodies = [
        HomogenizedBody.of_specimen(
            specimen, first_order, PlateLoading(quarter=True), edge_shifts=given
        )
        for given in ((0.0, 0.0), shifts)
    ]
    assert bodies[0].length == bodies[1].length == specimen.length
    before, after = (homogenize(body, [0.01]).states[0].energy for body in bodies)
    # A series and a sum of springs, nearly.
    a, b = specimen.cellular_half_size
    assert after / before == pytest.approx((1 - 0.03 / a) * (1 - 0.02 / b), abs=2e-3)


def test_edge_shifts_make_the_energy_of_a_direct_simulation() -> None:
    """Of a column of four cells between free sides with solid strips: at rest, exactly."""
    column = Specimen(1, 4, 1.5, PITCH, bulk_x=0.0, bulk_y=0.9)
    loading, first_order = PlateLoading(plates="sliding"), RVE(square(PITCH, 1.5, 0.4), Ogden())
    shifts = edge_shifts(column, Ogden(), 0.4, loading)
    test = Experiment(column, Ogden(), strains=(1e-4,), mesh_size=0.4, edges="sliding")
    direct = simulate(test).at(1e-4).energy
    off = []
    for given in ((0.0, 0.0), shifts):
        body = HomogenizedBody.of_specimen(column, first_order, loading, edge_shifts=given)
        off.append(homogenize(body, [1e-4]).states[0].energy / direct - 1.0)
    assert off[0] > 4e-3
    assert abs(off[1]) < 1e-5
    # Plates that slide along whole cells are mirrors of the lattice, which goes on beyond them.
    assert shifts[0] == pytest.approx(0.0, abs=1e-9)


def test_edge_shifts_are_lengths_of_the_cell() -> None:
    specimen = Specimen(6, 10, 1.5, PITCH, bulk_x=1.9, bulk_y=0.9)
    larger = Specimen(3, 4, 3.0, 2.0 * PITCH, bulk_x=3.8, bulk_y=1.8)
    clamped, stiffer = PlateLoading(), Ogden(moduli=(2.4,), kappa=10.8)
    found = edge_shifts(specimen, Ogden(), 0.5, clamped)
    assert edge_shifts(larger, Ogden(), 1.0, clamped) == pytest.approx(2 * np.array(found))
    assert edge_shifts(specimen, stiffer, 0.5, clamped) == pytest.approx(found)
    # Where holes are small nothing is to be made up for, and where sides aren't free nothing there.
    small = replace(specimen, diameter=0.2)
    assert np.abs(edge_shifts(small, Ogden(), 0.05, clamped)).max() < 1e-4 * PITCH
    assert edge_shifts(specimen, Ogden(), 0.5, PlateLoading(sides="periodic")) == (found[0], 0.0)
    assert edge_shifts(specimen, Ogden(), 0.5, PlateLoading(shear=1.0)) == (0.0, 0.0)
    assert edge_shifts(replace(specimen, stacking="triangular"), Ogden(), 0.5, clamped) == (0, 0)


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
    with pytest.raises(InputError, match="0% of them finite"):
        RVE(cell(), Ogden(), [lambda X: np.nan * X])
    with pytest.raises(InputError, match="normalisation"):
        RVE(cell(), Ogden(), [PATTERN], normalisation="unit")


ELEMENTS = {"T3": "triangle", "T6": "triangle6", "Q4": "quad", "Q8": "quad8", "Q9": "quad9"}


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_mesh_of_any_element_is_read_and_buckles_as_the_lattice_does(
    element: str, tmp_path: Path
) -> None:
    nodes = np.vstack([[9, 9], nine_nodes()[0]])  # one that no element has
    cells = [[1, 2, 3, 4, 5, 6, 7, 8, 9]]
    if element[0] == "T":
        cells = [[1, 2, 3, 5, 6, 9], [1, 3, 4, 9, 7, 8]]
    own = [cell[: NODES_PER_CELL[element]] for cell in cells]
    meshio.Mesh(np.pad(nodes, ((0, 0), (0, 1))), {ELEMENTS[element]: own}).write(tmp_path / "m.vtu")
    mesh, is_lattice, edges = read_body_mesh(tmp_path / "m.vtu")
    assert (mesh.element, is_lattice.all(), edges) == (element, True, {})
    assert quadrature(mesh, 2).weights.sum() == pytest.approx(12)
    found = homogenize(HomogenizedBody(mesh, rve(), FIXED), [0.06]).critical
    assert found is not None
    assert found.load == pytest.approx(bloch_critical(uniaxial_strain()), rel=1e-6)


def nine_nodes() -> tuple[FloatArray, list[list[int]]]:
    """One Q9 element."""
    sides = [[0, 0], [4, 0], [4, 3], [0, 3], [2, 0], [4, 1.5], [2, 3], [0, 1.5], [2, 1.5]]
    return np.array(sides, float), [list(range(9))]


def two_rectangles(path: Path, is_joined: bool = True) -> Path:
    """A lattice and a solid end, named; the plate on the right is the middle of its edge alone."""
    with quiet_gmsh():
        of = gmsh.model.occ
        parts = [of.addRectangle(x, 0, 0, 2, 2) for x in (0, 2)]
        if is_joined:
            of.fragment([(2, parts[0])], [(2, parts[1])])
        of.synchronize()
        right = [tag for dim, tag in gmsh.model.getEntitiesInBoundingBox(3.9, -1, -1, 4.1, 3, 1, 1)]
        for name, dim, tags in (
            ("bulk", 2, parts[1:]),
            ("holes", 2, parts[:1]),
            ("right", 1, right),
        ):
            gmsh.model.addPhysicalGroup(dim, tags, name=name)
        gmsh.option.setNumber("Mesh.MeshSizeMin", 1)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 1)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
        gmsh.write(str(path))
    return path


def test_named_groups_of_a_mesh_are_bulk_and_plates(tmp_path: Path) -> None:
    mesh, is_lattice, edges = read_body_mesh(two_rectangles(tmp_path / "two.msh"))
    middles = mesh.nodes[mesh.cells[:, :3]].mean(axis=1)[:, 0]
    np.testing.assert_array_equal(is_lattice, middles < 2)
    assert list(edges) == ["right"]
    np.testing.assert_allclose(mesh.nodes[edges["right"], 0], 4)
    some = edges["right"][mesh.nodes[edges["right"], 1] > 0.5]
    body = HomogenizedBody(
        mesh, rve(), PlateLoading(), is_lattice=is_lattice, edges={"right": some}
    )
    path = HomogenizedPath(body)
    assert path.follow_primary(0.01)
    u = path.states[-1].displacement
    np.testing.assert_allclose(u[some, 0], -0.5 * 0.01 * 4)
    free = np.setdiff1d(edges["right"], some)
    assert np.abs(u[free, 0] + 0.02).min() > 1e-4
    with pytest.raises(InputError, match="one piece of material, got 2; merge"):
        read_body_mesh(two_rectangles(tmp_path / "apart.msh", is_joined=False))


def test_bodies_and_loadings_that_will_not_do_are_refused() -> None:
    square_one = rectangle_mesh([0, 1], [0, 1])
    nodes, cells = square_one.nodes, square_one.cells
    on_tips = Mesh(nodes @ np.array([[1.0, 1.0], [-1.0, 1.0]]), cells, "Q8")
    inside_out = Mesh(nodes, cells[:, [0, 3, 2, 1, 7, 6, 5, 4]], "Q8")
    with pytest.raises(InputError, match="no rigid motion"):
        HomogenizedBody(on_tips, rve(), LOOSE)
    with pytest.raises(InputError, match="positive Jacobians"):
        HomogenizedBody(inside_out, rve(), LOOSE)
    ends = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]])
    corners = Mesh(ends, np.arange(4)[None], "Q4")
    with pytest.raises(InputError, match="nodes between the supports, got none"):
        HomogenizedBody(corners, rve(), PlateLoading())
    two_points = HomogenizedBody(Mesh(*nine_nodes(), "Q9"), rve(), FIXED, points=2)
    with pytest.raises(InputError, match=r"stable without load.* take more points"):
        HomogenizedPath(two_points)
    with pytest.raises(InputError, match="as many modes"):
        HomogenizedBody(square_one, [rve(), RVE(cell(), Ogden())], LOOSE)
    five: Any = SimpleNamespace(size=5, rank=0)
    with pytest.raises(InputError, match="at most 4 ranks, one an RVE, got 5"):
        HomogenizedBody(square_one, rve(), LOOSE, comm=five)
    for bad in (
        {"sides": "held"},
        {"compression": 0.0},
        {"pattern_at_bulk": "one"},
        {"bending": 1.0, "sides": "periodic"},
        {"lateral": 1.0},
    ):
        with pytest.raises(InputError):
            PlateLoading(**bad)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="ascending"):
        homogenize(lattice_body(rve(), FIXED), [0.1, 0.05])
