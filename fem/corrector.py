"""Newton's method back to equilibrium, with as few factorisations as it takes.

A solve with a factor that is there costs a twentieth of a new factorisation, so the tangent
is kept ("chord" iterations) as long as it makes the residual shrink fast enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from petsc4py import PETSc

from modeharvest.fem.equilibrium import Factor, Structure

_SHRINKS = 0.35  # a chord step that leaves more than this of the residual calls for a new factor
_MAX_FACTORS = 8
_MAX_ITERATIONS = 60
# The residual must be smaller than what a change of the nominal strain by this would make.
STRAIN_TOLERANCE = 1e-11


class Outcome(Enum):
    """Why a Newton iteration ended; the value says it in words."""

    CONVERGED = "the residual is below the tolerance"
    DIVERGED = "the residual kept growing or is not a number"
    SLOW = "the residual did not fall below the tolerance in the iterations allowed"


@dataclass(frozen=True, eq=False)
class Constraint:
    """The one equation that picks a point of the path: weights . (u - origin) = amplitude.

    The alternative, used where the constraint is None, is to prescribe the strain.
    """

    weights: PETSc.Vec
    origin: PETSc.Vec
    amplitude: float

    def value(self, u: PETSc.Vec) -> float:
        """weights . (u - origin) - amplitude."""
        return float(self.weights.dot(u) - self.weights.dot(self.origin)) - self.amplitude


@dataclass(frozen=True, eq=False)
class Correction:
    """Where Newton's method arrived: displacement, nominal strain, and why it stopped."""

    u: PETSc.Vec
    strain: float
    outcome: Outcome


def correct(
    structure: Structure,
    guess: PETSc.Vec,
    strain: float,
    factor: Factor | None = None,
    constraint: Constraint | None = None,
) -> Correction:
    """Find the equilibrium near ``guess``.

    Parameters
    ----------
    structure
        What is to be in equilibrium.
    guess
        Start (left as it is); its constrained components are set from ``strain``.
    strain
        Nominal strain: prescribed, or with a constraint the start of it.
    factor
        Factor of the tangent at a state nearby, if there is one.
    constraint
        Prescribe an amplitude instead of the strain.
    """
    u = guess.copy()
    structure.prescribe(u, strain)
    solver = factor
    tangent = None
    previous, factors = math.inf, 0
    for _ in range(_MAX_ITERATIONS):
        residual = structure.residual(u)
        load = structure.load(u)
        miss = 0.0 if constraint is None else constraint.value(u)
        size = residual.norm()
        if not math.isfinite(size):
            return Correction(u, strain, Outcome.DIVERGED)
        if size <= STRAIN_TOLERANCE * load.norm() and abs(miss) <= 1e-9:
            return Correction(u, strain, Outcome.CONVERGED)
        if solver is None or size > _SHRINKS * previous:
            if factors == _MAX_FACTORS or (factors > 2 and size > 2.0 * previous):
                return Correction(u, strain, Outcome.DIVERGED)
            solver, tangent = structure.factor(u), None
            factors += 1
        previous = size
        step = solver.solve(residual)
        step.scale(-1.0)
        if constraint is not None:
            if tangent is None:
                tangent = path_tangent(structure, solver, load)
            along = float(constraint.weights.dot(tangent))
            change = -(miss + float(constraint.weights.dot(step))) / along
            step.axpy(change, tangent)
            strain += change
        u.axpy(1.0, step)
        structure.prescribe(u, strain)
    return Correction(u, strain, Outcome.SLOW)


def path_tangent(structure: Structure, factor: Factor, load: PETSc.Vec) -> PETSc.Vec:
    """du/d(strain) along the equilibrium path [mm], constrained components included."""
    tangent = factor.solve(load)
    tangent.scale(-1.0)
    structure.prescribe(tangent, 1.0)
    return tangent
