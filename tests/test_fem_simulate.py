"""Virtual tests of small specimens: branches, steps, edges, scatter, failure, two MPI ranks."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.experiment import Experiment, PathOptions
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.util.errors import InputError

ALL = ("primary", "buckled+", "buckled-")
# Small, coarse and so rather stiff, but it buckles as the paper's does: rows of holes into
# alternating ellipses, at 13.9 %; the next mode comes after 15 %.
SMALL = Specimen(4, 6)
BEFORE, AFTER = 0.1, 0.15


def small(**changes: Any) -> Experiment:
    settings: dict[str, Any] = {"specimen": SMALL, "strains": (BEFORE, AFTER), "mesh_size": 0.5}
    return Experiment(**(settings | changes))


@cache
def reference() -> Solution:
    return simulate(small(branches=ALL))


def by_branch(solution: Solution, strain: float) -> dict[str, Snapshot]:
    return {s.branch: s for s in solution.snapshots if s.nominal_strain == strain}


def mirrored(mesh: Mesh, u: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """The displacement field seen in a mirror, at the same nodes."""
    sign = np.where(np.arange(2) == axis, -1.0, 1.0)
    _, image = cKDTree(mesh.nodes).query(mesh.nodes * sign)
    return np.asarray(u[image] * sign)


def test_snapshots_are_at_exactly_the_strains_asked_for() -> None:
    solution = reference()
    assert solution.info["outcome"] == "complete"
    assert [s.nominal_strain for s in solution.snapshots] == [BEFORE, AFTER, AFTER, AFTER]
    right = solution.mesh.nodes[:, 0] > SMALL.half_size[0] - 1e-9
    for s in solution.snapshots:
        np.testing.assert_allclose(
            s.displacement[right],
            np.broadcast_to([-0.5 * s.nominal_strain * SMALL.length, 0.0], (right.sum(), 2)),
            atol=1e-14,
        )


def test_pattern_becomes_critical_and_inertia_proves_where() -> None:
    critical = reference().info["critical"]
    assert BEFORE < critical["strain"] < AFTER
    assert (critical["negative_pivots_below"], critical["negative_pivots_above"]) == (0, 1)
    assert critical["pattern_overlap"] > 0
    assert critical["pattern_overlap_by_cell"] > 0.85


def test_stable_branches_lie_below_the_unstable_path() -> None:
    solution = reference()
    (before,) = by_branch(solution, BEFORE).values()
    after = by_branch(solution, AFTER)
    assert (before.branch, before.negative_pivots) == ("primary", 0)
    assert {b: s.negative_pivots for b, s in after.items()} == {
        "primary": 1,
        "buckled+": 0,
        "buckled-": 0,
    }
    assert after["buckled+"].energy < after["primary"].energy
    assert after["buckled+"].reaction < after["primary"].reaction
    assert solution.at(AFTER).branch.startswith("buckled")


def test_primary_path_keeps_both_symmetries() -> None:
    solution = reference()
    for s in (s for s in solution.snapshots if s.branch == "primary"):
        for axis in (0, 1):
            np.testing.assert_allclose(
                mirrored(solution.mesh, s.displacement, axis), s.displacement, rtol=0, atol=1e-9
            )


def test_branches_are_mirror_images() -> None:
    solution = reference()
    plus, minus = (by_branch(solution, AFTER)[b] for b in ("buckled+", "buckled-"))
    assert plus.energy == pytest.approx(minus.energy, rel=1e-10)
    assert plus.reaction == pytest.approx(minus.reaction, rel=1e-8)
    assert np.abs(plus.displacement - minus.displacement).max() > 0.1
    image = mirrored(solution.mesh, plus.displacement, 0)
    np.testing.assert_allclose(image, minus.displacement, rtol=0, atol=1e-7)


def test_sign_of_the_branch_is_that_of_the_pattern() -> None:
    solution = reference()
    after = by_branch(solution, AFTER)
    pattern = SMALL.pattern(solution.mesh.nodes)
    departure = after["buckled+"].displacement - after["primary"].displacement
    assert np.sum(pattern * departure) > 0


def test_critical_strain_does_not_depend_on_the_steps() -> None:
    for first, largest in ((0.02, 0.02), (0.05, 0.05)):
        again = simulate(small(path=PathOptions(first, largest)))
        expected = reference().info["critical"]["strain"]
        assert again.info["critical"]["strain"] == pytest.approx(expected, abs=1e-6)
        at, before = again.at(AFTER), by_branch(reference(), AFTER)["buckled+"]
        np.testing.assert_allclose(at.displacement, before.displacement, atol=1e-7)


def test_simulation_is_deterministic() -> None:
    again = simulate(small(branches=ALL))
    assert again.info["critical"]["strain"] == reference().info["critical"]["strain"]
    for a, b in zip(again.snapshots, reference().snapshots, strict=True):
        assert np.array_equal(a.displacement, b.displacement)


def test_sliding_edges_are_softer() -> None:
    sliding = simulate(small(edges="sliding"))
    assert sliding.info["critical"]["strain"] <= reference().info["critical"]["strain"]
    before = sliding.at(BEFORE)
    assert before.energy < reference().at(BEFORE).energy
    right = sliding.mesh.nodes[:, 0] > SMALL.half_size[0] - 1e-9
    assert np.ptp(before.displacement[right, 1]) > 0.1  # the edge does slide
    assert np.ptp(before.displacement[right, 0]) < 1e-14


@pytest.mark.parametrize("bulk_y", [0.0, 0.3])
@pytest.mark.parametrize("step", [0.03, 0.15])
def test_first_of_modes_that_lie_close_is_found(bulk_y: float, step: float) -> None:
    """Narrow bulk strips: several modes become critical within 0.1 % of strain."""
    specimen = Specimen(4, 4, bulk_y=bulk_y)
    found = [
        simulate(
            small(
                specimen=specimen,
                strains=(0.15,),
                branches=("primary",),
                path=PathOptions(first, first),
            )
        ).info["critical"]
        for first in (0.02, step)
    ]
    for critical in found:
        assert (critical["negative_pivots_below"], critical["negative_pivots_above"]) == (0, 1)
    assert found[0]["strain"] == pytest.approx(found[1]["strain"], abs=1e-8)


def test_specimen_that_stays_stable_has_no_critical_strain() -> None:
    solution = simulate(small(specimen=Specimen(2, 2)))
    assert solution.info["critical"] is None
    assert solution.info["outcome"] == "complete"
    assert [(s.branch, s.negative_pivots) for s in solution.snapshots] == [("primary", 0)] * 2


def test_odd_numbers_of_holes_both_ways_have_no_bifurcation_into_the_pattern() -> None:
    """There the pattern has both mirror symmetries of the specimen, as the primary path has.

    So the path itself bends into the pattern and stays stable; long steps slip off it, and
    have to end where short ones do.
    """
    specimen = Specimen(5, 7)
    found = []
    for step in (0.026, 0.01):
        path = PathOptions(first_step=step, largest_step=step)
        solution = simulate(small(specimen=specimen, strains=(0.05, 0.12, 0.135), path=path))
        assert solution.info["critical"] is None
        assert solution.info["outcome"] == "complete"
        assert not any(solution.info["path"]["primary"]["negative_pivots"])
        found.append(solution)
    pattern = specimen.pattern(found[0].mesh.nodes)
    early, _, late = (abs(np.vdot(pattern, s.displacement)) for s in found[0].snapshots)
    assert late > 20 * early
    for one, other in zip(found[0].snapshots, found[1].snapshots, strict=True):
        np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-6)


def test_scatter_leads_to_the_perfect_branch_as_it_vanishes() -> None:
    specimen = Specimen(4, 2)
    perfect = simulate(small(specimen=specimen, strains=(0.17,), branches=ALL)).snapshots
    energy = min(s.energy for s in perfect)
    distances = []
    for deviation in (1e-2, 1e-3, 1e-4):
        scatter = Imperfection(deviation, deviation, seed=1)
        solution = simulate(small(specimen=specimen, strains=(0.17,), imperfection=scatter))
        assert solution.info["outcome"] == "complete"
        assert solution.info["critical"] is None
        assert not any(solution.info["path"]["primary"]["negative_pivots"])
        (only,) = solution.snapshots
        nearest = min(np.abs(only.displacement - s.displacement).max() for s in perfect)
        distances.append((abs(only.energy - energy), nearest))
    ratios = np.divide(distances[:-1], distances[1:])
    np.testing.assert_allclose(np.log10(ratios), 1.0, atol=0.3)  # in proportion to the scatter


def test_scatter_repeats_with_its_seed() -> None:
    scatter = Imperfection(0.01, 0.01, seed=4)
    first, second = (simulate(small(strains=(0.05,), imperfection=scatter)) for _ in range(2))
    other = simulate(small(strains=(0.05,), imperfection=Imperfection(0.01, 0.01, seed=5)))
    assert np.array_equal(first.snapshots[0].displacement, second.snapshots[0].displacement)
    assert not np.array_equal(first.snapshots[0].displacement, other.snapshots[0].displacement)


def test_strain_out_of_reach_keeps_what_converged_and_says_so() -> None:
    solution = simulate(
        small(
            specimen=Specimen(4, 2),
            material=TwoTermI1(),
            strains=(0.05, 0.49),
            branches=("primary",),
        )
    )
    assert solution.info["outcome"].startswith("incomplete: primary lacks 49 %")
    assert re.search(
        r"did not converge beyond [\d.]+ % strain; 0\.5 mm is a coarse mesh_size for ligaments of "
        r"0\.4 mm\)$", solution.info["outcome"],
    )  # fmt: skip
    assert solution.at(0.05).negative_pivots == 0
    assert all(s.nominal_strain == 0.05 for s in solution.snapshots if s.branch == "primary")


def test_info_tells_how_it_came_about() -> None:
    info = reference().info
    assert info["specimen"]["holes_y"] == 6
    assert info["material"] == {"kind": "Ogden", "moduli": [1.2], "exponents": [3.0], "kappa": 5.4}
    curve = info["path"]["primary"]
    assert np.all(np.diff(curve["nominal_strain"]) > 0)
    assert len({len(column) for column in curve.values()}) == 1
    assert 0 < info["factorisations"] <= 60
    assert info["unknowns"] == 2 * len(reference().mesh.nodes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strains": ()}, "ascending positive"),
        ({"strains": (0.1, 0.1)}, "ascending positive"),
        ({"strains": (-0.1,)}, "ascending positive"),
        ({"strains": (float("nan"),)}, "ascending positive"),
        ({"strains": (7.8, 12.8)}, r"below 0.5 \(0.128 is 12.8 %\), got 12.8"),
        ({"branches": ("up",)}, "branches: expected some of"),
        ({"branches": ()}, "branches: expected some of"),
        ({"edges": "free"}, "'clamped' or 'sliding', got 'free'"),
        ({"mesh_size": 1.0}, "mesh size: expected at most"),
    ],
)
def test_bad_experiments_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(small(**changes))


@pytest.mark.parametrize(
    "options",
    [{"first_step": 0.0}, {"critical_tolerance": -1.0}, {"growth": 1.0}, {"largest_step": np.nan}],
)
def test_bad_path_options_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match="path options"):
        PathOptions(**options)
