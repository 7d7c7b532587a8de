"""All that the report of an infinite lattice shows, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.dispersion import Dispersion
from modeharvest.fem.field import Mesh
from modeharvest.fem.modes import Branch, BranchState, ModeSet, Wave
from modeharvest.idic.families.automatic import FoundFamily, mode_family
from modeharvest.idic.families.lattice_spectrum import LatticeSpectrum, lattice_spectrum
from modeharvest.validation.lattice.mode_study import ModeStudy
from modeharvest.validation.lattice.plots_branches import combination_name

if TYPE_CHECKING:  # its module needs dolfinx
    from modeharvest.fem.bloch_critical import LatticeCritical

FloatArray = NDArray[np.float64]

SHAPE = 0.16
"""Largest displacement that modes are drawn with [l]."""


@dataclass(frozen=True)
class CriticalPoint:
    """What ``LatticeCritical`` says, in plain values: where a lattice first becomes unstable.

    Parameters
    ----------
    loading
        Its name, e.g. "uniaxial".
    load
        Critical load [-]; without one, the largest at which the lattice was found stable.
    found
        Whether there is a critical point up to there.
    outcome
        In words.
    waves
        Phases (k . a1, k . a2) of the critical waves [rad]; empty for long waves.
    below, above
        Negative eigenvalues at each of them a millionth of the load below and above.
    earlier
        Waves of the grid that are unstable already below.
    value
        Lowest measure filling · λ / k² at ``load`` [MPa].
    angle
        Direction of long waves [rad]; None for others.
    """

    loading: str
    load: float
    found: bool
    outcome: str
    waves: tuple[Wave, ...] = ()
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    earlier: tuple[Wave, ...] = ()
    value: float = 0.0
    angle: float | None = None

    @classmethod
    def of(cls, loading: str, found: LatticeCritical) -> CriticalPoint:
        """Take the plain values of a search's result."""
        least = found.least
        return cls(loading, found.load, found.found, found.outcome, found.waves, found.below,
                   found.above, found.earlier, least.value, least.angle)  # fmt: skip


@dataclass(frozen=True, eq=False)
class FoundPattern:
    """A pattern of a lattice on the cell of its modes, its spectrum and its family.

    Parameters
    ----------
    name
        What it is, e.g. "φ₁ + φ₂ at 8.8 %".
    displacement
        (n, 2) of the nodes of ``ModeSet.mesh`` [mm], affine part included.
    gradient
        (2, 2) F̄ of that [-].
    spectrum, family
        Of the displacement without its affine part.
    stable
        Whether it is an equilibrium that is stable for fields with the period of its cell; None
        for a mode, which is no equilibrium.
    """

    name: str
    displacement: FloatArray
    gradient: FloatArray
    spectrum: LatticeSpectrum
    family: FoundFamily
    stable: bool | None = None

    def fluctuation(self, nodes: FloatArray) -> FloatArray:
        """(n, 2) displacement of these nodes without its affine part [mm]."""
        return np.asarray(self.displacement - nodes @ (self.gradient - np.eye(2)).T)

    @classmethod
    def of_state(
        cls, modes: ModeSet, branch: Branch, pitch: float, state: BranchState | None = None
    ) -> FoundPattern:
        """The pattern of a branch, at its last state unless another is given."""
        state = state or branch.states[-1]
        name = f"{combination_name(branch.combination)} at {100 * state.load:.4g} %"
        stable = state.negative_eigenvalues == 0
        u, F = state.displacement, state.gradient
        return cls(name, u, F, *_analysed(modes, state.fluctuation(modes.mesh), pitch), stable)

    @classmethod
    def of_mode(cls, modes: ModeSet, k: int, pitch: float) -> FoundPattern:
        """Mode k (from 0) of a set, drawn by SHAPE l upon the undeformed lattice."""
        shape = modes.shapes[k]
        u = SHAPE * pitch / float(np.linalg.norm(shape, axis=1).max()) * shape
        name = combination_name([float(j == k) for j in range(len(modes.waves))])
        return cls(f"mode {name}", u, np.eye(2), *_analysed(modes, u, pitch))


def _analysed(
    modes: ModeSet, field: FloatArray, pitch: float
) -> tuple[LatticeSpectrum, FoundFamily]:
    spectrum = lattice_spectrum(modes.mesh, modes.lattice, field, pitch)
    return spectrum, mode_family(modes.mesh, modes.lattice, field, pitch)


@dataclass(frozen=True, eq=False)
class LatticeRun:
    """All that the report of a lattice shows; what is None or empty is left out.

    Parameters
    ----------
    title
        Of the page.
    case
        What was run, as plain values.
    command
        That makes this page again.
    mesh, lattice
        Primitive cell [mm], and its (2, 2) lattice vectors as rows [mm].
    pitch
        Unit cell size l [mm].
    critical
        First critical points, one for each loading.
    dispersion
        Lowest eigenvalues along a path and over the zone.
    modes, branches
        At the critical point, and what leaves there.
    patterns
        On the cell of ``modes``; the first is shown at the top.
    study
        How the pattern depends on d/l and more.
    exports
        Files beside the page, and what each holds.
    notes
        What a reader should know before trusting the numbers.
    versions
        Of software.
    """

    title: str
    case: Mapping[str, Any]
    command: str
    mesh: Mesh
    lattice: FloatArray
    pitch: float
    critical: Sequence[CriticalPoint] = ()
    dispersion: Dispersion | None = None
    modes: ModeSet | None = None
    branches: Sequence[Branch] = ()
    patterns: Sequence[FoundPattern] = ()
    study: ModeStudy | None = None
    exports: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.patterns and self.modes is None:
            raise InputError("lattice report: expected the modes of the patterns, got none")
