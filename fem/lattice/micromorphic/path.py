"""Equilibria of a homogenized body: primary path, stability, critical point.

Newton's method solves both scales at once. The RVEs' initial guesses are extrapolated from their
last states, with F̄, v and g, by cubics. Stability follows from the inertia of L D L^T factors: of
all RVEs at fixed strains and of the body's condensed stiffness (the sum of both, Haynsworth, Linear
Algebra Appl. 1 (1968) 73-81), and of the block of v alone, where modes of u don't matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import bisect, brentq
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import eigsh

from modeharvest.fem.experiment import SMALLEST_STEP, PathOptions
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.path.continuation import extrapolate
from modeharvest.fem.sparse_factor import factorise
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, SingularMatrixError

_ITERATIONS = 8
# Tolerance: forces of a change of the load by this. One more Newton step removes them, and its
# linearisation, with an error of 1e-7, is used for moduli and inertia.
_SMALL, _SMALL_AT_CRITICAL = 1e-7, 1e-10  # there, rounding changes v of other modes nearly critical
_SINGULAR = 1e-9  # eigenvalue over the stiffness' diagonal that is zero but for rounding [-]
_DENSE = 1000  # unknowns up to which all eigenvalues are computed
_FEW = 6  # number of eigenvalues computed otherwise
_ALIKE = 1e-6  # critical modes have eigenvalues within this of the lowest one [-]
# Or, if a mesh splits a degenerate set of patterns: eigenvalues below this share of those at rest,
# and a common shape of v over the body that has this share of their square.
_SPLIT, _SHARED = 3e-2, 0.8
_NONE: FloatArray = np.zeros((0, 0))
_SOME = 0.01  # least ratio of pattern to u in a mode for which the pattern becomes unstable


@dataclass(frozen=True, eq=False)
class HomogenizedState:
    """An equilibrium of both scales."""

    load: float
    """Load e, such as the nominal strain [-]."""
    force: float
    """dE/de over L: for a compression the force on a plate per unit thickness [N/mm]."""
    energy: float
    """E, stored energy per unit thickness [N]."""
    displacement: FloatArray
    amplitudes: FloatArray
    """(n, 2) u [mm] and (n, m) v_i of the mesh's nodes; v_i is NaN outside the lattice."""
    strains: FloatArray
    stresses: FloatArray
    """(p, 4 + 3 m) strains F̄, v, g and stresses P̄, Pi, Lambda at the points of the lattice."""
    negative_eigenvalues: int
    """Number of negative eigenvalues of the tangent of both scales together; 0: stable."""
    rve_negative: int
    pattern_negative: int
    """Number for the RVEs alone at fixed F̄, v, g; for the condensed stiffness of v alone."""
    value: FloatArray = field(repr=False)
    rate: FloatArray = field(repr=False)
    """y followed by w of this rank's RVEs, and their derivatives by the load."""
    branch: str = "primary"


@dataclass(frozen=True, eq=False)
class HomogenizedCritical:
    """The first critical point of a primary path."""

    load: float
    """Critical load [-]."""
    kind: str
    """Kind of instability: "pattern" (a mode with v), "displacement" (of u alone), "RVE" (a
    fluctuation that no given mode describes; without modes, the pattern itself)."""
    state: HomogenizedState
    """The state just before."""
    modes: FloatArray
    """(k, free unknowns) critical modes of the body, scaled to a largest displacement of the
    pattern (of u for "displacement") of 1 mm; none for "RVE"."""
    negative_before: int
    negative_after: int
    """Negative eigenvalues ``critical_tolerance`` before and after: the proof."""


