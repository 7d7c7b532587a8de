"""A compression test whose material and supports are parameters: its states and sensitivities.

Forms are compiled once, with the parameters as constants. The states for given parameters are
found along the whole path, from the undeformed specimen through its critical point to the requested
branch. Parameters that break the mirror symmetry (tilt, individual holes) are applied last: at each
state of the symmetric specimen they are increased at constant strain, which stays on the named
branch, whereas the natural path would lead to the branch that it favours. States for nearby
parameters follow from these at a fraction of the cost: sensitivities predict them, Newton's method
corrects, and the inertia confirms their stability.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import hole_motion, mesh_specimen, perturb
from modeharvest.fem.path.bifurcation import Critical, follow_branch, locate_critical
from modeharvest.fem.path.continuation import BranchPoint, PathFollower, State, load_at, value_at
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.path.factor import BodyFactor
from modeharvest.fem.path.newton import Constraint, path_tangent
from modeharvest.fem.path.parameters import TILT, TRAVEL, holes_of, parameter, require_open
from modeharvest.fem.path.sensitivity import (
    OMITTED,
    Sensitivity,
    Variation,
    amplitude_sensitivity,
    sensitivities,
    with_omitted_terms,
)
from modeharvest.fem.path.stability import Mode
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

_SIGNS = {"buckled+": 1, "buckled-": -1}
_SHORTEST = 1 / 64  # smallest step, as a fraction of the asymmetry or of an amplitude
_NO_PATTERN = 1e-6  # overlap of a mode with the pattern [-], or amplitude [mm], that counts as 0
_AHEAD, _BEYOND = 1.02, 2.0  # times the last strain: range of the search for a critical point
_ATTEMPTS = 3  # each with shorter steps
_OFF, _JUMP = 0.5, 0.05
"""Largest deviation of a state from its prediction, over the predicted step, or over all of u."""
_BELOW = 1.0 - 1e-6  # factor on a critical point's u: so close, derivatives are the same
_KEPT = 0.3  # least fraction of a buckled state's pattern that remains after one step


@dataclass(frozen=True, eq=False)
class ParametricState:
    """An equilibrium state of a test, and its derivatives by the test's ``names``."""

    strain: float
    """Nominal strain over ``travel`` [-]: that of the test, or as given by the amplitude."""
    mesh: Mesh
    """The undeformed mesh, with the holes' positions according to the parameters."""
    displacement: FloatArray
    """(n, 2) displacement of the mesh's nodes [mm]."""
    force: float
    """Compressive force per unit thickness [N/mm]."""
    negative_pivots: int
    branch: str
    displacement_by: FloatArray
    nodes_by: FloatArray
    """(k, n, 2) derivatives of the nodes' displacements and of their positions [mm per unit]."""
    force_by: FloatArray
    """(k,) derivatives of the force [N/mm per unit]."""
    strain_by: FloatArray
    """(k,) derivatives of the strain [1 per unit]."""
    amplitude: float = 0.0
    """Amplitude of the pattern: the displacement's projection on it [mm]."""


class _Known(NamedTuple):
    """A known state, its internal forces, and its derivatives by the unknowns if requested."""

    state: State
    branch: str
    forces: PETSc.Vec
    by: Sequence[Sensitivity] = ()


