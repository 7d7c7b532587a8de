"""Sparse matrices over the nodes of a mesh, all of one pattern.

A matrix of displacements has three symmetric nodal parts, xx, xy and yy; unknown 2 i + c is
component c at node i.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.compiled import compiled


@dataclass(frozen=True, eq=False)
class NodalPattern:
    """Which nodes have to do with each other, in compressed rows.

    Parameters
    ----------
    indptr, indices
        (n + 1,), (q,): the neighbours of each node, itself included, ascending.
    """

    indptr: IntArray
    indices: IntArray

    @classmethod
    def of(cls, count: int, *groups: IntArray) -> NodalPattern:
        """From groups of nodes (m, k) that have to do with one another, out of ``count``."""
        rows = np.concatenate([np.repeat(g, g.shape[1], axis=1).ravel() for g in groups])
        cols = np.concatenate([np.tile(g, (1, g.shape[1])).ravel() for g in groups])
        one = np.ones(rows.size, dtype=np.int8)
        joined = csr_array(coo_array((one, (rows, cols)), shape=(count, count)))
        joined.sum_duplicates()
        joined.sort_indices()
        return cls(joined.indptr.astype(np.int64), joined.indices.astype(np.int64))

    def assembled(self, nodes: IntArray, blocks: FloatArray) -> FloatArray:
        """(parts, q) sums of symmetric blocks (m, parts, k, k) over their nodes (m, k)."""
        data = np.zeros((blocks.shape[1], self.indices.size))
        _scatter(self.indptr, self.indices, nodes, np.ascontiguousarray(blocks), data)
        return data

    def both(self, matrix: csr_array) -> csr_array:
        """(2 n, 2 n) of a matrix (n, n) of either component, with this pattern."""
        rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        own = np.repeat(np.arange(self.indptr.size - 1), np.diff(self.indptr))
        n = self.indptr.size - 1
        at = np.searchsorted(own * n + self.indices, rows * n + matrix.indices)
        parts = np.zeros((3, self.indices.size))
        parts[0, at] = parts[2, at] = matrix.data
        return self.matrix(parts)

    def matrix(self, parts: FloatArray) -> csr_array:
        """(2 n, 2 n) of nodal parts xx, xy, yy (3, q)."""
        n = self.indptr.size - 1
        degree = 2 * np.repeat(np.diff(self.indptr), 2)
        indptr = np.concatenate([[0], np.cumsum(degree)])
        data, indices = np.empty(indptr[-1]), np.empty(indptr[-1], dtype=np.int32)
        _expand(self.indptr, self.indices, np.ascontiguousarray(parts), indptr, indices, data)
        return csr_array((data, indices, indptr.astype(np.int32)), shape=(2 * n, 2 * n))


@compiled()
def _scatter(indptr: Any, indices: Any, nodes: Any, blocks: Any, data: Any) -> None:
    for e in range(nodes.shape[0]):
        for a in range(nodes.shape[1]):
            low, high = indptr[nodes[e, a]], indptr[nodes[e, a] + 1]
            for b in range(nodes.shape[1]):
                q = low + np.searchsorted(indices[low:high], nodes[e, b])
                for k in range(data.shape[0]):
                    data[k, q] += blocks[e, k, a, b]


@compiled()
def _expand(indptr: Any, indices: Any, parts: Any, begin: Any, columns: Any, data: Any) -> None:
    for i in range(indptr.size - 1):
        for c in range(2):
            to = begin[2 * i + c]
            for q in range(indptr[i], indptr[i + 1]):
                for d in range(2):
                    columns[to], data[to] = 2 * indices[q] + d, parts[c + d, q]
                    to += 1
