"""The first critical point of an infinite lattice: over all loads and all wave vectors.

At every load the least stable wave is found: on a grid of the zone, then by descent along the
eigenvalue's gradient from the best grid points, and for waves much longer than the cell by the
acoustic tensor of the effective medium. Once a wave is unstable, its critical load is found as a
root, and all waves are examined again at that load.

Wave vectors are phases (k . a1, k . a2) [rad]; k, -k and k plus 2 pi are the same mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import brentq, minimize

from modeharvest.fem.bloch.degenerate import Degeneracy, folded, is_same
from modeharvest.fem.bloch.eigen import BlochModes, BlochWaves, scan
from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.options import CENTRE, CriticalSearch, Wave, wave_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

_FIRST_STEP, _TOLERANCE = 1e-3, 1e-10  # first step of the load; tolerance of the critical load
_CANDIDATES = 3  # number of grid points from which to descend
_DEGENERATE = 1e-5  # of the measure at rest: smaller values at the critical load are critical too
_NOTHING = 1e-8  # of the moduli: a smaller measure at rest is rounding, the lattice a mechanism
_BESIDE = 1e-6  # of the critical load: distance at which the inertia is checked


@dataclass(frozen=True)
class LeastStable:
    """The wave nearest to instability at one load."""

    load: float
    value: float
    """Stability measure filling * lambda / |k|^2, with |k|^2 made periodic in k; for long waves its
    limit, the acoustic tensor's eigenvalue [MPa]. Negative: unstable."""
    wave: Wave
    """Phases [rad]; (0, 0) for long waves and for modes with the period of the cell."""
    angle: float | None = None
    """Direction of k for long waves [rad]; None otherwise."""


class Zone:
    """Stability over all waves, or some; even ``divisions`` have M and X on the grid."""

    def __init__(self, cell: PeriodicCell, divisions: int, only: Sequence[Wave] = ()) -> None:
        self.cell, self.only = cell, only
        inverse = np.linalg.inv(cell.cell.lattice)
        self._metric = inverse.T @ inverse  # |k|^2 = phases . metric . phases
        self._spacing = 2.0 * math.pi / divisions
        phases = [self._spacing * (n - (divisions - 1) // 2) for n in range(divisions)]
        points = [(p, q) for p in phases for q in phases if (p, q) != CENTRE]
        self.grid = [(p, q) for p, q in points if folded((p, q)) >= folded((-p, -q))]
        self.grid = list(only) or self.grid

    def least_stable(self, state: CellState) -> LeastStable:
        """The wave with the smallest measure in the whole zone."""
        waves = BlochWaves(self.cell, state)
        if self.only:
            return min((self.at(waves, wave) for wave in self.only), key=lambda one: one.value)
        value, angle = waves.long_wave()
        found = [LeastStable(state.load, value, CENTRE, angle), self.at(waves, CENTRE)]
        values = self.on_grid(waves)
        for k in np.argsort(values)[:_CANDIDATES]:
            value, wave = self._descend(waves, self.grid[k], float(values[k]))
            found.append(LeastStable(state.load, value, wave))
        return min(found, key=lambda least: least.value)

    def at(self, waves: BlochWaves, wave: Wave) -> LeastStable:
        """The measure at one wave vector."""
        value = float(waves.lowest(wave).eigenvalues[0])
        return LeastStable(waves.state.load, self.measure(wave, value), wave)

    def on_grid(self, waves: BlochWaves) -> FloatArray:
        """The measure at every point of ``grid`` [MPa]."""
        lowest = scan(waves, self.grid)[:, 0]
        pairs = zip(self.grid, lowest, strict=True)
        return np.array([self.measure(wave, float(value)) for wave, value in pairs])

    def measure(self, wave: Wave, eigenvalue: float) -> float:
        """filling * lambda / |k|^2 [MPa]; for modes with the cell's period |k|^2 is 4 / area."""
        squared = self._squared(wave)[0]
        squared = squared if squared > 1e-12 else 4.0 / self.cell.cell.area
        return self.cell.filling * eigenvalue / squared

    def _squared(self, wave: Wave) -> tuple[float, FloatArray]:
        """|k|^2 made periodic, with k_i k_j replaced by cosines; and its gradient."""
        g, mixed = self._metric, float(self._metric[0, 1])
        sign = -1.0 if mixed < 0 else 1.0
        weights = np.array([g[0, 0] - abs(mixed), g[1, 1] - abs(mixed), abs(mixed)])
        directions = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, sign]])
        phases = directions @ np.asarray(wave)
        gradient = (2.0 * weights * np.sin(phases)) @ directions
        return float(weights @ (2.0 - 2.0 * np.cos(phases))), gradient

    def _descend(self, waves: BlochWaves, start: Wave, value: float) -> tuple[float, Wave]:
        """A local minimum of the measure near a grid point with known value."""
        near: list[BlochModes] = []

        def measure(point: FloatArray) -> tuple[float, FloatArray]:
            wave = (float(point[0]), float(point[1]))
            modes = waves.lowest(wave, near=near[-1] if near else None, tolerance=1e-12)
            near[:] = [modes]
            squared, slope_of_squared = self._squared(wave)
            slope = waves.slope(modes) - modes.eigenvalues[0] * slope_of_squared / squared
            value = self.measure(wave, float(modes.eigenvalues[0]))
            return value, self.cell.filling * slope / squared

        # Start off the grid, as by symmetry a saddle there may look like a minimum, but closer
        # than the next points, one of which may be Γ.
        reach = 0.9 * self._spacing
        bounds = [(phase - reach, phase + reach) for phase in start]
        offset = np.add(start, [0.11, 0.07])
        found = minimize(measure, offset, jac=True, method="L-BFGS-B", bounds=bounds)
        wave = (float(found.x[0]), float(found.x[1]))
        # Prefer the grid point itself if it is as good: exactly M rather than nearly M.
        if found.fun < value - 1e-9 * abs(value) and not is_same(wave, start):
            return float(found.fun), folded(wave)
        return value, start


