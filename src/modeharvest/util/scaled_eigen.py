"""Normal equations solved by eigenvectors, along the directions that the data determine only."""

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
    """(n,) square root of the diagonal; infinite where that is at the level of rounding."""
    values: FloatArray
    """(n,) eigenvalues of the scaled matrix, ascending."""
    vectors: FloatArray
    """(n, n) eigenvectors of the scaled matrix, as columns."""

    @classmethod
    def of(cls, matrix: FloatArray) -> ScaledEigen:
        """Scale and decompose a positive semi-definite matrix (n, n)."""
        diagonal = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        # If rounding errors were scaled up to 1, steps along that direction would be enormous.
        observed = diagonal > _ROUNDING * diagonal.max(initial=0.0)
        scale = np.where(observed, diagonal, np.inf)
        values, vectors = np.linalg.eigh(matrix / scale / scale[:, None])
        return cls(scale, values, vectors)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(n,) True for eigenvectors whose eigenvalue exceeds the level of rounding."""
        floor = 1e-13 * len(self.values) * max(float(self.values[-1]), 0.0)
        return np.asarray(self.values > floor)

    @property
    def condition_number(self) -> float:
        """Largest over smallest eigenvalue of the *scaled* matrix; infinite if it is singular."""
        if not self.determined.all():
            return float("inf")
        return float(self.values[-1] / self.values[0])

    def solve(self, right: FloatArray, damping: float = 0.0, cutoff: float = 0.0) -> FloatArray:
        """Solve (matrix + damping diag(matrix)) x = right along the determined directions.

        Directions with an eigenvalue below ``cutoff`` times the largest are left out, too.
        """
        keep = self.determined & (self.values >= cutoff * self.values[-1])
        part = self.vectors[:, keep].T @ (right / self.scale) / (self.values[keep] + damping)
        return np.asarray(self.vectors[:, keep] @ part / self.scale)

    def inverse(self) -> FloatArray:
        """Inverse of the matrix; its diagonal is infinite for unknowns that are not determined."""
        keep = self.determined
        half = self.vectors[:, keep] / np.sqrt(self.values[keep]) / self.scale[:, None]
        result = half @ half.T
        lost = (self.vectors[:, ~keep] ** 2).sum(axis=1) > 1e-6
        result[lost, lost] = np.inf
        return np.asarray(result)
