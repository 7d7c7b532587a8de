"""A specimen compressed until its pattern is as strong as wanted.

:func:`modeharvest.fem.simulate.simulate` is told its strains beforehand, and walks the unstable
primary path up to them as well: that costs most where ligaments are thin.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from modeharvest import __version__
from modeharvest.fem.continuation import State, Walker, hermite_weights
from modeharvest.fem.corrector import Constraint
from modeharvest.fem.critical import Critical, locate_critical
from modeharvest.fem.equilibrium import Loading, Structure
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.stability import Mode

FloatArray = NDArray[np.float64]

CLOSE = 0.02
"""How near to the wanted amplitude is near enough [-]."""
_FIRST, _SHORTEST = 0.25, 0.01  # steps along the branch, in shares of the wanted amplitude
_WALKS = 3  # with shorter and shorter steps


class Pattern(Protocol):
    """What is looked for in nodal displacements (n, 2) [mm]."""

    def share(self, displacement: FloatArray) -> float:
        """How much of a field is the pattern, between -1 and 1; its sign is the pattern's."""

    def amplitude(self, displacement: FloatArray) -> float:
        """The pattern's amplitude [mm]."""


def simulate_pattern(
    experiment: Experiment, mesh: Mesh, pattern: Pattern, wanted: float, largest: float
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
    loading = Loading(spec.half_size[0], spec.length, experiment.edges)
    walker = Walker(Structure(mesh, experiment.material, loading, MPI.COMM_SELF), experiment.path)
    state, critical, outcome = _until_critical(walker, largest)
    info = None
    if critical is not None:
        share = pattern.share(walker.structure.nodal(critical.modes[0].vector))
        info = {"strain": critical.strain, "pattern_overlap_by_cell": abs(share)}
        oriented = critical.modes[0] if share > 0 else critical.modes[0].reversed()
        state, reached = _follow(walker, state, critical, oriented, pattern, wanted)
        if abs(reached / wanted - 1.0) > CLOSE:
            outcome = (
                f"the branch could be followed to a pattern of {reached / spec.pitch:.3f} l only, "
                f"not to {wanted / spec.pitch:.3f} l"
            )
    return _solution(walker, mesh, experiment, state, {"critical": info, "outcome": outcome})


def _follow(
    walker: Walker,
    stable: State,
    critical: Critical,
    mode: Mode,
    pattern: Pattern,
    wanted: float,
) -> tuple[State, float]:
    """Along the branch, step by step of the mode's amplitude, to a pattern of a wanted amplitude.

    The mode's amplitude is prescribed and the strain is free, so that a branch may turn back.
    Returns the last state, ``stable`` if there is none, and the pattern's amplitude there [mm].
    """
    structure = walker.structure
    largest = structure.largest(mode.vector)  # amplitudes are largest displacements
    weights = largest * mode.weighted
    points = [_Point(0.0, critical.strain, 0.0, critical.u, (1.0 / largest) * mode.vector)]
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
            _Point(amplitude, found.strain, strain_rate, found.u, strain_rate * found.tangent)
        )
        state, reached = found, pattern.amplitude(structure.nodal(found.u))
        if abs(reached / wanted - 1.0) < CLOSE:
            break
        step = amplitude * float(np.clip(wanted / reached - 1.0, -0.5, 1.0))
    return state, reached


class _Point(NamedTuple):
    """A point of the branch as a function of the mode's amplitude [mm]; ``u`` is a PETSc vector."""

    amplitude: float
    strain: float
    strain_rate: float
    u: Any
    rate: Any


def _predicted(points: list[_Point], amplitude: float) -> tuple[float, Any]:
    """Strain and displacement at an amplitude, from the last two points and their rates."""
    b = points[-1]
    if len(points) == 1:
        step = amplitude - b.amplitude
        return b.strain + step * b.strain_rate, b.u + step * b.rate
    a = points[-2]
    w = hermite_weights(a.amplitude, b.amplitude, amplitude)
    strain = w[0] * a.strain + w[1] * a.strain_rate + w[2] * b.strain + w[3] * b.strain_rate
    return strain, w[0] * a.u + w[1] * a.rate + w[2] * b.u + w[3] * b.rate


def _until_critical(walker: Walker, largest: float) -> tuple[State, Critical | None, str]:
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
    walker: Walker, mesh: Mesh, experiment: Experiment, state: State, info: dict[str, object]
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
        "specimen": asdict(spec),
        "material": {"kind": type(experiment.material).__name__, **vars(experiment.material)},
        "loading": {"edges": experiment.edges, "length_mm": spec.length},
        "mesh_size_mm": experiment.mesh_size,
        "factorisations": structure.factorisations,
        "versions": {"modeharvest": __version__},
    }
    return Solution(mesh, (snapshot,), {**made, **info})
