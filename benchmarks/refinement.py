"""Refined unit cells: each triangle divided into four while holes stay round.

Nested meshes show a rate of convergence undisturbed by a mesher's choices.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.bloch.mesh_error import refined
from modeharvest.fem.field import boundary_sides
from modeharvest.fem.lattice.cells import UnitCell

_NEAR = 0.02  # of the radius: what of the boundary belongs to a hole


def refined_cell(cell: UnitCell, diameter: float) -> UnitCell:
    """A unit cell refined, with its circular hole about the origin [mm]."""
    mesh = refined(cell.mesh, 1e-7 * float(np.linalg.norm(cell.lattice, axis=1).min()))
    boundary = np.unique(boundary_sides(mesh))
    stretch = 0.5 * diameter / np.linalg.norm(mesh.nodes[boundary], axis=1)
    factor = np.where(np.abs(stretch - 1.0) < _NEAR, stretch, 1.0)
    mesh.nodes[boundary] *= factor[:, None]
    return UnitCell(mesh, cell.lattice)
