"""Continuation of a path: predictors by tangent or cubic, and the primary path by nominal strain.

A predictor extrapolates along the tangent of one point, or the cubic through two points; ``newton``
corrects. On a mesh with the specimen's symmetries, the first bifurcation is a pitchfork: the
primary path keeps the symmetry and continues, unstable; two branches that break it leave the path
(``bifurcation``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem.experiment import SMALLEST_STEP, PathOptions
from modeharvest.fem.path.equilibrium import Structure
from modeharvest.fem.path.newton import Constraint, Linearisation, correct, path_tangent
from modeharvest.fem.path.stability import Mode, lowest_modes
from modeharvest.util.progress import Progress, silent


def hermite_weights(a: float, b: float, at: float) -> tuple[float, float, float, float]:
    """Weights, for the value at ``at``, of value and slope at ``a``, and at ``b`` (Hermite)."""
    h = b - a
    t = (at - a) / h
    before, after = (1 - t) ** 2, t**2
    return (1 + 2 * t) * before, h * t * before, after * (3 - 2 * t), h * after * (t - 1)


def extrapolate(points: Sequence[tuple[float, Any, Any]], at: float) -> Any:
    """Extrapolate to a parameter from (parameter, value, rate) of one or of the last two points.

    Values may be numbers, arrays or PETSc vectors: anything that can be added and scaled.
    """
    b, value, rate = points[-1]
    if len(points) == 1:
        return _combined((1.0, float(at - b)), (value, rate))
    a, before, rate_before = points[-2]
    weights = hermite_weights(float(a), float(b), float(at))
    return _combined(weights, (before, rate_before, value, rate))


def _combined(weights: Sequence[float], values: Sequence[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        if hasattr(total, "axpy"):  # a PETSc vector, in place
            total.axpy(weight, value)
        else:
            total = total + weight * value
    return total


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch, parametrised by amplitude; rates are derivatives by the amplitude."""

    amplitude: float
    """Amplitude of the mode [mm]."""
    load: float
    """Load, such as the nominal strain [-]."""
    load_rate: float
    value: Any
    """The state, such as displacements [mm]."""
    rate: Any


def load_at(points: Sequence[BranchPoint], amplitude: float) -> float:
    """The load extrapolated to an amplitude, from one point or the last two."""
    known = [(p.amplitude, p.load, p.load_rate) for p in points[-2:]]
    return float(extrapolate(known, amplitude))


def value_at(points: Sequence[BranchPoint], amplitude: float) -> Any:
    """The state extrapolated to an amplitude, from one point or the last two."""
    return extrapolate([(p.amplitude, p.value, p.rate) for p in points[-2:]], amplitude)


def amplitude_at(points: Sequence[BranchPoint], load: float, low: float, high: float) -> float:
    """Amplitude between ``low`` and ``high`` at which ``load_at`` equals a given load."""
    return float(brentq(lambda amplitude: load_at(points, amplitude) - load, low, high))


_MISS = 0.2  # largest error of a prediction, over the step, on a path without bifurcation
_STRETCH = 0.1  # largest relative extension of steps if that saves a step
_MODES = 3  # number of modes computed, or all negative ones and one more
_RESIDUAL = 3e-3  # residual tolerance of modes; their eigenvalues then have errors of 1e-5


@dataclass(frozen=True, eq=False)
class State:
    """An equilibrium state and its stability."""

    strain: float
    """Nominal strain [-]."""
    u: PETSc.Vec
    """Displacement [mm]."""
    tangent: PETSc.Vec
    """du/d(strain) [mm]."""
    negative_pivots: int
    eigenvalues: tuple[float, ...] = ()
    """Lowest eigenvalues of the tangent stiffness [N/mm^4], if computed."""


@dataclass(eq=False)
class PathFollower:
    """Follows the paths of one structure; the last state's factor is reused in the next step."""

    structure: Structure
    options: PathOptions = field(default_factory=PathOptions)
    progress: Progress = silent
    linearisation: Linearisation | None = None
    modes: list[Mode] = field(default_factory=list)
    """Linearisation and lowest modes of the state found last."""

    def __post_init__(self) -> None:
        self.mass = self.structure.mass()

    def start(self) -> State:
        """The undeformed state."""
        u = self.structure.zero()
        return self._settle(u, 0.0, self.structure.load(u))

    def equilibrium(
        self,
        strain: float,
        guess: PETSc.Vec,
        constraint: Constraint | None = None,
        with_modes: bool = True,
    ) -> State | None:
        """The equilibrium near ``guess``, at ``strain`` or where the constraint holds.

        None if Newton's method doesn't converge, or converges to a state with inverted elements.
        """
        found = correct(self.structure, guess, strain, self.linearisation, constraint)
        if found is None or self.structure.smallest_jacobian(found.u) <= 0.0:
            self.linearisation = None  # may belong to a wrong state
            return None
        return self._settle(found.u, found.strain, found.load, with_modes)

    def _settle(
        self, u: PETSc.Vec, strain: float, load: PETSc.Vec, with_modes: bool = True
    ) -> State:
        """Factorise at a converged equilibrium; compute inertia, modes, rate along the path."""
        eigenvalues: tuple[float, ...] = ()
        factor = self.structure.factor(u)
        if with_modes:
            self.modes = lowest_modes(factor, self.mass, _MODES, self.modes, _RESIDUAL)
            eigenvalues = tuple(mode.eigenvalue for mode in self.modes)
        tangent = path_tangent(self.structure, factor, load)
        self.linearisation = Linearisation(factor, tangent, float(load.norm()))
        return State(strain, u, tangent, factor.negative_pivots, eigenvalues)

    def follow_primary(
        self,
        states: list[State],
        targets: Sequence[float],
        until_unstable: bool = False,
        refuse_unstable: bool = False,
    ) -> bool:
        """Extend ``states`` through all ``targets`` (ascending strains), each reached exactly.

        False if no step down to a strain of 1e-5 converges.

        states, targets : equilibria so far, at least one; targets already passed are ignored.
        until_unstable : stop after the first state with negative pivots.
        refuse_unstable : treat a step to an unstable state, or far from its prediction, as a slip
            off the stable path (of an imperfect specimen), and repeat it with a shorter step.
        """
        step = self.options.first_step
        for target in (t for t in targets if t > states[-1].strain + 1e-12):
            while states[-1].strain < target - 1e-12:
                here = states[-1].strain
                pieces = max(1, int(np.ceil((target - here) / step - _STRETCH)))
                strain = target if pieces == 1 else here + (target - here) / pieces
                guess = displacement_at(states, strain)
                state = self.equilibrium(strain, guess)
                if state is None or (refuse_unstable and _is_slip(states[-1], state, guess)):
                    self.linearisation = None  # may belong to the refused state
                    step = 0.5 * (strain - here)
                    if step < SMALLEST_STEP:
                        return False
                    continue
                states.append(state)
                step = min(1.5 * step, self.options.largest_step)
                self.progress(state.strain, targets[-1], "primary path")
                if until_unstable and state.negative_pivots > 0:
                    return True
        return True


def _is_slip(before: State, state: State, guess: PETSc.Vec) -> bool:
    step, miss = state.u - before.u, state.u - guess
    return bool(state.negative_pivots > 0 or miss.norm() > _MISS * step.norm())


def displacement_at(states: Sequence[State], strain: float) -> PETSc.Vec:
    """Displacement extrapolated along one state's tangent, or the cubic through the last two."""
    return extrapolate([(s.strain, s.u, s.tangent) for s in states[-2:]], strain)
