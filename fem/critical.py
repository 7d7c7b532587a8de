"""The first critical point of a path: where the critical eigenvalue is zero, and the proof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from modeharvest.fem.continuation import MODES, State, Walker, along, interpolate
from modeharvest.fem.stability import Mode

_SEARCHES = 20  # equilibria tried on the way to one critical point
_ZERO = 1e-3  # of the eigenvalue at the unstable state: so small it has to become


@dataclass(frozen=True, eq=False)
class Critical:
    """The first critical point of the primary path.

    Parameters
    ----------
    strain
        Critical nominal strain [-].
    u
        Displacement there.
    modes
        The modes whose eigenvalues are nearest to zero, the critical one(s) first.
    eigenvalues
        (strain [-], eigenvalue [N/mm^4]) of the critical mode wherever it was computed.
    below, above
        Negative pivots at strain - tolerance and strain + tolerance: the proof.
    """

    strain: float
    u: PETSc.Vec
    modes: list[Mode]
    eigenvalues: list[tuple[float, float]]
    below: int
    above: int


def locate_critical(walker: Walker, low: State, high: State) -> Critical | None:
    """The first critical point between a stable state and the unstable one reached last.

    Interpolates the critical eigenvalue between equilibria, within the bracket that the
    inertia gives. Where the inertia below the point found is not zero, another mode
    became critical earlier, and that one is looked for. None if an equilibrium in
    between can't be found, or if no eigenvalue passes zero: then the two states are not on
    one path.
    """
    modes = walker.modes
    for _ in range(MODES):
        found = _approach(walker, low, high, modes)
        if found is None:
            return None
        low, critical, below = found
        (_, first), (_, last) = critical.eigenvalues[0], critical.eigenvalues[-1]
        if abs(last) > _ZERO * abs(first):
            return None
        if below is None or below.negative_pivots == 0:
            return critical
        high, modes = below, walker.modes
    return None


def _approach(
    walker: Walker, low: State, high: State, modes: list[Mode]
) -> tuple[State, Critical, State | None] | None:
    """A critical point between the states, the last stable state, the one just below it.

    ``modes`` are those at ``high``; afterwards ``walker.modes`` are those just below.
    """
    narrowed = _with_negative_mode(walker, low, high, modes)
    if narrowed is None:
        return None
    low, high, modes = narrowed
    estimate, critical = _first_crossing(walker, low, high, modes)
    history = [(high.strain, critical.eigenvalue)]
    state = high
    for k in range(_SEARCHES):
        walker.progress(k, 6, "critical point")
        if not low.strain < estimate < high.strain:  # it followed a mode that is later
            estimate, critical = _first_crossing(walker, low, high, modes)
            history = [(high.strain, critical.eigenvalue)]
        if not low.strain < estimate < high.strain:
            estimate = 0.5 * (low.strain + high.strain)
        found = walker.equilibrium(estimate, interpolate(low, high, estimate))
        if found is None:
            return None
        state, nearby = found, walker.modes
        critical = max(nearby, key=lambda mode: abs(mode.overlap(critical.vector)))
        history.append((state.strain, critical.eigenvalue))
        if state.negative_pivots:
            high, modes = state, nearby if _has_negative(nearby) else modes
        else:
            low = state
        previous, estimate = estimate, _root(history)
        if abs(estimate - previous) < walker.options.critical_tolerance:
            break
    return low, *_prove(walker, estimate, state, nearby, history)


def _with_negative_mode(
    walker: Walker, low: State, high: State, modes: list[Mode]
) -> tuple[State, State, list[Mode]] | None:
    """The bracket, halved until the modes at its end tell which one is negative there.

    A mode that is just critical hides those further from zero: next to its inverse eigenvalue,
    theirs are lost in the eigensolver's tolerance.
    """
    while not _has_negative(modes):
        if high.strain - low.strain < walker.options.critical_tolerance:
            return None
        strain = 0.5 * (low.strain + high.strain)
        state = walker.equilibrium(strain, interpolate(low, high, strain))
        if state is None:
            return None
        if state.negative_pivots:
            high, modes = state, walker.modes
        else:
            low = state
    return low, high, modes


def _has_negative(modes: list[Mode]) -> bool:
    return any(mode.eigenvalue < 0 for mode in modes)


def _first_crossing(
    walker: Walker, low: State, high: State, modes: list[Mode]
) -> tuple[float, Mode]:
    """Of the modes negative at ``high``: where the first one crosses zero, and which.

    At ``low`` the eigenvalue is estimated by the mode's Rayleigh quotient.
    """
    stiffness = walker.structure.stiffness(low.u)
    crossings = []
    for mode in (m for m in modes if m.eigenvalue < 0):
        quotient = float(mode.vector.dot(stiffness * mode.vector))
        points = [(low.strain, quotient), (high.strain, mode.eigenvalue)]
        crossings.append((_root(points), mode))
    return min(crossings, key=lambda crossing: crossing[0])


def _prove(
    walker: Walker,
    strain: float,
    near: State,
    modes: list[Mode],
    history: list[tuple[float, float]],
) -> tuple[Critical, State | None]:
    """The inertia a tolerance above and below the critical strain; the state below."""
    tolerance = walker.options.critical_tolerance
    above, below = (
        walker.equilibrium(strain + side, along(near, strain + side))
        for side in (tolerance, -tolerance)
    )
    counts = (-1 if state is None else state.negative_pivots for state in (below, above))
    modes = sorted(modes, key=lambda mode: abs(mode.eigenvalue))
    return Critical(strain, along(near, strain), modes, history, *counts), below


def _root(points: Sequence[tuple[float, float]]) -> float:
    """Strain of zero eigenvalue by inverse interpolation through the last three points."""
    strains, values = (np.array(column) for column in zip(*points[-3:], strict=True))
    if len(strains) == 1:
        return float(strains[0])
    weights = [
        np.prod([values[j] / (values[j] - values[i]) for j in range(len(values)) if j != i])
        for i in range(len(values))
    ]
    return float(np.dot(weights, strains))
