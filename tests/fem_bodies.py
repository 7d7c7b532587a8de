"""Small meshed bodies and vectors for the tests of the finite elements."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import join, rectangle
from modeharvest.fem.path.equilibrium import Structure

FloatArray = NDArray[np.float64]
_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


def plate(width: float, height: float, n_width: int, n_height: int) -> Mesh:
    """A solid rectangle about the origin, unstructured and without symmetry."""
    block = rectangle(width, height, n_width, n_height)
    return Mesh(block.nodes - [0.5 * width, 0.5 * height], block.cells, "T6")


def column(length: float, height: float, n_length: int, n_height: int) -> Mesh:
    """A solid rectangle about the origin, with both mirror symmetries.

    ``n_length`` and ``n_height`` are the numbers of elements on half a side.
    """
    quarter = rectangle(0.5 * length, 0.5 * height, n_length, n_height)
    return join([quarter.placed(s, (0.0, 0.0)) for s in _SIGNS], tolerance=1e-7 * height)


def moved(mesh: Mesh, motion: Callable[[FloatArray], FloatArray]) -> Mesh:
    """The mesh with every node at ``motion(nodes)``."""
    return Mesh(motion(mesh.nodes), mesh.cells, mesh.element)


def vector_of(structure: Structure, field: Callable[[FloatArray], FloatArray]) -> Any:
    """The PETSc vector of a displacement field, constrained components included."""
    vector = structure.zero()
    vector.array[:] = field(points_of(structure)).ravel()
    return vector


def points_of(structure: Structure) -> FloatArray:
    """(n, 2) positions of this rank's displacement vectors, in the order of PETSc [mm]."""
    count = structure.V.dofmap.index_map.size_local
    return np.array(structure.V.tabulate_dof_coordinates()[:count, :2])
