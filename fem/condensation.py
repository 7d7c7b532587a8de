"""One factorisation of a cell's interior serves all wave vectors.

Only nodes with copies in other cells feel the phase of a Bloch wave. So the other nodes are
eliminated once, which leaves a small dense (Schur) complement on the outline, and only that is
reduced by T(k) and factorised for each wave vector. Inertia adds up: the matrix for a wave has as
many negative eigenvalues as its interior and its complement together (Haynsworth, Linear Algebra
Appl. 1 (1968) 73-81).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array

from modeharvest.fem.copies import Batch, applied
from modeharvest.fem.outline import Outline
from modeharvest.fem.reduction import factorise, negative_pivots

FloatArray = NDArray[np.float64]


class Condensation:
    """A symmetric matrix of a mesh's nodes, condensed onto the nodes that have copies.

    Parameters
    ----------
    matrix
        (2 n, 2 n), the two components of a node side by side.
    outline
        The nodes that have copies.
    """

    def __init__(self, matrix: csr_array, outline: Outline) -> None:
        self.outline = outline
        rows = matrix[outline.inner]
        self.factor: Any = factorise(csc_array(rows[:, outline.inner]))
        self.is_definite = negative_pivots(self.factor) == 0
        self.coupling = rows[:, outline.rim]
        self.transposed = csr_array(self.coupling.T)
        self.response = np.ascontiguousarray(self.factor.solve(self.coupling.toarray()))
        corner = matrix[outline.rim][:, outline.rim].toarray()
        self._blocks = outline.sorted(corner - self.transposed @ self.response)

    def at(self, waves: FloatArray) -> CondensedWaves | None:
        """The solvers for phases (w, 2) [rad]; None if one matrix isn't positive definite."""
        if not self.is_definite:
            return None
        try:
            # LAPACK has matrices by columns, and A(-k)^T = A(k).
            transposed = self.outline.reduced(self._blocks, -waves)
            return CondensedWaves(self, transposed.transpose(0, 2, 1), waves)
        except np.linalg.LinAlgError:
            return None


class CondensedWaves:
    """The inverses of T(k)^H A T(k), in the order of the reduced unknowns."""

    def __init__(self, whole: Condensation, complements: Batch, waves: FloatArray) -> None:
        self._whole = whole
        self._T = whole.outline.copies.at(waves)
        options = {"lower": True, "check_finite": False, "overwrite_a": True}
        self._factors = [cho_factor(complement, **options) for complement in complements]

    def solve(self, forces: Batch) -> Batch:
        """The solutions for a batch of right-hand sides (size, w, m)."""
        whole, outline = self._whole, self._whole.outline
        relaxed = applied(whole.factor.solve, forces[outline.inner_places])
        reaction = self._T.gather(applied(whole.transposed.__matmul__, relaxed))
        complement = self._solved(forces[outline.rim_places] - reaction)
        result = np.empty_like(forces)
        result[outline.rim_places] = complement
        moved = applied(whole.response.__matmul__, self._T.spread(complement))
        result[outline.inner_places] = relaxed - moved
        return result

    def _solved(self, forces: Batch) -> Batch:
        for k, factor in enumerate(self._factors):
            forces[:, k] = cho_solve(factor, forces[:, k], check_finite=False)
        return forces
