"""The branch that leaves the primary path at the critical point, as a function of its mode.

The mode's amplitude is prescribed and the strain is an unknown: that system is regular at the
pitchfork itself. :func:`follow_branch` meets given strains exactly, under prescribed strain;
:func:`follow_to_pattern` ends where the pattern has a given amplitude.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from petsc4py import PETSc

from modeharvest.fem.path.continuation import PathFollower, State
from modeharvest.fem.path.critical import Critical
from modeharvest.fem.path.newton import Constraint
from modeharvest.fem.path.predictor import BranchPoint, amplitude_at, load_at, value_at
from modeharvest.util.arrays import FloatArray


def follow_branch(
    follower: PathFollower, critical: Critical, targets: Sequence[float], sign: int, length: float
) -> list[State]:
    """States on the bifurcated branch at the ``targets`` (ascending strains).

    One for each target; fewer if the branch could not be followed that far. ``sign``, +1 or -1,
    is which of the two branches, ``length`` what ``first_amplitude`` refers to, the pitch [mm].
    """
    weights, start = _start(follower, critical, sign)
    points = [start]
    found: list[State] = []
    shortest = 0.1 * follower.options.first_amplitude * length
    reach = follower.options.first_amplitude * length  # the largest amplitude to try next
    follower.linearisation = None
    while len(found) < len(targets):
        target, amplitude = targets[len(found)], reach
        is_near = load_at(points, reach) >= target
        if is_near:
            before = points[-1] if points[-1].load < target else points[-2]  # stepped beyond it
            amplitude = amplitude_at(points, target, before.amplitude, reach)
            state = follower.equilibrium(target, value_at(points, amplitude))
        else:
            strain, guess = load_at(points, amplitude), value_at(points, amplitude)
            constraint = Constraint(weights, critical.u, amplitude)
            state = follower.equilibrium(strain, guess, constraint, with_modes=False)
        if state is not None:
            reached = float(weights.dot(state.u) - weights.dot(critical.u))
        # Under prescribed strain Newton may fall back to the primary path.
        if state is None or reached < 0.2 * amplitude:
            reach = 0.5 * (points[-1].amplitude + amplitude)
            if reach - points[-1].amplitude < shortest:
                return found
            follower.linearisation = None  # it may be that of the state refused
            continue
        points.append(_point(state, weights, reached))
        reach = follower.options.growth * reached
        if is_near:
            found.append(state)
            follower.progress(state.strain, targets[-1], "buckled branch")
    return found


PATTERN_TOLERANCE = 0.02
"""How near to the target amplitude is near enough [-]."""
_FIRST, _SHORTEST = 0.25, 0.01  # steps along the branch, in shares of the target amplitude


def follow_to_pattern(
    follower: PathFollower,
    critical: Critical,
    measure: Callable[[FloatArray], float],
    target: float,
) -> tuple[State | None, float]:
    """Follow a branch, which may turn back, until its pattern has a given amplitude.

    ``measure`` is the amplitude in nodal displacements (n, 2), ``target`` that to reach [mm].
    Returns the last state, None if there is none, and the pattern's amplitude there [mm].
    """
    weights, start = _start(follower, critical)
    points, step, shortest = [start], _FIRST * target, _SHORTEST * target
    state, reached = None, 0.0
    while abs(step) > shortest:
        amplitude = points[-1].amplitude + step
        constraint = Constraint(weights, critical.u, amplitude)
        strain, guess = load_at(points, amplitude), value_at(points, amplitude)
        found = follower.equilibrium(strain, guess, constraint)
        if found is None:
            step, follower.linearisation = 0.5 * step, None  # it may belong to the failed state
            continue
        points.append(_point(found, weights, amplitude))
        state, reached = found, measure(follower.structure.nodal(found.u))
        if abs(reached / target - 1.0) < PATTERN_TOLERANCE:
            break
        step = amplitude * float(np.clip(target / reached - 1.0, -0.5, 1.0))
    return state, reached


def _start(
    follower: PathFollower, critical: Critical, sign: int = 1
) -> tuple[PETSc.Vec, BranchPoint]:
    """Weights of the amplitude, the largest displacement in the mode, and the branch's start."""
    mode = critical.modes[0]
    largest = sign * follower.structure.largest(mode.vector)
    start = BranchPoint(0.0, critical.strain, 0.0, critical.u, (1.0 / largest) * mode.vector)
    return largest * mode.weighted, start


def _point(state: State, weights: PETSc.Vec, amplitude: float) -> BranchPoint:
    strain_rate = 1.0 / float(weights.dot(state.tangent))
    return BranchPoint(amplitude, state.strain, strain_rate, state.u, strain_rate * state.tangent)
