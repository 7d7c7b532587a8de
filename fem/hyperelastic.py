"""The weak form of a hyperelastic body, assembled by dolfinx, for specimens and cells.

Total Lagrangian, plane strain, six-node triangles with the three-point Gauss rule, as in the
paper's section "Virtual Experiments"; or polynomials of a higher degree on the triangles, with a
matching rule. Stress and stiffness are derived from the material's energy.
"""

from __future__ import annotations

from copy import copy
from functools import partial
from typing import Any

import dolfinx
import numpy as np
import ufl
from mpi4py import MPI
from scipy.sparse import csr_array

from modeharvest.fem import dolfinx_api
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

_form = partial(
    dolfinx.fem.form, jit_options={"cffi_extra_compile_args": ["-O3", "-ffast-math", "-g0"]}
)
"""Compiles a form whose sums may be reordered; this reduces assembly to two thirds of the time."""
_CORNERS_AND_MIDDLES = 0.5 * np.array([[0, 0], [2, 0], [0, 2], [1, 1], [0, 1], [1, 0]])


class Hyperelastic:
    """Space, displacement and compiled forms of a meshed body.

    ``V`` is the space and ``u`` the displacement [mm] at which everything is assembled;
    ``energy``, ``forces``, ``stiffness`` and ``mass`` (of unit density) are dolfinx forms. The
    mesh is needed on rank 0 only; InputError for other elements than T6.

    parametric : whether ``constants`` has the material's constants as dolfinx Constants by name,
        such as "kappa" or "moduli[0]"; otherwise forms are compiled with fixed values, and faster.
    degree : polynomial degree of the displacement over an element.
    """

    def __init__(
        self, mesh: Mesh, material: Material, comm: MPI.Comm, parametric: bool = False,
        degree: int = 2,
    ) -> None:  # fmt: skip
        if mesh.element != "T6":
            raise InputError(f"finite elements: expected a T6 mesh, got {mesh.element}")
        domain = dolfinx_api.create_mesh(mesh, comm)
        self.V = dolfinx.fem.functionspace(domain, ("Lagrange", degree, (2,)))
        self.u = dolfinx.fem.Function(self.V)
        self.constants: dict[str, Any] = {}
        if parametric:
            material, self.constants = _with_constants(material, domain)
        test, trial = ufl.TestFunction(self.V), ufl.TrialFunction(self.V)
        F = ufl.Identity(2) + ufl.grad(self.u)
        rule = {"quadrature_degree": 2 * degree - 2}  # for 2 on a triangle: three Gauss points
        energy = material.energy(F) * ufl.Measure("dx", domain=domain, metadata=rule)
        self._forces: Any = ufl.derivative(energy, self.u, test)
        self.energy: Any = _form(energy)
        self.forces: Any = _form(self._forces)
        self.stiffness: Any = _form(ufl.derivative(self._forces, self.u, trial))
        self.mass: Any = _form(ufl.inner(trial, test) * ufl.dx(domain))
        self._det_f = dolfinx.fem.Expression(ufl.det(F), _CORNERS_AND_MIDDLES)
        self._own_cells = np.arange(domain.topology.index_map(2).size_local, dtype=np.int32)

    def stiffness_along(self, direction: dolfinx.fem.Function) -> Any:
        """The form of the stiffness times a displacement: change of the forces along it."""
        return _form(ufl.derivative(self._forces, self.u, direction))

    def sampled(self, points: FloatArray) -> csr_array:
        """Matrix (m k, n) from V's nodes to local points (k, 2) in all m elements; on one rank."""
        basis = self.V.element.basix_element.tabulate(0, points)[0, :, :, 0]  # (k, b)
        number = np.argsort(self.V.mesh.topology.original_cell_index)
        nodes = np.repeat(self.V.dofmap.list[number], len(basis), axis=0)  # (m k, b)
        rows = np.arange(0, nodes.size + 1, nodes.shape[1])
        weights = np.tile(basis, (len(number), 1))
        return csr_array((weights.ravel(), nodes.ravel(), rows))

    def smallest_jacobian(self) -> float:
        """Smallest det F at the corners and mid-sides of this rank's elements [-]."""
        values = self._det_f.eval(self.V.mesh, self._own_cells)
        return float(np.min(values, initial=np.inf))


def _with_constants(material: Material, domain: Any) -> tuple[Material, dict[str, Any]]:
    """The same law with dolfinx Constants instead of numbers, and these Constants by name."""
    constants: dict[str, Any] = {}

    def replaced(name: str, value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(replaced(f"{name}[{k}]", part) for k, part in enumerate(value))
        constants[name] = dolfinx.fem.Constant(domain, np.float64(value))
        return constants[name]

    law = copy(material)  # without its checks, which are for numbers
    for name, value in vars(material).items():
        object.__setattr__(law, name, replaced(name, value))
    return law, constants


class FreeBody:
    """A body without constraints, on one rank, used for periodic cells.

    Arrays are in the order of the mesh's nodes, with the two components of a node adjacent.
    """

    def __init__(self, mesh: Mesh, material: Material) -> None:
        self.mesh = mesh
        self._forms = Hyperelastic(mesh, material, MPI.COMM_SELF)
        self._V = self._forms.V
        count = len(mesh.nodes)
        numbers = dolfinx_api.gather_nodes(self._V, np.arange(2 * count, dtype=np.float64), count)
        # For each component in the order of the mesh's nodes: its position in dolfinx's order.
        self._order = np.rint(numbers).astype(np.int64).ravel()
        self._tangent: Any = None
        self._reordering: tuple[Any, ...] = ()

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
        shape = (len(self._order),) * 2
        if not self._reordering:  # all matrices of a body have the same pattern
            place, numbers = np.argsort(self._order), np.arange(len(values))
            rows = np.repeat(place, np.diff(indptr))
            found = csr_array((numbers, (rows, place[indices])), shape)
            self._reordering = found.data, found.indices, found.indptr
        order, indices, indptr = self._reordering
        return csr_array((values[order], indices, indptr), shape)
