"""From a periodic field to a truncated Fourier mode family, without a look at the spectrum.

What the paper does by eye in its Section "Parametrization and Initial Guess of the Patterning
Modes": find the peaks, take the waves that matter (:mod:`modeharvest.idic.selection`), see what
they have in common (:mod:`modeharvest.idic.constraints`), and say it in words. For the (π, π) mode
of a square lattice this is Eq. (mode) with its seven parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.idic.constraints import (
    SAME_PHASE,
    RealWave,
    Tie,
    as_rows,
    find_ties,
    real_waves,
    tied_family,
)
from modeharvest.idic.equivalents import mode_equivalent
from modeharvest.idic.family_words import describe
from modeharvest.idic.fourier import ModeFamily, free_family, square_family
from modeharvest.idic.lattice_spectrum import lattice_spectrum
from modeharvest.idic.overlap import best_amplitude, wave_values
from modeharvest.idic.quadrature import Quadrature, points_for
from modeharvest.idic.selection import GROWTH, select_waves

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
        As :func:`modeharvest.idic.lattice_spectrum.lattice_spectrum`.
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
    if not shared:
        rows = as_rows(waves, pitch)
        rows[:, :2] /= np.abs(rows[:, :2]).max()
        return free_family(rows, f"{count}, free")
    tied = tied_family(count, waves, ties, pitch)
    return as_square(tied, pitch) or tied


def as_square(family: ModeFamily, pitch: float) -> ModeFamily | None:
    """The same field as the paper's Eq. (mode), if two waves of a family are that; else None.

    Two waves near the two diagonals, |A| equal, |B| equal, and the product of the signs of A and
    of B opposite. Turned and shifted (:mod:`modeharvest.idic.equivalents`) to whichever of the two
    starts is nearer: the origin at a junction, or at a hole's centre.
    """
    waves = family.waves(family.start)
    if len(waves) != 2 or family.size != 7 or np.any(waves[:, :2] == 0):
        return None
    k = waves[:, 2:4]
    diagonal = np.all(np.abs(np.abs(k) - 1.0) <= NEAR_DIAGONAL) and np.prod(np.sign(k)) < 0
    (a1, b1), (a2, b2) = waves[:, :2]
    if not diagonal or a1 * a2 * b1 * b2 > 0:
        return None
    phases = waves[:, 4].copy()
    # Eq. (mode) has B = 1 and −1; a wave with the other sign is moved by half its length.
    turn = np.sign([b1, b2]) != (1, -1)
    phases[turn] += pitch
    ratio = -(a1 if not turn[0] else -a1) / abs(b1)
    mode = np.array([ratio, *k[0], *k[1], *phases])
    return _nearer(mode, pitch)


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
