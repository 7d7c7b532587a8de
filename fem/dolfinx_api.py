"""Functions that differ between the supported dolfinx versions (0.9 to 0.11)."""

from __future__ import annotations

import inspect
from importlib.metadata import version
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
from dolfinx.fem import petsc as dolfinx_petsc
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array

from modeharvest.fem.field import Mesh
from modeharvest.util.errors import MissingDependencyError

VERSION = version("fenics-dolfinx")
if tuple(int(v) for v in VERSION.split(".")[:2]) < (0, 9):
    raise MissingDependencyError(
        f"expected dolfinx 0.9 or newer, got {VERSION}; see 'Install' in the README"
    )

# dolfinx orders mid-side nodes by the opposite corner, VTK and gmsh counter-clockwise.
_T6_FROM_VTK = [0, 1, 2, 4, 5, 3]


def create_mesh(mesh: Mesh, comm: MPI.Comm) -> dolfinx.mesh.Mesh:
    """Distribute a T6 mesh (given on rank 0, ignored elsewhere) over the communicator.

    The body is repeatedly bisected by the cells' positions until every rank has its part, which is
    faster than graph partitioning.
    """
    if comm.rank == 0:
        nodes, cells = mesh.nodes, mesh.cells[:, _T6_FROM_VTK]
    else:
        nodes, cells = np.empty((0, 2)), np.empty((0, 6), dtype=np.int64)

    def parts(_comm: Any, count: int, *_cells: Any) -> Any:
        ranks = _bisected(nodes[cells[:, :3]].mean(axis=1), 0, count)
        found = dolfinx.graph.adjacencylist(ranks[:, None])
        return getattr(found, "_cpp_object", found)  # wrapped in 0.10

    element = basix.ufl.element("Lagrange", "triangle", 2, shape=(2,))
    partitioner = parts if comm.size > 1 else None
    return dolfinx.mesh.create_mesh(comm, cells=cells, x=nodes, e=element, partitioner=partitioner)


def _bisected(points: NDArray[np.float64], first: int, count: int) -> NDArray[np.int32]:
    """(n,) number of each point's part, from ``first``: recursive bisection in ``count`` parts."""
    part = np.full(len(points), first, dtype=np.int32)
    if count > 1 and len(points):
        order = np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")
        half = count // 2
        low, high = np.split(order, [len(points) * half // count])
        part[low] = _bisected(points[low], first, half)
        part[high] = _bisected(points[high], first + half, count - half)
    return part


def assemble_matrix(form: Any, bcs: list[Any], diagonal: float, matrix: Any = None) -> PETSc.Mat:
    """Assemble a PETSc matrix, into ``matrix`` if given; constrained rows get ``diagonal``."""
    if matrix is None:
        matrix = dolfinx_petsc.create_matrix(form)
    matrix.zeroEntries()
    keywords: dict[str, Any] = {"bcs": bcs, _DIAGONAL: diagonal}
    dolfinx_petsc.assemble_matrix(matrix, form, **keywords)
    matrix.assemble()
    return matrix


def create_symmetric_matrix(V: Any) -> PETSc.Mat:
    """An empty PETSc matrix for this rank's cells alone, over all its components of ``V``.

    It stores only the upper triangle, in blocks of two components. Assembly takes half the time:
    the lower halves of element matrices are omitted, and there is one look-up per block.
    """
    cells, nodes = V.dofmap.list, V.dofmap.index_map
    count = nodes.size_local + nodes.num_ghosts
    rows, columns = np.repeat(cells, cells.shape[1], axis=1), np.tile(cells, cells.shape[1])
    is_upper = columns >= rows
    places = coo_array((is_upper[is_upper], (rows[is_upper], columns[is_upper])), (count, count))
    matrix = PETSc.Mat().create(PETSc.COMM_SELF)
    matrix.setSizes((2 * count, 2 * count))
    matrix.setType(PETSc.Mat.Type.SBAIJ)
    matrix.setBlockSize(2)
    matrix.setPreallocationNNZ(np.diff(places.tocsr().indptr).astype(PETSc.IntType))
    matrix.setOption(PETSc.Mat.Option.IGNORE_LOWER_TRIANGULAR, True)
    same = PETSc.LGMap().create(np.arange(count, dtype=PETSc.IntType), 2, comm=PETSc.COMM_SELF)
    matrix.setLGMap(same, same)
    return matrix


def shared_nodes(V: Any) -> NDArray[np.int64]:
    """Local numbers of nodes that this rank's cells share with those of other ranks."""
    ghosts = dolfinx.fem.Function(V).x
    ghosts.array[2 * V.dofmap.index_map.size_local :] = 1.0
    ghosts.petsc_vec.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    return np.flatnonzero(ghosts.array[::2])


def assemble_vector(form: Any, vector: PETSc.Vec) -> None:
    """Assemble a linear form into ``vector`` and add ghost contributions to their owners."""
    with vector.localForm() as local:
        local.set(0.0)
    dolfinx_petsc.assemble_vector(vector, form)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def gather_nodes(V: Any, values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Nodal values (count, 2) in the order of the nodes given to :func:`create_mesh`.

    ``values``: local array of a function in the vector space ``V`` (quadratic, like the geometry).
    Every rank receives the whole array.
    """
    geometry = V.mesh.geometry  # "dofmap" became "dofmaps", one for each cell type, in 0.10
    dofmap = geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap
    nodes = np.asarray(geometry.input_global_indices)[dofmap.ravel()]
    result, owned = np.zeros((count, 2)), np.zeros((count, 1))
    result[nodes], owned[nodes] = values.reshape(-1, 2)[V.dofmap.list.ravel()], 1.0
    V.mesh.comm.Allreduce(MPI.IN_PLACE, result)
    V.mesh.comm.Allreduce(MPI.IN_PLACE, owned)
    return np.asarray(result / owned)


_PARAMETERS = inspect.signature(dolfinx_petsc.assemble_matrix).parameters
_DIAGONAL = "diag" if "diag" in _PARAMETERS else "diagonal"  # renamed in 0.10
