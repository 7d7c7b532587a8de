"""From a periodic field to a truncated Fourier mode family, without a look at the spectrum.

What the paper does by eye in its Section "Parametrization and Initial Guess of the Patterning
Modes": find the peaks, take the waves that matter (``selection``), see what they have in common
(``constraints``), and say it in words. For the (π, π) mode of a square lattice this is Eq. (mode)
with its seven parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.idic.families.constraints import (
    SAME_AMPLITUDE,
    SAME_PHASE,
    RealWave,
    Tie,
    as_rows,
    find_ties,
    real_waves,
    tied_family,
)
from modeharvest.idic.families.equivalents import mode_equivalent
from modeharvest.idic.families.lattice_spectrum import lattice_spectrum
from modeharvest.idic.families.overlap import best_amplitude, wave_values
from modeharvest.idic.families.quadrature import Quadrature, points_for
from modeharvest.idic.families.selection import GROWTH, select_waves
from modeharvest.idic.families.words import describe
from modeharvest.idic.fourier import ModeFamily, free_family, square_family

FloatArray = NDArray[np.float64]

NEAR_DIAGONAL = 0.1
"""Difference of a wave vector's components from ±1 [π/l] up to which it is called diagonal: the
next reciprocal vectors of even a 10 x 10 cell are 0.2 away."""


@dataclass(frozen=True, eq=False)
class FoundFamily:
    """A mode family, where it came from, and how much of the field it is.

    The field is about ``amplitude`` times the sum of the family's waves at its start.

    Parameters
    ----------
    family
        The family; its start is the field.
    pitch
        l [mm], the half-wavelength of :class:`modeharvest.idic.fourier.FourierMode`.
    amplitude
        [unit of the field], with sign.
    captured
        Share of ∫ |u|² over the material, translation apart, that ``amplitude`` and the start
        describe [-].
    growth
        (number of waves, share captured by as many, nothing tied); goes on beyond those taken.
    sentences
        What was found, in words.
    info
        Plain JSON values of the caller: lattice, material, loading, critical strain.
    """

    family: ModeFamily
    pitch: float
    amplitude: float
    captured: float
    growth: tuple[tuple[int, float], ...]
    sentences: tuple[str, ...]
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (0 < self.pitch < np.inf and np.isfinite([self.amplitude, self.captured]).all()):
            raise InputError(
                f"mode family {self.family.name!r}: expected a positive pitch and finite numbers, "
                f"got {self.pitch} mm, amplitude {self.amplitude}, captured {self.captured}"
            )

    @property
    def waves(self) -> FloatArray:
        """(w, 5) A, B, kx, ky [-] and c [mm] of the waves at the start."""
        return self.family.waves(self.family.start)


def mode_family(
    mesh: Mesh,
    lattice: ArrayLike,
    values: ArrayLike,
    pitch: float,
    *,
    shared: bool = True,
    growth: float = GROWTH,
    info: Mapping[str, Any] | None = None,
) -> FoundFamily:
    """Find the truncated Fourier series of a periodic field, and make it a family.

    Parameters
    ----------
    mesh
        One cell of the lattice [mm].
    lattice
        (2, 2) its lattice vectors as rows [mm].
    values
        (n, 2) field at the nodes, periodic, affine part removed [any unit].
    pitch
        l [mm].
    shared
        Look for constraints; otherwise every wave has five parameters of its own (but one).
    growth
        Least share of the energy that a further star of waves must add [-]; larger for fewer waves.
    info
        To keep with the family.

    Raises
    ------
    InputError
        As :func:`modeharvest.idic.families.lattice_spectrum.lattice_spectrum`.
    """
    spectrum = lattice_spectrum(mesh, lattice, values, pitch)
    rule = Quadrature(mesh, points_for(mesh, 6.0 * np.pi / pitch))
    u = rule.without_mean(rule.values(values))
    selection = select_waves(spectrum, rule, u, growth)
    waves = real_waves(selection)
    ties = find_ties(waves)
    family = _family(waves, ties, pitch, shared)
    phi = wave_values(rule, family.waves(family.start), pitch)
    amplitude, captured = best_amplitude(rule, u, phi)
    sentences = describe(selection, waves, ties if shared else [], family, captured)
    return FoundFamily(
        family, pitch, amplitude, captured, selection.growth, sentences, dict(info or {})
    )


def _family(waves: list[RealWave], ties: list[Tie], pitch: float, shared: bool) -> ModeFamily:
    count = f"{len(waves)} wave" + "s" * (len(waves) > 1)
    rows = as_rows(waves, pitch)
    rows[:, :2] /= np.abs(rows[:, :2]).max()
    if not shared:
        return free_family(rows, f"{count}, free")
    return as_square(rows, pitch) or tied_family(count, waves, ties, pitch)


def as_square(waves: FloatArray, pitch: float) -> ModeFamily | None:
    """The paper's Eq. (mode) with these two waves as its start, if it has them; else None.

    Two waves near the two diagonals, |A| equal, |B| equal, and signs the same in one component
    and opposite in the other. Turned and shifted (:mod:`modeharvest.idic.families.equivalents`) to
    whichever of the paper's starts is nearer: the origin at a junction, or at a hole's centre.

    Parameters
    ----------
    waves
        (w, 5) A, B, kx, ky [-] and c [mm].
    pitch
        l [mm].
    """
    if len(waves) != 2:
        return None
    amplitudes, k, phases = waves[:, :2], waves[:, 2:4], waves[:, 4].copy()
    same = SAME_AMPLITUDE * np.linalg.norm(amplitudes, axis=1).max()
    diagonal = np.all(np.abs(np.abs(k) - 1.0) <= NEAR_DIAGONAL) and k.prod() < 0
    equal = np.all(np.abs(np.diff(np.abs(amplitudes), axis=0)) <= same)
    if not (diagonal and equal and amplitudes.prod() < 0):
        return None
    # Eq. (mode) has B = 1 and −1; a wave with the other sign is moved by half its length.
    turned = np.sign(amplitudes[:, 1]) != (1, -1)
    phases[turned] += pitch
    signs = np.where(turned, -1.0, 1.0)
    ratio = -(signs @ amplitudes[:, 0]) / np.abs(amplitudes[:, 1]).sum()
    return _nearer(np.array([ratio, *k[0], *k[1], *phases]), pitch)


def _nearer(mode: FloatArray, pitch: float) -> ModeFamily:
    """Eq. (mode) with the start that needs the smaller phases."""
    found = []
    for origin in ("junction", "hole"):
        family = square_family(origin)
        start, _ = mode_equivalent(mode, pitch, family.start)
        off = float(np.abs(start[5:]).max()) / pitch
        found.append((round(off, 9), origin, family, start))
    off, origin, family, start = min(found, key=lambda f: f[0])
    name = family.name if off <= SAME_PHASE else "square"
    return ModeFamily(name, family.matrix, family.offset, start, family.names, family.units)
