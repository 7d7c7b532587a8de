"""Specimens with graded holes buckle where they should, and keep the symmetry that is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.runs.case import Case

STRAINS = (0.05, 0.082, 0.09)


def compressed(specimen: Specimen, strains: tuple[float, ...] = STRAINS) -> Solution:
    """A specimen on a mesh as coarse as can be."""
    return simulate(Experiment(specimen, TwoTermI1(), strains, mesh_size=0.29))


def columns(diameter: float, grading_x: float = 0.0, grading_y: float = 0.0) -> Specimen:
    """Two columns of four holes, with their centres at -0.95 and 0.95 mm."""
    return Specimen(2, 4, diameter, 1.9, 0.5, 0.5, grading_x, grading_y)


def test_the_critical_strain_lies_between_those_of_the_smallest_and_the_largest_holes() -> None:
    # Along the loading direction: the columns have the diameters of the two uniform specimens.
    graded = compressed(columns(1.7, grading_x=0.04))
    assert graded.info["outcome"] == "complete"
    assert graded.info["specimen"]["grading_x"] == 0.04
    critical = graded.info["critical"]
    assert (critical["negative_pivots_below"], critical["negative_pivots_above"]) == (0, 1)
    large = compressed(columns(1.738), (0.07,)).info["critical"]["strain"]
    small = compressed(columns(1.662), (0.11,)).info["critical"]["strain"]
    assert large < critical["strain"] < small

    image = cKDTree(graded.mesh.nodes).query(graded.mesh.nodes * [1.0, -1.0])[1]
    before, after = graded.snapshots[0].displacement, graded.snapshots[-1].displacement
    # Equilibrium is met to 1e-9 mm or so: before buckling the mirror image is the same state.
    np.testing.assert_allclose(before[image] * [1.0, -1.0], before, rtol=0, atol=1e-8)
    assert np.abs(after[image] * [1.0, -1.0] - after).max() > 0.05
    assert graded.snapshots[-1].branch == "buckled+"
    assert graded.snapshots[-1].negative_pivots == 0


def test_without_any_symmetry_the_pattern_grows_from_the_first_load_on() -> None:
    solution = compressed(columns(1.7, grading_x=0.04, grading_y=0.02))
    assert solution.info["outcome"] == "complete"
    assert solution.info["critical"] is None
    assert [s.negative_pivots for s in solution.snapshots] == [0, 0, 0]


def test_a_case_file_can_say_it(tmp_path: Path) -> None:
    path = tmp_path / "graded.toml"
    path.write_text("[experiment.specimen]\ngrading_x = 0.02\n")
    case = Case.read(path)
    assert case.experiment.specimen == Specimen(grading_x=0.02)
    assert case.plain()["experiment"]["specimen"]["grading_x"] == 0.02
