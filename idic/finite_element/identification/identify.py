"""Integrated DIC in the full sense: the unknowns are parameters of a finite-element model.

Minimises one cost in natural weights: grey levels by the camera's noise, displacements of another
measurement and forces by their noise, nominal strains and priors by their own. The model gives
nodal displacements u(p) on its mesh with their sensitivities. Source: Neggers, Allix,
Hild & Roux, Arch. Comput. Methods Eng. 25 (2018) 533-573, doi 10.1007/s11831-016-9181-z.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from modeharvest.idic.finite_element.identification.model_error import (
    ScoreTest,
    in_words,
    joint_score,
)
from modeharvest.idic.finite_element.identification.observed import (
    ImageData,
    StateEquations,
    StateObservation,
    at_fixed_points,
    displacement_at,
)
from modeharvest.idic.solver.assembly import NormalEquations
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Minimum, minimise
from modeharvest.idic.solver.pyramid import FULL, Level
from modeharvest.idic.uncertainty.parameters import undetermined_combinations
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.util.scaled_eigen import ScaledEigen

if TYPE_CHECKING:  # dolfinx makes the model; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState

LEVELS = (Level(2, 3.0), Level(2, 1.5), FULL)
"""Levels of the images, from coarse to fine."""
_COARSE = GaussNewtonOptions(tolerance_px=2e-2, max_iterations=20)
_FINE = GaussNewtonOptions(tolerance_px=1e-4, max_iterations=30)
_FORCE_PX = 0.01
"""A change of a force by its standard deviation counts as this in the length of a step [px]."""
_HOLD = 0.3
"""Standard deviation, in scales, of unknowns about their values at the beginning of a coarse level:
blurred images hardly determine some of them, and far off, the model is another one."""
_ROUNDS = 4  # most steps with a residual of another mesh or other slopes
_SETTLED = 0.05  # length of the last of those steps in standard errors, rms
_UNLIKE = 1.5  # residual, over that of noise alone, from which on states are unlike the data


class UnlikeDataError(InputError):
    """The states that look most like the data have residuals far above noise."""


Model = Callable[[FloatArray], "Sequence[ModelState]"]
"""From values of the unknowns (k,) to the states; InputError where there are none."""


class FinerMesh(NamedTuple):
    """The same states on a finer mesh."""

    model: Model
    """Model of the same states; their derivatives aren't used."""
    error_ratio: float
    """Ratio of its error to that of the original model [-]."""


@dataclass(frozen=True)
class Unknown:
    """A parameter to be identified; InputError if start, bounds and prior make no sense."""

    start: float
    bounds: tuple[float, float]
    prior_sd: float | None = None
    """Standard deviation of prior knowledge, about the start; None for none."""

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low < self.start < high:
            raise InputError(
                f"expected bounds [low, high] with the start between them, got a start of "
                f"{self.start:g} and bounds of [{low:g}, {high:g}]"
            )
        if self.prior_sd is not None and not self.prior_sd > 0.0:
            raise InputError(f"expected a prior_sd above 0, got {self.prior_sd:g}")

    def scale(self, value: float) -> float:
        """What its changes are compared with: itself, or half its bounds' gap if it may be 0."""
        low, high = self.bounds
        return abs(value) if low * high > 0.0 else 0.5 * (high - low)


@dataclass(frozen=True, eq=False)
class Readings:
    """A reading of one number of each state, or NaN: forces [N/mm] or nominal strains [-]."""

    values: FloatArray
    sd: FloatArray | float

    def residuals(self, states: Sequence[ModelState], name: str) -> Iterator[tuple[float, Any]]:
        """Residual over its standard deviation, and minus its derivatives, for each reading."""
        sds = np.broadcast_to(self.sd, self.values.shape)
        for value, state, sd in zip(self.values, states, sds, strict=False):
            if np.isfinite(value):
                by = getattr(state, f"{name}_by") / sd
                yield float((value - getattr(state, name)) / sd), by


