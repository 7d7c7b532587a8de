"""The buckled branches of a periodic cell, from the critical load on.

A branch starts along a combination of the critical modes. Its amplitude is prescribed and the
load is an unknown. This is regular where the branch leaves the primary path and where its load has
a maximum or minimum, so that branches with falling load can be followed. The states at given loads
are then computed exactly. A branch ends at contact, which isn't modelled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from modeharvest.fem.bloch.modes import Branch, BranchState, ModeSet
from modeharvest.fem.lattice.cell import Amplitude, CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.options import CENTRE
from modeharvest.fem.lattice.periodicity import overlaps
from modeharvest.fem.path.continuation import BranchPoint, amplitude_at, load_at, value_at
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

# First and largest step of the amplitude (the rms displacement in the mode), and where to stop, all
# over the primitive cell's shorter vector. At small amplitudes the directions of a degenerate set
# are almost equivalent.
_FIRST, _LONGEST, _FARTHEST = 0.01, 0.02, 0.4
_GROWTH = 1.6  # largest growth factor of the step from one point to the next
_BEFORE = 1e-4  # of the critical load: distance where the primary path is regular enough
# Of the load: largest distance of a mode's critical load, if a mesh splits a set (even at 10 % the
# same branches are found, docs/explanation/modes.md); least splitting that isn't rounding.
_CRITICAL, _SPLIT = 3e-2, 1e-5
_NEAR = 0.5  # largest distance of a point from its prediction, over the step
_REFINEMENTS = 6


def follow(
    path: CellPath,
    modes: ModeSet,
    combination: Sequence[float],
    loads: Sequence[float],
    progress: Progress = silent,
) -> Branch:
    """Follow the branch that starts along a combination of critical modes.

    Only the amplitude of the combination is prescribed; everything else, including other modes, is
    free, and ``BranchState.amplitudes`` has the result. InputError if the cell isn't that of the
    modes, or the combination doesn't fit them. A branch that can't be followed is reported in
    ``Branch.outcome``, not as an exception.

    path, modes : primary path of the commensurate cell, that of ``modes.mesh``, such as
        ``CellPath(PeriodicCell(cell.enlarged(2, 2), material), loading)``; its critical modes.
    combination : (m,) coefficients; only ratios and signs matter. The opposite: the other half.
    loads : loads at which to report states [-]. A load met twice is reported twice.
    """
    _check(path.cell, modes, combination, loads)
    mix = np.asarray(combination, dtype=np.float64)
    tracing = _Tracing(path, modes, mix / np.linalg.norm(mix))
    return tracing.run(sorted(loads), progress)


class _Tracing:
    """Follows a branch of a cell; ``points``: computed so far; ``stopped``: why no more."""

    def __init__(self, path: CellPath, modes: ModeSet, mix: FloatArray) -> None:
        self.cell, self.loading = path.cell, path.loading
        self.modes, self.mix = modes, mix
        self.pitch = float(np.linalg.norm(modes.primitive, axis=1).min())
        reduction, mass = self.cell.reduction, self.cell.nodal_mass
        shapes, material = modes.shapes.reshape(len(mix), -1), 0.5 * float(mass.sum())
        # (m, size): their products with the fluctuation are the amplitudes of the modes.
        self.weights = reduction.restricted(np.asarray(mass @ shapes.T)).T / material
        self.mass = self.cell.mass(CENTRE) / material
        below = path.at((1.0 - _BEFORE) * modes.load)
        self.primary = CellPath(self.cell, self.loading, [] if below is None else [below])
        self.points: list[BranchPoint] = []
        self.stopped = ""

    def run(self, loads: list[float], progress: Progress) -> Branch:
        """Follow the branch, and report states at the requested loads."""
        states: list[BranchState] = []
        for _ in self._follow():
            here, there = self.points[-2:]
            progress(there.load, loads[-1], "buckled branch")
            low, high = sorted((here.load, there.load))
            met = [load for load in loads if low <= load <= high and load != here.load]
            found = [self._at_load(here, there, load) for load in met]
            states += [self._report(state) for state in found if state is not None]
            is_past = there.load > loads[-1] and there.load_rate > 0
            if is_past or {state.load for state in states}.issuperset(loads):
                break
        states.sort(key=lambda state: state.load)
        curve = np.array([(p.amplitude, p.load) for p in self.points]).reshape(-1, 2)
        mix = tuple(float(c) for c in self.mix)
        return Branch(mix, tuple(states), self._outcome(states, loads), curve)

    def _outcome(self, states: list[BranchState], loads: list[float]) -> str:
        if not self.points:
            return f"not followed: {self.stopped}"
        start, last = self.points[0], self.points[-1]
        if len(self.points) == 1:
            why = f"{self.stopped}; perhaps no branch starts along this combination of the modes"
            if self.splitting > _SPLIT:
                by = f"{self.splitting:.1g} of the load"
                why = f"the mesh splits these modes by {by}, so branches start along single ones: "
                why += "for this one mesh one sector of the cell, and turn and mirror it"
            return f"not followed from e = {start.load:.6g} on: {why}"
        way = "rises" if self.points[1].load > start.load else "falls"
        text = f"the load {way} from e = {start.load:.4g} on; followed to e = {last.load:.4g}, "
        text += f"amplitude {last.amplitude:.4g} mm"
        text += f"; {self.stopped}" if self.stopped else ""
        met = {state.load for state in states}
        missing = ", ".join(f"e = {load:.6g}" for load in loads if load not in met)
        return text + (f"; not met: {missing}" if missing else "")

    def _follow(self) -> Iterator[None]:
        """Extend ``points`` by growing amplitude; yield after each except the critical point."""
        start = self._start()
        if start is None:
            return
        self.points.append(start)
        step = _FIRST * self.pitch
        while self.points[-1].amplitude + step <= _FARTHEST * self.pitch:
            found = self._at_amplitude(self.points[-2:], self.points[-1].amplitude + step)
            if isinstance(found, str):
                step *= 0.5
                if step < 0.05 * _FIRST * self.pitch:
                    self.stopped = found
                    return
                continue
            if len(self.points) == 1:  # determines the initial direction of the branch
                mix = self.weights @ (found.value[4:] - self.origin)
                rate = self._direction(mix) * (1.0 / found.amplitude)
                self.points[0] = replace(start, rate=rate)
            self.points.append(found)
            yield
            step = min(_GROWTH * step, _LONGEST * self.pitch)
        self.stopped = f"the largest amplitude asked for is {_FARTHEST} of the pitch"

    def _start(self) -> BranchPoint | None:
        """The critical point, extrapolated from a state with a regular tangent, and the mode."""
        load = self.modes.load
        if not self.primary.states:
            self.stopped = f"no equilibrium of the primary path near e = {load:.6g}"
            return None
        below, along = self.primary.states[0], self.mix != 0
        distances = self.cell.critical_distances(
            below, self.modes.shapes[along], self.modes.eigenvalues[along]
        )
        if (farthest := float(np.abs(distances).max())) > _CRITICAL:
            off = f"one mode's own critical load is {farthest:.2g} of it off"
            self.stopped = f"the modes are not critical at e = {load:.6g}: {off}"
            return None
        self.splitting = float(np.ptp(distances))
        value = below.value + (load - below.load) * below.rate
        self.origin = value[4:]
        return BranchPoint(0.0, load, 0.0, value, self._direction(self.mix))

    def _direction(self, mix: FloatArray) -> FloatArray:
        """(4 + size,) a combination of modes at fixed F̄, translated so that a master is fixed."""
        periodicity, order = self.cell.reduction.periodicity, self.cell.reduction.order
        at_masters = np.empty((periodicity.count, 2))
        at_masters[periodicity.master] = np.tensordot(mix, self.modes.shapes, 1)
        return np.concatenate([np.zeros(4), (at_masters - at_masters[0]).ravel()[order]])

    def _at_amplitude(self, points: Sequence[BranchPoint], amplitude: float) -> BranchPoint | str:
        """The branch's point at an amplitude, from one or two previous points; or why not."""
        weights, guess = self.mix @ self.weights, value_at(points, amplitude)
        prescribed = Amplitude(weights, amplitude + float(weights @ self.origin))
        load = load_at(points, amplitude)
        found = self.cell.corrected(self.loading, load, guess, prescribed)
        if isinstance(found, str):
            return found
        if self._overlaps(found):
            return "the material would run into itself (contact is not modelled)"
        off = found.fluctuation - guess[4:]
        if off @ (self.mass @ off) > (_NEAR * (amplitude - points[-1].amplitude)) ** 2:
            return "another branch is nearer"
        rate = float(weights @ found.rate[4:])
        return BranchPoint(amplitude, found.load, 1.0 / rate, found.value, found.rate / rate)

    def _at_load(self, here: BranchPoint, there: BranchPoint, load: float) -> CellState | None:
        """The state at a load between the loads of two points; None if not found."""
        for _ in range(_REFINEMENTS):
            between = (here, there)
            amplitude = amplitude_at(between, load, here.amplitude, there.amplitude)
            guess = value_at(between, amplitude)
            found = self.cell.corrected(self.loading, load, guess)
            if isinstance(found, CellState):
                got = float(self.mix @ self.weights @ (found.fluctuation - self.origin))
                # Under a prescribed load Newton may fall back to the primary path.
                if abs(got - amplitude) < 0.5 * min(amplitude, there.amplitude - here.amplitude):
                    return None if self._overlaps(found) else found
            middle = self._at_amplitude(between, amplitude)
            if isinstance(middle, str):
                return None
            is_beyond = (middle.load - load) * (here.load - load) <= 0
            here, there = (here, middle) if is_beyond else (middle, there)
        return None

    def _overlaps(self, state: CellState) -> bool:
        cell = self.cell.cell
        return overlaps(cell.mesh, cell.lattice, state.gradient, self.cell.displacement(state))

    def _report(self, state: CellState) -> BranchState:
        """The state as plain numpy, with the energy of the primary path at the same load."""
        cell, primary = self.cell, self.primary.at(state.load)
        u, before, on_path = cell.displacement(state), self.origin, math.nan
        if primary is not None:
            before, on_path = primary.fluctuation, cell.body.energy(cell.displacement(primary))
        return BranchState(
            load=state.load,
            gradient=state.gradient,
            stress=state.stress,
            energy=cell.body.energy(u) / cell.cell.area,
            primary_energy=on_path / cell.cell.area,
            negative_eigenvalues=cell.negative_eigenvalues(self.loading, state),
            displacement=u,
            amplitudes=self.weights @ (state.fluctuation - before),
        )


def _check(
    cell: PeriodicCell, modes: ModeSet, combination: Sequence[float], loads: Sequence[float]
) -> None:
    nodes, near = cell.cell.mesh.nodes, 1e-9 * np.abs(modes.lattice).max()
    if nodes.shape != modes.mesh.nodes.shape or not np.allclose(nodes, modes.mesh.nodes, atol=near):
        raise InputError(
            "branch: expected the path of the cell the modes live on, got another mesh; make it "
            f"with cell.enlarged{tuple(modes.info.get('copies', ('m', 'n')))}"
        )
    if len(combination) != len(modes.waves) or not 0 < np.linalg.norm(combination) < math.inf:
        what = f"{len(modes.waves)} coefficients of modes, not all 0"
        raise InputError(f"branch: expected {what}, got {tuple(combination)}")
    if not len(loads) or not np.isfinite(loads).all():
        raise InputError(f"branch: expected one finite load or more, got {tuple(loads)}")
