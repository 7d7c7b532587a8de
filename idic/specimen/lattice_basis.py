"""Two vectors that span a lattice, from points that lie on it.

Neighbours repeat: the vectors from point to point gather around the lattice's own. The two that
are met most often and are not parallel are reduced to the shortest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

FloatArray = NDArray[np.float64]

_ALIKE = 0.25
"""Vectors this near to each other, as a share of the pitch, stand for one of the lattice's:
locally, strain differs from the mean by 10 %, and holes are moulded a little off."""


def spanning_vectors(spots: FloatArray) -> FloatArray | None:
    """The two shortest vectors that span the lattice on which most of some points lie.

    Parameters
    ----------
    spots
        (n, 2) positions, (up, right) [px].

    Returns
    -------
    ndarray or None
        (2, 2) vectors as rows, (up, right) [px], the first to the right and the second upwards;
        None if the points lie in one row.
    """
    tree = KDTree(spots)
    distance, neighbour = tree.query(spots, k=min(9, len(spots)))
    nearest = float(np.median(distance[:, 1]))
    steps = (spots[neighbour] - spots[:, None])[(distance > 0) & (distance < 1.7 * nearest)]
    steps = np.concatenate([steps, -steps])
    gathered = KDTree(steps)
    near = gathered.query_ball_point(steps, _ALIKE * nearest)
    crowd = np.array([len(k) for k in near])
    # Of two equally frequent steps, the shorter one.
    order = np.lexsort([np.linalg.norm(steps, axis=1).round(6), -crowd])
    first = steps[near[order[0]]].mean(axis=0)
    for k in order:
        second = steps[near[k]].mean(axis=0)
        if _sine(first, second) > 0.5:
            return _oriented(_reduced(first, second))
    return None


def _sine(a: FloatArray, b: FloatArray) -> float:
    return abs(float(_cross(a, b))) / float(np.linalg.norm(a) * np.linalg.norm(b))


def _cross(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _reduced(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lagrange's reduction: the shortest two vectors that span the same lattice."""
    while True:
        if a @ a > b @ b:
            a, b = b, a
        turns = np.round((a @ b) / (a @ a))
        if turns == 0.0:
            return a, b
        b = b - turns * a


def _oriented(basis: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Choose i to the right and j upwards; of three directions 60 degrees apart, the best two."""
    a, b = basis
    third = a - b if a @ b > 0 else a + b
    candidates = [a, b]
    if np.linalg.norm(third) < 1.2 * np.linalg.norm(b):
        candidates.append(third)
    candidates += [-v for v in candidates]
    unit = [v / np.linalg.norm(v) for v in candidates]
    # A slight preference for the upper one settles ties.
    i = int(np.argmax([u[1] + 1e-3 * u[0] for u in unit]))
    j = int(np.argmax([u[0] + 1e-3 * u[1] if _sine(u, unit[i]) > 0.5 else -1.0 for u in unit]))
    return np.stack([candidates[i], candidates[j]])
