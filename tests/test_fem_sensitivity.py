"""Sensitivities of equilibria to material and supports: differences of whole simulations."""

from __future__ import annotations

import numpy as np
import pytest

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.fem.meshing import hole_motion, mesh_specimen
from modeharvest.fem.path.parameters import PARTS, parameter
from modeharvest.fem.path.parametric import ParametricTest
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.idic.finite_element.identification.identify import Readings, Unknown, identify
from modeharvest.idic.finite_element.identification.observed import (
    FieldData,
    at_fixed_points,
    displacement_at,
)
from modeharvest.util.errors import InputError

SMALL = Specimen(4, 4, diameter=1.6, bulk_x=0.9, bulk_y=0.4)
"""Buckles at 8.0 % with fine elements, and stays stable on its branch."""
MESH = mesh_specimen(SMALL, 0.6)
OGDEN = ("moduli[0]", "exponents[0]", "kappa", "travel", "tilt")
VALUES = np.array([1.2, 3.0, 5.4, 1.0, 0.0])
BEFORE, AFTER = 0.06, 0.12


FINER = mesh_specimen(SMALL, 0.4)
"""With coarser elements, a second mode is near, and it stays unstable up to 11 %."""


def made(
    strains: tuple[float, ...], names: tuple[str, ...], mesh: Mesh = MESH,
    with_critical: bool = False, **how: object,
) -> ParametricTest:  # fmt: skip
    experiment = Experiment(SMALL, strains=strains, mesh_size=0.6, **how)  # type: ignore[arg-type]
    test = ParametricTest(experiment, names, mesh)
    test.with_critical = with_critical
    return test


def require_derivatives(test: ParametricTest, values: np.ndarray) -> None:
    """Central differences of steps s have errors of order s^2, 1e-7 of the third derivative.

    Equilibria are solved to 1e-11 of strain, of which the smallest step makes some 1e-6 of a slope.
    """
    found = test.at(values)
    for k, value in enumerate(values):
        step = 3e-4 * max(abs(value), 0.1)
        moved = np.eye(len(values))[k] * step
        pairs = zip(test.at(values + moved, False), test.at(values - moved, False), strict=True)
        for state, (after, before) in zip(found, pairs, strict=True):
            for name in ("displacement", "force", "strain"):
                difference = (getattr(after, name) - getattr(before, name)) / (2.0 * step)
                scale = max(1e-3, float(np.abs(difference).max()))
                np.testing.assert_allclose(
                    getattr(state, f"{name}_by")[k], difference, rtol=0, atol=2e-5 * scale
                )


def test_a_parametric_test_is_the_simulation_with_these_parameters() -> None:
    """Whatever the material that it was made with."""
    direct = simulate(Experiment(SMALL, strains=(BEFORE, AFTER), mesh_size=0.6))
    test = made((BEFORE, AFTER), OGDEN, material=Ogden((0.9,), (2.5,), 4.0))
    found = test.at(VALUES, with_derivatives=False)
    assert test.critical_strain == pytest.approx(direct.info["critical"]["strain"], abs=1e-8)
    for state, snapshot in zip(found, direct.snapshots, strict=True):
        assert (state.branch, state.negative_pivots) == (snapshot.branch, 0)
        np.testing.assert_allclose(state.displacement, snapshot.displacement, rtol=0, atol=1e-9)
        assert state.force == pytest.approx(snapshot.reaction, rel=1e-9)


def test_before_and_after_buckling() -> None:
    test = made((BEFORE, AFTER), OGDEN[1:4])
    require_derivatives(test, VALUES[1:4])
    assert BEFORE < test.critical_strain < AFTER


def test_on_the_other_branch_of_a_tilted_specimen() -> None:
    """Whichever the tilt favours: with both signs of it the pattern has that of the branch."""
    test = made((AFTER,), ("kappa", "tilt"), branches=("buckled-",))
    for tilt in (0.02, -0.02):
        (state,) = test.at(np.array([5.4, tilt]), with_derivatives=False)
        assert state.amplitude < -0.1
    require_derivatives(test, np.array([5.4, 0.02]))


