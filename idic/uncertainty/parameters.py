"""Which parameters of a finite-element model the data determine, and which only together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeharvest.util.arrays import FloatArray

_LARGE = 0.2
"""Relative standard deviation of a combination of parameters beyond which words say so."""
_PART = 0.3
"""Of a unit eigenvector: which parameters a combination is of."""


def undetermined_combinations(
    names: Sequence[str], normal_matrix: FloatArray, scales: Sequence[float], remedy: str = ""
) -> list[str]:
    """Combinations of parameters that are known to no better than 20 %, each in words.

    normal_matrix : (k, k) of the cost in natural weights: the inverse of the covariance.
    scales : what changes of each parameter are compared with.
    remedy : what the words end with.
    """
    squares, vectors = np.linalg.eigh(normal_matrix * np.outer(scales, scales))
    with np.errstate(divide="ignore"):
        sizes = 1.0 / np.sqrt(np.maximum(squares, 0.0))
    found = list[str]()
    for size, vector in zip(sizes, vectors.T, strict=True):
        if size < _LARGE:
            continue
        own = [k for k in np.argsort(-abs(vector)) if abs(vector[k]) > _PART]
        vector = vector * np.sign(vector[own[0]])
        how = "nothing determines it" if size > 1e3 else f"known to {100 * size:.2g} %"
        if len(own) == 1:
            found.append(f"{names[own[0]]} is hardly determined ({how}){remedy}")
            continue
        parts = ", ".join(f"{vector[k]:+.2f} {names[k]}" for k in own)
        found.append(
            f"{' and '.join(names[k] for k in sorted(own))} are determined only in other "
            f"combinations than their relative changes ({parts}) together ({how}){remedy}"
        )
    return found
