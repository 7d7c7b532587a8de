"""LDL^T factors by MUMPS: solutions and inertia, of a matrix or of a body in substructures."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from modeharvest.fem import dolfinx_api
from modeharvest.util.arrays import FloatArray, IntArray

_ROOMS = (60, 200, 600)  # extra memory to try, for pivoting of an indefinite matrix [%]
_TOO_SMALL = (-8, -9)  # values of MUMPS' INFOG(1) if that memory was too small


class SymmetricFactor:
    """The LDL^T factorisation of a symmetric matrix by MUMPS: solutions and inertia.

    The elimination order is determined once, so the matrix's pattern must not change.

    interface : numbers of unknowns that are not eliminated; their ``schur`` complement is kept, and
        the inertia is that of the other unknowns.
    """

    def __init__(self, matrix: PETSc.Mat, interface: IntArray | None = None) -> None:
        self._matrix, self._pc = matrix, PETSc.PC().create(matrix.comm)
        self._pc.setOperators(matrix)
        self._pc.setType(PETSc.PC.Type.CHOLESKY)
        self._pc.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
        self._pc.setFactorSetUpSolverType()
        # The factor is used directly: a PC would first factorise a changed matrix.
        self._factor = self._pc.getFactorMatrix()
        self._factor.setMumpsIcntl(13, 1)  # root front on one rank, so that its inertia is counted
        self._factor.setMumpsIcntl(24, 1)  # detect null pivots instead of dividing by them
        self._factor.setMumpsIcntl(8, 0)  # no scaling: all unknowns are of the same kind
        if interface is not None:
            self.schur = SchurComplement(self._factor, interface)
        self.update()

    def update(self) -> None:
        """Factorise anew, after the matrix has been assembled anew."""
        for room in _ROOMS:
            self._factor.setMumpsIcntl(14, room)
            self._pc.setUp()
            if self._factor.getMumpsInfog(1) not in _TOO_SMALL:
                break
            self._matrix.stateIncrease()  # otherwise PETSc assumes it is factorised already
        if self._factor.getMumpsInfog(1) < 0:
            raise ArithmeticError(f"MUMPS failed with INFOG(1) = {self._factor.getMumpsInfog(1)}")

    @property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues of the matrix, by Sylvester's law of inertia."""
        return int(self._factor.getInertia()[0])

    def solve(self, rhs: PETSc.Vec) -> PETSc.Vec:
        """The solution for one right-hand side."""
        solution = rhs.duplicate()
        self._factor.solve(rhs, solution)
        return solution

    def solve_block(self, rhs: PETSc.Mat) -> PETSc.Mat:
        """The solutions for the columns of a dense matrix, in a quarter of the time per column."""
        solutions = rhs.duplicate()
        self._factor.matSolve(rhs, solutions)
        return solutions


class SubstructuredFactor:
    """The LDL^T factorisation for a body in substructures, one on each rank.

    Each rank eliminates the interior of its substructure without communication. The Schur
    complements add up to a matrix of the interface, which all ranks factorise together. A solution
    is a forward sweep through the interiors, a solution on the interface, and a backward sweep.
    Negative pivots add up, too (Haynsworth, Linear Algebra Appl. 1 (1968) 73-81). All right-hand
    sides are those of the whole body.

    matrix, V : assembled matrix of ``dolfinx_api.create_symmetric_matrix``, and its space.
    """

    def __init__(self, matrix: PETSc.Mat, V: Any) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        self._own, self._size = 2 * V.dofmap.index_map.size_local, matrix.size[0]
        shared = dolfinx_api.shared_nodes(V)
        names = V.dofmap.index_map.local_to_global(shared)
        interface = np.unique(np.concatenate(self._comm.allgather(names)))
        self._place = _components(np.searchsorted(interface, names))
        self._sum = PETSc.Mat().create(self._comm)
        self._sum.setSizes((2 * len(interface), 2 * len(interface)))
        self._sum.setType(PETSc.Mat.Type.SBAIJ)
        self._sum.setUp()
        self._sum.setOption(PETSc.Mat.Option.IGNORE_LOWER_TRIANGULAR, True)
        self._load, here = self._sum.createVecRight(), PETSc.COMM_SELF
        self._part = PETSc.Vec().createSeq(len(self._place), comm=here)
        places = PETSc.IS().createGeneral(self._place, comm=here)
        self._exchange = PETSc.Scatter().create(self._load, places, self._part, None)
        self._inside = SymmetricFactor(matrix, _components(shared))
        self._add_up()
        self._interface = SymmetricFactor(self._sum)

    def update(self) -> None:
        """Factorise anew, after the matrix has been assembled anew."""
        self._inside.update()
        self._add_up()
        self._interface.update()

    def _add_up(self) -> None:
        self._sum.zeroEntries()
        add = PETSc.InsertMode.ADD
        self._sum.setValues(self._place, self._place, self._inside.schur.values(), add)
        self._sum.assemble()
        self._inside.schur.solve_by(self._solve_interface)

    def _solve_interface(self, rhs: FloatArray) -> FloatArray:
        """The interface's displacements, from its right-hand side after the forward sweeps."""
        mode, insert = PETSc.ScatterMode, PETSc.InsertMode
        self._part.array[:] = rhs
        self._load.set(0.0)
        self._exchange.scatter(self._part, self._load, insert.ADD, mode.REVERSE)
        solution = self._interface.solve(self._load)
        self._exchange.scatter(solution, self._part, insert.INSERT, mode.FORWARD)
        return np.asarray(self._part.array)

    @property
    def negative_pivots(self) -> int:
        """Number of negative eigenvalues of the body's matrix (collective)."""
        inside = self._comm.allreduce(self._inside.negative_pivots)
        return int(inside + self._interface.negative_pivots)

    def solve(self, rhs: PETSc.Vec) -> PETSc.Vec:
        """The solution for one right-hand side."""
        solution = rhs.duplicate()
        solution.array[:] = self._solved(rhs.array[:, None])[:, 0]
        return solution

    def solve_block(self, rhs: PETSc.Mat) -> PETSc.Mat:
        """The solutions for a dense matrix's columns, in under half of the time per column."""
        solutions = rhs.duplicate()
        solutions.getDenseArray()[:] = self._solved(rhs.getDenseArray())
        return solutions

    def _solved(self, rhs: FloatArray) -> FloatArray:
        columns = np.zeros((self._size, rhs.shape[1]), order="F")  # 0 for nodes of other ranks
        columns[: self._own] = rhs
        local = PETSc.Mat().createDense(columns.shape, array=columns, comm=PETSc.COMM_SELF)
        solutions = self._inside.solve_block(local)
        return np.array(solutions.getDenseArray()[: self._own])


