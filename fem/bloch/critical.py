"""The first critical point of an infinite lattice: over all loads and all wave vectors.

At every load the least stable wave is found: on a grid of the zone, from its best points on by
descent along the eigenvalue's gradient, and for waves much longer than the cell by the acoustic
tensor of the effective medium. The load at which the least value is zero is a root in one variable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import brentq

from modeharvest.fem.bloch.eigen import BlochWaves
from modeharvest.fem.bloch.zone import LeastStable, Zone, is_same
from modeharvest.fem.lattice.cell import CellPath, CellState
from modeharvest.fem.lattice.options import CENTRE, CriticalSearch, Wave
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

_DEGENERATE = 1e-5  # of the measure at rest: values that far apart belong to one set
_NOTHING = 1e-8  # of the moduli: what a mechanism's measure may be by rounding
_BESIDE = 1e-6  # of the critical load: where the proof is made


@dataclass(frozen=True, eq=False)
class LatticeCritical:
    """Where a lattice first becomes unstable, or how far it was found to be stable."""

    load: float
    """Critical load; without one, the last load reached [-]."""
    found: bool
    """Whether there is a critical point up to ``load``."""
    outcome: str
    """What was found, as a sentence."""
    least_stable: LeastStable
    """The least stable wave at ``load``."""
    waves: tuple[Wave, ...]
    """All waves of the grid that are critical at ``load``: a degenerate set has more than one. k
    and -k are the same mode and appear once. Empty for long waves."""
    state: CellState
    """The equilibrium at ``load``."""
    history: tuple[LeastStable, ...]
    """The least stable wave at every load looked at, by load."""
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    """Number of negative eigenvalues at each of ``waves`` a millionth of the load below and above
    the critical one: the proof."""
    unstable_before: tuple[Wave, ...] = ()
    """Waves of the grid that are unstable already a millionth of the load below: this is the first
    critical point if there are none. Not looked for where one wave was given."""


def first_critical(
    path: CellPath, search: CriticalSearch | None = None, progress: Progress = silent
) -> LatticeCritical:
    """The first critical load over all wave vectors, along the path of a primitive cell.

    InputError if the lattice is a mechanism: a wave costs no energy without load.
    """
    search = search or CriticalSearch()
    zone = Zone(path.cell, search.divisions)
    return _LoadSearch(path, search, zone, zone.least_stable, progress, zone.grid).run()


def critical_at(
    path: CellPath, wave: Wave, search: CriticalSearch | None = None, progress: Progress = silent
) -> LatticeCritical:
    """The first load at which the given wave is critical, whatever the others do.

    (0, 0) stands for the modes with the period of the cell, which may be an enlarged one. F̄ is
    fixed while a mode grows.
    """
    search = search or CriticalSearch()
    zone = Zone(path.cell, search.divisions)

    def measure(state: CellState) -> LeastStable:
        return zone.at(BlochWaves(path.cell, state), wave)

    return _LoadSearch(path, search, zone, measure, progress).run()


@dataclass(eq=False)
class _LoadSearch:
    path: CellPath
    search: CriticalSearch
    zone: Zone
    measure: Callable[[CellState], LeastStable]
    progress: Progress
    everywhere: Sequence[Wave] = ()
    history: dict[float, LeastStable] = field(default_factory=dict)

    def run(self) -> LatticeCritical:
        """Raise the load until a wave is unstable, then find the root."""
        largest, load, step = self.search.largest, 0.0, self.search.first_step
        previous = self._at_rest()
        while load < largest:
            self.progress(load, largest, "lattice")
            target = min(load + step, largest)
            least = self._measured(self.path.at(target))
            path_ends = least is None
            if least is None:  # somewhere between: the path ends before it
                target = max(state.load for state in self.path.states)
                least = self._measured(self.path.at(target))
            assert least is not None, "a state that is known"
            if least.value <= 0:
                return self._root(load, target)
            if path_ends:
                return self._stable(target, f"Newton's method did not converge beyond {target:.6g}")
            rate = (previous.value - least.value) / (target - load)
            ahead = 1.05 * least.value / rate if rate > 0 else math.inf
            step = min(max(ahead, 0.2 * step), 3.0 * step, self.search.largest_step)
            load, previous = target, least
        return self._stable(load, f"stable up to {load:.6g}, the largest load asked for")

    def _at_rest(self) -> LeastStable:
        state = self.path.at(0.0)
        least = self._measured(state)
        if state is None or least is None or least.value < _NOTHING * np.abs(state.moduli).max():
            wave = CENTRE if least is None else least.wave
            raise InputError(
                "lattice: expected a cell that is stable without load, got a mechanism: a wave of "
                f"phases {wave} rad costs no energy; connect the cell's parts"
            )
        return least

    def _measured(self, state: CellState | None) -> LeastStable | None:
        if state is not None:
            self.history[state.load] = self.measure(state)
        return None if state is None else self.history[state.load]

    def _root(self, low: float, high: float) -> LatticeCritical:
        """The critical point between a stable and an unstable load."""

        def value(load: float) -> float:
            known = self.history.get(load) or self._measured(self._near(low, load))
            assert known is not None
            return known.value

        load = float(brentq(value, low, high, xtol=self.search.tolerance, rtol=1e-14))
        value(load)
        least, state = self.history[load], self._near(low, load)
        waves = () if least.angle is not None else self._critical_waves(state, least)
        before, after = (self._near(low, load * (1.0 + side)) for side in (-_BESIDE, _BESIDE))
        below, above = self._unstable(before, waves), self._unstable(after, waves)
        earlier = BlochWaves(self.path.cell, before).unstable_among(self.everywhere)
        kind = "long waves" if least.angle is not None else f"{len(waves)} wave vector(s)"
        text = f"critical at {load:.6g} for {kind}"
        text += f"; but {len(earlier)} others are unstable before" if earlier else ""
        known = (waves, state, self._by_load(), below, above, earlier)
        return LatticeCritical(load, True, text, least, *known)

    def _near(self, low: float, load: float) -> CellState:
        """The equilibrium at a load near the critical one, reached from the stable side afresh.

        Not from the nearest state: if that is critical with the cell's own period, its
        tangent is singular, and Newton's method may slip onto the branch.
        """
        start = self.path.at(low)
        assert start is not None
        state = CellPath(self.path.cell, self.path.loading, [start]).at(load)
        if state is None:
            raise ArithmeticError(f"no equilibrium at the load {load}, between two that have one")
        return state

    def _stable(self, load: float, outcome: str) -> LatticeCritical:
        state = self.path.at(load)
        assert state is not None
        return LatticeCritical(load, False, outcome, self.history[load], (), state, self._by_load())

    def _critical_waves(self, state: CellState, least: LeastStable) -> tuple[Wave, ...]:
        """The least stable wave, and those of the grid that are critical with it."""
        if least.wave == CENTRE:
            return (CENTRE,)
        values = self.zone.on_grid(BlochWaves(self.path.cell, state))
        small = np.abs(values) < _DEGENERATE * self.history[0.0].value
        also = [wave for wave, is_small in zip(self.zone.grid, small, strict=True) if is_small]
        return (least.wave, *(wave for wave in also if not is_same(wave, least.wave)))

    def _unstable(self, state: CellState, critical: tuple[Wave, ...]) -> tuple[int, ...]:
        """Negative eigenvalues at the critical waves; at Γ the translations don't count."""
        waves = BlochWaves(self.path.cell, state)
        if CENTRE in critical:  # then it is the only one
            return (int(np.sum(waves.lowest(CENTRE, 4).eigenvalues < 0)),)
        return tuple(waves.unstable(wave) for wave in critical)

    def _by_load(self) -> tuple[LeastStable, ...]:
        return tuple(self.history[load] for load in sorted(self.history))
