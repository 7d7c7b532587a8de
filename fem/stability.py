"""Which way an equilibrium is unstable: eigenpairs of the tangent nearest to zero.

Stability itself is read from the inertia of the LDL^T factor (``Factor.negative_pivots``),
which can't miss a mode. The eigenpairs say which mode it is and how far from zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from petsc4py import PETSc
from slepc4py import SLEPc

from modeharvest.fem.equilibrium import Factor


@dataclass(frozen=True, eq=False)
class Mode:
    """An eigenpair K x = lambda M x, with x normalised to x . M x = 1.

    Parameters
    ----------
    eigenvalue
        lambda [N/mm^4] (stiffness per unit thickness over area).
    vector
        x, zero at the constrained components.
    weighted
        M x, so that overlaps with other vectors are plain dot products.
    """

    eigenvalue: float
    vector: PETSc.Vec
    weighted: PETSc.Vec

    def overlap(self, other: PETSc.Vec) -> float:
        """x . M other; its size is at most 1 if ``other`` is normalised likewise."""
        return float(self.weighted.dot(other))

    def reversed(self) -> Mode:
        """The same mode with the opposite sign."""
        return Mode(self.eigenvalue, -self.vector, -self.weighted)


class _Solve:
    """A preconditioner that is the exact inverse: the factor at hand."""

    def __init__(self, factor: Factor) -> None:
        self._factor = factor

    def apply(self, _: Any, rhs: PETSc.Vec, solution: PETSc.Vec) -> None:
        self._factor.solve(rhs).copy(solution)


def modes_nearest_zero(
    stiffness: PETSc.Mat, factor: Factor, mass: PETSc.Mat, count: int
) -> list[Mode]:
    """The ``count`` modes whose eigenvalues are nearest to zero, by ascending eigenvalue.

    Shift-and-invert Lanczos about zero with the factor that is there already, so no further
    factorisation is needed. Deterministic: the start vector is fixed.

    Parameters
    ----------
    stiffness, factor
        Tangent stiffness and its factor.
    mass
        Mass matrix with zero rows at the constrained components.
    count
        Number of modes wanted; at least as many are returned unless the problem is smaller.
    """
    solver = SLEPc.EPS().create(mass.comm)
    solver.setOperators(stiffness, mass)
    solver.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    transform = solver.getST()
    transform.setType(SLEPc.ST.Type.SINVERT)
    ksp = transform.getKSP()
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.getPC().setType(PETSc.PC.Type.PYTHON)
    ksp.getPC().setPythonContext(_Solve(factor))
    solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    solver.setTarget(0.0)
    solver.setDimensions(count)
    solver.setTolerances(1e-8, 200)
    solver.setPurify(False)  # the start vector is in the range of K^-1 M already
    start = mass.createVecRight()
    first, last = start.getOwnershipRange()
    start.array[:] = [((k * 7919) % 1009) / 1009.0 - 0.5 for k in range(first, last)]
    solver.setInitialSpace([factor.solve(mass * start)])
    solver.solve()
    modes = [_mode(solver, mass, k) for k in range(solver.getConverged())]
    return sorted(modes, key=lambda mode: mode.eigenvalue)


def _mode(solver: Any, mass: PETSc.Mat, k: int) -> Mode:
    vector = mass.createVecRight()
    eigenvalue = solver.getEigenpair(k, vector).real
    weighted = mass * vector
    norm = vector.dot(weighted) ** 0.5
    vector.scale(1.0 / norm)
    weighted.scale(1.0 / norm)
    return Mode(float(eigenvalue), vector, weighted)
