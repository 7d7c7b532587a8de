"""From a specimen to its solution: mesh it, follow its path, keep the requested snapshots."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from modeharvest.fem import dolfinx_api
from modeharvest.fem.experiment import BRANCHES, Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import material_table
from modeharvest.fem.meshing import mesh_specimen, perturb
from modeharvest.fem.path.bifurcation import (
    PATTERN_TOLERANCE,
    Critical,
    follow_branch,
    follow_to_pattern,
    locate_critical,
)
from modeharvest.fem.path.continuation import PathFollower, State
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.path.stability import Mode
from modeharvest.util import RELEASE
from modeharvest.util.arrays import FloatArray
from modeharvest.util.progress import Progress, silent


def simulate(
    experiment: Experiment, progress: Progress = silent, comm: MPI.Comm = MPI.COMM_WORLD
) -> Solution:
    """Run a virtual compression test (collective over ``comm``; every rank gets the result).

    The solution's ``info["outcome"]`` says how far the path was followed; if it ended early, the
    solution has the snapshots reached. ``info["warnings"]`` names unstable states on branches that
    should be stable. ``info["critical"]`` is None if the specimen stays stable, or is imperfect.
    InputError for an element size that can't mesh the specimen.
    """
    spec = experiment.specimen
    mesh = perturb(mesh_specimen(spec, experiment.mesh_size), spec, experiment.imperfection)
    return _Run(experiment, mesh, _follower(experiment, mesh, comm, progress)).solution()


def _follower(
    experiment: Experiment, mesh: Mesh, comm: MPI.Comm, progress: Progress = silent
) -> PathFollower:
    spec, edges = experiment.specimen, experiment.edges
    pins = spec.mid_junctions if experiment.guided else ()
    loading = EdgeCompression(spec.half_size[0], spec.length, edges, experiment.tilt, pins)
    structure = Structure(mesh, experiment.material, loading, comm)
    return PathFollower(structure, experiment.path, progress)


def _snapshot(structure: Structure, length: float, state: State, branch: str) -> Snapshot:
    return Snapshot(
        nominal_strain=state.strain,
        displacement=structure.nodal(state.u),
        reaction=structure.reaction(state.u, length),
        energy=structure.energy(state.u),
        negative_pivots=state.negative_pivots,
        eigenvalues=state.eigenvalues,
        branch=branch,
    )


@dataclass(eq=False)
class _Run:
    experiment: Experiment
    mesh: Mesh
    follower: PathFollower

    def solution(self) -> Solution:
        """Follow the path and collect the solution."""
        path, critical = self._primary()
        branches = {} if critical is None else self._branches(self._oriented(critical))
        limit = _stable_until(path, critical)
        snapshots = self._snapshots(path, limit, branches)
        info = self._info(path, critical, branches)
        info["outcome"] = self._outcome(snapshots, limit, {"primary": path, **branches})
        info["warnings"] = [
            f"{s.branch} at {100 * s.nominal_strain:g} % is not stable ({s.negative_pivots} "
            "negative pivots): the secondary bifurcation before it is not followed"
            for s in snapshots
            if s.branch != "primary" and s.negative_pivots
        ]
        return Solution(self.mesh, tuple(snapshots), info)

    def _primary(self) -> tuple[list[State], Critical | None]:
        """The primary path and its critical point; the path beyond it only on request.

        Without a bifurcation there is one natural path, which bends where the pattern sets in.
        This is so with imperfections, under tilted loading, and with odd numbers of holes in both
        directions, where the pattern keeps the symmetry. Long steps may leave this path; it is then
        followed again from the last stable state, and unstable states are refused.
        """
        strains = self.experiment.strains
        path = [self.follower.start()]
        if self.experiment.is_perfect:
            self.follower.follow_primary(path, strains, until_unstable=True)
            if path[-1].negative_pivots == 0:
                return path, None
            critical = locate_critical(self.follower, path[-2], path[-1])
            if critical is not None:
                if "primary" in self.experiment.branches:
                    self.follower.follow_primary(path, strains)
                return path, critical
            path.pop()
            self.follower.linearisation = None
        self.follower.follow_primary(path, strains, refuse_unstable=True)
        return path, None

    def _oriented(self, critical: Critical) -> Critical:
        """The critical point, its mode with the sign of a positive overlap with the pattern.

        A mode of another symmetry, or of staggered rows, has no overlap. Then the overlap with a
        field without symmetries is used, so that the sign doesn't depend on rounding.
        """
        mode, spec = critical.modes[0], self.experiment.specimen
        overlap = 0.0 if spec.is_staggered else self._pattern_overlap(mode)
        if abs(overlap) < 1e-6:
            overlap = mode.overlap(self.follower.structure.from_function(spec.asymmetric))
        if overlap < 0:
            critical.modes[0] = mode.reversed()
        return critical

    def _pattern_overlap(self, mode: Mode) -> float:
        pattern = self.follower.structure.from_function(self.experiment.specimen.pattern)
        weighted = self.follower.mass * pattern
        return mode.overlap(pattern) / float(np.sqrt(pattern.dot(weighted)))

    def _pattern_share(self, mode: Mode) -> float:
        """Share of the pattern, with a free amplitude in each cell, in a mode x [-].

        The root of the fraction of x . M x in the span of the pattern's restrictions to single
        unit cells: 1 for the pattern with any smooth envelope.
        """
        structure, spec, nodes = self.follower.structure, self.experiment.specimen, self.mesh.nodes
        pattern = spec.pattern(nodes)
        (a, b), (x, y) = spec.cellular_half_size, nodes.T
        column = np.floor((x + a) / spec.pitch).astype(np.int64)
        row = np.floor((y + b) / spec.row_distance).astype(np.int64)
        inside = (column >= 0) & (column < spec.holes_x) & (row >= 0) & (row < spec.holes_y)
        cell = (column * spec.holes_y + row)[inside]
        with_mode = np.sum(pattern * structure.nodal(mode.weighted), axis=1)[inside]
        mass_of = structure.nodal(self.follower.mass * structure.from_function(spec.pattern))
        with_self = np.sum(pattern * mass_of, axis=1)[inside]
        numerator = np.bincount(cell, with_mode)
        return float(np.sqrt(np.sum(numerator**2 / np.bincount(cell, with_self))))

    def _branches(self, critical: Critical) -> dict[str, list[State]]:
        targets = [e for e in self.experiment.strains if e > critical.strain]
        pitch, signs = self.experiment.specimen.pitch, {"buckled+": 1, "buckled-": -1}
        return {
            name: follow_branch(self.follower, critical, targets, signs[name], pitch)
            for name in self.experiment.branches
            if name in signs
        }

    def _snapshots(
        self, path: Sequence[State], limit: float, branches: dict[str, list[State]]
    ) -> list[Snapshot]:
        beyond = np.inf if "primary" in self.experiment.branches else limit
        met = (s for s in path if np.isclose(s.strain, self.experiment.strains, 0, 1e-12).any())
        kept = [(state, "primary") for state in met if state.strain <= beyond]
        kept += [(state, name) for name, states in branches.items() for state in states]
        kept.sort(key=lambda item: (item[0].strain, item[0].negative_pivots))
        structure, length = self.follower.structure, self.experiment.specimen.length
        return [_snapshot(structure, length, state, name) for state, name in kept]

    def _info(
        self, path: list[State], critical: Critical | None, branches: dict[str, list[State]]
    ) -> dict[str, Any]:
        paths = {"primary": path, **branches}
        versions = {"modeharvest": RELEASE, "dolfinx": dolfinx_api.VERSION}
        versions |= {"numpy": np.__version__, "python": platform.python_version()}
        return {
            **self.experiment.described(),
            "mesh_size_mm": self.experiment.mesh_size,
            "critical": None if critical is None else self._critical_info(critical),
            "path": {name: self._curve(states) for name, states in paths.items()},
            "factorisations": self.follower.structure.factorisations,
            "unknowns": 2 * len(self.mesh.nodes),
            "versions": versions,
        }

    def _critical_info(self, critical: Critical) -> dict[str, Any]:
        mode, overlaps = critical.modes[0], {}
        if not self.experiment.specimen.is_staggered:
            overlaps["pattern_overlap"] = self._pattern_overlap(mode)
            overlaps["pattern_overlap_by_cell"] = self._pattern_share(mode)
        return {
            "strain": critical.strain,
            "tolerance": self.experiment.path.critical_tolerance,
            "negative_pivots_below": critical.below,
            "negative_pivots_above": critical.above,
            **overlaps,
            "eigenvalues_N_per_mm4": [list(pair) for pair in sorted(critical.eigenvalues)],
            "nearest_eigenvalues_N_per_mm4": [m.eigenvalue for m in critical.modes],
        }

    def _curve(self, states: list[State]) -> dict[str, Any]:
        """Quantities along a path, for plots, with one entry for each state."""
        structure, length = self.follower.structure, self.experiment.specimen.length
        return {
            "nominal_strain": [s.strain for s in states],
            "reaction_N_per_mm": [structure.reaction(s.u, length) for s in states],
            "energy_N": [structure.energy(s.u) for s in states],
            "negative_pivots": [s.negative_pivots for s in states],
            "lowest_eigenvalues_N_per_mm4": [list(s.eigenvalues) for s in states],
        }

    def _outcome(
        self, snapshots: list[Snapshot], limit: float, paths: dict[str, list[State]]
    ) -> str:
        """Text: "complete", or strains that branches lack; up to ``limit`` only primary counts."""
        size, thin = self.experiment.mesh_size, self.experiment.specimen.ligament_width
        coarse = f"; {size:g} mm is a coarse mesh_size for ligaments of {thin:.2g} mm"
        reasons, hint = [], coarse if size > 0.5 * thin else ""
        for branch in BRANCHES:
            have = [s.nominal_strain for s in snapshots if s.branch == branch]
            missing = [
                f"{100 * e:g} %"
                for e in self.experiment.strains
                if branch in (self.experiment.branches if e > limit else ("primary",))
                and not np.isclose(e, have, 0, 1e-12).any()
            ]
            if missing:
                reached = [limit, *(state.strain for state in paths.get(branch, []))][-1]
                reasons.append(
                    f"{branch} lacks {', '.join(missing)} "
                    f"(Newton's method did not converge beyond {100 * reached:.4g} % strain{hint})"
                )
        return "incomplete: " + "; ".join(reasons) if reasons else "complete"


def _stable_until(path: list[State], critical: Critical | None) -> float:
    """The strain up to which the primary path is known to be stable; infinity if throughout."""
    stable = max(state.strain for state in path if state.negative_pivots == 0)
    reached = stable if path[-1].negative_pivots else np.inf
    return reached if critical is None else critical.strain


_ATTEMPTS = 3  # each with shorter steps


class PatternMeasure(Protocol):
    """Measures a pattern in nodal displacements (n, 2) [mm]."""

    def share(self, displacement: FloatArray) -> float:
        """Share of the pattern in a field, -1 to 1 [-]; its sign is that of the amplitude."""

    def amplitude(self, displacement: FloatArray) -> float:
        """The pattern's amplitude [mm]."""


