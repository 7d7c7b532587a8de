"""The branch that leaves the primary path at the critical point, as a function of its mode.

The mode's amplitude is prescribed and the strain is an unknown: that system is regular at the
pitchfork itself. Snapshots are then met exactly under prescribed strain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem.continuation import State, Walker, combine, hermite_weights
from modeharvest.fem.corrector import Constraint
from modeharvest.fem.critical import Critical


def follow_branch(
    walker: Walker, critical: Critical, targets: Sequence[float], sign: int, length: float
) -> list[State]:
    """States on the bifurcated branch at the ``targets`` (ascending strains).

    Parameters
    ----------
    critical
        Where the branch leaves the primary path.
    targets
        Nominal strains above the critical one [-].
    sign
        +1 or -1: which of the two branches.
    length
        The length that ``first_amplitude`` refers to, e.g. the pitch [mm].

    Returns
    -------
    list of State
        One for each target; shorter if the branch could not be followed that far.
    """
    mode = critical.modes[0]
    unit = sign / walker.structure.largest(mode.vector)  # amplitude of 1 mm at the most
    weights = mode.weighted.copy()
    weights.scale(1.0 / unit)
    rate = mode.vector.copy()
    rate.scale(unit)
    points = [_BranchPoint(0.0, critical.strain, 0.0, critical.u, rate)]
    found: list[State] = []
    shortest = 0.1 * walker.options.first_amplitude * length
    reach = walker.options.first_amplitude * length  # the largest amplitude to try next
    walker.linearisation = None
    while len(found) < len(targets):
        target = targets[len(found)]
        wanted = _amplitude_at(points, target, reach)
        aimed = wanted <= reach
        if aimed:
            state = walker.equilibrium(target, _predict(points, wanted)[1])
        else:
            amplitude = min(wanted, reach)
            strain, guess = _predict(points, amplitude)
            constraint = Constraint(weights, critical.u, amplitude)
            state = walker.equilibrium(strain, guess, constraint, with_modes=False)
        point = None if state is None else _branch_point(state, weights, critical.u)
        # Under prescribed strain Newton may fall back to the primary path.
        if state is None or point is None or point.amplitude < 0.2 * min(wanted, reach):
            reach = 0.5 * (points[-1].amplitude + min(wanted, reach))
            if reach - points[-1].amplitude < shortest:
                return found
            walker.linearisation = None  # it may be that of the state refused
            continue
        points.append(point)
        reach = walker.options.growth * point.amplitude
        if aimed:
            found.append(state)
            walker.progress(state.strain, targets[-1], "buckled branch")
    return found


@dataclass(frozen=True, eq=False)
class _BranchPoint:
    """A point of the branch, seen as a function of the critical mode's amplitude [mm]."""

    amplitude: float
    strain: float
    strain_rate: float
    u: PETSc.Vec
    rate: PETSc.Vec


def _branch_point(state: State, weights: PETSc.Vec, origin: PETSc.Vec) -> _BranchPoint:
    amplitude = float(weights.dot(state.u) - weights.dot(origin))
    strain_rate = 1.0 / float(weights.dot(state.tangent))
    rate = state.tangent.copy()
    rate.scale(strain_rate)
    return _BranchPoint(amplitude, state.strain, strain_rate, state.u, rate)


def _predict(points: list[_BranchPoint], amplitude: float) -> tuple[float, PETSc.Vec]:
    """Strain and displacement at an amplitude, from the last two points of the branch."""
    if len(points) == 1:
        (p,) = points
        u = p.u.copy()
        u.axpy(amplitude - p.amplitude, p.rate)
        return p.strain, u
    p, q = points[-2:]
    weights = hermite_weights(p.amplitude, q.amplitude, amplitude)
    return _strain_at(points, amplitude), combine(weights, (p.u, p.rate, q.u, q.rate))


def _strain_at(points: list[_BranchPoint], amplitude: float) -> float:
    p, q = points[-2:]
    w = hermite_weights(p.amplitude, q.amplitude, amplitude)
    return w[0] * p.strain + w[1] * p.strain_rate + w[2] * q.strain + w[3] * q.strain_rate


def _amplitude_at(points: list[_BranchPoint], strain: float, reach: float) -> float:
    """The amplitude up to ``reach`` at which the branch is expected to meet ``strain``.

    Infinite if it is expected beyond.
    """
    if len(points) == 1 or _strain_at(points, reach) < strain:
        return np.inf
    here = points[-1].amplitude
    return float(brentq(lambda a: _strain_at(points, a) - strain, here, reach))
