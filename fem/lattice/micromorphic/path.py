"""Equilibrium paths of a homogenized body: primary path, critical point, buckled branch.

Newton's method goes for both scales at once; RVEs start from their own last states, carried
along with F̄, v and g by cubics. A body that has its lattice's symmetry keeps v = 0 for ever, so the
branch is entered by its amplitude. Stability is by the inertia of L D L^T factors: of all RVEs at
fixed strains and of the body's condensed stiffness (their sum, Haynsworth, Linear Algebra Appl. 1
(1968) 73-81), and of the block of v alone, which no soft mode of u can hide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import bisect, brentq
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import eigsh

from modeharvest.fem.experiment import SMALLEST_STEP, PathOptions
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.path.continuation import (
    BranchPoint,
    amplitude_at,
    extrapolate,
    load_at,
    value_at,
)
from modeharvest.fem.sparse_factor import factorise
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

_ITERATIONS = 8
# What a change of the load by this makes: forces that one more Newton step turns into nothing, so
# that its linearisation, by 1e-7 off, serves for moduli and inertia.
_SMALL = 1e-7
_DENSE = 1000  # unknowns up to which all eigenvalues are computed
_FEW = 6  # eigenvalues otherwise
_ALIKE = 1e-6  # critical modes have eigenvalues that far from the lowest one's [-]
_NONE: FloatArray = np.zeros((0, 0))
_SOME = 0.01  # of u: what a mode has at least of the pattern, if that is what becomes unstable
_FARTHEST = 0.5  # of the pitch: the largest amplitude of a branch


@dataclass(frozen=True, eq=False)
class HomogenizedState:
    """An equilibrium of both scales."""

    load: float
    """e, such as the nominal strain [-]."""
    force: float
    """dE/de over L and the thickness: of a compression the force on a plate [N/mm]."""
    energy: float
    """E, stored energy by thickness [N]."""
    displacement: FloatArray
    amplitudes: FloatArray
    """(n, 2) u [mm] and (n, m) v_i of the mesh's nodes, NaN where there is no lattice."""
    strains: FloatArray
    stresses: FloatArray
    """(p, 4 + 3 m) F̄, v, g and P̄, Pi, Lambda at the points of the lattice."""
    negative_eigenvalues: int
    """Of the tangent of both scales together; 0: stable."""
    rve_negative: int
    pattern_negative: int
    """Those of the RVEs alone at fixed F̄, v, g; those of the condensed stiffness of v alone."""
    value: FloatArray = field(repr=False)
    rate: FloatArray = field(repr=False)
    """y, then w of this rank's RVEs; their derivatives by the load."""
    branch: str = "primary"

    @property
    def is_stable(self) -> bool:
        """Whether neither the whole nor the block of v has a negative eigenvalue."""
        return self.negative_eigenvalues == 0 == self.pattern_negative


@dataclass(frozen=True, eq=False)
class HomogenizedCritical:
    """The first critical point of a primary path."""

    load: float
    """[-]."""
    kind: str
    """What becomes unstable: "pattern" (a mode with v), "displacement" (of u alone), "RVE" (a
    fluctuation that no given mode describes; without modes, the pattern itself)."""
    state: HomogenizedState
    """Just before."""
    modes: FloatArray
    """(k, free unknowns) critical modes of the body, the largest displacement of the pattern 1 mm;
    none of an "RVE"."""
    negative_before: int
    negative_after: int
    """Negative eigenvalues at either side, ``tolerance`` away: the proof."""


@dataclass(frozen=True, eq=False)
class Homogenized:
    """What a homogenized specimen does under load."""

    states: tuple[HomogenizedState, ...]
    """At the loads asked for, ascending; buckled beyond the critical point."""
    criticals: tuple[HomogenizedCritical, ...]
    """Those passed on the primary path; the branch starts at the last one."""
    outcome: str
    """How far it was followed, and why no farther."""
    linearisations: int
    """Of the whole body: as many factorisations of every RVE."""

    @property
    def critical(self) -> HomogenizedCritical | None:
        """Where the pattern starts to grow, or without modes the first RVE becomes unstable."""
        found = [c for c in self.criticals if c.kind != "displacement"]
        return found[0] if found else None


