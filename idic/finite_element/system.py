"""Linear systems of the nodes of a mesh: sparsity, smoothness or a law's imbalance, the factor.

A matrix of displacements has three symmetric nodal parts, xx, xy and yy; unknown 2 i + c is
component c at node i.

Smoothness, without a material law:

    u'Ru = sum over interior sides int (1/h) |[grad grad u]|^2 + (100/h^3) |[grad u]|^2 ds,

[.] being the jump across a side of length h; second gradients are an element's mean. It is zero for
quadratic displacements, and natural (free) at all boundaries: what finite elements have of the
integral of |grad grad grad u|^2, whose minimum under noise is the smoothing spline of third order,
with the jumps of gradients as interior penalty (G. Engel et al., Comput. Methods Appl. Mech. Eng.
191 (2002), doi 10.1016/S0045-7825(02)00286-4). A wave of length T costs (2 pi/T)^6 times its mean
square, so that a weight of (l/T)^6 v'Mv/v'Rv for any wave v halves what of it is at the wavelength
l: H. Leclerc, J.-N. Perie, S. Roux, F. Hild, Exp. Mech. 51 (2011), doi 10.1007/s11340-010-9407-6.

With a law: where nothing loads the body its internal forces f vanish, at interior nodes as on free
edges. Penalised is their sum of squares |D f(u)|^2, D leaving out the loaded nodes, not the energy:
M. Genet, C. R. Mecanique 351 (2023), doi 10.5802/crmeca.228. A factor of the moduli cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material, stress_and_tangent
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.idic.finite_element.pixels import NodalEquations
from modeharvest.imaging.mapping.elements import reference_element, shape_gradients
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled

_PENALTY = 100.0
"""Of jumps of gradients across sides, against those of second gradients [-]."""
_QUADRATURE = np.array([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]])
_LEAST_DET = 0.05
"""Points of an element that shrink to less have no part in it: an iteration gone astray."""
_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)


class Imbalance:
    """The forces of a T6 mesh that nothing balances.

    Parameters
    ----------
    mesh : [mm].
    material : of the body, in plane strain.
    loaded : (n,) True at nodes on which unknown forces act.
    """

    def __init__(self, mesh: Mesh, material: Material, loaded: BoolArray) -> None:
        self.mesh, self.material = mesh, material
        local, x = shape_gradients("T6", _QUADRATURE), mesh.nodes[mesh.cells]
        F = np.einsum("eki,qkj->eqij", x, local)
        self._slopes = np.einsum("qkj,eqji->eqki", local, np.linalg.inv(F))
        self._weights = np.linalg.det(F) / 6.0
        free = np.repeat(~loaded, 2).astype(float)
        self._free = csr_array(diags_array(free))
        dofs = (2 * mesh.cells[:, :, None] + np.arange(2)).reshape(len(mesh.cells), 12)
        self._rows, self._cols = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, 12).ravel()
        self._dofs = dofs.ravel()

    def forces(self, u: FloatArray) -> tuple[FloatArray, csr_array]:
        """(2 n,) internal forces at u (2 n,) and their derivatives (2 n, 2 n), up to a factor."""
        cells = self.mesh.cells
        F = np.eye(2) + np.einsum("eai,eqaj->eqij", u.reshape(-1, 2)[cells], self._slopes)
        there = np.linalg.det(F) > _LEAST_DET
        F[~there] = np.eye(2)
        P, A = stress_and_tangent(self.material, F.reshape(-1, 2, 2))
        w = (self._weights * there)[..., None, None]
        P, A = P.reshape(F.shape) * w, A.reshape(*F.shape, 2, 2) * w[..., None, None]
        f = np.einsum("eqij,eqaj->eai", P, self._slopes, optimize=True)
        half = np.einsum("eqijkl,eqbl->eqijkb", A, self._slopes, optimize=True)
        K = np.einsum("eqijkb,eqaj->eaibk", half, self._slopes, optimize=True)
        total = np.asarray(np.bincount(self._dofs, f.ravel(), u.size), dtype=np.float64)
        return total, csr_array((K.ravel(), (self._rows, self._cols)), shape=(u.size, u.size))

    def linearised(self, u: FloatArray) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) K'DK and (2 n,) K'Df."""
        f, K = self.forces(u)
        DK = self._free @ K
        return csr_array(K.T @ DK), np.asarray(DK.T @ f)


@dataclass(frozen=True, eq=False)
class NodalPattern:
    """Which nodes have to do with each other, in compressed rows."""

    indptr: IntArray
    indices: IntArray
    """(n + 1,), (q,): the neighbours of each node, itself included, ascending."""

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


