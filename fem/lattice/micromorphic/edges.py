"""Extents of a homogenized specimen's lattice that make up for the energy of its edges.

Beside plates and free sides, with the solid strips there, w isn't periodic, and homogenization is
off by an energy for each row or column of cells that ends there. Such an excess is a matter of
material and cell alone, and is an extent: as at Gibbs' dividing surfaces (Trans. Connecticut Acad.
3 (1878) 343), the lattice ends where its energy is right. It is found, at rest, on one cell between
plates, whose sides stay straight, and on one between free sides. Homogenized, the former is springs
in series, the latter parallel ones, so that neither is solved for.
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
    """By how much a lattice is longer at each plate and higher at each side [mm].

    0 where no such extent is known: in other than square stacking, under shear or lateral strain,
    at sides that aren't free. ``mesh_size``: of the elements of the RVE and of both cells [mm].
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
    """On each plate of a specimen at rest, per unit of nominal strain [N/mm]."""
    mesh, (a, b) = mesh_specimen(specimen, mesh_size), specimen.half_size
    x, y = mesh.nodes.T
    at_plates, at_sides = np.isclose(np.abs(x), a), np.isclose(np.abs(y), b)
    fixed = at_plates & (plates == "clamped") | at_sides & (sides == "guided")
    fixed[np.argmin(np.hypot(x + a, y))] = True  # on a mirror line: u_y = 0 in any case
    free = np.flatnonzero(~np.stack([at_plates, fixed], axis=1))
    u = np.stack([np.where(at_plates, -0.5 * specimen.length * np.sign(x), 0.0), 0.0 * y], axis=1)
    K, u = FreeBody(mesh, material).stiffness(0.0 * u), u.ravel()
    u[free] = -factorise(K[free][:, free].sorted_indices()).solve((K @ u)[free])
    return float(u @ (K @ u)) / specimen.length
