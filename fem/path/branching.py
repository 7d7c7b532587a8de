"""The branch that leaves the primary path at the critical point, as a function of its mode.

The mode's amplitude is prescribed and the strain is an unknown: that system is regular at the
pitchfork itself. :func:`follow_branch` meets given strains exactly under prescribed strain.
:func:`simulate_pattern` follows the branch until its pattern has a given amplitude, without the
unstable primary path up to given strains, which costs most where ligaments are thin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.optimize import brentq

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.path.continuation import PathFollower, State, combine
from modeharvest.fem.path.critical import Critical, locate_critical
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.path.newton import Constraint
from modeharvest.fem.path.predictor import hermite_weights
from modeharvest.fem.path.stability import Mode
from modeharvest.util import __version__
from modeharvest.util.arrays import FloatArray


def follow_branch(
    walker: PathFollower, critical: Critical, targets: Sequence[float], sign: int, length: float
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


PATTERN_TOLERANCE = 0.02
"""How near to the wanted amplitude is near enough [-]."""
_FIRST, _SHORTEST = 0.25, 0.01  # steps along the branch, in shares of the wanted amplitude
_WALKS = 3  # with shorter and shorter steps


class PatternMeasure(Protocol):
    """What is looked for in nodal displacements (n, 2) [mm]."""

    def share(self, displacement: FloatArray) -> float:
        """How much of a field is the pattern, between -1 and 1; its sign is the pattern's."""

    def amplitude(self, displacement: FloatArray) -> float:
        """The pattern's amplitude [mm]."""


def simulate_pattern(
    experiment: Experiment, mesh: Mesh, pattern: PatternMeasure, wanted: float, largest: float
) -> Solution:
    """Compress a perfect specimen until it buckles, and follow it until its pattern is so strong.

    Parameters
    ----------
    experiment
        Specimen, material, edges and path options; strains and branches are not used.
    mesh
        Of the specimen.
    pattern
        What is to become so strong.
    wanted
        The pattern's amplitude to be reached [mm].
    largest
        Nominal strain up to which to look for the first critical point [-].

    Returns
    -------
    Solution
        With one snapshot, on the branch that leaves the primary path at its first critical point.
        Without such a point it is the last stable state, and ``info["critical"]`` is None; else
        that has the ``strain`` and ``pattern_overlap_by_cell``, the buckling mode's
        share. ``info["outcome"]`` says in words what happened.
    """
    spec = experiment.specimen
    loading = EdgeCompression(spec.half_size[0], spec.length, experiment.edges)
    walker = PathFollower(
        Structure(mesh, experiment.material, loading, MPI.COMM_SELF), experiment.path
    )
    state, critical, outcome = _until_critical(walker, largest)
    info = None
    if critical is not None:
        share = pattern.share(walker.structure.nodal(critical.modes[0].vector))
        info = {"strain": critical.strain, "pattern_overlap_by_cell": abs(share)}
        oriented = critical.modes[0] if share > 0 else critical.modes[0].reversed()
        state, reached = _follow(walker, state, critical, oriented, pattern, wanted)
        if abs(reached / wanted - 1.0) > PATTERN_TOLERANCE:
            outcome = (
                f"the branch could be followed to a pattern of {reached / spec.pitch:.3f} l only, "
                f"not to {wanted / spec.pitch:.3f} l"
            )
    return _solution(walker, mesh, experiment, state, {"critical": info, "outcome": outcome})


