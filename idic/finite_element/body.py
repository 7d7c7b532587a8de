"""A mesh of the material with what all stages share: patterns, smoothness, the factor."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.idic.finite_element.equilibrium import Imbalance
from modeharvest.idic.finite_element.pattern import NodalPattern
from modeharvest.idic.finite_element.pixels import NodalEquations
from modeharvest.idic.finite_element.smoothness import add_at, inner_sides, smoothness_matrix
from modeharvest.util.arrays import FloatArray


class Body:
    """A mesh of the material with what all stages share: patterns, smoothness, the factor."""

    def __init__(self, mesh: Mesh, start: FloatArray) -> None:
        self.mesh, self.start = mesh, start
        sides = inner_sides(mesh.cells)
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
        return (cutoff / self._wavelength) ** 4 * data / smooth

    def factor(self, M: csr_array, R: csr_array, weight: float) -> Factor:
        """Factorise M + lambda R."""
        A = csr_array(M + weight * R)
        A.sort_indices()
        if self._factor is None or self._stored != A.nnz:
            self._factor, self._stored = factorise(A), A.nnz
        else:
            self._factor.update(A)
        return self._factor

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
