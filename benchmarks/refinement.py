"""Refined unit cells: each triangle divided into four while holes stay round.

Nested meshes show a rate of convergence undisturbed by a mesher's choices.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.meshing import MeshBlock, join
from modeharvest.util.arrays import FloatArray

_REFERENCE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
_CHILDREN = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
_NEAR = 0.02  # of the radius: what of the boundary belongs to a hole


def refined(mesh: Mesh, onto: Callable[[FloatArray], FloatArray], tolerance: float) -> Mesh:
    """The mesh with every element divided into four along its own curved coordinates.

    Parameters
    ----------
    mesh
        T6 mesh [mm].
    onto
        Moves nodes (n, 2) of the mesh's boundary onto the true one [mm].
    tolerance
        Nodes closer than this become one [mm].
    """
    blocks = []
    for child in _CHILDREN:
        corners = _REFERENCE[list(child)]
        places = np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])
        nodes = np.einsum("kn,end->ekd", _shape_functions(places), mesh.nodes[mesh.cells])
        blocks.append(MeshBlock(nodes.reshape(-1, 2), np.arange(6 * len(nodes)).reshape(-1, 6)))
    result = join(blocks, tolerance)
    boundary = np.unique(boundary_sides(result))
    result.nodes[boundary] = onto(result.nodes[boundary])
    return result


def refined_cell(cell: UnitCell, diameter: float) -> UnitCell:
    """A unit cell refined, with its circular hole about the origin [mm]."""
    shortest = float(np.linalg.norm(cell.lattice, axis=1).min())

    def onto(nodes: FloatArray) -> FloatArray:
        stretch = 0.5 * diameter / np.linalg.norm(nodes, axis=1)
        return np.where(np.abs(stretch - 1.0) < _NEAR, stretch, 1.0)[:, None] * nodes

    return UnitCell(refined(cell.mesh, onto, 1e-7 * shortest), cell.lattice)


def _shape_functions(places: FloatArray) -> FloatArray:
    """(k, 6) of the T6 at reference coordinates (k, 2)."""
    x, y = places.T
    z = 1.0 - x - y
    corners = [z * (2 * z - 1), x * (2 * x - 1), y * (2 * y - 1)]
    return np.stack([*corners, 4 * x * z, 4 * x * y, 4 * y * z], axis=1)