def _follow(
    walker: PathFollower,
    stable: State,
    critical: Critical,
    mode: Mode,
    pattern: PatternMeasure,
    wanted: float,
) -> tuple[State, float]:
    """Along the branch, step by step of the mode's amplitude, to a pattern of a wanted amplitude.

    The mode's amplitude is prescribed and the strain is free, so that a branch may turn back.
    Returns the last state, ``stable`` if there is none, and the pattern's amplitude there [mm].
    """
    structure = walker.structure
    largest = structure.largest(mode.vector)  # amplitudes are largest displacements
    weights = largest * mode.weighted
    points = [_PatternPoint(0.0, critical.strain, 0.0, critical.u, (1.0 / largest) * mode.vector)]
    step, shortest = _FIRST * wanted, _SHORTEST * wanted
    state, reached = stable, 0.0
    while abs(step) > shortest:
        amplitude = points[-1].amplitude + step
        constraint = Constraint(weights, critical.u, amplitude)
        found = walker.equilibrium(*_predicted(points, amplitude), constraint)
        if found is None:
            step, walker.linearisation = 0.5 * step, None  # it may belong to the failed state
            continue
        strain_rate = 1.0 / float(weights.dot(found.tangent))
        points.append(
            _PatternPoint(
                amplitude, found.strain, strain_rate, found.u, strain_rate * found.tangent
            )
        )
        state, reached = found, pattern.amplitude(structure.nodal(found.u))
        if abs(reached / wanted - 1.0) < PATTERN_TOLERANCE:
            break
        step = amplitude * float(np.clip(wanted / reached - 1.0, -0.5, 1.0))
    return state, reached


class _PatternPoint(NamedTuple):
    """A point of the branch as a function of the mode's amplitude [mm]; ``u`` is a PETSc vector."""

    amplitude: float
    strain: float
    strain_rate: float
    u: Any
    rate: Any


def _predicted(points: list[_PatternPoint], amplitude: float) -> tuple[float, Any]:
    """Strain and displacement at an amplitude, from the last two points and their rates."""
    b = points[-1]
    if len(points) == 1:
        step = amplitude - b.amplitude
        return b.strain + step * b.strain_rate, b.u + step * b.rate
    a = points[-2]
    w = hermite_weights(a.amplitude, b.amplitude, amplitude)
    strain = w[0] * a.strain + w[1] * a.strain_rate + w[2] * b.strain + w[3] * b.strain_rate
    return strain, w[0] * a.u + w[1] * a.rate + w[2] * b.u + w[3] * b.rate


def _until_critical(walker: PathFollower, largest: float) -> tuple[State, Critical | None, str]:
    """The last stable state of the primary path, its first critical point, and what happened.

    Where no bifurcation is found between the last two states, steps were too long to stay on the
    path: it is walked again from the stable one with shorter steps.
    """
    path = [walker.start()]
    for _ in range(_WALKS):
        reached = walker.primary(path, (largest,), until_unstable=True)
        last = path[-1]
        if last.negative_pivots == 0:
            why = "the largest strain looked at" if reached else "where the path was lost"
            return last, None, f"stable up to {100 * last.strain:.4g} %, {why}"
        critical = locate_critical(walker, path[-2], last)
        if critical is not None:
            return path[-2], critical, "complete"
        path.pop()
        steps = {n: getattr(walker.options, n) / 3.0 for n in ("first_step", "largest_step")}
        walker.options = replace(walker.options, **steps)
        walker.linearisation = None
    return path[-1], None, (
        f"unstable between {100 * path[-1].strain:.4g} and {100 * last.strain:.4g} %, where no "
        "bifurcation was found"
    )  # fmt: skip


def _solution(
    walker: PathFollower, mesh: Mesh, experiment: Experiment, state: State, info: dict[str, object]
) -> Solution:
    structure, spec = walker.structure, experiment.specimen
    snapshot = Snapshot(
        nominal_strain=state.strain,
        displacement=structure.nodal(state.u),
        reaction=structure.reaction(state.u, spec.length),
        energy=structure.energy(state.u),
        negative_pivots=state.negative_pivots,
        eigenvalues=state.eigenvalues,
        branch="primary" if info["critical"] is None else "buckled+",
    )
    made = {
        "specimen": spec.plain(),
        "material": {"kind": type(experiment.material).__name__, **vars(experiment.material)},
        "loading": {"edges": experiment.edges, "length_mm": spec.length},
        "mesh_size_mm": experiment.mesh_size,
        "factorisations": structure.factorisations,
        "versions": {"modeharvest": __version__},
    }
    return Solution(mesh, (snapshot,), {**made, **info})