def interior_sides(cells: IntArray) -> IntArray:
    """(s, 4) first cell, its side 0 ... 2, second cell and its side, of sides between two cells."""
    corners = np.sort(np.stack([cells[:, [k, (k + 1) % 3]] for k in range(3)], axis=1), axis=2)
    flat = corners.reshape(-1, 2)
    order = np.lexsort(flat.T)
    same = (flat[order[1:]] == flat[order[:-1]]).all(axis=1)
    first, second = order[:-1][same], order[1:][same]
    return np.stack([first // 3, first % 3, second // 3, second % 3], axis=1)


def second_gradients(mesh: Mesh) -> FloatArray:
    """(m, k, 2, 2) second derivatives of the shape functions, means over elements [1/mm^2]."""
    local = shape_gradients(mesh.element, _QUADRATURE)  # (q, k, 2)
    coefficients = reference_element(mesh.element).coefficients
    # Of 1, xi, eta, xi^2, xi eta, eta^2 only the last three have second derivatives.
    second = np.array([[[2, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 2]]], dtype=float)
    curved = np.einsum("mij,mk->kij", second, coefficients[3:6])
    x = mesh.nodes[mesh.cells]
    F = np.einsum("eki,qkj->eqij", x, local)
    inverse = np.linalg.inv(F)
    slopes = np.einsum("qkj,eqji->eqki", local, inverse)
    bending = np.einsum("eki,klm->eilm", x, curved)
    bare = curved - np.einsum("eqki,eilm->eqklm", slopes, bending)
    found = np.einsum("eqli,eqklm,eqmj->eqkij", inverse, bare, inverse)
    return np.asarray(found.mean(axis=1))


def side_jumps(mesh: Mesh, sides: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Jumps of the gradient across interior sides.

    Returns
    -------
    nodes, jumps, weights
        (s, 2 k) node numbers of both cells, (s, g, 2 k, 2) jump of the gradient for each of them
        [1/mm] at Gauss points, (s, g) lengths that these stand for, over that of the side [-].
    """
    corners = reference_element(mesh.element).nodes[:3]
    parts, weights = [], np.empty(0)
    for sign, cell, side, forwards in ((1.0, 0, 1, True), (-1.0, 2, 3, False)):
        begin, end = corners[sides[:, side]], corners[(sides[:, side] + 1) % 3]
        t = _GAUSS if forwards else 1.0 - _GAUSS  # the other cell goes the other way
        at = begin[:, None] + t[:, None] * (end - begin)[:, None]
        local = shape_gradients(mesh.element, at)  # (s, g, k, 2)
        x = mesh.nodes[mesh.cells[sides[:, cell]]]
        F = np.einsum("ski,sgkj->sgij", x, local)
        parts.append(sign * np.einsum("sgkj,sgji->sgki", local, np.linalg.inv(F)))
        if forwards:
            along = np.linalg.norm(np.einsum("sgij,sj->sgi", F, end - begin), axis=-1)
            weights = 0.5 * along / along.mean(axis=1, keepdims=True)
    nodes = np.hstack([mesh.cells[sides[:, 0]], mesh.cells[sides[:, 2]]])
    return nodes, np.concatenate(parts, axis=2), weights


def smoothness_roots(mesh: Mesh) -> tuple[IntArray, FloatArray]:
    """(s, 2 k) nodes around each interior side, and (s, 2 k, c) roots [1/mm^2] of their part of R.

    A part is its roots times their transpose.
    """
    curved, sides = second_gradients(mesh), interior_sides(mesh.cells)
    nodes, jumps, shares = side_jumps(mesh, sides)
    first, side, second, _ = sides.T
    x = mesh.nodes[mesh.cells[first]]
    ends = x[np.arange(len(x)), side], x[np.arange(len(x)), (side + 1) % 3]
    h = np.linalg.norm(ends[1] - ends[0], axis=1)
    bent = np.concatenate([curved[first], -curved[second]], axis=1)
    across = np.sqrt(_PENALTY * shares / h[:, None] ** 2)[:, :, None, None] * jumps
    second_part, first_part = bent.reshape(*nodes.shape, 4), np.moveaxis(across, 2, 1)
    return nodes, np.concatenate([second_part, first_part.reshape(*nodes.shape, 4)], axis=2)


def smoothness_matrix(mesh: Mesh) -> csr_array:
    """(n, n) R of one component [1/mm^4], for nodal values (n,) on a T6 mesh; sorted indices."""
    nodes, roots = smoothness_roots(mesh)
    blocks = roots @ roots.swapaxes(1, 2)
    n, k = len(mesh.nodes), nodes.shape[1]
    at = np.repeat(nodes, k, axis=1).ravel(), np.tile(nodes, (1, k)).ravel()
    total = csr_array((blocks.ravel(), at), shape=(n, n))
    total.sum_duplicates()
    total.sort_indices()
    return total


def smoothness_samples(mesh: Mesh, count: int) -> FloatArray:
    """(2 n, count) random vectors whose covariance is R of both components [1/mm^2]."""
    nodes, roots = smoothness_roots(mesh)
    z = np.random.default_rng(1).standard_normal((len(roots), roots.shape[2], 2 * count))
    total = np.zeros((len(mesh.nodes), 2 * count))
    add_at(total, nodes, roots @ z)
    return total.reshape(2 * len(mesh.nodes), count)


def add_at(total: FloatArray, nodes: IntArray, values: FloatArray) -> None:
    """Add values (m, k, s) to the rows of (n, s) whose numbers are (m, k)."""
    flat = nodes.ravel()
    ones = csr_array((np.ones(flat.size), (flat, np.arange(flat.size))), (len(total), flat.size))
    total += ones @ values.reshape(flat.size, -1)


class Body:
    """A mesh of the material with what all stages share: patterns, smoothness, the factor."""

    def __init__(self, mesh: Mesh, start: FloatArray) -> None:
        self.mesh, self.start = mesh, start
        sides = interior_sides(mesh.cells)
        pairs = np.hstack([mesh.cells[sides[:, 0]], mesh.cells[sides[:, 2]]])
        self.pattern = NodalPattern.of(len(mesh.nodes), mesh.cells, pairs)
        self._smoothness = self.pattern.both(smoothness_matrix(mesh))
        self.law: Imbalance | None = None
        edge = mesh.nodes[mesh.cells[:, 1]] - mesh.nodes[mesh.cells[:, 0]]
        self._wavelength = 10.0 * float(np.median(np.linalg.norm(edge, axis=1)))
        self._waves = _waves(mesh.nodes, self._wavelength)
        self._factor: Factor | None = None
        self._stored = 0

    @property
    def library(self) -> str:
        """What factorises."""
        return "" if self._factor is None else self._factor.library

    def assembled(self, equations: NodalEquations) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) M and (2 n,) J'r of the nodes."""
        M = self.pattern.matrix(self.pattern.assembled(self.mesh.cells, equations.blocks))
        gradient = np.zeros((len(self.mesh.nodes), 2))
        add_at(gradient, self.mesh.cells, equations.gradient)
        return M, gradient.ravel()

    def penalty(self, u: FloatArray) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) R and (2 n,) half the gradient of what is penalised, at u (2 n,)."""
        if self.law is not None:
            return self.law.linearised(u)
        return self._smoothness, self._smoothness @ (u - self.start.ravel())

    def weight(self, M: csr_array, R: csr_array, cutoff: float) -> float:
        """The weight lambda of R for a cut-off wavelength [mm]."""
        data, smooth = (float(np.sum(self._waves * (A @ self._waves))) for A in (M, R))
        power = 6 if self.law is None else 4
        return (cutoff / self._wavelength) ** power * data / smooth

    def factor(self, M: csr_array, R: csr_array, weight: float) -> Factor:
        """Factorise M + lambda R."""
        A = csr_array(M + weight * R)
        A.sort_indices()
        if self._factor is None or self._stored != A.nnz:
            self._factor, self._stored = factorise(A), A.nnz
        else:
            self._factor.update(A)
        return self._factor

    def prior_samples(self, count: int) -> FloatArray:
        """(2 n, count) random vectors of the covariance R; 0 with a law."""
        if self.law is not None:
            return np.zeros((self.start.size, count))
        return smoothness_samples(self.mesh, count)

    def samples(self, blocks: FloatArray, count: int) -> FloatArray:
        """(2 n, count) random vectors of the covariance M, given by its blocks."""
        n, m = len(self.mesh.nodes), len(blocks)
        parts = np.empty((m, 6, 2, 6, 2))
        for c in (0, 1):
            for d in (0, 1):
                parts[:, :, c, :, d] = blocks[:, c + d]
        M = parts.reshape(m, 12, 12)
        # Elements with few pixels have singular blocks.
        M[:, range(12), range(12)] *= 1.0 + 1e-9
        M[:, range(12), range(12)] += 1e-12 * M.max()
        z = np.linalg.cholesky(M) @ np.random.default_rng(0).standard_normal((m, 12, count))
        total = np.zeros((n, 2 * count))
        add_at(total, self.mesh.cells, z.reshape(m, 6, 2 * count))
        return total.reshape(2 * n, count)


def _waves(nodes: FloatArray, wavelength: float) -> FloatArray:
    """(2 n, 4) waves along x and y, of displacements along x and y."""
    waves = np.zeros((len(nodes), 2, 4))
    for k in range(4):
        waves[:, k % 2, k] = np.cos(2.0 * np.pi / wavelength * nodes[:, k // 2])
    return waves.reshape(-1, 4)
