"""The first bifurcation of a path: its critical point, located and proved, and its branches.

At the critical point the critical eigenvalue is zero; the inertia on both sides is the proof. A
branch from there is followed by its mode's amplitude, with the strain as an unknown: this system
is regular at the pitchfork itself. :func:`follow_branch` computes states at given strains exactly,
with prescribed strain; :func:`follow_to_pattern` ends where the pattern has a given amplitude.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem.path.continuation import (
    BranchPoint,
    PathFollower,
    State,
    amplitude_at,
    displacement_at,
    load_at,
    value_at,
)
from modeharvest.fem.path.newton import Constraint
from modeharvest.fem.path.stability import Mode
from modeharvest.util.arrays import FloatArray

_SEARCHES = 20  # most equilibria computed to locate a critical point
_NEAR = 1e-3  # strain distance below which the next estimate is accurate
_ZERO = 1e-3  # tolerance of the eigenvalue, relative to that at the unstable state


@dataclass(frozen=True, eq=False)
class Critical:
    """The first critical point of the primary path."""

    strain: float
    u: PETSc.Vec
    """Critical nominal strain [-], and the displacement there."""
    modes: list[Mode]
    """The modes whose eigenvalues are nearest to zero, the critical one(s) first."""
    eigenvalues: list[tuple[float, float]]
    """(strain [-], eigenvalue [N/mm^4]) of the critical mode wherever it was computed."""
    below: int
    above: int
    """Negative pivots at strain - tolerance and strain + tolerance: the proof."""


def locate_critical(follower: PathFollower, low: State, high: State) -> Critical | None:
    """The first critical point between a stable state and the unstable state reached last.

    The curvature x . K x of a normalised field exceeds the lowest eigenvalue by the square of its
    deviation from the mode. So the lowest strain where the curvature of a known mode passes zero on
    the interpolated path is an upper estimate; an equilibrium there gives better modes, with
    quadratic convergence. Two equilibria a tolerance below and above are the proof. If the inertia
    below isn't zero, another mode became critical before, and the search continues.

    None if an equilibrium in between can't be found, or if no eigenvalue passes zero: then the two
    states are not on one path.
    """
    search = _CriticalBracket(follower, low, high)
    for k in range(_SEARCHES):
        follower.progress(k, 4, "critical point")
        estimate = search.estimate()
        is_near = estimate is not None and abs(estimate - search.latest) < _NEAR
        if estimate is None or (k % 3 == 2 and not is_near):
            estimate = 0.5 * (search.low.strain + search.high.strain)
        if not is_near:
            if search.step(estimate) is None:
                return None
            continue
        critical = search.prove(estimate)
        if critical is not None or search.is_over:
            return critical
    return None


class _CriticalBracket:
    """A bracket of the first critical point, and the modes that may become critical in it.

    ``latest``: strain of the state reached last; ``is_over``: True if there is no critical point.
    """

    def __init__(self, follower: PathFollower, low: State, high: State) -> None:
        self.follower, self.low, self.high = follower, low, high
        self.latest, self.is_over = high.strain, False
        self._visited = [(high, follower.modes)]
        self._offs: list[float] = []  # distances of unstable states from the next estimates
        self._candidates = [mode for mode in follower.modes if mode.eigenvalue < 0]

    def estimate(self) -> float | None:
        """Strain at which the curvature of a candidate first passes zero; None if none does."""
        low, strain = self.low.strain, self.high.strain
        tolerance = 0.1 * self.follower.options.critical_tolerance
        curvature = cache(self._curvature)
        for mode in self._candidates:
            if curvature(strain, mode) < 0 < curvature(low, mode):
                strain = float(brentq(curvature, low, strain, (mode,), tolerance))
        if strain == self.high.strain:
            return None
        if self.latest == self.high.strain:
            self._offs.append(self.latest - strain)
            if len(self._offs) > 1:
                before, off = sum(self._offs[-2:]), self._offs[-1]
                strain -= off * (off / before) ** 2
        return strain

    def _curvature(self, strain: float, mode: Mode) -> float:
        u = displacement_at([self.low, self.high], strain)
        return self.follower.structure.curvature(u, mode.vector)

    def step(self, strain: float) -> State | None:
        """Compute an equilibrium, which becomes an end of the bracket; None if not found."""
        state = self.follower.equilibrium(strain, displacement_at([self.low, self.high], strain))
        if state is None:
            return None
        modes, self.latest = self.follower.modes, strain
        self._visited.append((state, modes))
        negative = [mode for mode in modes if mode.eigenvalue < 0]
        if state.negative_pivots:
            self.high, self._candidates = state, negative
        else:
            self.low, self._candidates = state, [*self._candidates, *modes[:1]]
        return state

    def prove(self, strain: float) -> Critical | None:
        """The critical point near a strain, if the inertia on both sides proves it the first.

        Otherwise the bracket is reduced, or ``is_over`` is set.
        """
        follower, tolerance = self.follower, self.follower.options.critical_tolerance
        below = self.step(strain - tolerance)
        if below is None or below.negative_pivots:
            self.is_over = below is None
            return None
        mode, *_ = modes = follower.modes
        guess = displacement_at([below], strain + tolerance)
        above = follower.equilibrium(strain + tolerance, guess, with_modes=False)
        if above is None or not above.negative_pivots:
            self.low, self.is_over = above or below, above is None
            return None
        beyond = follower.structure.curvature(above.u, mode.vector)
        values = []
        for state, known in self._visited:
            most_similar = max(known, key=lambda other: abs(mode.overlap(other.vector)))
            values.append((state.strain, most_similar.eigenvalue))
        values.append((above.strain, beyond))
        (last, final), (far, first) = values[-2], values[0]
        # Proportional to the distance, unless the two states are not on one path.
        share = 10 * tolerance / (far - last)
        if final > max(share, _ZERO) * abs(first):
            self.is_over = True
            return None
        if beyond < 0:
            strain = last + 2 * tolerance * final / (final - beyond)
        pivots = below.negative_pivots, above.negative_pivots
        return Critical(strain, displacement_at([below], strain), modes, values, *pivots)


def follow_branch(
    follower: PathFollower, critical: Critical, targets: Sequence[float], sign: int, length: float
) -> list[State]:
    """States on the bifurcated branch at the ``targets`` (ascending strains).

    One for each target; fewer if the branch could not be followed that far. ``sign`` (+1, -1)
    selects one of the two branches; ``length``: the pitch, for ``first_amplitude`` [mm].
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
            before = points[-1] if points[-1].load < target else points[-2]  # a step went beyond it
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
            follower.linearisation = None  # may belong to the refused state
            continue
        points.append(_point(state, weights, reached))
        reach = follower.options.growth * reached
        if is_near:
            found.append(state)
            follower.progress(state.strain, targets[-1], "buckled branch")
    return found


PATTERN_TOLERANCE = 0.02
"""Relative tolerance of the target amplitude [-]."""
_FIRST, _SHORTEST = 0.25, 0.01  # steps along the branch, over the target amplitude


def follow_to_pattern(
    follower: PathFollower,
    critical: Critical,
    measure: Callable[[FloatArray], float],
    target: float,
) -> tuple[State | None, float]:
    """Follow a branch, whose strain may turn back, until its pattern has a given amplitude.

    ``measure``: amplitude in nodal displacements (n, 2); ``target``: amplitude to be reached [mm].
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
            step, follower.linearisation = 0.5 * step, None  # may belong to the failed state
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
    """Weights that give the amplitude (largest displacement in the mode), and the first point."""
    mode = critical.modes[0]
    largest = sign * follower.structure.largest(mode.vector)
    start = BranchPoint(0.0, critical.strain, 0.0, critical.u, (1.0 / largest) * mode.vector)
    return largest * mode.weighted, start


def _point(state: State, weights: PETSc.Vec, amplitude: float) -> BranchPoint:
    strain_rate = 1.0 / float(weights.dot(state.tangent))
    return BranchPoint(amplitude, state.strain, strain_rate, state.u, strain_rate * state.tangent)