BodyFactor = SymmetricFactor | SubstructuredFactor


def factorise(matrix: PETSc.Mat, V: Any) -> BodyFactor:
    """The factor of a matrix of ``dolfinx_api.create_symmetric_matrix``; on all ranks."""
    alone = V.mesh.comm.size == 1
    return SymmetricFactor(matrix) if alone else SubstructuredFactor(matrix, V)


class SchurComplement:
    """The Schur complement in a factor, and its solver, accessed by PETSc's C functions.

    petsc4py lacks these functions. Between MUMPS' forward and backward sweeps, PETSc solves with
    the complement by a matrix operation, which is replaced here.
    """

    _FACTORED, _SOLVE = 1, 7  # MAT_FACTOR_SCHUR_FACTORED, MATOP_SOLVE

    def __init__(self, factor: PETSc.Mat, interface: IntArray) -> None:
        self._factor, self._size = factor, len(interface)
        self._matrix = ctypes.c_void_p()
        self._operation: Any = None
        numbers = PETSc.IS().createGeneral(interface, comm=PETSc.COMM_SELF)
        _petsc("MatFactorSetSchurIS", _handle(factor), _handle(numbers))

    def values(self) -> FloatArray:
        """The complement as a full matrix."""
        status, pointer = ctypes.c_int(), ctypes.POINTER(ctypes.c_double)()
        matrix = ctypes.byref(self._matrix)
        _petsc("MatFactorGetSchurComplement", _handle(self._factor), matrix, ctypes.byref(status))
        _petsc("MatDenseGetArrayRead", self._matrix, ctypes.byref(pointer))
        lower = np.ctypeslib.as_array(pointer, (self._size, self._size)).T  # by columns
        values: FloatArray = np.tril(lower) + np.tril(lower, -1).T
        _petsc("MatDenseRestoreArrayRead", self._matrix, ctypes.byref(pointer))
        return values

    def solve_by(self, function: Callable[[FloatArray], FloatArray]) -> None:
        """Use ``function`` to solve for a right-hand side, until the next update."""

        def operation(_matrix: int, rhs: int, solution: int) -> int:
            try:
                self._array(solution, "Write")[:] = function(self._array(rhs, "Read"))
            except Exception:  # exceptions must not pass through C
                return 1
            return 0

        self._operation = _OPERATION(operation)  # stored, as PETSc doesn't keep it alive
        _petsc("MatSetOperation", self._matrix, self._SOLVE, self._operation)
        matrix = ctypes.byref(self._matrix)
        name = "MatFactorRestoreSchurComplement"
        _petsc(name, _handle(self._factor), matrix, self._FACTORED)

    def _array(self, vector: int, access: str) -> FloatArray:
        pointer = ctypes.POINTER(ctypes.c_double)()
        for verb in ("Get", "Restore"):
            name = f"Vec{verb}Array{access}"
            _petsc(name, ctypes.c_void_p(vector), ctypes.byref(pointer))
            if verb == "Get":
                array = np.ctypeslib.as_array(pointer, (self._size,))
        return array


_LIBRARY = ctypes.CDLL(PETSc.__file__)  # also loads PETSc itself
_OPERATION = ctypes.CFUNCTYPE(ctypes.c_int, *3 * [ctypes.c_void_p])


def _petsc(name: str, *arguments: Any) -> None:
    code = getattr(_LIBRARY, name)(*arguments)
    if code:
        raise PETSc.Error(code)


def _handle(thing: PETSc.Object) -> ctypes.c_void_p:
    return ctypes.c_void_p(thing.handle)


def _components(nodes: IntArray) -> IntArray:
    """The numbers of both displacement components of nodes."""
    return (2 * nodes[:, None] + [0, 1]).ravel().astype(PETSc.IntType)
