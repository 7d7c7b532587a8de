"""A hyperelastic body without any constraint: energy, forces, stiffness and mass of its nodes.

What periodic cells are made of: dolfinx assembles, plain numpy and scipy take over. Everything
is in the order of the mesh's nodes, the two components of a node side by side. On one rank.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.sparse import csr_array

from modeharvest.errors import InputError
from modeharvest.fem import dolfinx_api
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material

FloatArray = NDArray[np.float64]
_THREE_POINTS = {"quadrature_degree": 2}  # on a triangle: the three-point Gauss rule
_CORNERS_AND_MIDDLES = np.array(
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 0.5], [0.5, 0.0]]
)


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
        if mesh.element != "T6":
            raise InputError(f"finite elements: expected a T6 mesh, got {mesh.element}")
        self.mesh = mesh
        domain = dolfinx_api.create_mesh(mesh, MPI.COMM_SELF)
        self._V = dolfinx.fem.functionspace(domain, ("Lagrange", 2, (2,)))
        self._u = dolfinx.fem.Function(self._V)
        size = 2 * len(mesh.nodes)
        numbers = np.arange(size, dtype=np.float64)
        # Position in dolfinx's order of every component in the order of the nodes.
        self._order = (
            np.rint(dolfinx_api.gather_nodes(self._V, numbers, len(mesh.nodes)))
            .astype(np.int64)
            .ravel()
        )
        self._define_forms(domain, material)
        self._tangent: Any = None

    def _define_forms(self, domain: dolfinx.mesh.Mesh, material: Material) -> None:
        u, form = self._u, dolfinx.fem.form
        test, trial = ufl.TestFunction(self._V), ufl.TrialFunction(self._V)
        dx = ufl.Measure("dx", domain=domain, metadata=_THREE_POINTS)
        F = ufl.Identity(2) + ufl.grad(u)
        energy = material.energy(F) * dx
        forces = ufl.derivative(energy, u, test)
        self._energy_form, self._forces_form = form(energy), form(forces)
        self._tangent_form = form(ufl.derivative(forces, u, trial))
        self._mass_form = form(ufl.inner(trial, test) * ufl.dx(domain))
        count = domain.topology.index_map(2).size_local
        det_f = dolfinx.fem.Expression(ufl.det(F), _CORNERS_AND_MIDDLES)
        self._det_f = (det_f, np.arange(count, dtype=np.int32))

    def energy(self, u: FloatArray) -> float:
        """Stored energy per unit thickness [N] at displacements ``u`` (n, 2) [mm]."""
        self._load(u)
        return float(dolfinx.fem.assemble_scalar(self._energy_form))

    def forces(self, u: FloatArray) -> FloatArray:
        """(2 n,) internal forces at displacements ``u`` (n, 2) [N/mm]."""
        self._load(u)
        return np.asarray(dolfinx.fem.assemble_vector(self._forces_form).array[self._order])

    def stiffness(self, u: FloatArray) -> csr_array:
        """(2 n, 2 n) tangent stiffness at displacements ``u`` (n, 2) [N/mm^2]."""
        self._load(u)
        self._tangent = dolfinx_api.assemble_matrix(self._tangent_form, [], 1.0, self._tangent)
        return self._reordered(self._tangent)

    def mass(self) -> csr_array:
        """(2 n, 2 n) mass matrix of unit density [mm^2]."""
        return self._reordered(dolfinx_api.assemble_matrix(self._mass_form, [], 1.0))

    def smallest_jacobian(self, u: FloatArray) -> float:
        """Smallest det F at the corners and mid-sides of all elements [-]."""
        self._load(u)
        expression, cells = self._det_f
        return float(np.min(expression.eval(self._V.mesh, cells)))

    def _load(self, u: FloatArray) -> None:
        self._u.x.array[self._order] = u.ravel()

    def _reordered(self, matrix: Any) -> csr_array:
        indptr, indices, values = matrix.getValuesCSR()
        place = np.empty_like(self._order)
        place[self._order] = np.arange(len(place))
        rows = np.repeat(place, np.diff(indptr))
        size = len(place)
        return csr_array((values, (rows, place[indices])), shape=(size, size))
