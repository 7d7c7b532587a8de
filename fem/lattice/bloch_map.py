"""The Bloch map T(k) and matrices T(k)^H K T(k): a lattice reduced to one cell, for any wave.

At a node at R1 a1 + R2 a2 from its master, u is exp(i (R1 k1 + R2 k2)) times the master's u, with
the phases k1 = k . a1 and k2 = k . a2. An entry of K between nodes with shifts R and R' is thus
multiplied by exp(i k . (R' - R)). The entries are sorted by R' - R once; the reduced matrix for any
k is then a sum of a few arrays over one sparsity pattern.

Only nodes with copies in other cells depend on the phase. So the others are eliminated once
(:class:`Condensation`), and only the small dense Schur complement on the cell's boundary is
reduced by T(k) and factorised for each wave vector. The matrix for a wave has as many negative
eigenvalues as its interior and its complement together (Haynsworth, Linear Algebra Appl. 1 (1968)
73-81). A batch of vectors is an array (size, w, m), m vectors for each of w wave vectors.
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

from modeharvest.fem.lattice.options import CENTRE, Wave
from modeharvest.fem.lattice.periodicity import Periodicity
from modeharvest.fem.sparse_factor import negative_pivots
from modeharvest.util.arrays import FloatArray, IntArray

Batch = NDArray[Any]  # of real or complex numbers


class BlochMap:
    """Components of displacement that are copies of unknowns, some in other cells.

    ``places`` (n,): unknown, 0 ... size - 1, that each component follows; ``shift`` (n, 2):
    integers R such that the component is at R1 a1 + R2 a2 from the unknown.
    """

    def __init__(self, places: IntArray, shift: IntArray) -> None:
        self.places, self.shift = places, shift
        self._turned = np.flatnonzero(np.any(shift != 0, axis=1))
        # First copies of all unknowns, then the second copies of unknowns that have them, ...
        order = np.argsort(places, kind="stable")
        first = np.searchsorted(places[order], np.arange(places.max() + 1))
        rank = np.arange(len(places)) - first[places[order]]
        self._ranks = [order[rank == k] for k in range(int(rank.max()) + 1)]

    def at(self, waves: FloatArray) -> BlochTransform:
        """T(k) for wave vectors given as phases (w, 2) [rad]; real if all entries are real."""
        return BlochTransform(self, phase_factors(self.shift[self._turned], waves))


class BlochTransform:
    """T(k) for several wave vectors, made by ``BlochMap.at``."""

    def __init__(self, bloch_map: BlochMap, factors: Batch) -> None:
        self.dtype = factors.dtype
        self._map, self._factors = bloch_map, factors[:, :, None]

    def expand(self, vectors: Batch) -> Batch:
        """T x (n, w, m) for x (size, w, m)."""
        bloch_map = self._map
        result = vectors[bloch_map.places].astype(np.result_type(vectors, self.dtype), copy=False)
        result[bloch_map._turned] *= self._factors
        return np.asarray(result)

    def restrict(self, forces: Batch) -> Batch:
        """T^H f (size, w, m) for f (n, w, m), which is overwritten."""
        bloch_map = self._map
        forces[bloch_map._turned] *= self._factors.conj()
        first, *others = bloch_map._ranks
        result = forces[first]
        for rank in others:
            result[bloch_map.places[rank]] += forces[rank]
        return np.asarray(result)


def phase_factors(shift: IntArray, waves: FloatArray) -> Batch:
    """(n, w) exp(i k . R) for shifts (n, 2) and phases (w, 2) [rad]; real if all of them are."""
    factors = np.exp(1j * (shift @ waves.T))
    is_real = np.abs(factors.imag).max(initial=0.0) < 1e-12
    return np.asarray(factors.real.copy() if is_real else factors)


def applied(operator: Callable[[FloatArray], FloatArray], vectors: Batch) -> Batch:
    """Apply a real linear operator (n, c) -> (n', c) to a real or complex batch (n, w, m)."""
    kind, flat = vectors.dtype, np.ascontiguousarray(vectors).reshape(len(vectors), -1)
    result = np.ascontiguousarray(operator(flat.view(np.float64))).view(kind)
    return result.reshape(len(result), *vectors.shape[1:])


class ShiftedEntries:
    """Sums the entries of unreduced matrices by their place in T^H A T and by R' - R.

    ``differences`` (e, 2) are R' - R of the unreduced entries, ``entries`` (e,) their indices among
    the ``count`` entries of the reduced matrix.
    """

    def __init__(self, differences: IntArray, entries: IntArray, count: int) -> None:
        self._differences, phase = np.unique(differences, axis=0, return_inverse=True)
        self._shape = len(self._differences), count
        self._target = phase.ravel() * count + entries.ravel()

    def summed(self, values: FloatArray) -> FloatArray:
        """(d, count) sums of the entries (e,), one row for each of d distinct R' - R."""
        size = self._shape[0] * self._shape[1]
        return np.asarray(np.bincount(self._target, values, size), np.float64).reshape(self._shape)

    def at(self, blocks: FloatArray, waves: FloatArray) -> Batch:
        """(w, count) entries of T^H A T for phases (w, 2) [rad]; real if T is."""
        factors = phase_factors(self._differences, waves).T
        if factors.dtype.kind == "f":
            return np.asarray(factors @ blocks)
        result = np.empty((len(factors), blocks.shape[1]), dtype=np.complex128)
        # Avoids a complex copy of the blocks.
        result.real, result.imag = factors.real @ blocks, factors.imag @ blocks
        return result


class BoundaryDofs:
    """The displacement components with copies in other cells, and the reduction of their matrices.

    ``interior`` and ``boundary`` are the components without and with copies, ``interior_places``
    and ``boundary_places`` the corresponding reduced unknowns; ``bloch_map``: of the boundary.
    """

    def __init__(self, bloch_map: BlochMap) -> None:
        is_interior = np.bincount(bloch_map.places)[bloch_map.places] == 1
        interior = np.flatnonzero(is_interior)
        self.interior = interior[np.argsort(bloch_map.places[interior])]  # for little fill-in
        self.interior_places = bloch_map.places[self.interior]
        self.boundary = np.flatnonzero(~is_interior)
        places = bloch_map.places[self.boundary]
        self.boundary_places, column = np.unique(places, return_inverse=True)
        shift = bloch_map.shift[self.boundary]
        self.bloch_map = BlochMap(column, shift)
        self._size = len(self.boundary_places)
        differences = (shift[None, :] - shift[:, None]).reshape(-1, 2)
        entries = column[:, None] * self._size + column
        self._entries = ShiftedEntries(differences, entries, self._size**2)

    def sorted(self, matrix: FloatArray) -> FloatArray:
        """The entries of a dense matrix over all boundary components, summed by phase."""
        return self._entries.summed(matrix.ravel())

    def reduced(self, blocks: FloatArray, waves: FloatArray) -> Batch:
        """(w, m, m) T^H A T of a matrix A, given as by :meth:`sorted`, for phases (w, 2) [rad]."""
        return self._entries.at(blocks, waves).reshape(-1, self._size, self._size)


class Reduction:
    """The sparsity pattern of reduced matrices, the same for every matrix of one mesh.

    Reduced unknowns are the masters' displacements, permuted so that factors have little
    fill-in: ``order[j]`` is the component (2 * master + axis) at place j. ``pattern`` (2 n, 2 n) is
    any matrix with the mesh's sparsity and with the two components of a node adjacent.
    """

    def __init__(self, pattern: csr_array, periodicity: Periodicity) -> None:
        self.size = 2 * periodicity.count
        self.periodicity = periodicity
        self.order: IntArray = np.arange(self.size)
        self._sort(pattern)
        whole = self.assembled(self._entries.summed(pattern.data).sum(axis=0))
        # Shifted to be regular; only the positions of its entries matter.
        identity = csc_array((np.ones(self.size), (self.order, self.order)))
        shift = 2.0 * float(abs(whole).sum(axis=0).max())
        regular = factorise(whole + shift * identity, "MMD_AT_PLUS_A")
        self.order = np.argsort(regular.perm_c).astype(np.int64)
        self._sort(pattern)

    def _sort(self, pattern: csr_array) -> None:
        """Find the place and the phase of every entry of an unreduced matrix.

        ``bloch_map`` describes the components of all nodes as copies of the reduced unknowns.
        """
        components = (2 * self.periodicity.master[:, None] + np.arange(2)).ravel()
        places = np.argsort(self.order)[components]
        shift = np.repeat(self.periodicity.shift, 2, axis=0)
        self.bloch_map = BlochMap(places, shift)
        rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        columns = pattern.indices
        numbers = places[columns] * self.size + places[rows]
        entries, entry = np.unique(numbers, return_inverse=True)
        self._indices = (entries % self.size).astype(np.int32)
        counts = np.bincount(entries // self.size, minlength=self.size)
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._entries = ShiftedEntries(shift[columns] - shift[rows], entry, len(entries))

    def reduced(self, matrix: csr_array) -> Callable[[Wave], csc_array]:
        """T(k)^H K T(k), Hermitian, as a function of the phases [rad]; real at multiples of pi.

        K must have the pattern given to the constructor.
        """
        blocks = self._entries.summed(matrix.data)
        return lambda wave: self.assembled(self._entries.at(blocks, np.array([wave]))[0])

    def assembled(self, data: NDArray[Any]) -> csc_array:
        """The sparse reduced matrix with these entries."""
        return csc_array((data, self._indices, self._indptr), shape=(self.size, self.size))

    @cached_property
    def boundary(self) -> BoundaryDofs:
        """The components that have copies in other cells."""
        return BoundaryDofs(self.bloch_map)

    def displacement(self, vector: NDArray[Any], wave: Wave = CENTRE) -> NDArray[Any]:
        """(n, 2) nodal displacement T(k) x of a reduced vector (real if x and T(k) are)."""
        T = self.bloch_map.at(np.array([wave]))
        return T.expand(vector[:, None, None]).reshape(-1, 2)

    def restricted(self, forces: FloatArray) -> FloatArray:
        """T(0)^T f for f (2 n,) or (2 n, m)."""
        result = self.bloch_map.at(np.array([CENTRE])).restrict(forces.reshape(len(forces), 1, -1))
        return result.reshape(self.size, *forces.shape[1:])


def factorise(matrix: csc_array, order: str = "NATURAL") -> Any:
    """SuperLU factor of a Hermitian matrix with diagonal pivots, in effect L D L^H."""
    options = {"SymmetricMode": True, "Equil": False}
    # Small supernodes are fastest for matrices of some thousand rows.
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=1, options=options)


class Condensation:
    """A symmetric matrix (2 n, 2 n) of a mesh's nodes, condensed onto nodes with copies."""

    def __init__(self, matrix: csr_array, dofs: BoundaryDofs) -> None:
        self.dofs = dofs
        rows = matrix[dofs.interior]
        self.factor: Any = factorise(csc_array(rows[:, dofs.interior]))
        self.is_definite = negative_pivots(self.factor) == 0
        self.coupling = rows[:, dofs.boundary]
        self.transposed = csr_array(self.coupling.T)
        self.response = np.ascontiguousarray(self.factor.solve(self.coupling.toarray()))
        corner = matrix[dofs.boundary][:, dofs.boundary].toarray()
        self._blocks = dofs.sorted(corner - self.transposed @ self.response)

    def at(self, waves: FloatArray) -> CondensedWaves | None:
        """The solvers for phases (w, 2) [rad]; None if any matrix isn't positive definite."""
        if not self.is_definite:
            return None
        try:
            # LAPACK stores matrices by columns, and A(-k)^T = A(k).
            transposed = self.dofs.reduced(self._blocks, -waves)
            return CondensedWaves(self, transposed.transpose(0, 2, 1), waves)
        except np.linalg.LinAlgError:
            return None


class CondensedWaves:
    """Solvers with T(k)^H A T(k), in the order of the reduced unknowns."""

    def __init__(self, whole: Condensation, complements: Batch, waves: FloatArray) -> None:
        self._whole = whole
        self._T = whole.dofs.bloch_map.at(waves)
        options = {"lower": True, "check_finite": False, "overwrite_a": True}
        self._factors = [cho_factor(complement, **options) for complement in complements]

    def solve(self, forces: Batch) -> Batch:
        """The solutions for a batch of right-hand sides (size, w, m)."""
        whole, dofs = self._whole, self._whole.dofs
        relaxed = applied(whole.factor.solve, forces[dofs.interior_places])
        reaction = self._T.restrict(applied(whole.transposed.__matmul__, relaxed))
        complement = forces[dofs.boundary_places] - reaction
        for k, factor in enumerate(self._factors):
            complement[:, k] = cho_solve(factor, complement[:, k], check_finite=False)
        result = np.empty_like(forces)
        result[dofs.boundary_places] = complement
        moved = applied(whole.response.__matmul__, self._T.expand(complement))
        result[dofs.interior_places] = relaxed - moved
        return result
