"""Extents of a homogenized specimen's lattice that compensate the energy of its edges.

Next to plates and free sides, with their solid strips, w isn't periodic, and the energy of the
homogenized body has an error for each row or column of cells that ends there. This error depends
on material and cell only and is expressed as an extent: as with Gibbs' dividing surfaces (Trans.
Connecticut Acad. 3 (1878) 343), the lattice ends where its energy is right. Extents are computed
at rest, on one cell between plates with straight sides, and on one between free sides. Homogenized,
the former is springs in series, the latter springs in parallel: neither has to be solved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeharvest.fem.hyperelastic import FreeBody
from modeharvest.fem.lattice.cells import square
from modeharvest.fem.lattice.micromorphic.body import PlateMotion
from modeharvest.fem.lattice.micromorphic.rve import RVE
from modeharvest.fem.materials import Material, stress_and_tangent
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.sparse_factor import factorise
from modeharvest.fem.specimen import Specimen


def edge_shifts(
    specimen: Specimen, material: Material, mesh_size: float, loading: PlateMotion
) -> tuple[float, float]:
    """Extensions of a lattice at each plate, along x, and at each side, along y [mm].

    0 if unknown: for other than square stacking, under shear or lateral strain, at sides that
    aren't free. ``mesh_size``: edge length of the elements of the RVE and of both cells [mm].
    """
    if specimen.stacking != "square" or loading.shear or loading.lateral:
        return 0.0, 0.0
    one, pitch = replace(specimen, holes_x=1, holes_y=1), specimen.pitch
    lattice = RVE(square(pitch, specimen.diameter, mesh_size), material)
    solid = stress_and_tangent(material, np.eye(2)[None])[1].reshape(4, 4)
    both = lattice.equilibrium(lattice.at_rest).moduli, solid
    between = _plate_force(replace(one, bulk_y=0.0), material, mesh_size, loading.plates, "guided")
    C, C_solid = (A[0, 0] for A in both)
    longer, higher = C * (pitch**2 / between - 2.0 * one.bulk_x / C_solid) - pitch, 0.0
    if loading.sides == "free":
        beside = _plate_force(replace(one, bulk_x=0.0), material, mesh_size, "sliding", "free")
        E, E_solid = (A[0, 0] - A[0, 3] * A[3, 0] / A[3, 3] for A in both)
        higher = (beside - 2.0 * one.bulk_y * E_solid) / E - pitch
    return 0.5 * float(longer), 0.5 * float(higher)


def _plate_force(
    specimen: Specimen, material: Material, mesh_size: float, plates: str, sides: str
) -> float:
    """Force on each plate of a specimen at rest, per unit of nominal strain [N/mm]."""
    mesh, (a, b) = mesh_specimen(specimen, mesh_size), specimen.half_size
    x, y = mesh.nodes.T
    at_plates, at_sides = np.isclose(np.abs(x), a), np.isclose(np.abs(y), b)
    fixed = at_plates & (plates == "clamped") | at_sides & (sides == "guided")
    fixed[np.argmin(np.hypot(x + a, y))] = True  # on a mirror line, where u_y = 0 anyway
    free = np.flatnonzero(~np.stack([at_plates, fixed], axis=1))
    u = np.stack([np.where(at_plates, -0.5 * specimen.length * np.sign(x), 0.0), 0.0 * y], axis=1)
    K, u = FreeBody(mesh, material).stiffness(0.0 * u), u.ravel()
    u[free] = -factorise(K[free][:, free].sorted_indices()).solve((K @ u)[free])
    return float(u @ (K @ u)) / specimen.length
