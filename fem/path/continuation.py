"""Continuation of a path: predictors by tangent or cubic, and the primary path by nominal strain.

A predictor extrapolates the tangent of one point, or the cubic through two; ``newton`` corrects.
On a mesh with the specimen's symmetries the first bifurcation is a pitchfork: the primary path
keeps the symmetry and goes on, unstable; two branches that break it leave sideways
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
    """Weights of value and slope at ``a``, value and slope at ``b``."""
    h = b - a
    t = (at - a) / h
    before, after = (1 - t) ** 2, t**2
    return (1 + 2 * t) * before, h * t * before, after * (3 - 2 * t), h * after * (t - 1)


def extrapolate(points: Sequence[tuple[float, Any, Any]], at: float) -> Any:
    """The value at a parameter, from (parameter, value, rate) of one point or of the last two.

    Values may be numbers, arrays or PETSc vectors: anything with sums and multiples.
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
        if hasattr(total, "axpy"):  # PETSc's, in place
            total.axpy(weight, value)
        else:
            total = total + weight * value
    return total


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch by its mode's amplitude; the rates are derivatives by that."""

    amplitude: float
    """[mm]."""
    load: float
    """[-]."""
    load_rate: float
    value: Any
    """Of the state, such as displacements [mm]."""
    rate: Any


def load_at(points: Sequence[BranchPoint], amplitude: float) -> float:
    """The load expected at an amplitude, from one point or the last two."""
    known = [(p.amplitude, p.load, p.load_rate) for p in points[-2:]]
    return float(extrapolate(known, amplitude))


def value_at(points: Sequence[BranchPoint], amplitude: float) -> Any:
    """The state expected at an amplitude, from one point or the last two."""
    return extrapolate([(p.amplitude, p.value, p.rate) for p in points[-2:]], amplitude)


def amplitude_at(points: Sequence[BranchPoint], load: float, low: float, high: float) -> float:
    """Where ``load_at`` meets a load that lies between its values at two amplitudes."""
    return float(brentq(lambda amplitude: load_at(points, amplitude) - load, low, high))


_MISS = 0.2  # of a step, by which a prediction may be off on a path without a bifurcation
_STRETCH = 0.1  # of a step, by which steps may be longer if one is saved
_MODES = 3  # computed, or all that are negative and one more
_RESIDUAL = 3e-3  # of modes: a hundred thousandth of their eigenvalues


@dataclass(frozen=True, eq=False)
class State:
    """An equilibrium state and its stability."""

    strain: float
    """Nominal [-]."""
    u: PETSc.Vec
    """Displacement [mm]."""
    tangent: PETSc.Vec
    """du/d(strain) [mm]."""
    negative_pivots: int
    eigenvalues: tuple[float, ...] = ()
    """The lowest ones of the tangent stiffness [N/mm^4], if any were computed."""


@dataclass(eq=False)
class PathFollower:
    """Follows the paths of one structure; the last state's factor serves the next step."""

    structure: Structure
    options: PathOptions = field(default_factory=PathOptions)
    progress: Progress = silent
    linearisation: Linearisation | None = None
    modes: list[Mode] = field(default_factory=list)
    """Both of the state found last; the modes are its lowest ones."""

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

        None if Newton does not get there, or gets to a state with a reversed element.
        """
        found = correct(self.structure, guess, strain, self.linearisation, constraint)
        if found is None or self.structure.smallest_jacobian(found.u) <= 0.0:
            self.linearisation = None  # it may be that of a wrong state
            return None
        return self._settle(found.u, found.strain, found.load, with_modes)

    def _settle(
        self, u: PETSc.Vec, strain: float, load: PETSc.Vec, with_modes: bool = True
    ) -> State:
        """Factorise at a converged equilibrium: its inertia, modes, and rate along the path."""
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
        """Extend ``states`` through all ``targets`` (ascending strains), each met exactly.

        False where no step down to 1e-5 of strain converges.

        states, targets : equilibria so far, at least one; targets already passed are left out.
        until_unstable : stop after the first state with negative pivots.
        refuse_unstable : take a step that arrives at an unstable state, or far from where it was
            expected, for a slip off a stable path (that of an imperfect specimen) and shorten it.
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
                    self.linearisation = None  # it may be that of the state refused
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
    """By the tangent of one state of a path, or the cubic through the last two."""
    return extrapolate([(s.strain, s.u, s.tangent) for s in states[-2:]], strain)
