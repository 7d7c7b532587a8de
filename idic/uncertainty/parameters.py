"""Parameters that the data determine, alone or only together; comparison of several models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeharvest.util.arrays import FloatArray

_LARGE = 0.2
"""Relative standard deviation of a combination of parameters from which on it is reported."""
_PART = 0.3
"""Least component of an eigenvector, over its largest, of a parameter that is named."""
_GEOMETRY = ": leave one of them out, give it a prior_sd, or add a state nearer to buckling"
"""Remedy for parameters of holes and edges, whose names have a dot."""


def undetermined_combinations(
    names: Sequence[str], normal_matrix: FloatArray, scales: Sequence[float], remedy: str = ""
) -> list[str]:
    """Describe the combinations of parameters that are known to no better than 20 %, in words.

    normal_matrix : (k, k) of the cost in natural weights: the inverse of the covariance.
    scales : values that changes of each parameter are compared with.
    remedy : end of the text, unless a hole or an edge is in the combination.
    """
    squares, vectors = np.linalg.eigh(normal_matrix * np.outer(scales, scales))
    with np.errstate(divide="ignore"):
        sizes = 1.0 / np.sqrt(np.maximum(squares, 0.0))
    found = list[str]()
    for size, vector in zip(sizes, vectors.T, strict=True):
        if size < _LARGE:
            continue
        own = [k for k in np.argsort(-abs(vector)) if abs(vector[k]) > _PART * max(abs(vector))]
        vector = vector * np.sign(vector[own[0]])
        hint = _GEOMETRY if any("." in names[k] for k in own) else remedy
        how = "nothing determines it" if size > 1e3 else f"known to {100 * size:.2g} %"
        if len(own) == 1:
            found.append(f"{names[own[0]]} is hardly determined ({how}){hint}")
            continue
        parts = ", ".join(f"{vector[k]:+.2f} {names[k]}" for k in own)
        found.append(
            f"{' and '.join(names[k] for k in sorted(own))} are determined only in other "
            f"combinations than their relative changes ({parts}) together ({how}){hint}"
        )
    return found


_GRADES = ((10.0, "decisive"), (6.0, "strong"), (2.0, "positive"))
"""Twice the logarithm of a Bayes factor above which evidence has that name: Kass & Raftery, J. Am.
Stat. Assoc. 90 (1995) 773-795, doi 10.1080/01621459.1995.10476572 ("very strong" there)."""


def compared_by_evidence(
    names: Sequence[str], evidence: Sequence[tuple[float, float]], rejected: Sequence[str]
) -> str:
    """Say in words which of several models the data prefer.

    evidence : logarithm of each, and its part due to the mesh, which is the Bayes factor's error.
    rejected : names of the models that a test of their own rejects.
    """
    values, by_mesh = np.array(evidence).T
    best, second = (int(k) for k in np.argsort(-values)[:2])
    difference = values[best] - values[second]
    least = difference - abs(by_mesh[best] - by_mesh[second])
    grade = next((word for limit, word in _GRADES if 2.0 * least > limit), None)
    factor = f"the logarithm of the Bayes factor is {difference:.3g}, {least:.3g} at least"
    doubt = ""
    if names[best] in rejected:
        doubt = f"; but the tests reject {names[best]} itself: it is the least wrong of these"
    if grade is None:
        return f"{names[best]} and {names[second]} are not distinguishable ({factor}){doubt}"
    return f"evidence for {names[best]} against {names[second]} is {grade} ({factor}){doubt}"
