"""Total-Lagrangian equilibrium of a loaded specimen (dolfinx): forms and LDL^T factor.

The nominal strain e is the only load: constrained displacements are e d with a fixed direction d.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import dolfinx
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from modeharvest.fem import dolfinx_api
from modeharvest.fem.experiment import require_edges
from modeharvest.fem.field import Mesh
from modeharvest.fem.hyperelastic import Hyperelastic
from modeharvest.fem.materials import Material
from modeharvest.fem.meshing import MeshBlock, join
from modeharvest.fem.path.factor import BodyFactor, factorise
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.elements import reference_element, shape_functions
from modeharvest.util.errors import InputError

_QUARTERS = np.concatenate([
    origin + 0.5 * sign * reference_element("T6").nodes
    for *origin, sign in ((0.0, 0.0, 1), (0.5, 0.0, 1), (0.0, 0.5, 1), (0.5, 0.5, -1))
])  # fmt: skip
_AT_QUARTERS = shape_functions("T6", _QUARTERS)
"""Nodes of the four T6 elements that divide a T6, in local coordinates; its shape functions there.
"""


@dataclass(frozen=True)
class EdgeCompression:
    """Compression along x by displacing the two edges x = +-half_width [mm] towards each other."""

    half_width: float
    length: float
    """Length to which nominal strain refers [mm]; e * length is the shortening."""
    edges: str = "clamped"
    """With "clamped", both components are prescribed; with "sliding", u_y is free on the loaded
    edges except at the node nearest to mid-height, which fixes the specimen."""
    tilt: float = 0.0
    """Counter-clockwise rotation of the edge x = +half_width about its middle, per nominal strain
    [rad]: -e tilt y is added to its u_x."""
    pins: tuple[tuple[float, float], ...] = ()
    """Points (x, y) with fixed u_y [mm]; they must be nodes."""

    def __post_init__(self) -> None:
        require_edges(self.edges)


class Structure:
    """A meshed hyperelastic body under one loading, with its equilibrium equations.

    Vectors are PETSc vectors over all displacement components; ``u`` includes the constrained ones.
    ``factorisations`` counts every numerical factorisation. The mesh (T6) is needed on rank 0 only.
    ``constants``: the material's changeable constants, all of them if ``parametric``. ``nodes``:
    current positions of the mesh's nodes, see :meth:`place` [mm]. With a ``degree`` above 2,
    displacements are polynomials of this degree on each element, on one rank, given at the nodes of
    ``shown``: the mesh with each element divided in four. Else ``shown`` is the mesh itself.
    """

    def __init__(
        self, mesh: Mesh, material: Material, loading: EdgeCompression,
        comm: MPI.Comm = MPI.COMM_WORLD, parametric: bool = False, degree: int = 2,
    ) -> None:  # fmt: skip
        self.mesh, self.comm, self.nodes = mesh, comm, mesh.nodes
        self._forms = Hyperelastic(mesh, material, comm, parametric, degree)
        self.shown, self._quadratic, self._sampled = mesh, self._forms.V, None
        if degree > 2:
            self._quadratic = dolfinx.fem.functionspace(self._forms.V.mesh, ("Lagrange", 2, (2,)))
            x = np.einsum("pa,mai->mpi", _AT_QUARTERS, mesh.nodes[mesh.cells]).reshape(-1, 2)
            cells = np.arange(len(x)).reshape(-1, 6)
            self.shown = join([MeshBlock(x, cells)], 1e-8 * float(np.ptp(x[:, 0])))
            self._once = np.unique(self.shown.cells, return_index=True)[1]
            self._sampled = self._forms.sampled(_QUARTERS)[self._once]
        self.constants = self._forms.constants
        self.V, self._u = self._forms.V, self._forms.u
        self._direction, self._along = (dolfinx.fem.Function(self.V) for _ in range(2))
        self._constrain(loading)
        self._load_form = self._forms.stiffness_along(self._direction)
        self._along_form = self._forms.stiffness_along(self._along)
        self.factorisations = 0
        self.tangent = dolfinx_api.create_symmetric_matrix(self.V)
        self._factor: BodyFactor | None = None

    def _constrain(self, loading: EdgeCompression) -> None:
        x = self.V.tabulate_dof_coordinates()  # ghosts included
        half, tolerance = loading.half_width, 1e-8 * loading.half_width
        on_edge = np.abs(np.abs(x[:, 0]) - half) < tolerance
        fixed_y = on_edge.copy()
        if loading.edges != "clamped":  # of two nodes equally far from mid-height, the upper one
            off = np.hypot(x[:, 0] + half, x[:, 1] - tolerance)
            least = self.comm.allreduce(float(off.min(initial=np.inf)), MPI.MIN)
            fixed_y = on_edge & (off < least + 0.5 * tolerance)
        for pin in loading.pins:
            fixed_y |= np.hypot(x[:, 0] - pin[0], x[:, 1] - pin[1]) < tolerance
        along, across = np.flatnonzero(on_edge), np.flatnonzero(fixed_y)
        if self.comm.allreduce(len(along)) == 0:
            raise InputError(f"loading: expected nodes on the edges x = +-{half} mm, found none")
        target = self._direction.x.array.reshape(-1, 2)
        target[along, 0] = -0.5 * loading.length * np.sign(x[along, 0])
        self._shortening, turning = self._direction.x.array.copy(), along[x[along, 0] > 0.0]
        self._direction.x.array[2 * turning] -= loading.tilt * x[turning, 1]
        dofs = 2 * along, 2 * across + 1
        # Only matrices use these conditions, where their values don't matter.
        self._bcs = [
            dolfinx.fem.dirichletbc(PETSc.ScalarType(0), d.astype(np.int32), self.V.sub(axis))
            for axis, d in enumerate(dofs)
        ]
        fixed = np.union1d(*dofs)
        self._fixed_owned = fixed[fixed < 2 * self.V.dofmap.index_map.size_local]

    def place(self, nodes: FloatArray) -> None:
        """Move the mesh's nodes to ``nodes`` (n, 2) [mm]; on one rank."""
        geometry = self.V.mesh.geometry
        geometry.x[:, :2] = nodes[geometry.input_global_indices]
        self.nodes = nodes

    def lead(self, edges: FloatArray) -> None:
        """Add strain * ``edges`` to the prescribed displacements, beyond the shortening.

        ``edges``: nodal values (n, 2) [mm]; unconstrained components are ignored; on one rank.
        """
        direction = self._direction.x
        direction.array[:] = self._shortening
        direction.petsc_vec.axpy(1.0, self.constrained(edges))

    def constrained(self, field: FloatArray) -> PETSc.Vec:
        """Vector with the constrained components of nodal values (n, 2) only; on one rank."""
        vector, fixed = self.zero(), self._fixed_owned
        if not field.any():
            return vector
        values, quadratic = (dolfinx.fem.Function(V) for V in (self.V, self._quadratic))
        quadratic.x.array[self._order] = field.ravel()
        values.interpolate(quadratic)
        vector.array[fixed] = values.x.array[fixed]
        return vector

    @cached_property
    def shortening(self) -> PETSc.Vec:
        """d(constrained displacements)/d(strain) for straight edges [mm], zero elsewhere."""
        vector, fixed = self.zero(), self._fixed_owned
        vector.array[fixed] = self._shortening[fixed]
        return vector

    def on_shown(self, field: FloatArray) -> FloatArray:
        """Nodal values (n, 2) interpolated quadratically to the nodes of ``shown``."""
        if self._sampled is None:
            return field
        values = np.einsum("pa,mai->mpi", _AT_QUARTERS, field[self.mesh.cells])
        return np.asarray(values.reshape(-1, 2)[self._once])

    @cached_property
    def _order(self) -> IntArray:
        """For each component in the order of the mesh's nodes: its position in dolfinx's order."""
        count = len(self.mesh.nodes)
        every = np.arange(2 * count, dtype=np.float64)
        numbers = dolfinx_api.gather_nodes(self._quadratic, every, count)
        return np.rint(numbers).astype(np.int64).ravel()

    def zero(self) -> PETSc.Vec:
        """The undeformed state."""
        vector = self._u.x.petsc_vec.duplicate()
        vector.set(0.0)
        return vector

    def prescribe(self, u: PETSc.Vec, strain: float) -> None:
        """Set the constrained components of ``u`` to their values at ``strain``."""
        u.array[self._fixed_owned] = strain * self._direction.x.array[self._fixed_owned]

    def nodal(self, u: PETSc.Vec) -> FloatArray:
        """(n, 2) displacement at the nodes of ``shown``, in their order [mm]; on every rank."""
        if self._sampled is not None:
            return np.asarray(self._sampled @ u.array.reshape(-1, 2))
        self._load(u)
        count = self.comm.bcast(len(self.mesh.nodes))
        return dolfinx_api.gather_nodes(self.V, self._u.x.array, count)

    def from_function(self, field: Callable[[FloatArray], FloatArray]) -> PETSc.Vec:
        """The vector of a displacement field: (n, 2) values at points (n, 2) [mm]."""
        vector, count = self.zero(), self.V.dofmap.index_map.size_local
        vector.array[:] = field(self.V.tabulate_dof_coordinates()[:count, :2]).ravel()
        vector.array[self._fixed_owned] = 0.0
        return vector

    def largest(self, u: PETSc.Vec) -> float:
        """The largest nodal displacement of ``u`` [mm]."""
        lengths = np.linalg.norm(u.array.reshape(-1, 2), axis=1)
        return float(self.comm.allreduce(float(np.max(lengths, initial=0.0)), MPI.MAX))

    def residual(self, u: PETSc.Vec) -> PETSc.Vec:
        """Internal forces [N/mm], zero at the constrained components."""
        return self.free(self.forces(u))

    def forces(self, u: PETSc.Vec) -> PETSc.Vec:
        """Internal forces [N/mm], including those at the constrained components."""
        return self._assemble(self._forms.forces, u)

    def forces_along(self, u: PETSc.Vec, direction: PETSc.Vec) -> PETSc.Vec:
        """Derivative of the internal forces along a displacement, K(u) direction, matrix-free."""
        self._set(self._along, direction)
        return self._assemble(self._along_form, u)

    def free(self, vector: PETSc.Vec) -> PETSc.Vec:
        """Set the constrained components to zero in place; return the vector."""
        vector.array[self._fixed_owned] = 0.0
        return vector

    def load(self, u: PETSc.Vec) -> PETSc.Vec:
        """d(internal forces)/d(strain) at fixed free components [N/mm]."""
        return self.free(self._assemble(self._load_form, u))

    def curvature(self, u: PETSc.Vec, direction: PETSc.Vec) -> float:
        """direction . K(u) direction [N], matrix-free: cheap for a single vector."""
        return float(direction.dot(self.forces_along(u, direction)))

    def stiffness(self, u: PETSc.Vec) -> PETSc.Mat:
        """Tangent stiffness at ``u`` [N/mm^2], identity in constrained rows; one reused object."""
        self._load(u)
        return dolfinx_api.assemble_matrix(self._forms.stiffness, self._bcs, 1.0, self.tangent)

    def factor(self, u: PETSc.Vec) -> BodyFactor:
        """Factorise the tangent stiffness at ``u``; like the matrix, one reused object."""
        self.factorisations += 1
        tangent = self.stiffness(u)
        if self._factor is None:
            self._factor = factorise(tangent, self.V)
        else:
            self._factor.update()
        return self._factor

    def mass(self) -> PETSc.Mat:
        """Mass matrix of unit density, constrained rows zero [mm^2]."""
        return dolfinx_api.assemble_matrix(self._forms.mass, self._bcs, 0.0)

    def energy(self, u: PETSc.Vec) -> float:
        """Stored energy per unit thickness [N]."""
        self._load(u)
        return float(self.comm.allreduce(dolfinx.fem.assemble_scalar(self._forms.energy)))

    def reaction(self, u: PETSc.Vec, length: float) -> float:
        """Compressive force on a loaded edge per unit thickness [N/mm].

        By virtual work: d(energy)/d(strain) = force * length (+ moment * tilt) at equilibrium.
        """
        return self.reaction_of(self.forces(u), length)

    def reaction_of(self, forces: PETSc.Vec, length: float) -> float:
        """The reaction from internal forces, or its change from theirs, as it is linear."""
        return float(forces.dot(self.shortening)) / length

    def smallest_jacobian(self, u: PETSc.Vec) -> float:
        """Smallest det F at the corners and mid-sides of all elements [-]."""
        self._load(u)
        return float(self.comm.allreduce(self._forms.smallest_jacobian(), MPI.MIN))

    def _load(self, u: PETSc.Vec) -> None:
        self._set(self._u, u)

    @staticmethod
    def _set(function: dolfinx.fem.Function, vector: PETSc.Vec) -> None:
        function.x.array[: len(vector.array)] = vector.array
        function.x.scatter_forward()

    def _assemble(self, form: Any, u: PETSc.Vec) -> PETSc.Vec:
        self._load(u)
        vector = u.duplicate()
        dolfinx_api.assemble_vector(form, vector)
        return vector