@dataclass(frozen=True, eq=False)
class Identified:
    """The parameters of a model that were identified from data."""

    unknowns: dict[str, Unknown]
    values: FloatArray
    """(k,) in the order of the unknowns."""
    covariance: FloatArray
    """(k, k) due to noise, including that of a reference which several states share."""
    covariance_with_model_error: FloatArray
    """(k, k) due to the residual, from part to part of the body, in place of noise; forces and
    strains count with their noise at least."""
    minimum: Minimum
    states: list[ModelState]
    state_equations: list[StateEquations]
    """Equations of the states, which are those of ``minimum.unknowns``."""
    evaluations: int
    """Number of solutions of the model."""
    mesh_error: FloatArray
    """(k,) estimated remaining error of the finer mesh, which was added to the values: from their
    change by that mesh and the ratio of errors; 0 without a finer mesh."""
    equations: list[Callable[[], NormalEquations]]
    """Equations of the prepared data, at the states, and at those for elements of zero size."""
    forces: Readings | None = None
    model_error: ScoreTest | None = None
    law_error: ScoreTest | None = None
    """Tests whether the model can be right, by corrections independent of the law, and whether its
    law can, by terms of the energy that it may lack; None where these weren't given."""

    @property
    def sd(self) -> FloatArray:
        """(k,) standard deviations due to noise; infinite where an unknown is undetermined."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def sd_with_model_error(self) -> FloatArray:
        """(k,) due to noise or to the residual, whichever is larger, and due to the mesh."""
        variance = np.maximum(np.diag(self.covariance_with_model_error), np.diag(self.covariance))
        return np.asarray(np.hypot(np.sqrt(variance), self.mesh_error))

    @property
    def correlations(self) -> FloatArray:
        """(k, k) correlations of the unknowns due to noise [-]."""
        return np.asarray(self.covariance / np.outer(self.sd, self.sd))

    @property
    def force_sd(self) -> FloatArray:
        """(states,) of the model's forces by the parameters' covariance with model error [N/mm]."""
        J = np.array([state.force_by for state in self.states])
        variance = np.einsum("sj,jk,sk->s", J, self.covariance_with_model_error, J)
        return np.asarray(np.sqrt(variance))

    def log_evidence(self) -> tuple[float, float]:
        """Logarithm of the evidence, up to a term common to all models; the part due to the mesh.

        Marginal likelihood by Laplace's method; unknowns without a prior are uniform within their
        bounds: MacKay, Neural Comput. 4 (1992) 415-447, doi 10.1162/neco.1992.4.3.415. Comparable
        between models after all have been identified, from the same prepared data.
        """
        H, costs = self.minimum.equations.matrix, list[float]()
        for at in (equations() for equations in self.equations):
            # Unknowns would move to the least cost of these states.
            costs.append(at.cost - 0.5 * float(at.gradient @ ScaledEigen.of(H).solve(at.gradient)))
        unknowns = self.unknowns.values()
        sizes = [u.prior_sd or float(np.ptp(u.bounds)) / np.sqrt(2.0 * np.pi) for u in unknowns]
        # An unknown that nothing determines has the width of its bounds, and costs nothing.
        bounded = np.diag([float(u.prior_sd is None) for u in unknowns])
        occam = 0.5 * float(np.linalg.slogdet(H * np.outer(sizes, sizes) + bounded)[1])
        return -costs[1] - occam, costs[0] - costs[1]

    @property
    def is_rejected(self) -> bool:
        """Whether a test says that the model or its law is wrong."""
        return any(test and test.is_rejected for test in (self.model_error, self.law_error))

    @property
    def statements(self) -> tuple[str, ...]:
        """What the data don't determine, and which unknowns are at their bounds, in words."""
        scales, found = list[float](), in_words(self.model_error, self.law_error)
        for (name, unknown), value in zip(self.unknowns.items(), self.values, strict=True):
            scales.append(unknown.scale(value))
            low, high = unknown.bounds
            if min(value - low, high - value) < 1e-3 * (high - low):
                found.append(
                    f"{name} is at its bound: the data may want it beyond [{low:g}, {high:g}]"
                )
        for state, share in zip(self.states, self.state_equations, strict=False):
            if share.residual > _UNLIKE * share.expected:
                found.append(
                    f"at {100 * state.strain:.4g} % the residual is {share.residual:.3g}, "
                    f"{share.residual / share.expected:.2g} times what noise makes: the model, its "
                    "branch or its mesh is not the specimen's, or this is a local minimum"
                )
        remedy = "" if self.forces is not None else ": add a force"
        matrix = self.minimum.equations.matrix
        found += undetermined_combinations(list(self.unknowns), matrix, scales, remedy)
        return tuple(found)