class HomogenizedPath:
    """Equilibria of one body; the linearisation at the last one is reused for the next.

    ``linearisations`` counts linearisations of the body; each factorises every RVE once.
    """

    def __init__(self, body: HomogenizedBody, options: PathOptions | None = None) -> None:
        self.body, self.options = body, options or PathOptions()
        self.linearisations = 0
        vectors = body.rves[0].cell.cell.lattice
        self.pitch = 0.5 * float(np.linalg.norm(vectors, axis=1).min())
        """Half the RVE's shorter vector, to which a branch's amplitudes refer [mm]."""
        start = self.equilibrium(0.0, body.start)
        if start is None or start.negative_eigenvalues or self._is_singular():
            what = "homogenized body: expected one that is stable without load, got one that isn't"
            raise InputError(f"{what}; check material and mesh, or take more points")
        self.states = [start]
        """States of the primary path."""
        # A metric that makes eigenvalues of u and v comparable.
        self._at_rest = self.last.stiffness
        self.scale = np.abs(self._at_rest.diagonal())

    def _is_singular(self) -> bool:
        """Whether the last stiffness has an eigenvalue that rounding may make negative or not."""
        K = self.last.stiffness
        shift = diags_array(_SINGULAR * np.abs(K.diagonal()))
        try:
            return (
                factorise(csr_array(K - shift).sorted_indices(), definite=False).negative_pivots > 0
            )
        except SingularMatrixError:
            return True

    def equilibrium(
        self, load: float, guess: FloatArray, weights: FloatArray | None = None,
        amplitude: float = 0.0, branch: str = "primary", small: float = _SMALL,
    ) -> HomogenizedState | None:  # fmt: skip
        """The equilibrium near a guess, at a load or with weights . y = amplitude; None if lost."""
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
            if rest <= small * at.load_size and at.excess <= small:
                self.last = at
                return self._settled(load, value, dy, branch)
        return None

    def _settled(
        self, load: float, value: FloatArray, dy: FloatArray, branch: str
    ) -> HomogenizedState | None:
        """The state after a last, small step from the linearisation.

        None if an element of an RVE is inverted.
        """
        at, body = self.last, self.body
        areas = [region.at.weights.ravel() for region in self.body.regions]
        unknowns = body.unknowns(value, load)
        strains, rows = body.strains(unknowns), np.empty((len(body.own), 2))
        for row, number, w in zip(rows, body.own, body.fluctuations(value), strict=True):
            rve, q = body.rve(number), strains[0][number // len(body.rves)]
            u = rve.displacement(q, w)
            row[:] = rve.cell.body.energy(u) / rve.area, rve.cell.body.smallest_jacobian(u)
        every = body.gathered(rows)
        if not every[..., 1].min() > 0:
            return None
        u, v = body.fields(unknowns)
        energy = float(areas[0] @ every[..., 0].mean(axis=1))
        if len(areas) > 1:
            energy += float(areas[1] @ body.bulk_response(strains[1])[0])
        chosen = np.flatnonzero(body.is_pattern)
        K = at.stiffness[chosen][:, chosen].sorted_indices()
        stresses = at.stresses + np.einsum("pst,pt->ps", at.moduli, strains[0] - at.strains)
        work_rate = body.direction @ (at.forces + (load - at.load) * at.along_load)
        return HomogenizedState(
            load=float(load),
            force=body.copies * float(work_rate + at.load_force @ dy) / body.length,
            energy=body.copies * energy, displacement=u, amplitudes=v, strains=strains[0],
            stresses=stresses, negative_eigenvalues=at.negative, rve_negative=at.rve_negative,
            pattern_negative=factorise(K, definite=False).negative_pivots if len(chosen) else 0,
            value=value,
            rate=at.moved(at.along, 1.0, relax=False), branch=branch,
        )  # fmt: skip

    def follow_primary(self, load: float, block: str = "") -> bool:
        """Extend ``states`` to a load, or to the first state at which a block is unstable.

        False if no step, down to 1e-5, converges.

        block : "all", or "pattern" for v alone; by default stability is ignored.
        """
        step = self.options.first_step
        while (here := self.states[-1]).load < load - 1e-12 and not is_unstable(here, block):
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
        """The critical point between the last two of ``states``; None if it can't be located.

        There the block's lowest eigenvalue passes zero, or the number of negative eigenvalues of
        the RVEs changes; the inertia on both sides is the proof.
        """
        tolerance, ends = self.options.critical_tolerance, self.states[-2:]
        known, calm = {state.load: state for state in ends}, ends[0].rve_negative

        def at(load: float) -> HomogenizedState:
            # Extrapolate only from states that are not so close to the singular one that rounding
            # changes their v, and not that close to each other.
            far, near = 100 * tolerance, list[float]()
            for e in sorted(known, key=lambda e: abs(e - load)):
                if e == load or all(abs(e - other) > far for other in (load, *near)):
                    near.append(e)
            states = [known[e] for e in near[1::-1]] or [ends[0]]
            guess = _expected(states, load)
            found = self.equilibrium(load, guess, small=_SMALL_AT_CRITICAL)
            if found is None:
                raise ArithmeticError(f"no equilibrium at the load {load}")
            known[load] = found
            return found

        def measure(load: float, part: str) -> float:
            state = at(load)
            if part == "RVE":
                return -1.0 if state.rve_negative > calm else 1.0
            return float(self._eigenpairs(part)[0][0])

        # First the block of v alone: its eigenvalue is smooth even if modes of u are lower.
        parts = ["pattern", block] if ends[1].pattern_negative else [block]
        if block == "all" and ends[1].rve_negative > calm:
            parts = ["RVE", *parts]
        between = [state.load for state in ends]
        for part in parts:
            find = bisect if part == "RVE" else brentq
            try:
                load = float(find(measure, *between, (part,), xtol=0.2 * tolerance))
                after, before = at(load + tolerance), at(load - tolerance)
            except (ArithmeticError, ValueError):  # ValueError: no change of sign
                continue
            if is_unstable(after, block) and not is_unstable(before, block):
                modes, kind = self._critical_modes(block) if part != "RVE" else (_NONE, part)
                counts = before.negative_eigenvalues, after.negative_eigenvalues
                return HomogenizedCritical(load, kind, before, modes, *counts)
            if part == "RVE":  # the whole body becomes unstable earlier
                between[1] = before.load
        return None

    def _critical_modes(self, block: str) -> tuple[FloatArray, str]:
        """(k, free unknowns) set of critical modes of the last state, and its kind."""
        values, vectors = self._eigenpairs(block)
        count = int(np.sum(np.abs(values - values[0]) < _ALIKE))
        falls = values < _SPLIT * np.sum(vectors * (self._at_rest @ vectors), axis=0)
        v = np.nan_to_num([self.body.fields(self.body.T @ x)[1].T for x in vectors.T])
        for n in range(count + 1, min(self.body.mode_count, int(np.argmin([*falls, False]))) + 1):
            size = np.linalg.svd(v[:n].reshape(-1, v.shape[2]), compute_uv=False) ** 2
            count = n if size[0] > _SHARED * size.sum() else count
        modes = vectors[:, :count].T
        peaks = np.array([self.largest(mode) for mode in modes])
        kind = "pattern" if peaks[0, 0] > _SOME * peaks[0, 1] else "displacement"
        return modes / peaks[:, [int(kind != "pattern")]], kind

    def _eigenpairs(self, block: str) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues [-], ascending, and eigenvectors of y's stiffness at the last state."""
        chosen = np.flatnonzero(self.body.is_pattern | (block == "all"))
        root = 1.0 / np.sqrt(self.scale[chosen])
        K = self.last.stiffness[chosen][:, chosen] * root[:, None] * root
        if len(chosen) <= _DENSE:
            values, scaled = eigh(K.toarray())
        else:
            values, scaled = eigsh(csc_array(K), _FEW, sigma=0.0)
        order = np.argsort(values)[:_FEW]
        vectors = np.zeros((self.body.free_count, len(order)))
        vectors[chosen] = root[:, None] * scaled[:, order]
        return values[order], vectors

    def largest(self, mode: FloatArray) -> tuple[float, float]:
        """Largest displacement of the pattern, sum |v_i| max |phi_i|, and of u [mm]."""
        u, v = self.body.fields(self.body.T @ mode)
        peaks = np.linalg.norm(self.body.rves[0].shapes, axis=2).max(axis=1)
        pattern = np.nan_to_num(np.abs(v)) @ peaks
        return float(pattern.max()), float(np.linalg.norm(u, axis=1).max())


def _expected(states: Sequence[HomogenizedState], load: float) -> FloatArray:
    """State extrapolated to a load by the last state's tangent, or the last two's cubic."""
    return np.asarray(extrapolate([(s.load, s.value, s.rate) for s in states[-2:]], load))


def is_unstable(state: HomogenizedState, block: str) -> bool:
    """Whether a block ("all", "pattern", or none) has a negative eigenvalue."""
    counts = {"all": state.negative_eigenvalues, "pattern": state.pattern_negative, "": 0}
    return counts[block] > 0
