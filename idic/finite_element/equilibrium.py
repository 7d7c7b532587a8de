"""Imbalance of a hyperelastic body: what its nodes' forces leave, as a regularisation with a law.

Where nothing loads the body its internal forces vanish, at inner nodes as on free edges. Penalised
is their sum of squares |D f(u)|^2, D leaving out the loaded nodes, not the energy: M. Genet, C. R.
Mecanique 351 (2023), doi 10.5802/crmeca.228. A factor of the moduli cancels.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, diags_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material, stress_and_tangent
from modeharvest.imaging.mapping.elements import shape_gradients
from modeharvest.util.arrays import BoolArray, FloatArray

_QUADRATURE = np.array([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]])
_LEAST_DET = 0.05
"""Points of an element that shrink to less have no part in it: an iteration gone astray."""


class Imbalance:
    """The forces of a T6 mesh that nothing balances.

    Parameters
    ----------
    mesh
        [mm].
    material
        Of the body, in plane strain.
    loaded
        (n,) True at nodes on which unknown forces act.
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
