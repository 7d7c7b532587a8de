"""Linear systems of nodal displacements: sparsity, regularisation (by law or not), the factor.

A matrix of displacements has three symmetric nodal parts, xx, xy and yy; unknown 2 i + c is
component c at node i.

Regularisation without a material law, by smoothness:

    u'Ru = sum over interior sides int (1/h) |[grad grad u]|^2 + (100/h^3) |[grad u]|^2 ds,

[.] being the jump across a side of length h; second gradients are means over an element. u'Ru is
zero for quadratic u, with natural (free) boundary conditions. It is the finite-element equivalent
of the integral of |grad grad grad u|^2, which yields smoothing splines of third order, and jumps of
gradients are an interior penalty (G. Engel et al., Comput. Methods Appl. Mech. Eng. 191 (2002), doi
10.1016/S0045-7825(02)00286-4). A wave v of length T costs (2 pi/T)^6 times its mean square, so that
the weight (l/T)^6 v'Mv/v'Rv of any such wave halves the amplitude of waves of the cut-off length
l: H. Leclerc, J.-N. Perie, S. Roux, F. Hild, Exp. Mech. 51 (2011), doi 10.1007/s11340-010-9407-6.

With a law: the internal forces f vanish where no load acts, at interior nodes and on free edges.
The penalty is their sum of squares |D f(u)|^2, not the energy; D leaves out the loaded nodes:
M. Genet, C. R. Mecanique 351 (2023), doi 10.5802/crmeca.228. A factor of the moduli cancels.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import bsr_array, csr_array, diags_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material, stress_and_tangent
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.idic.finite_element.equations.normal_equations import NodalEquations
from modeharvest.idic.finite_element.equations.pixels import SLIVERS, MeshPixels
from modeharvest.idic.finite_element.fields import mean_around
from modeharvest.idic.solver.free_edges import FreeEdges, on_sides
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled
from modeharvest.util.elements import nodal_sums, reference_element, shape_gradients

_PENALTY = 100.0
"""Weight of gradient jumps across sides, relative to jumps of second gradients [-]."""
_QUADRATURE = np.array([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]])
_LEAST_DET = 0.05
"""Integration points of smaller det F are left out: they show a diverged iteration [-]."""
SAMPLES = 32
"""Number of random vectors; standard deviations estimated from them are known to 13 %."""
SOME = 8
"""Number of random vectors where a coarser estimate suffices."""
_UNKNOWN = 1e-9
"""Weight of nodes with unknown displacement, which determines islands that have no others."""
_TINY = 1e-200
_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class NodalPattern:
    """Sparsity pattern of nodal matrices: coupled nodes, in compressed rows."""

    indptr: IntArray
    indices: IntArray
    """(n + 1,) row pointers; (q,) nodes coupled with each node, itself included, ascending."""

    @classmethod
    def of(cls, count: int, *groups: IntArray) -> NodalPattern:
        """Pattern of ``count`` nodes, from groups (m, k) of nodes coupled with each other."""
        rows = np.concatenate([np.repeat(g, g.shape[1], axis=1).ravel() for g in groups])
        cols = np.concatenate([np.tile(g, (1, g.shape[1])).ravel() for g in groups])
        joined = csr_array((np.ones(rows.size, np.int8), (rows, cols)), (count, count))  # each once
        return cls(joined.indptr.astype(np.int64), joined.indices.astype(np.int64))

    def assembled(self, nodes: IntArray, blocks: FloatArray) -> csr_array:
        """(2 n, 2 n) sums of blocks (m, 3 or 4, k, k), xx, xy, (yx,) yy, at nodes (m, k)."""
        indptr, indices = self._of_components
        data = np.zeros(indices.size)
        _scatter(self.indptr, self.indices, nodes, np.ascontiguousarray(blocks), data)
        return csr_array((data, indices, indptr), shape=(indptr.size - 1,) * 2)

    @cached_property
    def _of_components(self) -> tuple[IntArray, IntArray]:
        """Row pointers and columns of the (2 n, 2 n) matrix."""
        ones = np.ones((self.indices.size, 2, 2), np.int8)
        whole = bsr_array((ones, self.indices, self.indptr)).tocsr()
        return whole.indptr, whole.indices


@compiled()
def _scatter(indptr: Any, indices: Any, nodes: Any, blocks: Any, data: Any) -> None:
    parts = blocks.shape[1]
    for e in range(nodes.shape[0]):
        for a in range(nodes.shape[1]):
            low, high = indptr[nodes[e, a]], indptr[nodes[e, a] + 1]
            for b in range(nodes.shape[1]):
                x = 4 * low + 2 * np.searchsorted(indices[low:high], nodes[e, b])
                y = x + 2 * (high - low)
                data[x] += blocks[e, 0, a, b]
                data[x + 1] += blocks[e, 1, a, b]
                data[y] += blocks[e, parts - 2, a, b]
                data[y + 1] += blocks[e, parts - 1, a, b]


def interior_sides(cells: IntArray) -> IntArray:
    """(s, 4) for sides between two cells: first cell, its side 0 ... 2, second cell, its side."""
    middle = cells[:, 3:].ravel()
    order = np.argsort(middle, kind="stable")
    same = middle[order[1:]] == middle[order[:-1]]
    first, second = order[:-1][same], order[1:][same]
    return np.stack([first // 3, first % 3, second // 3, second % 3], axis=1)


def second_gradients(mesh: Mesh) -> FloatArray:
    """(m, k, 2, 2) second derivatives of the shape functions, averaged per element [1/mm^2]."""
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


class SmoothnessRoots(NamedTuple):
    """Factorised form of R by sides: each contribution is its roots times their transpose."""

    size: int
    """Nodes of the mesh."""
    nodes: IntArray
    roots: FloatArray
    """(s, 2 k) nodes of the two cells at each interior side, and (s, 2 k, c) roots [1/mm^2]."""

    @classmethod
    def of(cls, mesh: Mesh) -> SmoothnessRoots:
        """Compute the roots of a T6 mesh."""
        curved, (first, side, second, other) = second_gradients(mesh), interior_sides(mesh.cells).T
        _, here, along = on_sides(mesh, first, side, _GAUSS)
        there = on_sides(mesh, second, other, 1.0 - _GAUSS)[1]  # in the opposite direction
        speed = np.linalg.norm(along, axis=-1)
        shares = 0.5 * speed / speed.mean(axis=1, keepdims=True)
        corners = mesh.nodes[mesh.cells[first, (side + 1) % 3]], mesh.nodes[mesh.cells[first, side]]
        h = np.linalg.norm(corners[0] - corners[1], axis=1)
        bent = np.concatenate([curved[first], -curved[second]], axis=1)
        jumps = np.concatenate([here, -there], axis=2)
        across = np.sqrt(_PENALTY * shares / h[:, None] ** 2)[:, :, None, None] * jumps
        nodes = np.hstack([mesh.cells[first], mesh.cells[second]])
        second_part, first_part = bent.reshape(*nodes.shape, 4), np.moveaxis(across, 2, 1)
        roots = np.concatenate([second_part, first_part.reshape(*nodes.shape, 4)], axis=2)
        return cls(len(mesh.nodes), nodes, roots)

    def matrix(self, pattern: NodalPattern) -> csr_array:
        """(2 n, 2 n) R of both components [1/mm^4]."""
        own = self.roots @ self.roots.swapaxes(1, 2)
        return pattern.assembled(self.nodes, np.stack([own, np.zeros_like(own), own], axis=1))

    def samples(self, count: int) -> FloatArray:
        """(2 n, count) random vectors whose covariance is R of both components [1/mm^2]."""
        shape = len(self.roots), self.roots.shape[2], 2 * count
        random = self.roots @ np.random.default_rng(1).standard_normal(shape)
        return nodal_sums(self.size, self.nodes, random).reshape(2 * self.size, count)


class Body:
    """A T6 mesh of the material with all that measurements on it share: patterns, the factor."""

    def __init__(
        self, mesh: Mesh, mask: BoolArray | None = None, changes: tuple[str, ...] = ()
    ) -> None:
        self.mesh, self.mask, self.changes = mesh, mask, changes
        """(rows, cols) mask from which the mesh was made, if it was; notes on parts left out."""
        self.pixels = MeshPixels(mesh, 0.0 if mask is None else SLIVERS)
        roots = SmoothnessRoots.of(mesh)
        with ThreadPoolExecutor(1) as beside:
            samples = beside.submit(roots.samples, SAMPLES)
            self.pattern = NodalPattern.of(len(mesh.nodes), mesh.cells, roots.nodes)
            self.smoothness = roots.matrix(self.pattern)
            self.smoothness_samples = samples.result()
        """(2 n, 2 n) R of both components, and (2 n, SAMPLES) random vectors of covariance R."""
        edge = np.diff(mesh.nodes[mesh.cells[:, :2]], axis=1)
        self.wavelength = 10.0 * float(np.median(np.linalg.norm(edge, axis=2)))
        """Wavelength [mm] of the waves (along x and y, both components) that compare M with R."""
        self._waves = np.kron(np.cos(2.0 * np.pi / self.wavelength * mesh.nodes), np.eye(2))
        self.roughness = self.energies(self.smoothness)
        self._factor: Factor | None = None
        self._factorised: tuple[csr_array, csr_array, float] | None = None
        self._stored, self.library = 0, ""  # entries of the factorised matrix, and its library

    def matrix(self, blocks: FloatArray) -> csr_array:
        """Assemble element blocks (m, 3, 6, 6) to a matrix (2 n, 2 n)."""
        return self.pattern.assembled(self.mesh.cells, blocks)

    def vector(self, parts: FloatArray) -> FloatArray:
        """Assemble element vectors (m, 6, 2) to (2 n,), or (m, 6, 2 count) to (2 n count,)."""
        return nodal_sums(len(self.mesh.nodes), self.mesh.cells, parts).ravel()

    def away_from(self, cells: BoolArray, layers: int = 0) -> BoolArray:
        """(n,) True for nodes beyond the selected cells (m,) and layers of cells around them."""
        near = np.zeros(len(self.mesh.nodes), np.bool_)
        near[self.mesh.cells[cells]] = True
        for _ in range(layers):
            near[self.mesh.cells[near[self.mesh.cells].any(axis=1)]] = True
        return ~near

    def energies(self, matrix: csr_array) -> float:
        """Sum of v'Av over the waves v that compare matrices A."""
        return float(np.sum(self._waves * (matrix @ self._waves)))

    def factor(self, M: csr_array, R: csr_array, weight: float) -> Factor:
        """Factorise M + lambda R; if all three are those of the last call, return its factor."""
        last = self._factorised
        if self._factor and last and last[0] is M and last[1] is R and last[2] == weight:
            return self._factor
        if np.array_equal(M.indptr, R.indptr) and np.array_equal(M.indices, R.indices):
            A = csr_array((M.data + weight * R.data, M.indices, M.indptr), shape=M.shape)
        else:
            A = csr_array(M + weight * R)
            A.sort_indices()
        if self._factor is None or self._stored != A.nnz:
            self._factor, self._stored = factorise(A, block=2), A.nnz
            self.library = self._factor.library
        else:
            self._factor.update(A)
        self._factorised = M, R, weight
        return self._factor

    def smoothed(self, u: FloatArray, cutoff: float, known: BoolArray | bool = True) -> FloatArray:
        """(n, 2) u without waves shorter than a cut-off [mm], from the nodes (n,) with known u.

        Where none is known around, u itself.
        """
        own = np.broadcast_to(np.where(known, 1.0, _UNKNOWN), len(u))[:, None] * [1.0, 0.0, 1.0]
        one = self.pattern.assembled(np.arange(len(u))[:, None], own[..., None, None])
        R = self.smoothness
        if not R.data.any():  # a single element
            return u
        weight = (cutoff / self.wavelength) ** Smoothness.power * self.energies(one)
        return self.factor(one, R, weight / self.roughness).solve(one @ u.ravel()).reshape(-1, 2)

    def samples(self, M: FloatArray, pull: FloatArray, free: FloatArray) -> tuple[FloatArray, ...]:
        """(2 n, SAMPLES) random vectors of covariance M (m, 3, 6, 6) times the inflation (n,) >= 1.

        ``pull`` (m, 6, 2) is the actual vector, ``free`` (m,) its degrees of freedom. Residuals
        correlated over an element, mainly by its own error, pull its nodes more than equal noise.
        """
        m, own = len(M), _definite(M)
        ridge = 1e-4 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(12)
        moved = np.linalg.solve(own + ridge, pull.reshape(m, 12, 1))[..., 0]
        square = (pull.reshape(m, 12) * moved).sum(axis=1)
        found, expected = mean_around(self.mesh, np.stack([square, free], axis=1)).T
        inflation = np.maximum(found / np.maximum(expected, 1.0), 1.0)
        share = inflation[self.mesh.cells].mean(axis=1)[:, None, None, None]
        return self.random(share * M, SAMPLES), inflation

    def random(self, M: FloatArray, count: int) -> FloatArray:
        """(2 n, count) random vectors of covariance M, given by element blocks (m, 3, 6, 6)."""
        z = np.random.default_rng(0).standard_normal((len(M), 12, count))
        z = np.linalg.cholesky(_definite(M)) @ z
        return self.vector(z.reshape(len(M), 6, -1)).reshape(-1, count)