def test_at_the_bifurcation_with_the_amplitude_as_an_unknown() -> None:
    """The strain there follows; at small amplitudes its derivatives are the critical strain's."""
    tilted = made((0.1,), ("tilt", "amplitude[0]"))
    require_derivatives(tilted, np.array([0.01, 0.1]))
    test = made((0.1,), ("kappa", "amplitude[0]"))
    require_derivatives(test, np.array([5.4, 0.03]))
    (state,) = test.at(np.array([5.4, 1e-3]))
    assert state.strain == pytest.approx(test.critical_strain, abs=3e-6)  # 2.1 a^2
    assert state.amplitude == pytest.approx(1e-3, abs=1e-9)
    criticals = []
    for kappa in (5.4 + 1e-4, 5.4 - 1e-4):
        test.at(np.array([kappa, 1e-3]), with_derivatives=False)
        criticals.append(test.critical_strain)
    # Both are located to 1e-7 at most, in fact some 1e-11.
    assert state.strain_by[0] == pytest.approx((criticals[0] - criticals[1]) / 2e-4, rel=1e-3)


def test_holes_and_edges_before_and_after_buckling() -> None:
    """Derivatives of u at nodes that move; holes of their own, and edges that slide and spread."""
    names = ("holes.diameter[0,0]", "holes[5].diameter", "holes.x[0,1]", "right.x[2]", "left.y[1]")
    test = made((BEFORE, AFTER), names)
    require_derivatives(test, np.array([0.03, 0.02, -0.015, 0.05, -0.04]))
    state = test.at(np.array([0.03, 0.0, 0.0, 0.0, 0.0]), with_derivatives=False)[0]
    at_hole = np.linalg.norm(MESH.nodes - SMALL.hole_centres[6], axis=1) < 0.801
    radii = np.linalg.norm(state.mesh.nodes[at_hole] - SMALL.hole_centres[6], axis=1)
    np.testing.assert_allclose(radii, 0.5 * (SMALL.diameter + 0.03), atol=1e-12)
    assert np.abs(state.mesh.nodes - MESH.nodes).max() == pytest.approx(0.015, rel=1e-9)


def test_holes_that_are_not_round() -> None:
    """All alike the specimen keeps its mirrors; smooth in both directions diagonals do, too."""
    names = ("holes.oval0[0,0]", "holes.oval45[1,1]", "holes[5].oval45")
    test = made((BEFORE, AFTER), names)
    values = np.array([0.03, -0.02, 0.01])
    require_derivatives(test, values)
    for name, degrees in (("oval0", "[0,0]"), ("oval45", "[1,1]"), ("oval0", "[1,0]")):
        found = parameter(f"holes.{name}{degrees}", test.experiment)
        assert found.holes is not None
        moved = MESH.nodes + 0.05 * hole_motion(MESH.nodes, SMALL, found.holes)
        rows = {tuple(row) for row in np.round(moved, 9) + 0.0}
        mirrors = [{tuple(row) for row in np.round(moved * m, 9) + 0.0} for m in ([1, -1], [-1, 1])]
        assert (mirrors == [rows, rows]) == found.is_symmetric == (degrees != "[1,0]")


def test_holes_with_the_amplitude_as_an_unknown() -> None:
    test = made((0.1,), ("holes.diameter[0,0]", "holes[3].x", "amplitude[0]"), FINER)
    require_derivatives(test, np.array([0.02, 0.01, 0.13]))


@pytest.mark.parametrize(("seed", "ovality_sd"), [(2, 0.0), (5, 0.006)])
def test_scattered_holes_are_those_of_the_simulation(seed: int, ovality_sd: float) -> None:
    """Its natural path leads to one of the branches; that of the name is continued to the same."""
    imperfection = Imperfection(0.006, 0.006, seed, ovality_sd)
    natural = simulate(
        Experiment(SMALL, strains=(BEFORE, AFTER), mesh_size=0.4, imperfection=imperfection)
    )
    names = [f"holes[{k}].{part}" for k in range(16) for part in PARTS]
    holes = imperfection.drawn(16)
    test = made((BEFORE, AFTER), tuple(names), FINER)
    for state in test.at(holes.ravel(), with_derivatives=False):
        snapshot = natural.at(state.strain)
        np.testing.assert_allclose(state.mesh.nodes, natural.mesh.nodes, rtol=0, atol=1e-12)
        np.testing.assert_allclose(state.displacement, snapshot.displacement, rtol=0, atol=1e-6)
        assert state.force == pytest.approx(snapshot.reaction, rel=1e-6)
    assert state.amplitude > 0.1


