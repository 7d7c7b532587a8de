"""A hyperelastic body without any constraint: energy, forces, stiffness and mass of its nodes.

What periodic cells are made of: dolfinx assembles, plain numpy and scipy take over. Everything
is in the order of the mesh's nodes, the two components of a node side by side. On one rank.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.sparse import csr_array

from modeharvest.fem import dolfinx_api
from modeharvest.fem.field import Mesh
from modeharvest.fem.hyperelastic import Hyperelastic
from modeharvest.fem.materials import Material

FloatArray = NDArray[np.float64]


class FreeBody:
    """Total-Lagrangian finite elements of a T6 mesh in plane strain.

    Parameters
    ----------
    mesh
        T6 mesh [mm].
    material
        Strain energy density [MPa].
    """

    def __init__(self, mesh: Mesh, material: Material) -> None:
        self.mesh = mesh
        self._forms = Hyperelastic(mesh, material, MPI.COMM_SELF)
        self._V = self._forms.V
        size = 2 * len(mesh.nodes)
        numbers = np.arange(size, dtype=np.float64)
        # Position in dolfinx's order of every component in the order of the nodes.
        self._order = (
            np.rint(dolfinx_api.gather_nodes(self._V, numbers, len(mesh.nodes)))
            .astype(np.int64)
            .ravel()
        )
        self._tangent: Any = None

    def energy(self, u: FloatArray) -> float:
        """Stored energy per unit thickness [N] at displacements ``u`` (n, 2) [mm]."""
        self._load(u)
        return float(dolfinx.fem.assemble_scalar(self._forms.energy))

    def forces(self, u: FloatArray) -> FloatArray:
        """(2 n,) internal forces at displacements ``u`` (n, 2) [N/mm]."""
        self._load(u)
        return np.asarray(dolfinx.fem.assemble_vector(self._forms.forces).array[self._order])

    def stiffness(self, u: FloatArray) -> csr_array:
        """(2 n, 2 n) tangent stiffness at displacements ``u`` (n, 2) [N/mm^2]."""
        self._load(u)
        self._tangent = dolfinx_api.assemble_matrix(self._forms.stiffness, [], 1.0, self._tangent)
        return self._reordered(self._tangent)

    def mass(self) -> csr_array:
        """(2 n, 2 n) mass matrix of unit density [mm^2]."""
        return self._reordered(dolfinx_api.assemble_matrix(self._forms.mass, [], 1.0))

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest det F at the corners and mid-sides of all elements [-]."""
        self._load(u)
        return self._forms.smallest_jacobian()

    def _load(self, u: FloatArray) -> None:
        self._forms.u.x.array[self._order] = u.ravel()

    def _reordered(self, matrix: Any) -> csr_array:
        indptr, indices, values = matrix.getValuesCSR()
        place = np.empty_like(self._order)
        place[self._order] = np.arange(len(place))
        rows = np.repeat(place, np.diff(indptr))
        size = len(place)
        return csr_array((values, (rows, place[indices])), shape=(size, size))
