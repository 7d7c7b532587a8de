"""The solutions that ship with the package are what the project's own code computes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.field import Solution
from modeharvest.fem.meshing import mesh_specimen, perturb
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.simulate import simulate
from modeharvest.runs.case import Case, shipped_solution

FloatArray = NDArray[np.float64]


def test_shipped_solution_of_the_paper_case_against_a_fresh_one() -> None:
    """Other versions of MUMPS and BLAS round differently; equilibrium is met to 1e-11 of strain."""
    path = shipped_solution("paper-virtual")
    shipped, fresh = Solution.read(path), simulate(Case.read("paper-virtual").experiment)
    np.testing.assert_array_equal(shipped.mesh.cells, fresh.mesh.cells)
    np.testing.assert_allclose(shipped.mesh.nodes, fresh.mesh.nodes, rtol=0, atol=1e-12)
    assert abs(shipped.info["critical"]["strain"] - fresh.info["critical"]["strain"]) < 1e-8
    assert fresh.info["critical"]["negative_pivots_below"] == 0
    assert fresh.info["critical"]["negative_pivots_above"] == 1
    assert fresh.info["factorisations"] <= 50
    assert [s.nominal_strain for s in fresh.snapshots] == [0.078, 0.128]
    for old, new in zip(shipped.snapshots, fresh.snapshots, strict=True):
        assert (old.branch, old.negative_pivots) == (new.branch, new.negative_pivots)
        assert new.negative_pivots == 0
        np.testing.assert_allclose(old.displacement, new.displacement, rtol=0, atol=1e-7)


def test_shipped_twin_is_in_stable_equilibrium_under_its_tilted_and_guided_loading() -> None:
    """Without walking its path again: residual and inertia at what is shipped."""
    case, path = Case.read("paper-real-twin"), shipped_solution("paper-real-twin")
    shipped, experiment = Solution.read(path), case.experiment
    spec = experiment.specimen
    mesh = perturb(mesh_specimen(spec, experiment.mesh_size), spec, experiment.imperfection)
    np.testing.assert_array_equal(shipped.mesh.cells, mesh.cells)
    np.testing.assert_allclose(shipped.mesh.nodes, mesh.nodes, rtol=0, atol=1e-12)
    loading = EdgeCompression(
        spec.half_size[0], spec.length, "clamped", experiment.tilt, spec.mid_junctions
    )
    structure = Structure(mesh, experiment.material, loading)
    places = cKDTree(mesh.nodes)
    for snapshot in shipped.snapshots:

        def nodal(points: FloatArray, u: FloatArray = snapshot.displacement) -> FloatArray:
            return np.asarray(u[places.query(points)[1]])

        u = structure.from_function(nodal)
        structure.prescribe(u, snapshot.nominal_strain)
        np.testing.assert_allclose(structure.nodal(u), snapshot.displacement, rtol=0, atol=1e-12)
        # As small as a change of the strain by 1e-10 would make; the solver stops at 1e-11.
        assert structure.residual(u).norm() < 1e-10 * structure.load(u).norm()
        assert structure.factor(u).negative_pivots == 0
        assert abs(structure.energy(u) - snapshot.energy) < 1e-9 * snapshot.energy
        force = structure.reaction(u, spec.length)
        assert abs(force - snapshot.reaction) < 1e-7 * snapshot.reaction