def test_states_nearby_are_those_of_the_whole_path() -> None:
    """With a few factorisations; where a state is no longer buckled, the path is followed."""
    names = ("exponents[0]", "travel", "tilt", "holes[5].diameter", "amplitude[1]")
    values = np.array([3.0, 1.0, 0.01, 0.005, 0.1])
    test, other = (made((BEFORE, 0.1, AFTER), names) for _ in range(2))
    for change in (0.0, 1e-3, 0.03, 0.01):
        before = test.structure.factorisations
        near, whole = (find(values * (1.0 + change)) for find in (test.near, other.at))
        needed = test.structure.factorisations - before
        assert needed == other.structure.factorisations if change == 0.0 else needed <= 9
        for state, same in zip(near, whole, strict=True):
            assert (state.branch, state.negative_pivots) == (same.branch, same.negative_pivots)
            for name in ("displacement", "force", "strain", "displacement_by", "force_by"):
                found, true = np.asarray(getattr(state, name)), np.asarray(getattr(same, name))
                np.testing.assert_allclose(found, true, rtol=0, atol=2e-6 * np.abs(true).max())
    one = made((0.1,), ("travel",))
    assert [one.near(np.array([t]))[0].branch for t in (1.0, 0.7)] == ["buckled+", "primary"]


def test_cubic_elements() -> None:
    """Where the critical strain is 7.80 %, quadratic ones of this size are 0.2 % too high."""
    mesh = mesh_specimen(SMALL, 0.35)
    names = ("exponents[0]", "right.x[2]", "holes.diameter[0,0]", "tilt")
    test = ParametricTest(Experiment(SMALL, strains=(BEFORE, AFTER)), names, mesh, degree=3)
    values = np.array([3.0, 0.0, 0.0, 0.01])
    for state in test.at(values, with_derivatives=False):
        assert len(state.displacement) == len(test.mesh.nodes) > 3 * len(mesh.nodes)
    assert test.critical_strain == pytest.approx(0.0780, abs=1.5e-4)
    require_derivatives(test, np.array([3.0, 0.02, 0.03, 0.01]))


def test_derivatives_at_points_of_the_material_that_stay() -> None:
    """As pixels see them; by differences at points, to the mesh: 7 % off with the coarse one."""
    test = made((AFTER,), ("holes.diameter[0,0]", "holes[5].x"), FINER)
    values = np.array([0.02, 0.01])
    (at_nodes,) = test.at(values)
    seen, nodes = at_fixed_points(at_nodes), at_nodes.mesh.nodes
    for k, least in enumerate((0.05, 0.2)):
        step = np.eye(2)[k] * 1e-3
        after, before = (test.at(values + s * step, False)[0] for s in (1.0, -1.0))
        slope = (displacement_at(after, nodes) - displacement_at(before, nodes)) / 2e-3
        size = np.linalg.norm(slope)
        assert np.linalg.norm(seen.displacement_by[k] - slope) < 0.02 * size
        assert np.linalg.norm(at_nodes.displacement_by[k] - slope) > least * size


def test_motion_of_the_edges() -> None:
    """Legendre polynomials of the place along an edge, times the nominal strain."""
    names = ("right.x[2]", "right.y[0]", "left.x[1]", "tilt")
    (state,) = made((BEFORE,), names).at(np.array([0.2, -0.3, 0.1, 0.04]), with_derivatives=False)
    (x, y), (a, b), u = MESH.nodes.T, SMALL.half_size, state.displacement
    right, left = x > a - 1e-9, x < 1e-9 - a
    stroke, s = 0.5 * SMALL.length, y / b
    of_right = -stroke + 0.2 * (1.5 * s**2 - 0.5) - 0.04 * y
    np.testing.assert_allclose(u[right, 0], BEFORE * of_right[right], atol=1e-13)
    np.testing.assert_allclose(u[right, 1], -0.3 * BEFORE, atol=1e-13)
    np.testing.assert_allclose(u[left, 0], BEFORE * (stroke + 0.1 * s)[left], atol=1e-13)