class HomogenizedPath:
    """Equilibria of one body; the linearisation at the last one serves what is next.

    ``linearisations`` counts those of the whole body: each factorises every RVE once.
    """

    def __init__(self, body: HomogenizedBody, options: PathOptions | None = None) -> None:
        self.body, self.options = body, options or PathOptions()
        self.linearisations = 0
        vectors = body.rves[0].cell.cell.lattice
        self.pitch = 0.5 * float(np.linalg.norm(vectors, axis=1).min())
        """Half the RVE's shorter vector, what a branch's amplitudes refer to [mm]."""
        start = self.equilibrium(0.0, body.start)
        if start is None:
            raise InputError("homogenized body: no equilibrium without load; check the material")
        self.states = [start]
        """The primary path."""
        # A metric that makes eigenvalues of u and v comparable numbers.
        self._scale = np.abs(self.last.stiffness.diagonal())

    def equilibrium(
        self,
        load: float,
        guess: FloatArray,
        weights: FloatArray | None = None,
        amplitude: float = 0.0,
        branch: str = "primary",
    ) -> HomogenizedState | None:
        """The equilibrium near a guess at a load, or where weights . y = amplitude; or None."""
        value, count = guess, self.body.free_count
        for _ in range(_ITERATIONS):
            at = LinearisedBody(self.body, load, value)
            self.linearisations += 1
            if not at.is_regular:
                return None
            dy, change = at.relaxed, 0.0
            if weights is not None:
                miss = weights @ (value[:count] + dy) - amplitude
                change = -float(miss / (weights @ at.along))
            dy = dy + change * at.along
            load, value = load + change, value + at.moved(dy, change)
            if not np.isfinite(value).all():
                return None
            rest = float(np.linalg.norm(at.residual)) + abs(change) * at.load_size
            if rest <= _SMALL * at.load_size and at.excess <= _SMALL:
                self.last = at
                return self._settled(load, value, dy, branch)
        return None

    def _settled(
        self, load: float, value: FloatArray, dy: FloatArray, branch: str
    ) -> HomogenizedState | None:
        """The state that a last, small step from a linearisation leads to.

        None where an element of an RVE is turned inside out.
        """
        at, body = self.last, self.body
        areas = [region.at.weights.ravel() for region in self.body.regions]
        unknowns = body.unknowns(value, load)
        strains, rows = body.strains(unknowns), np.empty((len(body.own), 2))
        for row, number, w in zip(rows, body.own, body.fluctuations(value), strict=True):
            rve, q = body.rve(number), strains[0][number // len(body.rves)]
            row[:] = rve.energy(q, w), rve.smallest_jacobian(q, w)
        every = body.gathered(rows)
        if not every[..., 1].min() > 0:
            return None
        energy = float(areas[0] @ every[..., 0].mean(axis=1))
        if len(areas) > 1:
            energy += float(areas[1] @ body.bulk_response(strains[1])[0])
        stresses = at.stresses + np.einsum("pst,pt->ps", at.moduli, strains[0] - at.strains)
        work_rate = body.direction @ (at.forces + (load - at.load) * at.along_load)
        return HomogenizedState(
            load=load,
            force=body.copies * float(work_rate + at.load_force @ dy) / body.length,
            energy=body.copies * energy,
            displacement=body.displacement(unknowns),
            amplitudes=body.amplitudes(unknowns),
            strains=strains[0],
            stresses=stresses,
            negative_eigenvalues=at.negative,
            rve_negative=at.rve_negative,
            pattern_negative=self._pattern_negative(at.stiffness),
            value=value,
            rate=at.moved(at.along, 1.0, relax=False),
            branch=branch,
        )

    def _pattern_negative(self, stiffness: csr_array) -> int:
        chosen = np.flatnonzero(self.body.is_pattern)
        K = stiffness[chosen][:, chosen].sorted_indices()
        return factorise(K, definite=False).negative_pivots if len(chosen) else 0

    def follow_primary(self, load: float, block: str = "") -> bool:
        """Extend ``states`` to a load, or to the first state where a block is unstable.

        False where no step, down to 1e-5, converges.

        block : "all", or "pattern" for v alone; by default stability doesn't matter.
        """
        step = self.options.first_step
        while (here := self.states[-1]).load < load - 1e-12 and not _is_unstable(here, block):
            pieces = max(1, int(np.ceil((load - here.load) / step - 0.1)))
            to = load if pieces == 1 else here.load + (load - here.load) / pieces
            found = self.equilibrium(to, _expected(self.states, to))
            if found is None:
                step = 0.5 * (to - here.load)
                if step < SMALLEST_STEP:
                    return False
                continue
            self.states.append(found)
            step = min(1.5 * step, self.options.largest_step)
        return True

    def critical(self, block: str = "all") -> HomogenizedCritical | None:
        """The critical point between the last two of ``states``; None if it gets lost.

        Its load is where the block's lowest eigenvalue passes zero, or where the number of negative
        ones of the RVEs changes, proved by the inertia at both sides.
        """
        tolerance, ends = self.options.critical_tolerance, self.states[-2:]
        known, calm = {state.load: state for state in ends}, ends[0].rve_negative

        def at(load: float) -> HomogenizedState:
            # Not from states so near to a singular one that rounding moves their v.
            far = [e for e in known if abs(e - load) > 100 * tolerance or e == load]
            near = [known[e] for e in sorted(far or known, key=lambda e: -abs(e - load))]
            found = self.equilibrium(load, _expected(near, load))
            if found is None:
                raise ArithmeticError(f"no equilibrium at the load {load}")
            known[load] = found
            return found

        def measure(load: float, part: str) -> float:
            state = at(load)
            if part == "RVE":
                return -1.0 if state.rve_negative > calm else 1.0
            return float(self._eigenpairs(part)[0][0])

        # The block of v alone first: its eigenvalue is smooth where modes of u are lower.
        parts = ["pattern", block] if ends[1].pattern_negative else [block]
        if block == "all" and ends[1].rve_negative > calm:
            parts = ["RVE"]
        for part in parts:
            find, between = bisect if part == "RVE" else brentq, [state.load for state in ends]
            try:
                load = float(find(measure, *between, (part,), xtol=0.2 * tolerance))
                after, before = at(load + tolerance), at(load - tolerance)
            except (ArithmeticError, ValueError):  # ValueError: no change of sign
                continue
            if _is_unstable(after, block) and not _is_unstable(before, block):
                modes, kind = self._critical_modes(block) if part != "RVE" else (_NONE, part)
                counts = before.negative_eigenvalues, after.negative_eigenvalues
                return HomogenizedCritical(load, kind, before, modes, *counts)
        return None

    def _critical_modes(self, block: str) -> tuple[FloatArray, str]:
        """(k, free unknowns) modes of the last state that belong together, and of what kind."""
        values, vectors = self._eigenpairs(block)
        modes = vectors[:, np.abs(values - values[0]) < _ALIKE].T
        peaks = np.array([self._largest(mode) for mode in modes])
        kind = "pattern" if peaks[0, 0] > _SOME * peaks[0, 1] else "displacement"
        return modes / peaks[:, [int(kind != "pattern")]], kind

    def _eigenpairs(self, block: str) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues [-], ascending, and vectors of the stiffness of y at the last state."""
        chosen = np.flatnonzero(self.body.is_pattern | (block == "all"))
        root = 1.0 / np.sqrt(self._scale[chosen])
        K = self.last.stiffness[chosen][:, chosen] * root[:, None] * root
        if len(chosen) <= _DENSE:
            values, scaled = eigh(K.toarray())
        else:
            values, scaled = eigsh(csc_array(K), _FEW, sigma=0.0)
        order = np.argsort(values)[:_FEW]
        vectors = np.zeros((self.body.free_count, len(order)))
        vectors[chosen] = root[:, None] * scaled[:, order]
        return values[order], vectors

    def _largest(self, mode: FloatArray) -> tuple[float, float]:
        """The largest displacement by the pattern, sum |v_i| max |phi_i|, and that of u [mm]."""
        body = self.body
        a, peaks = body.expand(mode), np.linalg.norm(body.rves[0].shapes, axis=2).max(axis=1)
        pattern = np.nan_to_num(np.abs(body.amplitudes(a))) @ peaks
        return float(pattern.max()), float(np.linalg.norm(body.displacement(a), axis=1).max())

    def follow_branch(
        self,
        critical: HomogenizedCritical,
        loads: Sequence[float],
        pattern: Sequence[float] | None = None,
        progress: Progress = silent,
    ) -> tuple[list[HomogenizedState], str]:
        """States on a branch that starts at a critical point, and how it ended.

        One for each of the ``loads``, ascending, or fewer. Amplitudes are prescribed and grow;
        the load is found, so that a branch whose load falls is followed too. It starts along the
        critical mode, of several the combination, that is most like v = ``pattern`` (m,)
        everywhere: all 1 unless given. The opposite is the other half of the branch.
        """
        if not len(critical.modes):
            raise InputError("branch: expected a critical point of the body, got one of an RVE")
        mode = self._combined(critical, pattern)
        weights = self._scale * mode / float(mode @ (self._scale * mode))
        start = self._start(critical, mode)
        points, found, name = [start], list[HomogenizedState](), "buckled"
        origin = float(weights @ start.value[: self.body.free_count])
        first = self.options.first_amplitude * self.pitch
        reach = first
        while len(found) < len(loads):
            target, amplitude = loads[len(found)], reach
            if reach > _FARTHEST * self.pitch:
                return found, f"the pattern has grown to {_FARTHEST} of the pitch"
            is_near = load_at(points, reach) >= target
            if is_near:
                before = points[-1] if points[-1].load < target else points[-2]
                amplitude = amplitude_at(points, target, before.amplitude, reach)
                state = self.equilibrium(target, value_at(points, amplitude), branch=name)
            else:
                guess = load_at(points, amplitude), value_at(points, amplitude)
                state = self.equilibrium(*guess, weights, origin + amplitude, branch=name)
            reached = -1.0
            if state is not None:
                reached = float(weights @ state.value[: self.body.free_count]) - origin
            # Under a prescribed load Newton may fall back to the primary path.
            if state is None or reached < 0.2 * amplitude:
                reach = 0.5 * (points[-1].amplitude + amplitude)
                if reach - points[-1].amplitude < 0.02 * first:
                    return found, f"no equilibrium beyond the load {points[-1].load:.6g}"
                continue
            rate = float(weights @ state.rate[: self.body.free_count])
            points.append(
                BranchPoint(reached, state.load, 1 / rate, state.value, state.rate / rate)
            )
            reach = self.options.growth * reached
            if is_near:
                found.append(state)
                progress(state.load, loads[-1], "buckled branch")
        return found, f"followed to the load {points[-1].load:.6g}"

    def _combined(
        self, critical: HomogenizedCritical, pattern: Sequence[float] | None
    ) -> FloatArray:
        """The combination of critical modes nearest to a pattern, of size 1 mm."""
        count = self.body.mode_count
        wanted = np.ones(count) if pattern is None else np.asarray(pattern, np.float64)
        if wanted.shape != (count,) or not np.any(wanted):
            raise InputError(f"branch: expected {count} amplitudes, not all 0, got {pattern}")
        like = np.zeros(self.body.size)
        like[2 * len(self.body.mesh.nodes) :].reshape(-1, count)[:] = wanted
        modes = critical.modes
        overlaps = modes @ (self._scale * self.body.picked(like))
        mix = np.linalg.solve((modes * self._scale) @ modes.T, overlaps)
        size = np.linalg.norm(mix)
        mode = mix @ modes if size > _SOME * np.linalg.norm(wanted) else modes[0]
        return np.asarray(mode / self._largest(mode)[critical.kind != "pattern"])

    def _start(self, critical: HomogenizedCritical, mode: FloatArray) -> BranchPoint:
        """The critical point, and the direction in which the branch leaves it."""
        state = critical.state
        value = state.value + (critical.load - state.load) * state.rate
        at = LinearisedBody(self.body, state.load, state.value)
        return BranchPoint(0.0, critical.load, 0.0, value, at.moved(mode, 0.0, relax=False))


def homogenize(
    body: HomogenizedBody,
    loads: Sequence[float],
    options: PathOptions | None = None,
    progress: Progress = silent,
) -> Homogenized:
    """States of a homogenized specimen at some loads [-], positive and ascending.

    On the primary path up to the first critical point at which a pattern grows, then on the branch
    that it makes. Critical points of u alone, before it, are kept in ``criticals`` and passed.
    """
    wanted = np.asarray(loads, dtype=np.float64)
    if wanted.ndim != 1 or not len(wanted) or not (np.diff(wanted, prepend=0.0) > 0).all():
        raise InputError(f"loads: expected ascending positive ones, got {list(loads)}")
    path, met = HomogenizedPath(body, options), list[HomogenizedState]()
    criticals: list[HomogenizedCritical] = []
    block, pending = "all", list(wanted)

    def ended(outcome: str) -> Homogenized:
        return Homogenized(tuple(met), tuple(criticals), outcome, path.linearisations)

    while pending:
        if not path.follow_primary(pending[0], block):
            return ended(f"no equilibrium of the primary path beyond {path.states[-1].load:.6g}")
        here = path.states[-1]
        progress(here.load, wanted[-1], "primary path")
        if _is_unstable(here, block):
            found = path.critical(block)
            if found is None:
                return ended(f"the critical point below the load {here.load:.6g} got lost")
            criticals.append(found)
            if found.kind == "pattern":
                states, outcome = path.follow_branch(found, pending, progress=progress)
                met += states
                return ended(outcome)
            block = "pattern" if found.kind == "displacement" else ""
        if here.load >= pending[0] - 1e-12:
            met.append(here)
            pending.pop(0)
    return ended(f"followed to the load {met[-1].load:.6g}")


def ranked_branches(
    path: HomogenizedPath, critical: HomogenizedCritical, load: float
) -> list[tuple[tuple[float, ...], HomogenizedState]]:
    """The branches of a critical point at a load, that of least energy first.

    Those along single modes v_i and along sums of them with either sign, the first one positive,
    each with its pattern; those that can't be followed are left out.
    """
    signs = product((0.0, 1.0, -1.0), repeat=path.body.mode_count)
    patterns = [p for p in signs if next((x for x in p if x), 0.0) > 0]
    found = [(p, path.follow_branch(critical, [load], p)[0]) for p in patterns]
    met = [(pattern, states[0]) for pattern, states in found if states]
    return sorted(met, key=lambda item: item[1].energy)


def _expected(states: Sequence[HomogenizedState], load: float) -> FloatArray:
    """The state at a load by the tangent of the last state, or the cubic of the last two."""
    return np.asarray(extrapolate([(s.load, s.value, s.rate) for s in states[-2:]], load))


def _is_unstable(state: HomogenizedState, block: str) -> bool:
    """Whether a block ("all", "pattern", or none) has a negative eigenvalue."""
    counts = {"all": state.negative_eigenvalues, "pattern": state.pattern_negative, "": 0}
    return counts[block] > 0