@dataclass(eq=False)
class _Cost:
    """The cost and its normal equations, for the data of one level."""

    model: Model
    data: Sequence[StateObservation | None]
    unknowns: dict[str, Unknown]
    forces: Readings | None
    strains: Readings | None
    px: float
    hold: FloatArray | None = None
    """(k,) values about which coarse levels hold the unknowns; None on the finest level."""
    evaluations: int = 0
    _states: dict[bytes, list[ModelState]] = field(default_factory=dict)

    def states(self, values: FloatArray) -> list[ModelState]:
        """The model's states, of which the last few are cached."""
        key = values.tobytes()
        if key not in self._states:
            self.evaluations += 1
            self._states = {
                **dict(list(self._states.items())[-2:]),
                key: [at_fixed_points(s) for s in self.model(values)],
            }
        return self._states[key]

    def state_equations(self, states: Sequence[ModelState]) -> list[StateEquations]:
        """Equations of the states with images or displacements."""
        return [data.equations(s) for data, s in zip(self.data, states, strict=True) if data]

    def scalars(self, states: Sequence[ModelState], values: FloatArray) -> list[tuple[float, Any]]:
        """Residuals of forces, strains and priors over their standard deviations, with -dr/dp."""
        found = list[tuple[float, Any]]()
        if self.forces is not None:
            found += self.forces.residuals(states, "force")
        if self.strains is not None:
            found += self.strains.residuals(states, "strain")
        for k, unknown in enumerate(self.unknowns.values()):
            if self.hold is not None:
                sd = _HOLD * unknown.scale(unknown.start)
                found.append(((self.hold[k] - values[k]) / sd, np.eye(len(values))[k] / sd))
            if unknown.prior_sd is not None:
                one = np.eye(len(values))[k] / unknown.prior_sd
                found.append(((unknown.start - values[k]) / unknown.prior_sd, one))
        return found

    def equations(self, values: FloatArray, _with_matrix: bool = True) -> NormalEquations:
        """Equations of all data; an infinite cost beyond bounds or if the model has no states."""
        count = len(values)
        nothing = NormalEquations(np.zeros((count, count)), np.zeros(count), np.inf, 1, 0)
        bounds = np.array([u.bounds for u in self.unknowns.values()])
        if np.any(values <= bounds[:, 0]) or np.any(values >= bounds[:, 1]):
            return nothing
        try:  # holes' unknowns may fold the mesh
            return self.equations_at(self.states(values), values)
        except InputError:
            if not self._states:
                raise
            return nothing

    def equations_at(self, states: Sequence[ModelState], values: FloatArray) -> NormalEquations:
        """Equations of all data, with the model's states at these values."""
        matrix: FloatArray = np.zeros((len(values),) * 2)
        gradient: FloatArray = np.zeros(len(values))
        squares, number = 0.0, 0
        for share in self.state_equations(states):
            matrix, gradient = matrix + share.matrix, gradient + share.blocks.sum(axis=0)
            squares, number = squares + share.squares, number + share.count
        for r, J in self.scalars(states, values):
            matrix, gradient = matrix + np.outer(J, J), gradient - r * J
            squares, number = squares + r**2, number + 1
        return NormalEquations(matrix, gradient, 0.5 * squares, number, 0)

    def step_length(self, before: FloatArray, after: FloatArray) -> float:
        """Rms change of the displacements [px], or the equivalent of changes of forces."""
        states, change = self.states(before), after - before
        squares = [
            np.mean(np.tensordot(change, s.displacement_by, 1) ** 2) / self.px**2 for s in states
        ]
        moved = float(np.sqrt(2.0 * np.mean(squares)))
        if self.forces is not None:
            sizes = np.abs([s.force_by @ change for s in states]) / self.forces.sd
            moved = max(moved, _FORCE_PX * float(sizes.max()))
        return moved


def identify(
    model: Model,
    data: Sequence[StateObservation | None],
    unknowns: dict[str, Unknown],
    *,
    pixel_size: float,
    forces: Readings | None = None,
    strains: Readings | None = None,
    levels: Sequence[Level] = LEVELS,
    finer: FinerMesh | None = None,
    corrections: FloatArray | None = None,
    omitted: Model | None = None,
    unlike_is_error: bool = False,
    progress: Progress = silent,
) -> Identified:
    """Find the unknowns for which a model's states match the data; InputError without states.

    model : gives one state for each entry of ``data``, with derivatives in the unknowns' order.
    data : images or displacements of each state, or None where there is only a force.
    pixel_size : unit of the lengths of steps [mm].
    forces : readings of the first states [N/mm], NaN where there is none.
    strains : readings of nominal strains, NaN where there is none; they count for states that are
        determined by something else, an amplitude or as critical ones.
    finer : a finer mesh, whose residual is used in the last steps with the sensitivities of this
        one; from both, the values are extrapolated to zero error (Richardson).
    corrections : (j, n, 2) nodal displacements of each state that are independent of the law [-],
        by which the model is tested.
    omitted : the states with derivatives by further parameters alone, which are 0 in the model:
        factors of terms that its law may lack, by which the law is tested.
    unlike_is_error : whether residuals far above noise raise UnlikeDataError, before the finer mesh
        is used; otherwise a statement says so.
    """
    if not any(data) and forces is None:
        raise InputError("expected images, displacements or forces to identify from, got none")
    cost = _Cost(model, data, unknowns, forces, strains, pixel_size)
    values = np.array([unknown.start for unknown in unknowns.values()])
    # The last one twice: only the model shows where material ends in the deformed image.
    stages = [*levels, levels[-1]] if any(isinstance(d, ImageData) for d in data) else [FULL]
    found: Minimum | None = None
    for number, level in enumerate(stages):
        progress(number, len(stages), "identify")
        for part, state in zip(data, cost.states(values), strict=True):
            if part is not None:
                part.prepare(level, state)
        how = _FINE if level == stages[-1] else _COARSE
        cost.hold = None if level == stages[-1] else values
        found = minimise(cost.equations, cost.step_length, values, how, level.factor)
        values = found.unknowns
    assert found is not None
    progress(len(stages), len(stages), "identify")
    for part in data:
        if part is not None:
            part.weigh_by_reference()
    values, states = _finished(cost, values, cost.states)
    if unlike_is_error and are_unlike(cost.state_equations(states)):
        raise UnlikeDataError("expected states that look like the data, got others")
    begin, factor = values, 0.0
    if finer is not None:
        values, states = _finished(cost, values, finer.model)
        factor = finer.error_ratio / (1.0 - finer.error_ratio)
    off = (values - begin) * factor
    found = replace(found, unknowns=values)
    result = _assessed(cost, states, found, off, factor, corrections, omitted)
    return replace(result, values=values + off)


