"""Refined unit cells: each triangle is divided into four, and holes stay round.

Nested meshes give a rate of convergence that a mesher doesn't affect; used by bloch_scan.py.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.bloch.mesh_error import refined
from modeharvest.fem.field import boundary_sides
from modeharvest.fem.lattice.cells import UnitCell

_NEAR = 0.02  # fraction of the radius within which boundary nodes belong to the hole


def refined_cell(cell: UnitCell, diameter: float) -> UnitCell:
    """Refine a unit cell whose circular hole of ``diameter`` [mm] is at the origin."""
    mesh = refined(cell.mesh, 1e-7 * float(np.linalg.norm(cell.lattice, axis=1).min()))
    boundary = np.unique(boundary_sides(mesh))
    stretch = 0.5 * diameter / np.linalg.norm(mesh.nodes[boundary], axis=1)
    factor = np.where(np.abs(stretch - 1.0) < _NEAR, stretch, 1.0)
    mesh.nodes[boundary] *= factor[:, None]
    return UnitCell(mesh, cell.lattice)
