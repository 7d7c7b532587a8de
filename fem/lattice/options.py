"""Options of a lattice's analysis: macroscopic loading, search for the critical point, waves.

Plain dataclasses, checked when they are built; neither dolfinx nor gmsh is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.fem.experiment import SMALLEST_STEP
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within


@dataclass(frozen=True)
class CriticalSearch:
    """Options of the search for the first critical point; loads [-]."""

    largest: float = 0.3
    """Load up to which to search [-]."""
    divisions: int = 8
    """Divisions of the zone along each axis; even numbers have the points M and X on the grid."""
    largest_step: float = 0.02
    """Largest step of the load [-]."""
    waves: tuple[tuple[float, ...], ...] = ()
    """Phases [π rad] of the only waves to consider, such as [[1, 1]]; empty: all waves."""
    refine: bool = True
    """Whether to estimate the critical load's error, on the mesh refined once."""

    def __post_init__(self) -> None:
        _ = self.phases
        require_within("search: expected a largest load", self.largest, 0.0, above=True)
        require_within("search: expected divisions", self.divisions, 2, 200)
        require_within("search: expected a largest_step", self.largest_step, SMALLEST_STEP)

    @property
    def phases(self) -> tuple[Wave, ...]:
        """The waves' phases [rad]."""
        return tuple(phases_in_rad(wave) for wave in self.waves)


Wave = tuple[float, float]
"""Phases (k . a1, k . a2) of a Bloch wave from cell to cell [rad]."""
CENTRE: Wave = (0.0, 0.0)
"""The point Γ: modes with the period of the cell."""


def wave_of(given: Any) -> Wave:
    """A wave vector as two finite phases [rad]; InputError for anything else."""
    try:
        phases = np.asarray(given)
    except ValueError:  # rows of different lengths
        phases = np.empty(0)
    if phases.shape != (2,) or phases.dtype.kind not in "iuf" or not np.isfinite(phases).all():
        raise InputError(
            "wave vector: expected its phases (k . a1, k . a2) as two finite real numbers, in the "
            f"lattice's plane, got {given}"
        )
    return float(phases[0]), float(phases[1])


def phases_in_rad(wave: Sequence[float]) -> Wave:
    """Convert phases in units of π to rad; InputError unless there are two."""
    p, q = wave_of(wave)
    return math.pi * p, math.pi * q


def lattice_vectors(given: ArrayLike, what: str) -> FloatArray:
    """Two lattice vectors as rows (2, 2) [mm]; InputError, naming ``what``, for other values."""
    try:
        vectors = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):  # text, or rows of different lengths
        vectors = np.empty(0)
    if vectors.shape == (2, 2):
        lengths = np.linalg.norm(vectors, axis=1)
        if 1e-6 * np.prod(lengths) < abs(np.linalg.det(vectors)) < np.inf:
            return vectors
    got = np.asarray(given, dtype=object).tolist()
    raise InputError(
        f"{what}: expected two lattice vectors of two numbers [mm] that are not parallel, as rows, "
        f"got {got}"
    )


Rates = tuple[tuple[float | None, float | None], tuple[float | None, float | None]]


@dataclass(frozen=True)
class MacroLoading:
    """Macroscopic loading: each component of either F̄ or P̄ is proportional to the load e.

    F̄_ij = δ_ij + e · gradient_ij [-] where gradient_ij is given. Where it is None, P̄_ij = e ·
    stress_ij [MPa] (first Piola-Kirchhoff, over the cell including holes; default 0: a free side).
    """

    gradient: Rates
    stress: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    angle: float = 0.0
    """Rotation of the axes of all components, counter-clockwise from x and y [rad]."""

    def __post_init__(self) -> None:
        if not all(len(x) == 2 == len(x[0]) == len(x[1]) for x in (self.gradient, self.stress)):
            got = f"{self.gradient} and {self.stress}"
            raise InputError(f"macroscopic loading: expected two rows of two each, got {got}")
        given = [g for row in self.gradient for g in row if g is not None]
        if not np.isfinite([*given, *np.ravel(self.stress), self.angle]).all():
            raise InputError(f"macroscopic loading: expected finite rates, got {self}")
        if self.gradient[0][1] is None and self.gradient[1][0] is None:
            raise InputError(
                "macroscopic loading: expected F̄_12 or F̄_21 to be prescribed (otherwise the "
                "lattice is free to rotate), got neither; set one of them to 0"
            )
        if not any(given) and not np.any(self.dead):
            raise InputError(f"macroscopic loading: expected a rate other than 0, got {self}")

    @property
    def axes(self) -> FloatArray:
        """(4, 4) matrix from components along the rotated axes to those along x and y."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        turn = np.array([[c, -s], [s, c]])
        return np.asarray(np.kron(turn, turn))

    @property
    def free(self) -> NDArray[np.bool_]:
        """(4,) True where P̄ is prescribed instead of F̄ (11, 12, 21, 22 along its axes)."""
        return np.array([g is None for row in self.gradient for g in row])

    @property
    def rate(self) -> FloatArray:
        """(4,) dF̄/de, 0 where not prescribed."""
        return np.array([g or 0.0 for row in self.gradient for g in row])

    @property
    def dead(self) -> FloatArray:
        """(4,) dP̄/de [MPa], 0 where F̄ is prescribed."""
        return np.where(self.free, np.ravel(self.stress), 0.0)


def uniaxial(axis: int = 0, lateral: float | None = None) -> MacroLoading:
    """Compression by e along an axis (0: x, 1: y); lateral sides free, or strained by lateral e."""
    if axis not in (0, 1):
        raise InputError(f"macroscopic loading: expected the axis 0 (x) or 1 (y), got {axis}")
    x, y = (-1.0, lateral) if axis == 0 else (lateral, -1.0)
    return MacroLoading(((x, 0.0), (0.0, y)))


def uniaxial_strain(axis: int = 0) -> MacroLoading:
    """Compression by the nominal strain e along an axis (0: x, 1: y), no lateral strain."""
    return uniaxial(axis, lateral=0.0)


def equibiaxial() -> MacroLoading:
    """Compression by the nominal strain e along both axes."""
    return MacroLoading(((-1.0, 0.0), (0.0, -1.0)))


def simple_shear() -> MacroLoading:
    """F̄ = I + e · (x ⊗ y): planes y = const slide along x."""
    return MacroLoading(((0.0, 1.0), (0.0, 0.0)))
