"""The load path: primary branch, first critical point, the stable branch beyond it.

On a mesh with the specimen's symmetries the first bifurcation is a pitchfork: the primary
path keeps the symmetry and goes on, unstable; two branches that break it leave sideways. So
the primary path is followed by strain; the critical strain is where the critical eigenvalue,
interpolated between equilibria, is zero (and where the inertia proves to change); the branch
is entered by prescribing the amplitude of the critical mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem.corrector import Constraint, Outcome, correct, path_tangent
from modeharvest.fem.equilibrium import Factor, Structure
from modeharvest.fem.experiment import PathOptions
from modeharvest.fem.stability import Mode, modes_nearest_zero
from modeharvest.progress import Progress, silent

_SMALLEST_STEP = 1e-5  # of nominal strain
_MODES = 8  # followed near the critical point
_SEARCHES = 20  # equilibria on the way to it


@dataclass(frozen=True, eq=False)
class State:
    """An equilibrium state: strain, displacement, its rate along the path, stability.

    Parameters
    ----------
    strain
        Nominal strain [-].
    u, tangent
        Displacement and du/d(strain) [mm].
    negative_pivots
        Of the tangent stiffness there.
    eigenvalues
        The lowest ones [N/mm^4], ascending; empty where none were computed.
    """

    strain: float
    u: PETSc.Vec
    tangent: PETSc.Vec
    negative_pivots: int
    eigenvalues: tuple[float, ...] = ()


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


@dataclass(eq=False)
class Walker:
    """Follows the paths of one structure; the last state's factor serves the next step.

    ``factor`` and ``modes`` (those nearest to zero) belong to the state settled last.
    """

    structure: Structure
    options: PathOptions = field(default_factory=PathOptions)
    progress: Progress = silent
    factor: Factor | None = None
    modes: list[Mode] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.mass = self.structure.mass()

    # -- one equilibrium ----------------------------------------------------------------

    def start(self) -> State:
        """The undeformed state."""
        return self._settle(self.structure.zero(), 0.0)

    def equilibrium(
        self, strain: float, guess: PETSc.Vec, constraint: Constraint | None = None
    ) -> State | None:
        """The equilibrium near ``guess``, at ``strain`` or where the constraint holds.

        None if Newton does not get there, or gets to a state with a reversed element.
        """
        found = correct(self.structure, guess, strain, self.factor, constraint)
        if found.outcome is not Outcome.CONVERGED:
            return None
        if self.structure.smallest_jacobian(found.u) <= 0.0:
            return None
        return self._settle(found.u, found.strain)

    def _settle(self, u: PETSc.Vec, strain: float) -> State:
        """Factorise at a converged equilibrium: its inertia, and its rate along the path."""
        self.factor = self.structure.factor(u)
        tangent = path_tangent(self.structure, self.factor, self.structure.load(u))
        self.modes = modes_nearest_zero(self.structure.tangent, self.factor, self.mass, _MODES)
        eigenvalues = tuple(mode.eigenvalue for mode in self.modes)
        return State(strain, u, tangent, self.factor.negative_pivots, eigenvalues)

    # -- the primary path ---------------------------------------------------------------

    def primary(
        self,
        states: list[State],
        targets: Sequence[float],
        until_unstable: bool = False,
        refuse_unstable: bool = False,
    ) -> bool:
        """Extend ``states`` through all ``targets`` (ascending strains), each met exactly.

        Parameters
        ----------
        states
            Equilibria so far, at least one; the new ones are appended.
        targets
            Nominal strains to pass through [-]; those already passed are left out.
        until_unstable
            Stop after the first state with negative pivots.
        refuse_unstable
            Take a step that lands on an unstable state for a slip off a stable path (that of
            an imperfect specimen) and shorten it.

        Returns
        -------
        bool
            False where no step down to 1e-5 of strain converges.
        """
        step = self.options.first_step
        for target in (t for t in targets if t > states[-1].strain + 1e-12):
            while states[-1].strain < target - 1e-12:
                here = states[-1].strain
                pieces = max(1, int(np.ceil((target - here) / step - 1e-9)))
                strain = target if pieces == 1 else here + (target - here) / pieces
                state = self.equilibrium(strain, _extrapolate(states, strain))
                if state is None or (refuse_unstable and state.negative_pivots > 0):
                    self.factor = None  # it may belong to the failed state
                    step = 0.5 * (strain - here)
                    if step < _SMALLEST_STEP:
                        return False
                    continue
                states.append(state)
                step = min(1.5 * step, self.options.largest_step)
                self.progress(state.strain, targets[-1], "primary path")
                if until_unstable and state.negative_pivots > 0:
                    return True
        return True

    # -- the critical point -------------------------------------------------------------

    def locate_critical(self, low: State, high: State) -> Critical | None:
        """The first critical point between a stable state and the unstable one reached last.

        Interpolates the critical eigenvalue between equilibria, within the bracket that the
        inertia gives. Where the inertia below the point found is not zero, another mode
        became critical earlier, and that one is looked for. None if an equilibrium in
        between can't be found.
        """
        modes = self.modes
        for _ in range(_MODES):
            found = self._approach(low, high, modes)
            if found is None:
                return None
            low, critical, below = found
            if below is None or below.negative_pivots == 0:
                return critical
            high, modes = below, self.modes
        return None

    def _approach(
        self, low: State, high: State, modes: list[Mode]
    ) -> tuple[State, Critical, State | None] | None:
        """A critical point between the states, the last stable state, the one just below it.

        ``modes`` are those at ``high``; afterwards ``self.modes`` are those just below.
        """
        estimate, critical = self._first_crossing(low, high, modes)
        history = [(high.strain, critical.eigenvalue)]
        state = high
        for k in range(_SEARCHES):
            self.progress(k, 6, "critical point")
            if not low.strain < estimate < high.strain:  # it followed a mode that is later
                estimate, critical = self._first_crossing(low, high, modes)
                history = [(high.strain, critical.eigenvalue)]
            if not low.strain < estimate < high.strain:
                estimate = 0.5 * (low.strain + high.strain)
            found = self.equilibrium(estimate, _interpolate(low, high, estimate))
            if found is None:
                return None
            state, nearby = found, self.modes
            critical = max(nearby, key=lambda mode: abs(mode.overlap(critical.vector)))
            history.append((state.strain, critical.eigenvalue))
            if state.negative_pivots:
                high, modes = state, nearby
            else:
                low = state
            previous, estimate = estimate, _root(history)
            if abs(estimate - previous) < self.options.critical_tolerance:
                break
        return low, *self._prove(estimate, state, nearby, history)

    def _first_crossing(self, low: State, high: State, modes: list[Mode]) -> tuple[float, Mode]:
        """Of the modes negative at ``high``: where the first one crosses zero, and which.

        At ``low`` the eigenvalue is estimated by the mode's Rayleigh quotient.
        """
        stiffness = self.structure.stiffness(low.u)
        crossings = []
        for mode in (m for m in modes if m.eigenvalue < 0):
            quotient = float(mode.vector.dot(stiffness * mode.vector))
            points = [(low.strain, quotient), (high.strain, mode.eigenvalue)]
            crossings.append((_root(points), mode))
        return min(crossings, key=lambda crossing: crossing[0])

    def _prove(
        self, strain: float, near: State, modes: list[Mode], history: list[tuple[float, float]]
    ) -> tuple[Critical, State | None]:
        """The inertia a tolerance above and below the critical strain; the state below."""
        tolerance = self.options.critical_tolerance
        above, below = (
            self.equilibrium(strain + side, _along(near, strain + side))
            for side in (tolerance, -tolerance)
        )
        counts = (-1 if state is None else state.negative_pivots for state in (below, above))
        modes = sorted(modes, key=lambda mode: abs(mode.eigenvalue))
        return Critical(strain, _along(near, strain), modes, history, *counts), below

    # -- the branch ---------------------------------------------------------------------

    def branch(
        self, critical: Critical, targets: Sequence[float], sign: int, length: float
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
        unit = sign / self.structure.largest(mode.vector)  # amplitude of 1 mm at the most
        weights = mode.weighted.copy()
        weights.scale(1.0 / unit)
        rate = mode.vector.copy()
        rate.scale(unit)
        points = [_BranchPoint(0.0, critical.strain, 0.0, critical.u, rate)]
        found: list[State] = []
        shortest = 0.01 * self.options.first_amplitude * length
        reach = self.options.first_amplitude * length  # the largest amplitude to try next
        self.factor = None
        while len(found) < len(targets):
            target = targets[len(found)]
            wanted = _amplitude_at(points, target, reach)
            aimed = wanted <= reach
            if aimed:
                state = self.equilibrium(target, _predict(points, wanted)[1])
            else:
                amplitude = min(wanted, reach)
                strain, guess = _predict(points, amplitude)
                constraint = Constraint(weights, critical.u, amplitude)
                state = self.equilibrium(strain, guess, constraint)
            point = None if state is None else _branch_point(state, weights, critical.u)
            # Under prescribed strain Newton may fall back to the primary path.
            if state is None or point is None or point.amplitude < 0.2 * min(wanted, reach):
                reach = 0.5 * (points[-1].amplitude + min(wanted, reach))
                if reach - points[-1].amplitude < shortest:
                    return found
                self.factor = None  # it may belong to the failed state
                continue
            points.append(point)
            reach = self.options.growth * point.amplitude
            if aimed:
                found.append(state)
                self.progress(state.strain, targets[-1], "buckled branch")
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
    weights = _hermite(p.amplitude, q.amplitude, amplitude)
    return _strain_at(points, amplitude), _combine(weights, (p.u, p.rate, q.u, q.rate))


def _strain_at(points: list[_BranchPoint], amplitude: float) -> float:
    p, q = points[-2:]
    w = _hermite(p.amplitude, q.amplitude, amplitude)
    return w[0] * p.strain + w[1] * p.strain_rate + w[2] * q.strain + w[3] * q.strain_rate


def _amplitude_at(points: list[_BranchPoint], strain: float, reach: float) -> float:
    """The amplitude up to ``reach`` at which the branch is expected to meet ``strain``.

    Infinite if it is expected beyond.
    """
    if len(points) == 1 or _strain_at(points, reach) < strain:
        return np.inf
    here = points[-1].amplitude
    return float(brentq(lambda a: _strain_at(points, a) - strain, here, reach))


def _extrapolate(states: Sequence[State], strain: float) -> PETSc.Vec:
    if len(states) == 1:
        return _along(states[-1], strain)
    return _interpolate(states[-2], states[-1], strain)


def _interpolate(a: State, b: State, strain: float) -> PETSc.Vec:
    """Cubic Hermite interpolation (or extrapolation) between two states of a path."""
    return _combine(_hermite(a.strain, b.strain, strain), (a.u, a.tangent, b.u, b.tangent))


def _along(state: State, strain: float) -> PETSc.Vec:
    u = state.u.copy()
    u.axpy(strain - state.strain, state.tangent)
    return u


def _hermite(a: float, b: float, at: float) -> tuple[float, float, float, float]:
    """Weights of value and slope at ``a``, value and slope at ``b``."""
    h = b - a
    t = (at - a) / h
    return (
        (1 + 2 * t) * (1 - t) ** 2,
        h * t * (1 - t) ** 2,
        t**2 * (3 - 2 * t),
        h * t**2 * (t - 1),
    )


def _combine(weights: Sequence[float], vectors: Sequence[PETSc.Vec]) -> PETSc.Vec:
    result = vectors[0].copy()
    result.scale(weights[0])
    for weight, vector in zip(weights[1:], vectors[1:], strict=True):
        result.axpy(weight, vector)
    return result


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