@dataclass(frozen=True, eq=False)
class LatticeCritical:
    """The point where a lattice first becomes unstable, or up to which it is stable."""

    load: float
    """Critical load; without one, the last load reached [-]."""
    found: bool
    """Whether there is a critical point up to ``load``."""
    outcome: str
    """The result as text."""
    least_stable: LeastStable
    """The least stable wave at ``load``."""
    waves: tuple[Wave, ...]
    """All waves that are critical at ``load``; a degenerate set has more than one. They are on the
    grid, or images of the least stable wave under symmetries of lattice and load, even if the mesh
    splits them slightly. k and -k are the same mode and appear once. Empty for long waves."""
    state: CellState
    """The equilibrium at ``load``."""
    history: tuple[LeastStable, ...]
    """The least stable wave at every load at which all waves were examined, by load."""
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    """Number of negative eigenvalues at each of ``waves``, a millionth of the load below and above
    the critical load: the proof."""
    splitting: float = 0.0
    """Largest measure among ``waves``, over the measure without load: splitting by the mesh of
    modes that are degenerate by the lattice's symmetry [-]."""
    splitting_bound: float = 0.0
    """Upper bound of ``splitting`` from images of the lowest mode, by the min-max principle."""
    unstable_before: tuple[Wave, ...] = ()
    """Waves of the grid that are already unstable a millionth of the load below. If there are none,
    this is the first critical point. Not computed if one wave was given."""


def first_critical(
    path: CellPath, search: CriticalSearch | None = None, progress: Progress = silent
) -> LatticeCritical:
    """The first critical load over all wave vectors, along the path of a primitive cell.

    If the search names waves, only over these. Modes with the period of the cell have the wave
    (0, 0). InputError if the lattice is a mechanism: a wave needs no energy without load.
    """
    search = search or CriticalSearch()
    zone = Zone(path.cell, search.divisions, search.phases)
    return _LoadSearch(path, search, zone, zone.least_stable, progress, zone.grid).run()