class ParametricTest:
    """The states of a virtual test at its strains, for any values of its unknown parameters.

    experiment : values of everything that isn't unknown; only its first branch is used.
    names : names of the unknowns, see :func:`modeharvest.fem.path.parameters.parameter`. With
        "amplitude[k]" state number k is defined by the pattern's amplitude [mm] instead of its
        nominal strain.
    mesh : T6 mesh of the specimen.
    degree : polynomial degree of the displacement over an element. Above 2 the states are given
        on another ``mesh``, with every element divided into four.
    """

    def __init__(
        self, experiment: Experiment, names: Sequence[str], mesh: Mesh, degree: int = 2
    ) -> None:
        spec = experiment.specimen
        pins = spec.mid_junctions if experiment.guided else ()
        loading = EdgeCompression(spec.half_size[0], spec.length, experiment.edges, 0.0, pins)
        comm = MPI.COMM_SELF
        self.structure = Structure(mesh, experiment.material, loading, comm, True, degree)
        self.experiment, self.names, self.mesh = experiment, tuple(names), self.structure.shown
        self.with_critical = False  # whether the critical state comes last
        self._nodes, self._degree = mesh.nodes, degree
        self._parameters = {name: parameter(name, experiment) for name in (*names, TILT)}
        self._variations = {name: self._variation(name) for name in self._parameters}
        self._moved = {n: self.structure.on_shown(v.nodes) for n, v in self._variations.items()}
        self._follower = PathFollower(self.structure, experiment.path)
        pattern = self.structure.from_function(spec.pattern)
        weighted = self._follower.mass * pattern
        square = float(weighted.dot(pattern))
        self._weights, self._norm = (1.0 / square) * weighted, float(np.sqrt(square))
        self._critical: Critical | None = None
        self._last: tuple[FloatArray, list[_Known]] | None = None

    @classmethod
    def meshed(
        cls, experiment: Experiment, names: Sequence[str], degree: int = 3
    ) -> ParametricTest:
        """A test on a mesh of the experiment's element size, with its scatter of the holes."""
        spec = experiment.specimen
        mesh = perturb(mesh_specimen(spec, experiment.mesh_size), spec, experiment.imperfection)
        return cls(experiment, names, mesh, degree)

    @property
    def critical_strain(self) -> float | None:
        """Critical strain for the last values whose path was followed; None if none [-]."""
        return None if self._critical is None else self._critical.strain

    @property
    def own_values(self) -> FloatArray:
        """(k,) values of the parameters in the experiment: material constants; 1 for travel."""
        known = {name: float(c.value) for name, c in self.structure.constants.items()}
        known |= {TRAVEL: 1.0, TILT: self.experiment.tilt}
        return np.array([known.get(name, 0.0) for name in self.names])

    @property
    def unknowns(self) -> int:
        """Number of displacement unknowns."""
        return int(self._weights.size)

    def at(self, values: FloatArray, with_derivatives: bool = True) -> list[ParametricState]:
        """The states for values (k,) of the unknowns, in the order of ``names``.

        InputError if the path doesn't reach one of the states.
        """
        first, late, travel, amplitudes = self._given(values)
        self._vary(first)
        known = []
        for k, (state, branch) in enumerate(self._states(travel, amplitudes)):
            weights, factor = None if amplitudes[k] is None else self._weights, None
            if late.nodes.any() or late.edges.any():
                state, factor = self._bent(state, first, late, weights), self._factor
            known.append(self._known(state, branch, k, travel, weights, factor, with_derivatives))
        return self._results(values, known)

    def near(self, values: FloatArray, with_derivatives: bool = True) -> list[ParametricState]:
        """The states as from :meth:`at`, if possible in one step from the states found last.

        The whole path is followed without such states, or if the step leads to no equilibrium, to
        an unstable one, to one far from its prediction, or to one without the pattern.
        """
        if self._last is None:
            return self.at(values, with_derivatives)
        first, late, travel, amplitudes = self._given(values)
        self._vary(first, 1.0, late)
        change, known = values - self._last[0], []
        for k, before in enumerate(self._last[1]):
            guess, strain, constraint = before.state.u.copy(), before.state.strain, None
            for part, rate in zip(change, before.by, strict=False):
                guess.axpy(float(part), rate.displacement)
                strain += float(part) * rate.strain
            if (amplitude := amplitudes[k]) is None:
                strain = travel * self.experiment.strains[k]
            else:
                constraint = Constraint(self._weights, self.structure.zero(), amplitude)
            self._follower.linearisation = None
            state = self._follower.equilibrium(strain, guess, constraint, with_modes=False)
            if state is None or state.negative_pivots > before.state.negative_pivots:
                return self.at(values, with_derivatives)
            step, size = (guess - before.state.u).norm(), before.state.u.norm()
            is_far = (state.u - guess).norm() > max(_OFF * step, _JUMP * size)
            was, now = (float(self._weights.dot(s.u)) for s in (before.state, state))
            is_lost = now * np.sign(was) < max(_KEPT * abs(was), _NO_PATTERN)
            if is_far or (before.branch != "primary" and amplitude is None and is_lost):
                return self.at(values, with_derivatives)
            weights = None if amplitude is None else self._weights
            how = k, travel, weights, self._factor, with_derivatives
            known.append(self._known(state, before.branch, *how))
        if self.with_critical:  # always by the whole primary path, which is exactly symmetric
            self._vary(first)
            most = _BEYOND * travel * max(self.experiment.strains)
            _, self._critical = self._primary(most, (), self.experiment.branches[0])
            if self._critical is None:
                return self.at(values, with_derivatives)
        return self._results(values, known)

    def critical_state(self, values: FloatArray) -> ParametricState | None:
        """The bifurcation and its derivatives for the last values whose states were found, or None.

        Asymmetric parameters act to first order: a tilt doesn't, the holes' mean deviation does.
        """
        if (point := self._critical) is None:
            return None
        first, _, travel, _ = self._given(values)
        self._vary(first)
        factor = self.structure.factor(_BELOW * point.u)  # at the point the tangent is singular
        tangent = path_tangent(self.structure, factor, self.structure.load(point.u))
        state = State(point.strain, point.u, tangent, 0)
        forces = self.structure.forces(state.u)
        by = self._by(state, -1, travel, forces, None, factor, point.modes[0])
        found = self._result(_Known(state, "critical", forces, by), travel)
        late = np.array([not self._parameters[name].is_symmetric for name in self.names])
        return replace(found, strain=found.strain + float(found.strain_by @ (late * values)))

    def _results(self, values: FloatArray, known: list[_Known]) -> list[ParametricState]:
        """The states found last, and the critical state if requested."""
        self._last = np.array(values), known
        _, late, travel, _ = found = self._given(values)
        self._vary(found[0], 1.0, late)
        states = [self._result(one, travel) for one in known]
        critical = self.critical_state(values) if self.with_critical else None
        return [*states, critical] if critical else states

    def _given(
        self, values: FloatArray
    ) -> tuple[Variation, Variation, float, dict[int, float | None]]:
        """Symmetric and asymmetric variation, travel, amplitudes; sets the material's constants."""
        given = dict(zip(self.names, map(float, values), strict=True))
        for name, constant in self.structure.constants.items():
            constant.value = given.get(name, float(constant.value))
        amplitudes = {k: given.get(f"amplitude[{k}]") for k in range(len(self.experiment.strains))}
        travel, given = given.get(TRAVEL, 1.0), {TILT: self.experiment.tilt, **given}
        off = holes_of(list(given), list(given.values()), self.experiment)
        require_open(self.experiment.specimen, off)
        keeping = {name for name in given if self._parameters[name].is_symmetric}
        first, late = self._sum(given, keeping), self._sum(given, given.keys() - keeping)
        return first, late, travel, amplitudes

    @property
    def _factor(self) -> BodyFactor | None:
        """Factor of the tangent stiffness at the equilibrium found last."""
        near = self._follower.linearisation
        return None if near is None else near.factor

    def omitted_terms(self, values: FloatArray) -> list[ParametricState]:
        """The states, with derivatives by the OMITTED constants of the law only."""
        k, law = len(values), with_omitted_terms(self.experiment.material)
        wider = replace(self.experiment, material=law)
        test = ParametricTest.meshed(wider, [*self.names, *OMITTED], self._degree)
        test.with_critical = self.with_critical
        return [
            replace(s, displacement_by=s.displacement_by[k:], nodes_by=s.nodes_by[k:],
                    force_by=s.force_by[k:], strain_by=s.strain_by[k:])
            for s in test.at(np.append(values, np.zeros(len(OMITTED))))
        ]  # fmt: skip

    def _variation(self, name: str) -> Variation:
        """The change of the structure with a parameter."""
        found, spec, nodes = self._parameters[name], self.experiment.specimen, self._nodes
        zero = np.zeros_like(nodes)
        moved = zero if found.holes is None else hole_motion(nodes, spec, found.holes)
        edges = zero if found.edge is None else found.edge.at(nodes, spec)
        return Variation(moved, edges, found.constant)

    def _sum(self, values: Mapping[str, float], names: Iterable[str]) -> Variation:
        """The sum of the changes of nodes and edges due to some of the parameters."""
        nodes, edges = np.zeros_like(self._nodes), np.zeros_like(self._nodes)
        for name in names:
            nodes += values[name] * self._variations[name].nodes
            edges += values[name] * self._variations[name].edges
        return Variation(nodes, edges)

    def _vary(self, first: Variation, share: float = 0.0, late: Variation | None = None) -> None:
        """Apply one variation and a fraction ``share`` of another to the structure."""
        late = late or first
        self.structure.place(self._nodes + first.nodes + share * late.nodes)
        self.structure.lead(first.edges + share * late.edges)

    def _states(
        self, travel: float, amplitudes: dict[int, float | None]
    ) -> list[tuple[State, str]]:
        strains = [travel * e for e in self.experiment.strains]
        by_strain = [e for k, e in enumerate(strains) if amplitudes[k] is None]
        name = self.experiment.branches[0]
        # A branch with a given amplitude may start beyond the strains for these parameters.
        most = _BEYOND if len(by_strain) < len(strains) or self.with_critical else _AHEAD
        most *= max(strains)
        path, critical = self._primary(most, by_strain, name)
        self._critical = critical
        if critical is None and self.with_critical:
            raise InputError(f"critical_strain: expected buckling up to {most:.4g}, got none")
        buckled: list[State] = []
        if critical is not None:
            targets = [e for e in by_strain if e > critical.strain]
            pitch = self.experiment.specimen.pitch
            buckled = follow_branch(self._follower, critical, targets, 1, pitch) if targets else []
        found: list[tuple[State, str]] = []
        for k, e in enumerate(strains):
            amplitude = amplitudes[k]
            if amplitude is not None:
                state = None if critical is None else self._at_amplitude(critical, amplitude)
                branch = name
            else:
                is_buckled = critical is not None and e > critical.strain
                states, branch = (buckled, name) if is_buckled else (path, "primary")
                state = next((s for s in states if abs(s.strain - e) < 1e-12), None)
            if state is None:
                raise InputError(
                    f"expected an equilibrium at a nominal strain of {100 * e:.4g} % on the "
                    f"{branch} path, got none: it does not reach it; leave that strain out"
                )
            found.append((state, branch))
        return found

    def _primary(
        self, largest: float, strains: Sequence[float], name: str
    ) -> tuple[list[State], Critical | None]:
        """The primary path through the strains until it is unstable, and its critical point."""
        follower, options = self._follower, self.experiment.path
        follower.options, follower.linearisation, follower.modes = options, None, []
        path, targets = [follower.start()], sorted({*strains, largest})
        if not self.experiment.imperfection.is_none:
            follower.follow_primary(path, targets, refuse_unstable=True)
            return path, None
        for _ in range(_ATTEMPTS):
            follower.follow_primary(path, targets, until_unstable=True)
            if path[-1].negative_pivots == 0:
                return path, None
            critical = locate_critical(follower, path[-2], path[-1])
            if critical is not None:
                return path, self._of_branch(critical, name)
            path.pop()
            steps = {n: getattr(follower.options, n) / 3.0 for n in ("first_step", "largest_step")}
            follower.options, follower.linearisation = replace(follower.options, **steps), None
        follower.follow_primary(path, targets, refuse_unstable=True)
        return path, None

    def _of_branch(self, critical: Critical, name: str) -> Critical:
        """The critical point, its mode with the sign of the named branch, as in simulations."""
        mode, spec = critical.modes[0], self.experiment.specimen
        share = self._share(mode.vector)
        if spec.is_staggered or abs(share) < _NO_PATTERN:
            share = mode.overlap(self.structure.from_function(spec.asymmetric))
        if share * _SIGNS.get(name, 1) < 0.0:
            critical.modes[0] = mode.reversed()
        return critical

    def _share(self, mode: PETSc.Vec) -> float:
        """Overlap of a mode with the pattern [-]."""
        return float(self._weights.dot(mode)) * self._norm

    def _at_amplitude(self, critical: Critical, target: float) -> State | None:
        """The state of the branch at which the pattern has a given amplitude [mm]."""
        follower, weights = self._follower, self._weights
        mode = critical.modes[0].vector
        if abs(self._share(mode)) < _NO_PATTERN:
            raise InputError(
                f"expected a first buckling mode with a part of the pattern, whose amplitude "
                f"amplitude[k] is, got one of another symmetry at {100 * critical.strain:.4g} %"
            )
        rate = (1.0 / float(weights.dot(mode))) * mode
        points = [BranchPoint(0.0, critical.strain, 0.0, critical.u, rate)]
        origin = self.structure.zero()
        step, state = min(abs(target), 0.05 * self.experiment.specimen.pitch), None
        follower.linearisation = None
        while points[-1].amplitude != target:
            left = target - points[-1].amplitude
            amplitude = points[-1].amplitude + float(np.copysign(step, left))
            amplitude = target if abs(left) <= 1.1 * step else amplitude
            constraint = Constraint(weights, origin, amplitude)
            guess = value_at(points, amplitude)
            at = follower.equilibrium(load_at(points, amplitude), guess, constraint, False)
            if at is None:
                step, follower.linearisation = 0.5 * step, None
                if step < _SHORTEST * abs(target):
                    return None
                continue
            state, by_load = at, 1.0 / float(weights.dot(at.tangent))
            points.append(BranchPoint(amplitude, at.strain, by_load, at.u, by_load * at.tangent))
            step *= 2.0
        return state

    def _bent(
        self, state: State, first: Variation, late: Variation, weights: PETSc.Vec | None
    ) -> State:
        """The state at the same strain or amplitude with the asymmetric variation, in steps."""
        structure, follower = self.structure, self._follower
        length, constraint, reached, step = self.experiment.specimen.length, None, 0.0, 1.0
        if weights is not None:
            constraint = Constraint(weights, structure.zero(), float(weights.dot(state.u)))
        while reached < 1.0:
            aim = 1.0 if 1.0 - reached <= 1.01 * step else reached + step
            self._vary(first, reached, late)
            (rate,) = sensitivities(structure, state, [late], length, weights)
            guess = state.u + (aim - reached) * rate.displacement
            strain = state.strain + (aim - reached) * rate.strain
            self._vary(first, aim, late)
            follower.linearisation = None
            found = follower.equilibrium(strain, guess, constraint, with_modes=False)
            # With a prescribed small amplitude opposed by the tilt, the state is unstable.
            is_slip = constraint is None and found and found.negative_pivots > state.negative_pivots
            if found is None or is_slip:
                step *= 0.5
                if step < _SHORTEST:
                    raise InputError(
                        f"expected an equilibrium at a nominal strain of {100 * state.strain:.4g} "
                        "% with a tilt or holes of their own, got none beyond "
                        f"{100 * reached:.3g} % of them: give them less, or a state farther from "
                        "buckling, or its amplitude as an unknown"
                    )
                continue
            state, reached = found, aim
        return state

    def _known(
        self, state: State, branch: str, number: int, travel: float, weights: PETSc.Vec | None,
        factor: BodyFactor | None, with_derivatives: bool,
    ) -> _Known:  # fmt: skip
        """A state with its internal forces, and with its derivatives if requested."""
        forces = self.structure.forces(state.u)
        how = number, travel, forces, weights, factor
        return _Known(state, branch, forces, self._by(state, *how) if with_derivatives else ())

    def _by(
        self, state: State, number: int, travel: float, forces: PETSc.Vec,
        weights: PETSc.Vec | None, factor: BodyFactor | None, mode: Mode | None = None,
    ) -> list[Sensitivity]:  # fmt: skip
        """Derivatives by all unknowns; zero for amplitudes of other states."""
        structure, length = self.structure, self.experiment.specimen.length
        own = [n for n in self.names if not n.startswith("amplitude")]
        variations = [None if n == TRAVEL else self._variations[n] for n in own]
        how = length, weights, travel, factor, mode, forces
        parts = sensitivities(structure, state, variations, *how)
        known: dict[str, Any] = dict(zip(own, parts, strict=True))
        if weights is not None:
            derivative = amplitude_sensitivity(structure, state, length, weights)
            known[f"amplitude[{number}]"] = derivative
        nothing = Sensitivity(structure.zero(), 0.0, 0.0)
        return [known.get(name, nothing) for name in self.names]

    def _result(self, known: _Known, travel: float) -> ParametricState:
        state, branch, forces, by = known
        structure, length, mesh = self.structure, self.experiment.specimen.length, self.mesh
        if np.any(structure.nodes != self._nodes):
            mesh = replace(mesh, nodes=structure.on_shown(structure.nodes))
        names, shape = self.names[: len(by)], (-1, *mesh.nodes.shape)
        fields = [structure.nodal(s.displacement) for s in by]
        moved = [self._moved[n] for n in names]
        of_travel = np.array([name == TRAVEL for name in names], np.float64)
        strain, strain_by = state.strain / travel, np.array([s.strain for s in by])
        return ParametricState(
            strain, mesh, structure.nodal(state.u), structure.reaction_of(forces, length),
            state.negative_pivots, branch, np.reshape(fields, shape), np.reshape(moved, shape),
            np.array([s.force for s in by]), np.asarray((strain_by - strain * of_travel) / travel),
            float(self._weights.dot(state.u)),
        )  # fmt: skip