def test_moduli_and_another_material() -> None:
    require_derivatives(made((BEFORE,), ("moduli[0]",)), np.array([1.2]))
    test = made((BEFORE,), ("c1", "c2", "bulk"), material=TwoTermI1())
    require_derivatives(test, np.array([0.55, 0.3, 55.0]))


def test_the_critical_strain_answers_to_every_parameter() -> None:
    """By differences of whole simulations; what breaks the symmetry counts as far as it keeps it.

    Steps as above; a critical strain is located to some 1e-10.
    """
    names = ("exponents[0]", "kappa", "holes.diameter[0,0]", "right.x[2]", "travel", "tilt")
    holes = tuple(f"holes[{k}].diameter" for k in range(16))
    values = np.append([3.0, 5.4, 0.02, 0.05, 1.01], np.zeros(17))
    test = made((BEFORE,), names + holes, with_critical=True)
    _, state = test.at(values)
    assert (state.branch, state.strain) == ("critical", pytest.approx(test.critical_strain / 1.01))
    for k in range(5):
        step, found = np.eye(22)[k] * 3e-4 * max(abs(values[k]), 0.1), []
        for sign in (1.0, -1.0):
            test.at(values + sign * step, False)
            found.append(test.critical_strain / (values + sign * step)[4])
        slope = (found[0] - found[1]) / (2.0 * step[k])
        assert state.strain_by[k] == pytest.approx(slope, rel=5e-5)
    assert abs(state.strain_by[5]) < 1e-7
    assert state.strain_by[6:].sum() == pytest.approx(state.strain_by[2], rel=1e-4)
    scattered = values + np.append(np.zeros(6), np.linspace(-1e-4, 2e-4, 16))
    expected = state.strain + state.strain_by[6:] @ scattered[6:]
    assert test.at(scattered, False)[-1].strain == pytest.approx(expected, abs=1e-9)


def test_a_critical_point_nearby_is_that_of_the_whole_path() -> None:
    names = ("exponents[0]", "kappa", "holes.diameter[0,0]", "tilt")
    values = np.array([3.0, 5.4, 0.02, 0.01])
    test, other = (made((BEFORE,), names, with_critical=True) for _ in range(2))
    for change in (0.0, 1e-3, 0.02):
        near, whole = (find(values * (1.0 + change))[-1] for find in (test.near, other.at))
        assert near.strain == pytest.approx(whole.strain, abs=1e-9)
        off = np.abs(near.strain_by - whole.strain_by)
        assert np.all(off < 1e-4 * np.abs(whole.strain_by) + 1e-7)
        np.testing.assert_allclose(near.displacement, whole.displacement, rtol=0, atol=1e-6)


def test_the_critical_strain_is_a_datum() -> None:
    """Beside a state before it: what is known adds up as of independent data."""
    names, exact, sd = ("kappa", "holes.diameter[0,0]"), np.array([5.4, 0.02]), 1e-3
    test = made((BEFORE,), names, with_critical=True)
    true, critical = test.at(exact, False)
    noise = np.random.default_rng(0).normal(0.0, sd, MESH.nodes.shape)
    data = [FieldData(MESH.nodes, true.displacement + noise, sd, MESH), None]
    unknowns = {
        "kappa": Unknown(4.4, (0.5, 100.0)),
        "holes.diameter[0,0]": Unknown(0.0, (-0.1, 0.1)),
    }
    found = []
    for reading in (np.nan, critical.strain):
        strains = Readings(np.array([BEFORE, reading]), np.array([1e-5, 1e-5]))
        found.append(identify(test.near, data, unknowns, pixel_size=0.03, strains=strains))
    without, known = found
    assert np.all(np.abs(known.values - exact) < 4.0 * known.sd)
    slope = known.states[1].strain_by / 1e-5
    information = np.linalg.inv(without.covariance) + np.outer(slope, slope)
    np.testing.assert_allclose(known.sd, np.sqrt(np.diag(np.linalg.inv(information))), rtol=0.1)
    assert known.sd[1] < 0.7 * without.sd[1]
    assert known.states[1].strain == pytest.approx(critical.strain, abs=3e-5)
    with pytest.raises(InputError, match=r"expected buckling up to 0\.06, got none"):
        made((0.03,), names, with_critical=True).at(exact)


