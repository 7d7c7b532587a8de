"""A normal matrix by its eigenvectors: steps along what the data determine, and no others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.util.arrays import FloatArray

_ROUNDING = 1e-10


@dataclass(frozen=True, eq=False)
class ScaledEigen:
    """A positive semi-definite matrix, scaled to a unit diagonal and decomposed."""

    scale: FloatArray
    """(n,): square root of the diagonal; infinite where that is nothing but rounding."""
    values: FloatArray
    """Ascending."""
    vectors: FloatArray
    """Of the scaled matrix, as are the eigenvalues."""

    @classmethod
    def of(cls, matrix: FloatArray) -> ScaledEigen:
        """Decompose a matrix."""
        diagonal = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        # Scaling rounding up to 1 would make a direction of it, with enormous steps along it.
        observed = diagonal > _ROUNDING * diagonal.max(initial=0.0)
        scale = np.where(observed, diagonal, np.inf)
        values, vectors = np.linalg.eigh(matrix / scale / scale[:, None])
        return cls(scale, values, vectors)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(n,) True for eigenvectors whose eigenvalue stands out of the rounding."""
        floor = 1e-13 * len(self.values) * max(float(self.values[-1]), 0.0)
        return np.asarray(self.values > floor)

    @property
    def condition_number(self) -> float:
        """Largest over smallest eigenvalue of the *column-scaled* matrix; may be infinite."""
        if not self.determined.all():
            return float("inf")
        return float(self.values[-1] / self.values[0])

    def solve(self, right: FloatArray, damping: float = 0.0, cutoff: float = 0.0) -> FloatArray:
        """Solve (matrix + damping diag) x = right on the determined directions.

        Those with an eigenvalue below ``cutoff`` times the largest one count as undetermined, too.
        """
        keep = self.determined & (self.values >= cutoff * self.values[-1])
        part = self.vectors[:, keep].T @ (right / self.scale) / (self.values[keep] + damping)
        return np.asarray(self.vectors[:, keep] @ part / self.scale)

    def inverse(self) -> FloatArray:
        """Inverse of the matrix; infinite on the diagonal of unknowns not determined."""
        keep = self.determined
        half = self.vectors[:, keep] / np.sqrt(self.values[keep]) / self.scale[:, None]
        result = half @ half.T
        lost = (self.vectors[:, ~keep] ** 2).sum(axis=1) > 1e-6
        result[lost, lost] = np.inf
        return np.asarray(result)
