"""What the waves of a field have in common, as a family with few parameters.

Plane waves with complex amplitudes become real ones, A and B sin(π/l (kx x + ky y + c)), and what
symmetry makes equal among them becomes one parameter:

* Components x and y with a common phase: one wave. Otherwise two waves with the same wave vector,
  one along x and one along y, each with a phase of its own.
* |A|, and |B|, equal within a star of waves: one parameter, the signs held.
* An amplitude of zero is held at zero.
* The overall amplitude is held, since v_i carries it.

Wave vectors are free, and so are phases: they make up for a specimen that isn't quite its drawing
(the paper's a₂ ... a₇). A and B have parameters of their own even where they are equal, as in the
paper's Eq. (mode): a load along one axis tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.fourier import PER_WAVE, ModeFamily
from modeharvest.idic.selection import Selection

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SAME_AMPLITUDE = 0.02
"""Difference of two amplitudes that are called equal, or from zero, of the star's strongest: the
smallest that a correlation would notice; a mesh without symmetry makes less (a test)."""
IN_PHASE = 0.02
"""Share of a wave that may be out of phase between x and y. A real mode at a wave vector on the
zone's boundary is in phase to rounding where the cell has an inversion centre."""
SAME_PHASE = 0.01
"""Difference of phases [l] that are called equal: a hundredth of a cell."""
POLARISED = 0.1
"""Sine of the angle up to which a wave is called transverse or longitudinal."""


@dataclass(frozen=True)
class RealWave:
    """A wave A and B sin(π/l (k·x + c)) of the field.

    Parameters
    ----------
    k
        Wave vector [π/l].
    amplitude
        (A, B) with their signs [unit of the field].
    phase
        c [l], above −1/2 and up to 1/2; the rest is in the signs.
    star
        Which star of waves it belongs to.
    shares_k
        Whether its wave vector is that of the wave before: one of two that are out of phase.
    """

    k: tuple[float, float]
    amplitude: tuple[float, float]
    phase: float
    star: int
    shares_k: bool = False

    @property
    def strength(self) -> float:
        """Length of (A, B) [unit of the field]."""
        return float(np.hypot(*self.amplitude))

    @property
    def polarisation(self) -> str:
        """How it moves compared with where it points: transverse, longitudinal, or both."""
        a, b = self.amplitude
        along = (a * self.k[0] + b * self.k[1]) / (self.strength * np.hypot(*self.k))
        across = (a * self.k[1] - b * self.k[0]) / (self.strength * np.hypot(*self.k))
        if abs(along) <= POLARISED:
            return "transverse"
        return "longitudinal" if abs(across) <= POLARISED else "mixed"


@dataclass(frozen=True)
class Tie:
    """Amplitudes of one component that are one parameter, held at zero, or held at the scale.

    Parameters
    ----------
    component
        0 for A (along x), 1 for B (along y).
    waves
        Numbers of the waves, from 0.
    value
        Their common magnitude [unit of the field].
    """

    component: int
    waves: tuple[int, ...]
    value: float

    @property
    def name(self) -> str:
        """Name of the parameter, such as "A1" or "A1,2"."""
        return "AB"[self.component] + ",".join(str(w + 1) for w in self.waves)


def real_waves(selection: Selection) -> list[RealWave]:
    """Turn complex amplitudes into real waves, one each or two."""
    waves: list[RealWave] = []
    for xi, z, star in zip(selection.xi, selection.amplitudes, selection.star, strict=True):
        angle = 0.5 * float(np.angle(np.sum(z**2)))
        turned = z * np.exp(-1j * angle)
        if np.linalg.norm(turned.imag) <= IN_PHASE * np.linalg.norm(turned):
            waves.append(_real_wave(xi, turned.real, angle, star))
            continue
        for axis in (0, 1):
            alone = np.where(np.arange(2) == axis, np.abs(z), 0.0)
            waves.append(_real_wave(xi, alone, float(np.angle(z[axis])), star, axis == 1))
    return waves