def are_unlike(shares: Sequence[StateEquations]) -> bool:
    """Whether a state's residual is far above its noise."""
    return any(share.residual > _UNLIKE * share.expected for share in shares)


def _finished(cost: _Cost, values: FloatArray, model: Model) -> tuple[FloatArray, list[ModelState]]:
    """Gauss-Newton steps with another model's residual, but these sensitivities: values, states."""
    bounds = np.array([u.bounds for u in cost.unknowns.values()])
    for _ in range(_ROUNDS):
        states = [
            replace(state, displacement=displacement_at(fine, state.mesh.nodes), force=fine.force,
                    strain=fine.strain)
            for state, fine in zip(cost.states(values), model(values), strict=True)
        ]  # fmt: skip
        here = cost.equations_at(states, values)
        eigen = ScaledEigen.of(here.matrix)
        step = -eigen.solve(here.gradient)
        if float(step @ here.matrix @ step) < _SETTLED**2 * step.size:
            break
        # Halfway to a bound at most, as from inside.
        room = np.where(step > 0.0, bounds[:, 1] - values, values - bounds[:, 0])
        values = values + np.clip(step, -0.5 * room, 0.5 * room)
    return values, states


def _assessed(
    cost: _Cost, states: list[ModelState], found: Minimum, off: FloatArray, factor: float,
    corrections: FloatArray | None, omitted: Model | None,
) -> Identified:  # fmt: skip
    """Make the result: covariances by noise and by the residual of blocks, tests of the model.

    factor : of the change of states by the finer mesh, for its remaining error.
    """
    values = found.unknowns
    found = replace(found, equations=cost.equations_at(states, values))
    inverse = ScaledEigen.of(found.equations.matrix).inverse()
    known = np.isfinite(np.diag(inverse))
    half = np.where(np.outer(known, known), inverse, 0.0)
    shares, k = cost.state_equations(states), len(values)
    # By parts of the body, because noise of the reference and model errors are in all states.
    blocks = np.zeros((max([len(s.blocks) for s in shares], default=0), k))
    for share in shares:
        blocks[: len(share.blocks)] += share.blocks
    limit = [
        replace(s, displacement=s.displacement + factor * (s.displacement - c.displacement),
                force=s.force + factor * (s.force - c.force),
                strain=s.strain + factor * (s.strain - c.strain))
        for s, c in zip(states, cost.states(values), strict=True)
    ]  # fmt: skip
    wider = states if omitted is None else [
        replace(state, **{
            name: np.concatenate([getattr(state, name), getattr(row, name)])
            for name in ("displacement_by", "force_by", "strain_by")
        }) for state, row in zip(states, omitted(values), strict=True)
    ]  # fmt: skip
    scalars, expected = (cost.scalars(each, values) for each in (wider, limit))
    phi = np.zeros((0, *states[0].displacement.shape)) if corrections is None else corrections
    readings = 0 if cost.forces is None else int(np.isfinite(cost.forces.values).sum())
    joint = joint_score(cost.data, wider, limit, scalars, expected, phi, readings)
    terms, n = len(wider[0].displacement_by), len(joint.score)
    scatter = blocks.T @ blocks
    for r, J in scalars:
        scatter += max(1.0, r**2) * np.outer(J[:k], J[:k])
    matrices = half @ joint.noise[:k, :k] @ half, half @ scatter @ half
    for matrix in matrices:
        matrix[~known, ~known] = np.inf
    return Identified(
        cost.unknowns, values, *matrices, found, states, shares, cost.evaluations, off,
        [partial(cost.equations_at, each, values) for each in (states, limit)], cost.forces,
        joint.test(k, terms, n) if len(phi) else None,
        joint.test(k, k, terms) if terms > k else None,
    )  # fmt: skip