@pytest.mark.parametrize(("beyond", "start"), [(1e-3, 3.5), (1e-4, 2.0), (1e-5, 2.0)])
def test_parameters_are_identified_from_a_state_beside_the_bifurcation(
    beyond: float, start: float
) -> None:
    """Where u goes with the root of the strain: its amplitude is an unknown, too.

    With a prescribed strain the last one ends at an exponent of 1.93 ± 0.04.
    """
    critical = made((BEFORE,), ("amplitude[0]",))
    critical.at(np.array([0.01]), with_derivatives=False)
    assert critical.critical_strain is not None
    strains, sd = (BEFORE, critical.critical_strain + beyond), 1e-3
    true = made(strains, ("kappa",)).at(np.array([5.4]), with_derivatives=False)
    noise = np.random.default_rng(0).normal(0.0, sd, (2, *MESH.nodes.shape))
    data = [
        FieldData(MESH.nodes, s.displacement + e, sd, MESH)
        for s, e in zip(true, noise, strict=True)
    ]
    test = made(strains, ("exponents[0]", "kappa", "amplitude[1]"))
    unknowns = {
        "exponents[0]": Unknown(start, (0.5, 10.0)),
        "kappa": Unknown(4.4, (0.5, 100.0)),
        "amplitude[1]": Unknown(0.05, (-1.0, 1.0)),
    }
    readings = Readings(np.array(strains), 1e-5)
    found = identify(test.near, data, unknowns, pixel_size=0.03, strains=readings)
    exact = np.array([3.0, 5.4, true[1].amplitude])
    assert np.all(np.abs(found.values - exact) < 4.0 * found.sd)
    assert found.sd[1] < 0.1
    assert found.states[1].strain == pytest.approx(strains[1], abs=5e-5)


def test_holes_are_identified_from_displacements_at_points() -> None:
    """Which lie where they lie, whatever the model's nodes do."""
    names, exact = ("kappa", "holes.diameter[0,0]", "holes[5].x"), np.array([5.4, 0.03, -0.012])
    test, sd = made((BEFORE,), names, FINER), 1e-3
    (true,) = test.at(exact, with_derivatives=False)
    points = true.mesh.nodes[true.mesh.cells].mean(axis=1)
    u = displacement_at(true, points) + np.random.default_rng(0).normal(0.0, sd, points.shape)
    unknowns = {
        "kappa": Unknown(4.0, (0.5, 100.0)),
        **{name: Unknown(0.0, (-0.08, 0.08)) for name in names[1:]},
    }
    found = identify(test.near, [FieldData(points, u, sd, FINER)], unknowns, pixel_size=0.03)
    assert np.all(np.abs(found.values - exact) < 4.0 * found.sd)
    assert np.all(found.sd[1:] < 3e-3)
    assert found.state_equations[0].residual == pytest.approx(sd, rel=0.05)


def test_what_it_is_not_made_for() -> None:
    with pytest.raises(InputError, match=r"expected some of .*'kappa'.*'tilt'.*got 'mu'"):
        made((BEFORE,), ("mu",))
    for name, message in (
        ("holes[16].x", r"expected a hole from 0 to 15 in holes\[16\].x, got 16"),
        ("holes.x[7,0]", "expected a degree from 0 to 6"),
        ("holes.z[0,0]", "expected some of .*'holes.diameter.i,j.'.*got 'holes.z"),
        ("amplitude[1]", "expected a state from 0 to 0"),
    ):
        with pytest.raises(InputError, match=message):
            made((BEFORE,), (name,))
    with pytest.raises(InputError, match=r"expected clamped edges for right.y.0., got 'sliding'"):
        made((BEFORE,), ("right.y[0]",), edges="sliding")
    with pytest.raises(InputError, match=r"at most 50 % of half a ligament, got 0.15 mm of hole 0"):
        made((BEFORE,), ("holes.diameter[0,0]",)).at(np.array([0.3]))
    with pytest.raises(InputError, match=r"15 % on the buckled\+ path, got none"):
        made((0.15,), ("amplitude[0]",)).at(np.array([5.0]))
    odd = Experiment(Specimen(4, 2), strains=(0.16,), mesh_size=0.55)
    bowing = ParametricTest(odd, ("amplitude[0]",), mesh_specimen(odd.specimen, 0.55))
    with pytest.raises(InputError, match="first buckling mode with a part of the pattern"):
        bowing.at(np.array([0.01]))
