"""What the analysis of a lattice hands on: its modes and its branches, as plain numpy.

Neither dolfinx nor gmsh is needed to hold, read or use these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh

FloatArray = NDArray[np.float64]
Wave = tuple[float, float]

NORMALISATION = "the mean over the cell's material of phi_i . phi_j is 1 for i = j, otherwise 0"


@dataclass(frozen=True, eq=False)
class ModeSet:
    """Real modes of a lattice on its smallest cell that has their period.

    Parameters
    ----------
    mesh
        T6 mesh of the commensurate cell, undeformed [mm].
    lattice, primitive
        (2, 2) lattice vectors of that cell and of the primitive one, as rows [mm].
    waves
        (m,) phases (k . a1, k . a2) of each mode from primitive cell to primitive cell [rad].
    eigenvalues
        (m,) of K x = lambda M x, M of unit density [N/mm^4]; near zero at a critical point.
    shapes
        (m, n, 2) nodal modes [-], orthonormal: the mean of phi_i . phi_j over the material is
        delta_ij. The sign is such that the first large component is positive. Waves with phases
        other than 0 and pi have their modes in pairs, which are the real and imaginary part.
    load
        Load parameter of the state whose tangent they belong to [-].
    gradient
        (2, 2) F̄ of that state [-].
    info
        Plain JSON values: lattice, material, loading, whether and where it is critical, versions.
    """

    mesh: Mesh
    lattice: FloatArray
    primitive: FloatArray
    waves: tuple[Wave, ...]
    eigenvalues: FloatArray
    shapes: FloatArray
    load: float
    gradient: FloatArray
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.waves)
        expected = {
            "shapes": (count, len(self.mesh.nodes), 2),
            "eigenvalues": (count,),
            "lattice": (2, 2),
            "primitive": (2, 2),
            "gradient": (2, 2),
        }
        for name, shape in expected.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise InputError(
                    f"modes: expected finite {name} of shape {shape}, got {values.shape}"
                )


@dataclass(frozen=True, eq=False)
class BranchState:
    """An equilibrium of the commensurate cell beyond the critical point.

    Parameters
    ----------
    load
        [-].
    gradient, stress
        (2, 2) F̄ [-] and P̄ [MPa].
    energy, primary_energy
        Stored energy per area of the cell, here and on the primary path at the same load [MPa];
        NaN where that path ends before. Under a stress other than 0 the lower energy minus
        P̄ : F̄ is what is preferred.
    negative_eigenvalues
        Of the cell's tangent with F̄'s free components; 0: stable against its own period.
    displacement
        (n, 2) of the mesh's nodes [mm].
    amplitudes
        (m,) mean over the material of (u - affine part - primary fluctuation) . phi_i [mm].
    """

    load: float
    gradient: FloatArray
    stress: FloatArray
    energy: float
    primary_energy: float
    negative_eigenvalues: int
    displacement: FloatArray
    amplitudes: FloatArray

    def fluctuation(self, mesh: Mesh) -> FloatArray:
        """(n, 2) displacement without its affine part (F̄ - I) X [mm]."""
        return np.asarray(self.displacement - mesh.nodes @ (self.gradient - np.eye(2)).T)


@dataclass(frozen=True, eq=False)
class Branch:
    """A buckled branch: which combination of modes it started with, and its states.

    Parameters
    ----------
    combination
        (m,) coefficients of the modes at the start, of unit length [-].
    states
        By load; empty if it could not be followed. A load that the branch meets twice is there
        twice.
    outcome
        In words.
    curve
        (p, 2) amplitude of the combination [mm] and load [-] of the points passed on the way,
        the critical one first.
    """

    combination: tuple[float, ...]
    states: tuple[BranchState, ...]
    outcome: str
    curve: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
