"""Newton's method back to equilibrium, with as few factorisations as it takes.

An iteration with a factor that is there costs an eighth of a new factorisation, so the tangent
is kept ("chord" iterations) as long as that is the shorter way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from petsc4py import PETSc

from modeharvest.fem.equilibrium import Factor, Structure

_PATIENCE = 9  # chord iterations still to come for which a new factor isn't worth its cost
_MAX_FACTORS = 8
_SMALLEST_SHARE = 1 / 64  # of a Newton step, before giving up
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
    iterate = _Iterate(structure, guess, strain, factor, constraint)
    outcome = Outcome.SLOW
    for _ in range(_MAX_ITERATIONS):
        iterate.evaluate()
        if iterate.is_solved:
            outcome = Outcome.CONVERGED
            break
        if not iterate.prepare_step():
            outcome = Outcome.DIVERGED
            break
        iterate.step()
    return Correction(iterate.u, iterate.strain, outcome)


class _Iterate:
    """A Newton iteration under way: where it is, and how the last step went."""

    def __init__(
        self,
        structure: Structure,
        guess: PETSc.Vec,
        strain: float,
        factor: Factor | None,
        constraint: Constraint | None,
    ) -> None:
        self.structure, self.constraint, self.factor = structure, constraint, factor
        self.u, self.strain = guess.copy(), strain
        structure.prescribe(self.u, strain)
        self.tangent: PETSc.Vec | None = None
        self.small = self._tolerance()
        self.factors, self.is_fresh = 0, False
        self.best = math.inf  # smallest residual so far, before the last step
        self.last: tuple[PETSc.Vec, float] | None = None  # where the last step came from
        self.share = 1.0  # of the full step, where that was too long

    def evaluate(self) -> None:
        """Residual and the constraint's miss at the present state."""
        self.residual = self.structure.residual(self.u)
        self.miss = 0.0 if self.constraint is None else self.constraint.value(self.u)
        self.size = float(self.residual.norm())

    @property
    def is_solved(self) -> bool:
        """Whether the residual and the constraint are within tolerance."""
        if not (self.size <= self.small and abs(self.miss) <= 1e-9):
            return False
        self.small = self._tolerance()  # it was that of the guess
        return self.size <= self.small

    def _tolerance(self) -> float:
        return STRAIN_TOLERANCE * float(self.structure.load(self.u).norm())

    def prepare_step(self) -> bool:
        """Decide from where, and with which factor, to step next; False to give up.

        A step that did not lower the residual is taken back: it is halved if its factor was
        fresh, and tried with a fresh factor otherwise.
        """
        if self.last is not None and not self.size < self.best:
            self.u, self.strain = self.last[0].copy(), self.last[1]
            self.evaluate()
            if self.is_fresh:
                self.share *= 0.5
                return self.share > _SMALLEST_SHARE
            return self._refactor()
        is_slow = self.share == 1.0 and self._iterations_left > _PATIENCE
        self.share = 1.0
        if self.factor is None or is_slow:
            return self._refactor()
        self.is_fresh = False
        return True

    @property
    def _iterations_left(self) -> float:
        """How many more it will take at the rate of the last one; 0 before the first."""
        if math.isinf(self.best):
            return 0.0
        return math.log(self.size / self.small) / math.log(self.best / self.size)

    def _refactor(self) -> bool:
        if self.factors == _MAX_FACTORS or not math.isfinite(self.size):
            return False
        self.factor, self.tangent = self.structure.factor(self.u), None
        self.factors += 1
        self.is_fresh = True
        return True

    def step(self) -> None:
        """Move by (a share of) the Newton step, along the constraint if there is one."""
        assert self.factor is not None
        self.best, self.last = self.size, (self.u.copy(), self.strain)
        step, change = self.factor.solve(self.residual), 0.0
        step.scale(-1.0)
        if self.constraint is not None:
            if self.tangent is None:
                load = self.structure.load(self.u)
                self.tangent = path_tangent(self.structure, self.factor, load)
            weights = self.constraint.weights
            change = -(self.miss + float(weights.dot(step))) / float(weights.dot(self.tangent))
            step.axpy(change, self.tangent)
        self.u.axpy(self.share, step)
        self.strain += self.share * change
        self.structure.prescribe(self.u, self.strain)


def path_tangent(structure: Structure, factor: Factor, load: PETSc.Vec) -> PETSc.Vec:
    """du/d(strain) along the equilibrium path [mm], constrained components included."""
    tangent = factor.solve(load)
    tangent.scale(-1.0)
    structure.prescribe(tangent, 1.0)
    return tangent