def simulate_pattern(
    experiment: Experiment,
    mesh: Mesh,
    pattern: PatternMeasure,
    target: float,
    largest_strain: float,
) -> Solution:
    """Compress a perfect specimen beyond buckling until its pattern has a given amplitude.

    The unstable primary path, which costs most if ligaments are thin, is not followed. The solution
    has one snapshot, on the branch from the first critical point of the primary path. Without a
    critical point it is the last stable state, and ``info["critical"]`` is None; otherwise this has
    ``strain`` and ``pattern_overlap_by_cell``, the pattern's share in the buckling mode.
    ``info["outcome"]`` is "complete" or the reason why not.

    experiment, mesh : its strains and branches are ignored; the mesh of its specimen.
    pattern, target : measure of the pattern, and the amplitude to be reached [mm].
    largest_strain : strain up to which to look for the first critical point [-].
    """
    spec, follower = experiment.specimen, _follower(experiment, mesh, MPI.COMM_SELF)
    structure = follower.structure
    state, critical, outcome = _until_critical(follower, largest_strain)
    info = None
    if critical is not None:
        mode = critical.modes[0]
        share = pattern.share(structure.nodal(mode.vector))
        info = {"strain": critical.strain, "pattern_overlap_by_cell": abs(share)}
        critical.modes[0] = mode if share > 0 else mode.reversed()
        found, reached = follow_to_pattern(follower, critical, pattern.amplitude, target)
        state = found or state
        if abs(reached / target - 1.0) > PATTERN_TOLERANCE:
            outcome = f"the branch could be followed to a pattern of {reached / spec.pitch:.3f} l "
            outcome += f"only, not to {target / spec.pitch:.3f} l"
    branch = "primary" if critical is None else "buckled+"
    return Solution(
        mesh,
        (_snapshot(structure, spec.length, state, branch),),
        {
            "specimen": spec.plain(),
            "material": material_table(experiment.material),
            "loading": {"edges": experiment.edges, "length_mm": spec.length},
            "mesh_size_mm": experiment.mesh_size,
            "factorisations": structure.factorisations,
            "versions": {"modeharvest": RELEASE},
            "critical": info,
            "outcome": outcome,
        },
    )


def _until_critical(
    follower: PathFollower, largest_strain: float
) -> tuple[State, Critical | None, str]:
    """The last stable state of the primary path, its first critical point, and the outcome.

    If no bifurcation is found between the last two states, the steps were too long to stay on the
    path: it is followed again from the stable state with shorter steps.
    """
    path = [follower.start()]
    for _ in range(_ATTEMPTS):
        reached = follower.follow_primary(path, (largest_strain,), until_unstable=True)
        last = path[-1]
        if last.negative_pivots == 0:
            why = "the largest strain looked at" if reached else "where the path was lost"
            return last, None, f"stable up to {100 * last.strain:.4g} %, {why}"
        critical = locate_critical(follower, path[-2], last)
        if critical is not None:
            return path[-2], critical, "complete"
        path.pop()
        steps = {n: getattr(follower.options, n) / 3.0 for n in ("first_step", "largest_step")}
        follower.options = replace(follower.options, **steps)
        follower.linearisation = None
    before, after = 100 * path[-1].strain, 100 * last.strain
    where = f"between {before:.4g} and {after:.4g} %"
    return path[-1], None, f"unstable {where}, where no bifurcation was found"
