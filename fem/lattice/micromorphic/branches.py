"""Response of a homogenized specimen to its load: primary path, critical point, branches.

A body with its lattice's symmetry keeps v = 0 on the primary path. A branch is therefore entered by
prescribing its amplitude, with the load as an unknown. This is regular at the critical point and at
maxima or minima of the load. States at given loads are then computed exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from modeharvest.fem.experiment import PathOptions
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.path import (
    HomogenizedCritical,
    HomogenizedPath,
    HomogenizedState,
    is_unstable,
)
from modeharvest.fem.path.continuation import BranchPoint, amplitude_at, load_at, value_at
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

_FARTHEST = 0.5  # largest amplitude of a branch, over the pitch
_SHORTEST = 0.02  # smallest step, over the first amplitude
_LIKE = 0.01  # overlap of a critical mode with a pattern below which it counts as zero
_ALIKE = 1e-6  # 1 - cosine below which two directions are the same
_OWN = 0.8  # least cosine between a state's v and the v of the mode that starts its branch


@dataclass(frozen=True, eq=False)
class Homogenized:
    """Response of a homogenized specimen to its load."""

    states: tuple[HomogenizedState, ...]
    """States at the requested loads, ascending; buckled beyond the critical point."""
    criticals: tuple[HomogenizedCritical, ...]
    """Critical points on the primary path; the branch starts at the last one."""
    outcome: str
    """How far the path was followed, and why no farther."""
    linearisations: int
    """Number of linearisations of the body, each with one factorisation of every RVE."""
    ranked: tuple[tuple[tuple[float, ...], HomogenizedState], ...] = ()
    """(pattern at the start, state) of all branches of a degenerate critical point at one load, by
    ascending energy; ``states`` follow the first."""

    @property
    def critical(self) -> HomogenizedCritical | None:
        """The point where the pattern starts to grow, or, without modes, an RVE gets unstable."""
        found = [c for c in self.criticals if c.kind != "displacement"]
        return found[0] if found else None


def homogenize(
    body: HomogenizedBody, loads: Sequence[float], options: PathOptions | None = None,
    progress: Progress = silent,
) -> Homogenized:  # fmt: skip
    """States of a homogenized specimen at some loads [-], positive and ascending.

    They are on the primary path up to the first critical point at which a pattern grows, then on
    the branch from there; of several branches (``ranked_branches``, at the first load) on that of
    least energy. Earlier critical points of u alone are passed, and kept in ``criticals``.
    """
    wanted = np.asarray(loads, dtype=np.float64)
    if wanted.ndim != 1 or not len(wanted) or not (np.diff(wanted, prepend=0.0) > 0).all():
        raise InputError(f"loads: expected ascending positive ones, got {list(loads)}")
    path, met = HomogenizedPath(body, options), list[HomogenizedState]()
    criticals: list[HomogenizedCritical] = []
    block, pending = "all", list(wanted)
    ranked: list[tuple[tuple[float, ...], HomogenizedState]] = []
    outcome = ""
    while pending and not outcome:
        is_found, here = path.follow_primary(pending[0], block), path.states[-1]
        if not is_found:
            outcome = f"no equilibrium of the primary path beyond {here.load:.6g}"
            break
        progress(here.load, wanted[-1], "primary path")
        if is_unstable(here, block):
            found = path.critical(block)
            if found is None:
                outcome = f"the critical point below the load {here.load:.6g} got lost"
                break
            criticals.append(found)
            if found.kind == "pattern":
                if len(found.modes) > 1:
                    ranked = ranked_branches(path, found, pending[0], progress)
                pattern = ranked[0][0] if ranked else None
                states, outcome = follow_branch(path, found, pending, pattern, progress)
                met += states
            block = "pattern" if found.kind == "displacement" else ""
            continue
        if here.load >= pending[0] - 1e-12:
            met.append(here)
            pending.pop(0)
    outcome = outcome or f"followed to the load {met[-1].load:.4g}"
    known = tuple(met), tuple(criticals), outcome, path.linearisations
    return Homogenized(*known, tuple(ranked))


def follow_branch(
    path: HomogenizedPath, critical: HomogenizedCritical, loads: Sequence[float],
    pattern: Sequence[float] | None = None, progress: Progress = silent,
) -> tuple[list[HomogenizedState], str]:  # fmt: skip
    """States on a branch that starts at a critical point, and the outcome as text.

    There is one state for each of the ``loads``, ascending, or fewer. Growing amplitudes are
    prescribed and the load is found, so that a branch with falling load is followed, too. It starts
    along the critical mode, or the combination of several, nearest to v = ``pattern`` (m,)
    everywhere (by default all 1). The opposite pattern gives the other half of the branch.
    """
    if not len(critical.modes):
        raise InputError("branch: expected a critical point of the body, got one of an RVE")
    along = _combined(path, critical, pattern)
    mode = critical.modes[0] if along is None else along
    weights = path.scale * mode / float(mode @ (path.scale * mode))
    before = critical.state
    value = before.value + (critical.load - before.load) * before.rate
    leaves = LinearisedBody(path.body, before.load, before.value).moved(mode, 0.0, relax=False)
    points, found = [BranchPoint(0.0, critical.load, 0.0, value, leaves)], list[HomogenizedState]()
    origin = float(weights @ value[: path.body.free_count])
    reach = first = path.options.first_amplitude * path.pitch
    while len(found) < len(loads):
        target, amplitude = loads[len(found)], reach
        if reach > _FARTHEST * path.pitch:
            return found, f"the pattern has grown to {_FARTHEST} of the pitch"
        is_near = load_at(points, reach) >= target
        if is_near:
            below = points[-1] if points[-1].load < target else points[-2]
            amplitude = amplitude_at(points, target, below.amplitude, reach)
            state = path.equilibrium(target, value_at(points, amplitude), branch="buckled")
        else:
            guess = load_at(points, amplitude), value_at(points, amplitude)
            state = path.equilibrium(*guess, weights, origin + amplitude, branch="buckled")
        reached = -1.0
        if state is not None:
            reached = float(weights @ state.value[: path.body.free_count]) - origin
        # Under a prescribed load Newton may fall back to the primary path.
        if state is None or reached < 0.2 * amplitude:
            reach = 0.5 * (points[-1].amplitude + amplitude)
            if reach - points[-1].amplitude < _SHORTEST * first:
                return found, f"no equilibrium beyond the load {points[-1].load:.4g}"
            continue
        rate = float(weights @ state.rate[: path.body.free_count])
        points.append(BranchPoint(reached, state.load, 1 / rate, state.value, state.rate / rate))
        reach = path.options.growth * reached
        if is_near:
            found.append(state)
            progress(state.load, loads[-1], "buckled branch")
    return found, f"followed to the load {points[-1].load:.4g}"


def _combined(
    path: HomogenizedPath, critical: HomogenizedCritical, pattern: Sequence[float] | None
) -> FloatArray | None:
    """The combination of critical modes nearest to a pattern, of size 1 mm; None if orthogonal."""
    count = path.body.mode_count
    wanted = np.ones(count) if pattern is None else np.asarray(pattern, np.float64)
    if wanted.shape != (count,) or not np.any(wanted):
        raise InputError(f"branch: expected {count} amplitudes, not all 0, got {pattern}")
    like = np.tile([0.0, 0.0, *wanted], len(path.body.mesh.nodes))
    modes = critical.modes
    overlaps = modes @ (path.scale * path.body.picked(like))
    mix = np.linalg.solve((modes * path.scale) @ modes.T, overlaps)
    if not np.linalg.norm(mix) > _LIKE * np.linalg.norm(wanted):
        return None
    mode = mix @ modes
    return np.asarray(mode / path.largest(mode)[critical.kind != "pattern"])


def ranked_branches(
    path: HomogenizedPath, critical: HomogenizedCritical, load: float, progress: Progress = silent
) -> list[tuple[tuple[float, ...], HomogenizedState]]:
    """The branches of a critical point at a load, with their patterns, by ascending energy.

    They start along single modes v_i and along sums with any signs, the first one positive. Omitted
    are branches that can't be followed or end on another pattern's branch (if a mesh splits the
    degenerate modes), and patterns with the same combination of critical modes as another.
    """
    signs = product((0.0, 1.0, -1.0), repeat=path.body.mode_count)
    patterns = [p for p in signs if next((x for x in p if x), 0.0) > 0]
    met, followed = list[tuple[tuple[float, ...], HomogenizedState]](), list[FloatArray]()
    for k, pattern in enumerate(patterns, start=1):
        mode = _combined(path, critical, pattern)
        if mode is None:
            continue
        start = np.nan_to_num(path.body.fields(path.body.T @ mode)[1])
        mode = mode * np.sqrt(path.scale) / np.sqrt(mode @ (path.scale * mode))
        if any(abs(mode @ other) > 1.0 - _ALIKE for other in followed):
            continue
        followed.append(mode)
        states, size = follow_branch(path, critical, [load], pattern)[0], np.linalg.norm
        fields = [(state, np.nan_to_num(state.amplitudes)) for state in states]
        met += [(pattern, state) for state, v in fields
                if np.sum(v * start) > _OWN * size(v) * size(start)]  # fmt: skip
        progress(k, len(patterns), "branches")
    return sorted(met, key=lambda item: float(f"{item[1].energy:.9e}"))  # stable for equal energies
