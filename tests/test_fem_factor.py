"""The factor of a body in substructures, one on each rank: the same solutions and inertia."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from test_fem_simulate import PATIENT
from test_fem_stability import compressed, small_structure

STRAINS = (0.0, 0.15, 0.4)

SUBSTRUCTURED = f"""
import numpy as np
from petsc4py import PETSc
from modeharvest.fem import dolfinx_api
from test_fem_stability import compressed, small_structure

structure = small_structure()
counts = []
for strain in {STRAINS}:
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
if structure.comm.rank == 0:
    print(structure.comm.size, *counts)
"""


@pytest.mark.parametrize("ranks", [2, 3])
def test_substructures_solve_and_count_as_the_whole_does(ranks: int) -> None:
    """On unstable states, too, where insides of substructures are unstable as well."""
    command = ["mpirun", "-n", str(ranks), sys.executable, "-c", SUBSTRUCTURED]
    run = subprocess.run(
        command, capture_output=True, text=True, timeout=900, env=PATIENT, check=False,
        cwd=Path(__file__).parent,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    structure = small_structure()
    whole = [structure.factor(compressed(structure, e)).negative_pivots for e in STRAINS]
    assert whole[0] == 0 < whole[1] < whole[2]
    assert [int(word) for word in run.stdout.split()] == [ranks, *whole]