def _real_wave(
    xi: FloatArray, amplitude: FloatArray, angle: float, star: int, shares_k: bool = False
) -> RealWave:
    """Move the phase between −1/2 and 1/2 l; what rounding makes of 0 and 1/2 is the same."""
    phase = round(angle / np.pi, 12)
    turns = np.ceil(phase - 0.5 - 1e-9)
    a, b = amplitude * (-1.0) ** turns
    k = (2.0 * float(xi[0]), 2.0 * float(xi[1]))
    return RealWave(k, (float(a), float(b)), float(phase - turns) + 0.0, star, shares_k)


def find_ties(waves: list[RealWave]) -> list[Tie]:
    """Amplitudes that are equal within a star, or zero; A before B, strongest star first."""
    ties = []
    for component in (0, 1):
        for star in dict.fromkeys(w.star for w in waves):
            members = [k for k, w in enumerate(waves) if w.star == star]
            tolerance = SAME_AMPLITUDE * max(waves[k].strength for k in members)
            sizes = {k: abs(waves[k].amplitude[component]) for k in members}
            ties += _clustered(component, sizes, tolerance)
    return ties


def _clustered(component: int, sizes: dict[int, float], tolerance: float) -> list[Tie]:
    ties: list[Tie] = []
    left = dict(sizes)
    while left:
        first = next(iter(left.values()))
        same = [k for k, size in left.items() if abs(size - first) <= tolerance]
        value = float(np.mean([left.pop(k) for k in same]))
        ties.append(Tie(component, tuple(same), 0.0 if value <= tolerance else value))
    return ties


def held_tie(ties: list[Tie]) -> Tie:
    """The amplitudes that are held at ±1: B's first if they are among the larger, else the largest.

    The paper holds B in Eq. (mode). Half the largest is large enough for v_i to carry.
    """
    largest = max(ties, key=lambda tie: tie.value)
    first = next((tie for tie in ties if tie.component == 1 and tie.value > 0), largest)
    return first if first.value >= 0.5 * largest.value else largest


def tied_family(name: str, waves: list[RealWave], ties: list[Tie], pitch: float) -> ModeFamily:
    """Make the family: amplitudes first, then wave vectors, then phases.

    Parameters
    ----------
    name
        What to call it.
    waves
        Of the field, two or more of a star tied.
    ties
        From :func:`find_ties`.
    pitch
        l [mm].
    """
    held = held_tie(ties)
    unit = np.copysign(held.value, waves[held.waves[0]].amplitude[held.component])
    columns, start, names, units = [], [], [], []
    offset = np.zeros(PER_WAVE * len(waves))

    def add(rows: dict[int, float], value: float, called: str, unit_of_it: str = "-") -> None:
        column = np.zeros(len(offset))
        column[list(rows)] = list(rows.values())
        columns.append(column)
        start.append(value)
        names.append(called)
        units.append(unit_of_it)

    for tie in ties:
        signs = [np.sign(waves[w].amplitude[tie.component] / unit) for w in tie.waves]
        rows = {
            PER_WAVE * w + tie.component: float(sign / signs[0])
            for w, sign in zip(tie.waves, signs, strict=True)
            if tie.value > 0
        }
        if tie is held:
            offset[list(rows)] = list(rows.values())
        elif tie.value > 0:
            add(rows, float(signs[0] * tie.value / abs(unit)), tie.name)
    for first, both in _by_wave_vector(waves):
        for axis in (0, 1):
            rows = {PER_WAVE * w + 2 + axis: 1.0 for w in both}
            add(rows, waves[first].k[axis], f"k{'xy'[axis]}{first + 1}")
    for w, wave in enumerate(waves):
        add({PER_WAVE * w + 4: 1.0}, wave.phase * pitch, f"c{w + 1}", "mm")
    matrix = np.stack(columns, axis=1)
    return ModeFamily(name, matrix, offset, np.array(start), tuple(names), tuple(units))


def _by_wave_vector(waves: list[RealWave]) -> list[tuple[int, list[int]]]:
    """Waves that share one wave vector, named by the first of them."""
    groups: list[tuple[int, list[int]]] = []
    for w, wave in enumerate(waves):
        if wave.shares_k:
            groups[-1][1].append(w)
        else:
            groups.append((w, [w]))
    return groups


def as_rows(waves: list[RealWave], pitch: float) -> FloatArray:
    """(w, 5) A, B [unit of the field], kx, ky [-], c [mm], nothing tied."""
    return np.array([[*w.amplitude, *w.k, w.phase * pitch] for w in waves])
