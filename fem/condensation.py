"""One factorisation of a cell's interior serves all wave vectors.

Only nodes with copies in other cells feel the phase of a Bloch wave. So the other nodes are
eliminated once, which leaves a small dense (Schur) complement on the outline, and only that is
reduced by T(k) and factorised for each wave vector. Inertia adds up: the matrix for a wave has as
many negative eigenvalues as its interior and its complement together (Haynsworth, Linear Algebra
Appl. 1 (1968) 73-81).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array

from modeharvest.fem.reduction import Reduction, factorise, negative_pivots

FloatArray = NDArray[np.float64]


class Condensation:
    """A symmetric matrix of a mesh's nodes, condensed onto the nodes that have copies.

    Parameters
    ----------
    matrix
        (2 n, 2 n), the two components of a node side by side.
    reduction
        Which nodes are copies, and the order of the reduced unknowns.
    """

    def __init__(self, matrix: csr_array, reduction: Reduction) -> None:
        self.reduction = reduction
        place = reduction.places
        master = reduction.periodicity.master
        is_inner = np.repeat(np.bincount(master)[master] == 1, 2)
        inner, outline = np.flatnonzero(is_inner), np.flatnonzero(~is_inner)
        inner = inner[np.argsort(place[inner])]  # the order of little fill-in
        self.outline = outline
        self.inner_places = place[inner]
        self.outline_places, self._column = np.unique(place[outline], return_inverse=True)
        rows = matrix[inner]
        self.factor: Any = factorise(csc_array(rows[:, inner]))
        self.coupling = rows[:, outline]
        self.response = np.ascontiguousarray(self.factor.solve(self.coupling.toarray()))
        self.complement = matrix[outline][:, outline].toarray() - self.coupling.T @ self.response
        self.is_definite = negative_pivots(self.factor) == 0

    def at(self, wave: tuple[float, float]) -> CondensedWave | None:
        """The solver for one wave vector; None where the matrix isn't positive definite."""
        if not self.is_definite:
            return None
        shift = self.reduction.periodicity.shift[self.outline // 2]
        phases = np.exp(1j * (shift @ np.asarray(wave)))
        if np.abs(phases.imag).max() < 1e-12:
            phases = phases.real
        size = len(self.outline), len(self.outline_places)
        T = csr_array((phases, (np.arange(size[0]), self._column)), shape=size)
        try:
            return CondensedWave(self, T)
        except np.linalg.LinAlgError:
            return None


class CondensedWave:
    """The inverse of T(k)^H A T(k), in the order of the reduced unknowns."""

    def __init__(self, whole: Condensation, transformation: csr_array) -> None:
        self._whole, self._T = whole, transformation
        self._adjoint = csr_array(transformation.conj().T)
        reduced = self._adjoint @ (self._adjoint @ whole.complement.T).conj().T
        self._complement = cho_factor(0.5 * (reduced + reduced.conj().T), lower=True)

    def solve(self, block: NDArray[Any]) -> NDArray[Any]:
        """The solutions for right-hand sides (size, m)."""
        whole = self._whole
        relaxed = _by_parts(whole.factor.solve, block[whole.inner_places])
        forces = block[whole.outline_places] - self._adjoint @ (whole.coupling.T @ relaxed)
        outline = cho_solve(self._complement, forces)
        result = np.empty(block.shape, dtype=np.result_type(block, outline))
        result[whole.outline_places] = outline
        result[whole.inner_places] = relaxed - _by_parts(
            whole.response.__matmul__, self._T @ outline
        )
        return result


def _by_parts(operator: Callable[[FloatArray], FloatArray], block: NDArray[Any]) -> NDArray[Any]:
    """A real linear operator applied to a block that may be complex, without a complex copy."""
    if block.dtype.kind == "f":
        return operator(block)
    parts = operator(np.asfortranarray(np.hstack([block.real, block.imag])))
    count = block.shape[1]
    return np.asarray(parts[:, :count] + 1j * parts[:, count:])
