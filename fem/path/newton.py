"""Newton's method for equilibrium, with as few factorisations as possible.

An iteration with an existing factor costs an eighth of a new factorisation, so the tangent
is kept ("chord" iterations) as long as that is faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from petsc4py import PETSc

from modeharvest.fem.path.equilibrium import Structure
from modeharvest.fem.path.factor import BodyFactor

_PATIENCE = 12  # expected further chord iterations up to which a new factor doesn't pay
_MAX_FACTORS = 8
_SMALLEST_SHARE = 1 / 64  # smallest fraction of a Newton step before giving up
_MAX_ITERATIONS = 60
# The residual must be smaller than that of a change of the nominal strain by this.
STRAIN_TOLERANCE = 1e-11


@dataclass(frozen=True, eq=False)
class Constraint:
    """Defines a point of the path instead of a strain: weights . (u - origin) = amplitude."""

    weights: PETSc.Vec
    origin: PETSc.Vec
    amplitude: float

    def value(self, u: PETSc.Vec) -> float:
        """weights . (u - origin) - amplitude."""
        return float(self.weights.dot(u) - self.weights.dot(self.origin)) - self.amplitude


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Linearised response of the structure at an equilibrium, used for nearby states, too."""

    factor: BodyFactor
    """Factor of the tangent stiffness."""
    tangent: PETSc.Vec
    """du/d(strain) along the path [mm]."""
    load_size: float
    """Norm of ``Structure.load`` [N/mm]."""


def correct(
    structure: Structure,
    guess: PETSc.Vec,
    strain: float,
    near: Linearisation | None = None,
    constraint: Constraint | None = None,
) -> NewtonIteration | None:
    """The converged iteration at the equilibrium near ``guess``; None if it doesn't converge.

    ``guess`` isn't modified. Constrained components follow from ``strain``, the prescribed nominal
    strain or, with a constraint, its initial guess. ``near``: linearisation of a nearby state.
    """
    iteration = NewtonIteration(structure, guess, strain, near, constraint)
    for _ in range(_MAX_ITERATIONS):
        iteration.evaluate()
        if iteration.is_solved:
            return iteration
        if not iteration.advance():
            break
    return None


class NewtonIteration:
    """State of a Newton iteration: current ``u`` and ``strain``, and the step that led there.

    After convergence, ``load`` is that of ``u``.

    A step is assessed by the next step with the same factor, which measures the error in mm
    (natural monotonicity: Deuflhard, Newton Methods for Nonlinear Problems, Springer 2011,
    section 2.1); residuals, in contrast, are dominated by stiff deformations.
    """

    def __init__(
        self,
        structure: Structure,
        guess: PETSc.Vec,
        strain: float,
        near: Linearisation | None,
        constraint: Constraint | None,
    ) -> None:
        self.structure, self.constraint = structure, constraint
        self.u, self.strain = guess.copy(), strain
        structure.prescribe(self.u, strain)
        self.factor: BodyFactor | None = None
        self.load: PETSc.Vec | None = None
        if near is None:
            self._weigh()
        else:
            self.factor, self.tangent = near.factor, near.tangent
            self.small = STRAIN_TOLERANCE * near.load_size
        self.factors = 0
        self.last: _NewtonStep | None = None

    def evaluate(self) -> None:
        """Compute the residual and the constraint's violation at the current state."""
        self.residual = self.structure.residual(self.u)
        self.miss = 0.0 if self.constraint is None else self.constraint.value(self.u)
        self.size = float(self.residual.norm())

    @property
    def is_solved(self) -> bool:
        """Whether the residual and the constraint are within tolerance."""
        if not (self.size <= self.small and abs(self.miss) <= 1e-9):
            return False
        self._weigh()  # the tolerance was that of a nearby state
        return self.size <= self.small

    def _weigh(self) -> None:
        """Compute the load at the current state, which sets the tolerance of the residual."""
        self.load = self.structure.load(self.u)
        self.small = STRAIN_TOLERANCE * float(self.load.norm())

    def advance(self) -> bool:
        """Take the next step, with a new factor if that pays; False to give up."""
        last, step = self.last, None
        if self.factor is not None and math.isfinite(self.size):
            step = self._step(is_fresh=False)
        rate = 0.0 if last is None else math.inf
        if last is not None and step is not None:
            rate = step.length / last.length
        if last is not None and not rate < 1.0:
            self.u, self.strain = last.start.copy(), last.strain
            if last.is_fresh:
                step = replace(last, share=0.5 * last.share)
                if step.share < _SMALLEST_SHARE:
                    return False
            else:
                self.evaluate()
                step = None
        elif self._iterations_left(rate) > _PATIENCE:
            step = None
        if step is None:
            if self.factors == _MAX_FACTORS or not math.isfinite(self.size):
                return False
            self.factor = self.structure.factor(self.u)
            self.factors += 1
            if self.constraint is not None:
                self._weigh()
                self.tangent = path_tangent(self.structure, self.factor, self.load)
            step = self._step(is_fresh=True)
        self.u, self.last = step.start.copy(), step
        self.u.axpy(step.share, step.direction)
        self.strain = step.strain + step.share * step.change
        self.structure.prescribe(self.u, self.strain)
        return True

    def _iterations_left(self, rate: float) -> float:
        """Expected number of further iterations if each reduces the error by ``rate``."""
        left = max(math.log(self.size / self.small), 0.0)
        return left / -math.log(rate) if rate > 0.0 else 0.0

    def _step(self, is_fresh: bool) -> _NewtonStep:
        """The Newton step with the current factor, subject to the constraint if there is one."""
        assert self.factor is not None
        step, change = self.factor.solve(self.residual), 0.0
        step.scale(-1.0)
        if self.constraint is not None:
            weights = self.constraint.weights
            change = -(self.miss + float(weights.dot(step))) / float(weights.dot(self.tangent))
            step.axpy(change, self.tangent)
        return _NewtonStep(self.u, self.strain, step, change, float(step.norm()), is_fresh)


@dataclass(frozen=True, eq=False)
class _NewtonStep:
    """A step from a state, and whether the tangent was factorised at that state."""

    start: PETSc.Vec
    strain: float
    direction: PETSc.Vec
    change: float
    length: float
    is_fresh: bool
    share: float = 1.0


def path_tangent(structure: Structure, factor: BodyFactor, load: PETSc.Vec) -> PETSc.Vec:
    """du/d(strain) along the equilibrium path [mm], including constrained components."""
    tangent = factor.solve(load)
    tangent.scale(-1.0)
    structure.prescribe(tangent, 1.0)
    return tangent
