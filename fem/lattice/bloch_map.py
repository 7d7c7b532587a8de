"""The Bloch map T(k) and matrices T(k)^H K T(k): a lattice reduced to one cell, for any wave.

A Bloch wave is a displacement that changes from cell to cell by a phase only: at a node that
lies R1 a1 + R2 a2 from its master, u = exp(i (R1 k1 + R2 k2)) times the master's, with the
phases k1 = k . a1 and k2 = k . a2. An entry of K between nodes of shifts R and R' is thus
multiplied by exp(i k . (R' - R)). Sorted by R' - R once, the reduced matrix for any k is a sum
of a few arrays over one sparsity pattern.

Only nodes with copies in other cells feel the phase. So the others are eliminated once
(:class:`Condensation`), which leaves a small dense (Schur) complement on the cell's boundary, and
only that is reduced by T(k) and factorised for each wave vector. Inertia adds up: the matrix for a
wave has as many negative eigenvalues as its interior and its complement together (Haynsworth,
Linear Algebra Appl. 1 (1968) 73-81).

Many wave vectors at once share numpy's own time: a batch of vectors is an array (size, w, m), m
vectors for each of w wave vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from modeharvest.fem.lattice.periodicity import Periodicity
from modeharvest.util.arrays import ComplexArray, FloatArray, IntArray

Batch = NDArray[Any]  # of real or complex numbers


class BlochMap:
    """Components of displacement that are copies of others, some in other cells.

    Parameters
    ----------
    places
        (n,) which unknown, 0 ... size - 1, each component follows.
    shift
        (n, 2) integers R: it lies R1 a1 + R2 a2 from there.
    """

    def __init__(self, places: IntArray, shift: IntArray) -> None:
        self.places, self.shift = places, shift
        self._turned = np.flatnonzero(np.any(shift != 0, axis=1))
        # The first copies of all unknowns, the second copies of those that have one, ...
        order = np.argsort(places, kind="stable")
        starts = np.searchsorted(places[order], np.arange(places.max() + 1))
        rank = np.arange(len(places)) - starts[places[order]]
        self._ranks = [order[rank == k] for k in range(int(rank.max()) + 1)]

    def at(self, waves: FloatArray) -> BlochTransform:
        """T(k) for wave vectors given as phases (w, 2) [rad]; real if all its entries are."""
        return BlochTransform(self, phase_factors(self.shift[self._turned], waves))


class BlochTransform:
    """T(k) for some wave vectors; made by ``Copies.at``."""

    def __init__(self, copies: BlochMap, factors: Batch) -> None:
        self.dtype = factors.dtype
        self._copies, self._factors = copies, factors[:, :, None]

    def spread(self, vectors: Batch) -> Batch:
        """T x for x (size, w, m)."""
        copies = self._copies
        result = vectors[copies.places]
        result[copies._turned] *= self._factors
        return np.asarray(result)

    def gather(self, forces: Batch) -> Batch:
        """T^H f for f (n, w, m), which is overwritten."""
        copies = self._copies
        forces[copies._turned] *= self._factors.conj()
        first, *others = copies._ranks
        result = forces[first]
        for rank in others:
            result[copies.places[rank]] += forces[rank]
        return np.asarray(result)


def phase_factors(shift: IntArray, waves: FloatArray) -> Batch:
    """(n, w) exp(i k . R) for shifts (n, 2) and phases (w, 2) [rad]; real if all of them are."""
    factors = np.exp(1j * (shift @ waves.T))
    is_real = np.abs(factors.imag).max(initial=0.0) < 1e-12
    return np.asarray(factors.real.copy() if is_real else factors)


def applied(operator: Callable[[FloatArray], FloatArray], vectors: Batch) -> Batch:
    """A real linear operator (n, c) -> (n', c) applied to a batch (n, w, m), complex or not."""
    kind, flat = vectors.dtype, np.ascontiguousarray(vectors).reshape(len(vectors), -1)
    result = np.ascontiguousarray(operator(flat.view(np.float64))).view(kind)
    return result.reshape(len(result), *vectors.shape[1:])


class BoundaryDofs:
    """The components of displacement with copies in other cells, and how their matrices reduce.

    ``inner`` and ``rim`` are the components without and with copies, ``inner_places`` and
    ``rim_places`` the reduced unknowns that they are; ``copies`` those of the rim alone.

    Parameters
    ----------
    copies
        All components of the mesh's nodes.
    """

    def __init__(self, copies: BlochMap) -> None:
        is_inner = np.bincount(copies.places)[copies.places] == 1
        inner = np.flatnonzero(is_inner)
        self.inner = inner[np.argsort(copies.places[inner])]  # the order of little fill-in
        self.inner_places = copies.places[self.inner]
        self.rim = np.flatnonzero(~is_inner)
        self.rim_places, column = np.unique(copies.places[self.rim], return_inverse=True)
        shift = copies.shift[self.rim]
        self.copies = BlochMap(column, shift)
        # Sorted by R' - R once, as in ``Reduction``; here matrices are dense.
        size = len(self.rim_places)
        differences = (shift[None, :] - shift[:, None]).reshape(-1, 2)
        self._differences, phase = np.unique(differences, axis=0, return_inverse=True)
        entry = column[:, None] * size + column
        self._target = phase.ravel() * size**2 + entry.ravel()

    def sorted(self, matrix: FloatArray) -> FloatArray:
        """The entries of a matrix of all the outline's components by their phase."""
        shape = len(self._differences), len(self.rim_places) ** 2
        summed = np.bincount(self._target, matrix.ravel(), shape[0] * shape[1])
        return np.asarray(summed, dtype=np.float64).reshape(shape)

    def reduced(self, blocks: FloatArray, waves: FloatArray) -> Batch:
        """(w, m, m) T^H A T of a sorted matrix A for phases (w, 2) [rad]."""
        factors = phase_factors(self._differences, waves).T
        size = len(factors), len(self.rim_places), len(self.rim_places)
        if factors.dtype.kind == "f":
            return (factors @ blocks).reshape(size)
        result = np.empty((len(factors), blocks.shape[1]), dtype=np.complex128)
        result.real, result.imag = factors.real @ blocks, factors.imag @ blocks
        return result.reshape(size)


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
    def copies(self) -> BlochMap:
        """The components of the mesh's nodes as copies of the reduced unknowns."""
        components = 2 * np.repeat(self.periodicity.master, 2)
        components[1::2] += 1
        places = np.argsort(self.order)[components]
        return BlochMap(places, np.repeat(self.periodicity.shift, 2, axis=0))

    @cached_property
    def outline(self) -> BoundaryDofs:
        """Those of them that have copies in other cells."""
        return BoundaryDofs(self.copies)

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


class Condensation:
    """A symmetric matrix of a mesh's nodes, condensed onto the nodes that have copies.

    Parameters
    ----------
    matrix
        (2 n, 2 n), the two components of a node side by side.
    outline
        The nodes that have copies.
    """

    def __init__(self, matrix: csr_array, outline: BoundaryDofs) -> None:
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