def critical_at(
    path: CellPath, wave: Wave, search: CriticalSearch | None = None
) -> LatticeCritical:
    """The first load at which the given wave is critical, regardless of other waves.

    (0, 0) means modes with the period of the cell, which may be an enlarged cell. F̄ is
    fixed while a mode grows.
    """
    search = search or CriticalSearch()
    zone = Zone(path.cell, search.divisions, [wave_of(wave)])
    return _LoadSearch(path, search, zone, zone.least_stable, silent).run()


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
        largest, load, step = self.search.largest, 0.0, _FIRST_STEP
        previous = self._at_rest()
        while load < largest:
            self.progress(load, largest, "lattice")
            target = min(load + step, largest)
            least = self._measured(self.path.at(target))
            path_ends = least is None
            if least is None:  # the path ends before the target
                target = max(state.load for state in self.path.states)
                least = self._measured(self.path.at(target))
            assert least is not None, "a state that is known"
            if least.value <= 0:
                return self._root(load, target)
            if path_ends:
                return self._stable(
                    target, f"Newton's method did not converge beyond e = {target:.6g}"
                )
            rate = (previous.value - least.value) / (target - load)
            ahead = 1.05 * least.value / rate if rate > 0 else math.inf
            step = min(max(ahead, 0.2 * step), 3.0 * step, self.search.largest_step)
            load, previous = target, least
        return self._stable(load, f"stable up to e = {load:.6g}, the largest load asked for")

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
        """The critical point between a stable and an unstable load.

        All waves are examined again at the critical load of the previous least stable wave.
        """
        last, load, exact = math.inf, high, _TOLERANCE * self.history[0.0].value
        while last - load > _TOLERANCE * load and self.history[load].value < -exact:
            last, load = load, self._critical_load(self.history[load], low, load)
            self._measured(self._near(low, load))
        least, state = self.history[load], self._near(low, load)
        none: tuple[tuple[Wave, ...], float, float] = ((), 0.0, 0.0)
        waves, split, bound = none if least.angle is not None else self._set(state, least)
        before, after = (self._near(low, load * (1.0 + side)) for side in (-_BESIDE, _BESIDE))
        below, above = self._unstable(before, waves), self._unstable(after, waves)
        earlier = BlochWaves(self.path.cell, before).unstable_among(self.everywhere)
        kind = "long waves" if least.angle is not None else f"{len(waves)} wave vector(s)"
        text = f"critical at e = {load:.6g} for {kind}"
        text += f"; but {len(earlier)} others are unstable before" if earlier else ""
        text += self._where
        known = (waves, state, self._by_load(), below, above, split, bound, earlier)
        return LatticeCritical(load, True, text, least, *known)

    def _critical_load(self, least: LeastStable, low: float, high: float) -> float:
        """Critical load of a wave that is unstable at the load ``high``."""

        def value(load: float) -> float:
            waves, angle = BlochWaves(self.path.cell, self._near(low, load)), least.angle
            return self.zone.at(waves, least.wave).value if angle is None else waves.acoustic(angle)

        return float(brentq(value, low, high, xtol=_TOLERANCE * high, rtol=1e-14))

    def _near(self, low: float, load: float) -> CellState:
        """The equilibrium at a load near the critical load, computed from the stable side.

        It doesn't start at the nearest state: if that is critical with the period of the cell, its
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
        known = ((), state, self._by_load())
        return LatticeCritical(load, False, outcome + self._where, self.history[load], *known)

    @property
    def _where(self) -> str:
        count = len(self.zone.only)
        return f"; looked for at the {count} wave(s) asked for only" if count else ""

    def _set(self, state: CellState, least: LeastStable) -> tuple[tuple[Wave, ...], float, float]:
        """The least stable wave and others critical with it; their splitting and its bound.

        The others are critical points of the grid, or images of the wave by symmetry.
        """
        waves, rest = BlochWaves(self.path.cell, state), self.history[0.0].value
        small = np.abs(self.zone.on_grid(waves)) < _DEGENERATE * rest
        every = [wave for wave, is_small in zip(self.zone.grid, small, strict=True) if is_small]
        lowest, degeneracy = waves.lowest(least.wave), Degeneracy(waves)
        found = [least.wave]
        for wave in (*degeneracy.waves(least.wave), *every):
            if not any(is_same(wave, other) for other in found):
                found.append(wave)
        split = max(abs(self.zone.at(waves, wave).value) for wave in found) / rest
        bound = self.zone.measure(least.wave, degeneracy.bound(lowest)) / rest
        return tuple(found), split, max(bound, split)

    def _unstable(self, state: CellState, critical: tuple[Wave, ...]) -> tuple[int, ...]:
        """Number of negative eigenvalues at the critical waves; at Γ without translations."""
        waves = BlochWaves(self.path.cell, state)
        return tuple(
            int(np.sum(waves.lowest(CENTRE, 4).eigenvalues < 0)) if wave == CENTRE
            else waves.unstable(wave) for wave in critical
        )  # fmt: skip

    def _by_load(self) -> tuple[LeastStable, ...]:
        return tuple(self.history[load] for load in sorted(self.history))
