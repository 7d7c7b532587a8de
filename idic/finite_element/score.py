"""Score, information and noise of a model's parameters, and of corrections that it doesn't know.

The score is minus the slope of the cost. Parameters and corrections move a state's displacement by
fields of their own: what they do to the data is what the observations make of those fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from modeharvest.idic.finite_element.observed import StateObservation
from modeharvest.util.arrays import FloatArray

if TYPE_CHECKING:  # dolfinx makes the model; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState


class Scalar(NamedTuple):
    """A residual of one number, over its standard deviation."""

    residual: float
    slopes: FloatArray
    """(k,) minus its derivatives by the parameters."""
    by_mesh: float = 0.0
    """What the residual is expected to change by without a mesh."""


class JointScore(NamedTuple):
    """Of parameters, then of corrections."""

    score: FloatArray
    information: FloatArray
    noise: FloatArray
    """(n,), (n, n) and (n, n) covariance of the score, where the model is right: more than the
    information where states share their reference's noise."""
    by_mesh: FloatArray
    """(n, m) what of the score the model's mesh is expected to make, by each of m causes."""


def joint_score(
    data: Sequence[StateObservation | None],
    states: Sequence[ModelState],
    scalars: Sequence[Scalar],
    by_mesh: Sequence[FloatArray],
    corrections: FloatArray | None = None,
    readings: int = 0,
) -> JointScore:
    """Joint score of the parameters of states, and of corrections of each.

    by_mesh : (n, 2) of each state, what its displacement is expected to change by with elements of
        no size [mm].
    corrections : (j, n, 2) displacements, of which every state is given a combination of its own.
    readings : the first so many scalars have a correction each, too, last of all.
    """
    k, seen = states[0].displacement_by.shape[0], [i for i, part in enumerate(data) if part]
    if corrections is None:
        corrections, readings = np.zeros((0, *states[0].displacement.shape)), 0
    j, n = len(corrections), k + len(corrections) * len(seen) + readings
    score, information = np.zeros(n), np.zeros((n, n))
    errors = list[FloatArray]()
    # The parameters' fields differ from state to state; all are needed where noise is shared.
    fields = np.concatenate([*(states[i].displacement_by for i in seen), corrections])
    parts = []
    for number, i in enumerate(seen):
        observed, state = data[i], states[i]
        assert observed is not None
        by = np.concatenate([fields, by_mesh[i][None]])
        part = observed.equations(replace(state, displacement_by=by))
        to = np.r_[:k, k + j * number : k + j * (number + 1)]
        of = np.r_[k * number : k * (number + 1), k * len(seen) : len(fields)]
        parts.append((part, to, of))
        score[to] -= part.blocks.sum(axis=0)[of] / part.gain
        information[np.ix_(to, to)] += part.matrix[np.ix_(of, of)]
        errors.append(np.zeros(n))
        errors[-1][to] = part.matrix[of, -1]
    noise = information.copy()
    for s, (one, to, of) in enumerate(parts):
        for t, (other, to_t, of_t) in enumerate(parts):
            if s != t:
                both = 0.5 * np.sqrt(one.shared * other.shared) * (one.matrix + other.matrix)
                noise[np.ix_(to, to_t)] += both[np.ix_(of, of_t)]
    for number, scalar in enumerate(scalars):
        row = np.append(scalar.slopes, np.zeros(n - k))
        if number < readings:
            row[n - readings + number] = 1.0
        score += scalar.residual * row
        information += np.outer(row, row)
        noise += np.outer(row, row)
        errors.append(-scalar.by_mesh * row)
    return JointScore(score, information, noise, np.array(errors).T)
