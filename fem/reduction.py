"""Matrices of a whole lattice, reduced to one cell by T(k)^H K T(k), for any wave vector.

A Bloch wave is a displacement that changes from cell to cell by a phase only: at a node that
lies R1 a1 + R2 a2 from its master, u = exp(i (R1 k1 + R2 k2)) times the master's, with the
phases k1 = k . a1 and k2 = k . a2. An entry of K between nodes of shifts R and R' is thus
multiplied by exp(i k . (R' - R)). Sorted by R' - R once, the reduced matrix for any k is a sum
of a few arrays over one sparsity pattern.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from modeharvest.fem.copies import Copies
from modeharvest.fem.outline import Outline
from modeharvest.fem.periodicity import Periodicity

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]


class Reduction:
    """The pattern of reduced matrices; the same for every matrix of one mesh.

    Reduced unknowns are the masters' displacements, permuted so that factors have little
    fill-in: ``order[j]`` is the component (2 * master + axis) at place j.

    Parameters
    ----------
    pattern
        (2 n, 2 n) any matrix with the mesh's sparsity, the two components of a node side by
        side.
    periodicity
        Of the mesh's nodes.
    """

    def __init__(self, pattern: csr_array, periodicity: Periodicity) -> None:
        self.size = 2 * periodicity.count
        self.periodicity = periodicity
        self.order: IntArray = np.arange(self.size)
        self._sort(pattern)
        whole = self.assembled(self._sorted(pattern.data).sum(axis=0))
        # Shifted, so that it is regular; all that counts is where its entries are.
        identity = csc_array((np.ones(self.size), (self.order, self.order)))
        shift = 2.0 * float(abs(whole).sum(axis=0).max())
        regular = factorise(whole + shift * identity, "MMD_AT_PLUS_A")
        self.order = np.argsort(regular.perm_c).astype(np.int64)
        self._sort(pattern)

    def _sort(self, pattern: csr_array) -> None:
        """Find where every entry of an unreduced matrix goes, and with which phase."""
        master, shift = self.periodicity.master, self.periodicity.shift
        rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        columns = pattern.indices
        place = np.argsort(self.order)
        row = place[2 * master[rows // 2] + rows % 2]
        column = place[2 * master[columns // 2] + columns % 2]
        differences = shift[columns // 2] - shift[rows // 2]
        self._differences, phase = np.unique(differences, axis=0, return_inverse=True)
        entries, entry = np.unique(column * self.size + row, return_inverse=True)
        self._indices = (entries % self.size).astype(np.int32)
        counts = np.bincount(entries // self.size, minlength=self.size)
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._target = phase.ravel() * len(entries) + entry

    def _sorted(self, values: FloatArray) -> FloatArray:
        blocks = len(self._differences), len(self._indices)
        summed = np.bincount(self._target, values, blocks[0] * blocks[1])
        return np.asarray(summed, dtype=np.float64).reshape(blocks)

    def reduced(self, matrix: csr_array) -> Reduced:
        """The matrix (of the pattern this was made for), ready for any wave vector."""
        return Reduced(self, self._sorted(matrix.data))

    def assembled(self, data: NDArray[Any]) -> csc_array:
        """The sparse matrix with these entries."""
        return csc_array((data, self._indices, self._indptr), shape=(self.size, self.size))

    @cached_property
    def copies(self) -> Copies:
        """The components of the mesh's nodes as copies of the reduced unknowns."""
        components = 2 * np.repeat(self.periodicity.master, 2)
        components[1::2] += 1
        places = np.argsort(self.order)[components]
        return Copies(places, np.repeat(self.periodicity.shift, 2, axis=0))

    @cached_property
    def outline(self) -> Outline:
        """Those of them that have copies in other cells."""
        return Outline(self.copies)

    def phases(self, wave: tuple[float, float]) -> ComplexArray:
        """The factors exp(i k . (R' - R)) of the sorted entries."""
        return np.asarray(np.exp(1j * (self._differences @ np.asarray(wave))))

    def displacement(self, vector: NDArray[Any], wave: tuple[float, float]) -> NDArray[Any]:
        """(n, 2) nodal displacement T(k) x of a reduced vector (real if x and T(k) are)."""
        masters = np.empty(self.size, dtype=vector.dtype)
        masters[self.order] = vector
        at_nodes = masters.reshape(-1, 2)[self.periodicity.master]
        if wave == (0.0, 0.0):
            return np.asarray(at_nodes)
        phase = np.exp(1j * (self.periodicity.shift @ np.asarray(wave)))
        return np.asarray(phase[:, None] * at_nodes)

    def gathered(self, forces: FloatArray) -> FloatArray:
        """T(0)^T f for f (2 n,) or (2 n, m)."""
        component = 2 * np.repeat(self.periodicity.master, 2) + np.tile([0, 1], len(forces) // 2)
        summed = np.zeros((self.size, *forces.shape[1:]))
        np.add.at(summed, component, forces)
        return np.asarray(summed[self.order])


class Reduced:
    """One matrix K as T(k)^H K T(k), a function of the phases k = (k . a1, k . a2) [rad]."""

    def __init__(self, reduction: Reduction, blocks: FloatArray) -> None:
        self._reduction, self._blocks = reduction, blocks

    def at(self, wave: tuple[float, float]) -> csc_array:
        """The Hermitian matrix; real where both phases are multiples of pi."""
        phases = self._reduction.phases(wave)
        if np.abs(phases.imag).max() < 1e-12:
            return self._reduction.assembled(phases.real @ self._blocks)
        return self._reduction.assembled(self._combined(phases))

    def _combined(self, factors: ComplexArray) -> ComplexArray:
        """The sorted entries times complex factors, without a complex copy of them."""
        data = np.empty(self._blocks.shape[1], dtype=np.complex128)
        data.real, data.imag = factors.real @ self._blocks, factors.imag @ self._blocks
        return data


def factorise(matrix: csc_array, order: str = "NATURAL") -> Any:
    """SuperLU factor of a Hermitian matrix with pivots on the diagonal: L D L^H in fact."""
    options = {"SymmetricMode": True, "Equil": False}
    # Small supernodes suit matrices of some thousand rows.
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=1, options=options)


def negative_pivots(factor: Any) -> int:
    """Number of negative eigenvalues of the factorised Hermitian matrix (law of inertia).

    Raises
    ------
    ArithmeticError
        If a zero pivot made SuperLU leave the diagonal, so that signs mean nothing.
    """
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise ArithmeticError("a zero pivot: the matrix is singular or nearly so")
    return int(np.count_nonzero(factor.U.diagonal().real < 0))
