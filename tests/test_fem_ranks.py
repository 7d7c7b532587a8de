"""Several MPI ranks find what one does: the factor in substructures, specimens, homogenized too.

Both or all three start once, for Python and dolfinx take them longer than all they have to do.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_fem_homogenization import LOOSE, homogeneous
from test_fem_simulate import by_branch, reference
from test_fem_stability import compressed, small_structure
from test_homogenization_run import ONE_ELEMENT, case_of

from modeharvest.cli.root import main
from modeharvest.fem import dolfinx_api
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.runs.homogenization.pipeline import HomogenizationRun
from modeharvest.util.files import read_json

STRAINS = (0.0, 0.15, 0.4)
PATIENT = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1"}
"""For Open MPI: a rank that waits leaves the processor to the others, whoever else needs it."""
Found = Callable[[int], tuple[Path, dict[str, Any]]]
"""By the number of ranks, a folder and what they have found."""


def on_each_rank(folder: Path) -> None:
    """What a rank does: solutions to ``rank0.h5`` …, and numbers to ``found.json``."""
    rank, size = MPI.COMM_WORLD.rank, MPI.COMM_WORLD.size
    found: dict[str, Any] = {"ranks": size, "negative_pivots": negative_pivots()}
    if size == 2:
        specimen = Experiment(Specimen(4, 6), strains=(0.1, 0.15), mesh_size=0.5)
        simulate(specimen).write(folder / f"rank{rank}.h5")
        homogenized = homogeneous(LOOSE)
        assert homogenized.critical is not None
        found["critical"] = homogenized.critical.load
        found["energy"] = homogenized.states[-1].energy
        sys.argv = ["modeharvest", "homogenize", str(folder / "case.toml"), "--out", str(folder)]
        with contextlib.suppress(SystemExit):
            main()
    if rank == 0:
        (folder / "found.json").write_text(json.dumps(found))


def negative_pivots() -> list[int]:
    """On unstable states, too, where insides of substructures are unstable as well."""
    structure = small_structure()
    counts = []
    for strain in STRAINS:
        u = compressed(structure, strain)
        factor = structure.factor(u)
        counts.append(factor.negative_pivots)
        K = dolfinx_api.assemble_matrix(structure._forms.stiffness, structure._bcs, 1.0)
        rhs = structure.load(u)
        solution = factor.solve(rhs)
        assert (K * solution - rhs).norm() < 1e-10 * rhs.norm()
        both = np.stack([rhs.array, -2.0 * rhs.array], axis=1)
        sizes = (rhs.getSizes(), (PETSc.DECIDE, 2))
        block = factor.solve_block(PETSc.Mat().createDense(sizes, array=both, comm=structure.comm))
        expected = np.stack([solution.array, -2.0 * solution.array], axis=1)
        largest = solution.norm(PETSc.NormType.INFINITY)
        np.testing.assert_allclose(block.getDenseArray(), expected, rtol=0, atol=1e-12 * largest)
    return counts


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    @cache
    def by(ranks: int) -> tuple[Path, dict[str, Any]]:
        folder = tmp_path_factory.mktemp("ranks")
        (folder / "case.toml").write_text(ONE_ELEMENT, "utf-8")
        command = ["mpirun", "-n", str(ranks), sys.executable, Path(__file__).name, str(folder)]
        run = subprocess.run(
            command, capture_output=True, text=True, timeout=1800, env=PATIENT, check=False,
            cwd=Path(__file__).parent,
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        return folder, json.loads((folder / "found.json").read_text()) | {"said": run.stdout}

    return by


@pytest.mark.parametrize("ranks", [2, 3])
def test_substructures_solve_and_count_as_the_whole_does(ranks: int, found: Found) -> None:
    _, numbers = found(ranks)
    whole = negative_pivots()
    assert whole[0] == 0 < whole[1] < whole[2]
    assert (numbers["ranks"], numbers["negative_pivots"]) == (ranks, whole)


def test_two_ranks_simulate_the_same(found: Found) -> None:
    folder, _ = found(2)
    expected = reference()
    for rank in (0, 1):
        solution = Solution.read(folder / f"rank{rank}.h5")
        critical, wanted = solution.info["critical"], expected.info["critical"]
        assert critical["strain"] == pytest.approx(wanted["strain"], abs=1e-8)
        assert critical["negative_pivots_below"] == 0
        assert critical["negative_pivots_above"] == 1
        assert critical["pattern_overlap_by_cell"] == pytest.approx(
            wanted["pattern_overlap_by_cell"], rel=1e-5
        )
        assert np.array_equal(solution.mesh.nodes, expected.mesh.nodes)
        for s in solution.snapshots:
            other = by_branch(expected, s.nominal_strain)[s.branch]
            np.testing.assert_allclose(s.displacement, other.displacement, rtol=0, atol=1e-8)
            assert s.energy == pytest.approx(other.energy, rel=1e-10)
            assert s.reaction == pytest.approx(other.reaction, rel=1e-8)
            assert s.negative_pivots == other.negative_pivots


def test_two_ranks_homogenize_the_same(found: Found) -> None:
    _, numbers = found(2)
    alone = homogeneous(LOOSE)
    assert alone.critical is not None
    assert numbers["critical"] == pytest.approx(alone.critical.load, rel=1e-9)
    assert numbers["energy"] == pytest.approx(alone.states[-1].energy, rel=1e-9)


@pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")
def test_the_command_shares_rves_out_over_ranks(found: Found, tmp_path: Path) -> None:
    folder, numbers = found(2)
    assert numbers["said"].count("A small specimen") == 1, "one rank talks"
    both = read_json(folder / "summary.json")
    alone = HomogenizationRun(case_of(tmp_path / "case.toml", ONE_ELEMENT), tmp_path).all()
    for one, two in ((alone, both), (alone["direct"], both["direct"])):
        for a, b in zip(one["states"], two["states"], strict=True):
            assert b["energy_N"] == pytest.approx(a["energy_N"], rel=1e-9)
    with h5py.File(tmp_path / "rve.h5") as rve, h5py.File(folder / "rve.h5") as shared:
        for name in ("points", "moduli", "fluctuations"):
            values = rve[f"states/{name}"][:]
            off = np.abs(shared[f"states/{name}"][:] - values).max()
            assert off < 1e-8 * np.abs(values).max()


if __name__ == "__main__":
    on_each_rank(Path(sys.argv[1]))