def _definite(M: FloatArray) -> FloatArray:
    """(m, 12, 12) of element blocks (m, 3, 6, 6), made definite: few pixels leave them singular."""
    M = M[:, [[0, 1], [1, 2]]].transpose(0, 3, 1, 4, 2).reshape(len(M), 12, 12)
    M[:, range(12), range(12)] *= 1.0 + 1e-9
    return np.asarray(M + max(1e-12 * M.max(), _TINY) * np.eye(12))


class Smoothness:
    """Roughness of the difference between u and a start (n, 2) [mm], on a body's mesh."""

    power = 6
    """Exponent of the wave number in the penalty of a wave."""

    def __init__(self, body: Body, start: FloatArray) -> None:
        self.body, self.start = body, start.ravel()

    def linearised(self, u: FloatArray) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) R and (2 n,) R(u - u_0)."""
        R = self.body.smoothness
        return R, R @ (u - self.start)


class Imbalance:
    """Unbalanced nodal forces of a T6 mesh [mm], which are least if the body obeys its law.

    material : of the body, in plane strain.
    loaded : (n,) True at nodes where unknown forces may act, which are left out.
    """

    power = 4

    def __init__(self, mesh: Mesh, material: Material, loaded: BoolArray) -> None:
        self.mesh, self.material = mesh, material
        local, x = shape_gradients("T6", _QUADRATURE), mesh.nodes[mesh.cells]
        F = np.einsum("eki,qkj->eqij", x, local)
        self._slopes = slopes = np.einsum("qkj,eqji->eqik", local, np.linalg.inv(F), order="C")
        self.weights = np.linalg.det(F) / 6.0
        row = np.arange(slopes.size // slopes.shape[3]).repeat(slopes.shape[3])
        col = np.broadcast_to(mesh.cells[:, None, None], slopes.shape).ravel()
        self._gradient = csr_array((slopes.ravel(), (row, col)), (row[-1] + 1, len(mesh.nodes)))
        self._free = csr_array(diags_array(np.repeat(~loaded, 2).astype(float)))
        self._pattern = NodalPattern.of(len(mesh.nodes), mesh.cells)

    def deformation_gradient(self, u: FloatArray) -> FloatArray:
        """(m, q, 2, 2) F at the integration points of each element [-], for u (2 n,) [mm]."""
        found = (self._gradient @ u.reshape(-1, 2)).reshape(*self.weights.shape, 2, 2)
        return np.asarray(np.eye(2) + found.swapaxes(2, 3))

    def forces(self, u: FloatArray) -> tuple[FloatArray, csr_array]:
        """(2 n,) internal forces at u (2 n,) [mm], their tangent K (2 n, 2 n), up to a factor."""
        F = self.deformation_gradient(u)
        there = np.linalg.det(F) > _LEAST_DET
        F[~there] = np.eye(2)
        P, A = stress_and_tangent(self.material, F.reshape(-1, 2, 2))
        w = (self.weights * there)[..., None, None]
        P, A = P.reshape(F.shape) * w, A.reshape(*F.shape, 2, 2) * w[..., None, None]
        m, q, _, k = (G := self._slopes).shape  # products of matrices are faster than einsum
        half = (A.reshape(m, q, 8, 2) @ G).reshape(m, q, 2, 2, 2, k).transpose(0, 2, 4, 5, 1, 3)
        K = (half.reshape(m, 4 * k, 2 * q) @ G.reshape(m, 2 * q, k)).reshape(m, 4, k, k)
        f = self._gradient.T @ P.swapaxes(2, 3).reshape(-1, 2)
        return f.ravel(), self._pattern.assembled(self.mesh.cells, K.swapaxes(2, 3))

    def linearised(self, u: FloatArray) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) K'DK and (2 n,) K'Df, the Gauss-Newton matrix and gradient of |D f|^2/2."""
        f, K = self.forces(u)
        DK = self._free @ K
        return csr_array(K.T @ DK), np.asarray(DK.T @ f)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Normal equations at a displacement u of the nodes."""

    body: Body
    prior: Smoothness | Imbalance
    """The regularisation."""
    u: FloatArray
    """(2 n,) nodal displacements [mm]."""
    sums: NodalEquations
    """Sums over the pixels; blocks are weighed, and may be those of a nearby displacement."""
    signal: FloatArray
    gain: float
    """Results of :meth:`NodalEquations.signal`; their product squared weighs the blocks."""
    M: csr_array
    gradient: FloatArray
    """(2 n, 2 n) weighed sums of h h', and (2 n,) sums of h r weighed by the product itself."""
    R: csr_array
    penalty: FloatArray
    """(2 n, 2 n) matrix and (2 n,) gradient of the regularisation."""
    ratio: float
    """v'Mv over v'Rv, each summed over the body's waves v."""
    edges: FreeEdges | None = None
    """Relation at free edges, used as data besides the images; None for no such relation."""
    near: csr_array | None = None
    """Matrix of images and edge relation from a nearby displacement, used again if not None."""

    def mean(self, values: FloatArray) -> float:
        """Mean over the pixels of values (m,) of the elements."""
        return float(values @ self.sums.counts) / self.sums.pixels

    def weight(self, cutoff: float) -> float:
        """Weight lambda of R for a cut-off wavelength [mm]."""
        return (cutoff / self.body.wavelength) ** self.prior.power * self.ratio

    @property
    def variance(self) -> float:
        """Mean square of the residual [grey levels^2]."""
        return self.sums.rms**2

    @cached_property
    def known(self) -> tuple[csr_array, FloatArray]:
        """Matrix M and gradient, with the contributions of the relation at free edges."""
        if self.edges is None:
            return self.M, self.gradient
        blocks, e = self.edges.linearised(self.u)
        A, M = self.near, self.M
        if A is None:
            E = self.body.pattern.assembled(self.edges.nodes, blocks)
            A = csr_array((M.data + self.variance * E.data, M.indices, M.indptr), shape=M.shape)
        return A, self.gradient + self.variance * e

    def factor(self, weight: float) -> Factor:
        """Factor of M + lambda R, M with the contribution of the relation at free edges."""
        return self.body.factor(self.known[0], self.R, weight)

    def right(self, weight: float) -> FloatArray:
        """(2 n,) right-hand side of a step."""
        return self.known[1] - weight * self.penalty

    def step(self, cutoff: float, times: float = 1.0) -> FloatArray:
        """(2 n,) Gauss-Newton step [mm] for a cut-off [mm], its weight multiplied by ``times``."""
        weight = times * self.weight(cutoff)
        return self.factor(weight).solve(self.right(weight))
