"""Factorisation of sparse symmetric matrices with one pattern by a library, and their inertia.

MUMPS through petsc4py, which is installed with dolfinx, determines the elimination order once for
all matrices of a pattern. Without it, SciPy's SuperLU is used, which takes several times as long.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix, csr_array
from scipy.sparse.linalg import splu

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import SingularMatrixError


def factorise(
    matrix: csr_array, library: str | None = None, definite: bool = True, block: int = 1
) -> Factor:
    """Factorise a symmetric sparse matrix with sorted indices.

    ModuleNotFoundError without the named library; SingularMatrixError, here or in ``update``.

    matrix : (n, n), both triangles.
    library : a name among ``LIBRARIES``; by default MUMPS if available.
    definite : whether all matrices are known to be positive definite; else L D L^T with pivoting.
    block : number of consecutive unknowns per node; MUMPS then orders nodes, in half the time.
    """
    best = "mumps" if find_spec("petsc4py") else "superlu"
    return LIBRARIES[library or best](matrix, definite, block)


class _Mumps:
    library = "MUMPS"

    def __init__(self, matrix: csr_array, definite: bool, block: int) -> None:
        from petsc4py import PETSc

        # The arrays are shared, so that new values need no call for each row.
        rows = (part.astype(PETSc.IntType) for part in (matrix.indptr, matrix.indices))
        self._arrays, alone = (*rows, matrix.data.astype(PETSc.ScalarType)), PETSc.COMM_SELF
        self._matrix = PETSc.Mat().createAIJWithArrays(matrix.shape, self._arrays, comm=alone)
        self._matrix.setOption(PETSc.Mat.Option.SPD, definite)
        self._pc = PETSc.PC().create(alone)
        self._pc.setOperators(self._matrix)
        self._pc.setType(PETSc.PC.Type.CHOLESKY)
        self._pc.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
        self._pc.setFactorSetUpSolverType()
        self._factor = self._pc.getFactorMatrix()
        self._factor.setMumpsIcntl(8, 0)  # no scaling: all unknowns are of the same kind
        self._factor.setMumpsIcntl(13, 1)  # root front on one rank, so that its inertia is counted
        self._factor.setMumpsIcntl(14, 60 if definite else 200)  # room for fill-in and pivoting [%]
        self._factor.setMumpsIcntl(15, -block if block > 1 else 0)  # order blocks
        self.update(matrix)

    def update(self, matrix: csr_array) -> None:
        self._arrays[2][:] = matrix.data
        self._matrix.stateIncrease()
        self._pc.setUp()
        if (code := self._factor.getMumpsInfog(1)) < 0:
            failure = SingularMatrixError if code in (-6, -10) else ArithmeticError
            raise failure(f"MUMPS ended with INFOG(1) = {code}")

    def solve(self, rhs: FloatArray) -> FloatArray:
        from petsc4py import PETSc

        columns = np.asfortranarray(rhs.reshape(len(rhs), -1))
        b = PETSc.Mat().createDense(columns.shape, array=columns, comm=PETSc.COMM_SELF)
        x = b.duplicate()
        self._factor.matSolve(b, x)
        return np.array(x.getDenseArray()).reshape(rhs.shape)

    @property
    def negative_pivots(self) -> int:
        return int(self._factor.getMumpsInfog(12))


class _SuperLU:
    library = "SuperLU"

    def __init__(self, matrix: csr_array, definite: bool, block: int) -> None:
        self.update(matrix)

    def update(self, matrix: csr_array) -> None:
        try:
            self._factor: Any = splu(
                csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )  # fmt: skip
        except RuntimeError as error:
            raise SingularMatrixError(f"SuperLU, {error}") from error

    def solve(self, rhs: FloatArray) -> FloatArray:
        return np.asarray(self._factor.solve(rhs))

    @property
    def negative_pivots(self) -> int:
        return negative_pivots(self._factor)


def negative_pivots(factor: Any) -> int:
    """Number of negative eigenvalues of a Hermitian matrix, from its SuperLU factor.

    ArithmeticError if a zero pivot made SuperLU pivot off the diagonal: signs are then meaningless.
    """
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise ArithmeticError("a zero pivot: the matrix is singular or nearly so")
    return int(np.count_nonzero(factor.U.diagonal().real < 0))


Factor = _Mumps | _SuperLU
"""A factorised matrix; ``library`` is the library used. ``update`` factorises another matrix of the
same pattern; ``solve`` takes a right-hand side (n,) or several (n, k); ``negative_pivots`` is the
number of negative eigenvalues, by Sylvester's law of inertia."""
LIBRARIES: dict[str, type[Factor]] = {"mumps": _Mumps, "superlu": _SuperLU}
