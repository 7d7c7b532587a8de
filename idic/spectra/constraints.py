"""Constraints between the waves of a field: equal amplitudes and phases as one parameter.

Plane waves with complex amplitudes become real ones, A and B sin(π/l (kx x + ky y + c)), and
amplitudes that symmetry makes equal become one parameter. A symmetry that turns one wave vector
into another turns the motion with it, so amplitudes are compared in each wave's own frame: L along
its wave vector and T across, (A, B) = L n + T m with n = k/|k| and m = n turned by +90 degrees.

* L and T with a common phase: one wave. Otherwise two waves with the same wave vector, one of L
  and one of T, each with a phase of its own.
* |L|, and |T|, equal within a star of waves: one parameter, the signs fixed.
* L or T zero: fixed at zero.
* The overall amplitude is fixed, since v_i carries it.

Wave vectors and phases are free: they compensate differences between a specimen and its drawing
(the paper's a₂ ... a₇). The frames remain those of the wave vectors found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeharvest.idic.modes import PER_WAVE, ModeFamily, local_frame
from modeharvest.idic.spectra.pattern import SAME_PHASE
from modeharvest.idic.spectra.waves import Selection, common_phase, grouped
from modeharvest.util.arrays import FloatArray

SAME_AMPLITUDE = 0.02
"""Difference of two amplitudes that are called equal, or from zero, over the star's strongest: the
smallest that a correlation would notice; an asymmetric mesh makes less (a test)."""
IN_PHASE = 0.02
"""Share of a wave that may be out of phase between x and y. A real mode at a wave vector on the
zone's boundary is in phase to rounding where the cell has an inversion centre."""
POLARISED = 0.1
"""Sine of the angle up to which a wave is called transverse or longitudinal."""
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


@dataclass(frozen=True)
class RealWave:
    """A wave (L n + T m) sin(π/l (k·x + c)) of the field."""

    k: tuple[float, float]
    """Wave vector [π/l]."""
    amplitude: tuple[float, float]
    """(L, T) along n = k/|k| and along m = n turned by +90 degrees, signed [unit of the field]."""
    phase: float
    """c [l], above −1/2 and up to 1/2; the rest is in the signs."""
    star: int
    """Number of the star of waves that it belongs to."""
    shares_k: bool = False
    """Whether it has the wave vector of the wave before: two such waves are out of phase."""

    @property
    def frame(self) -> FloatArray:
        """(2, 2) n and m as rows."""
        return local_frame(np.array(self.k))

    @property
    def strength(self) -> float:
        """Length of the amplitude [unit of the field]."""
        return float(np.hypot(*self.amplitude))

    @property
    def row(self) -> FloatArray:
        """(5,) A, B [unit of the field], kx, ky [-] and c [l]."""
        return np.array([*(np.array(self.amplitude) @ self.frame), *self.k, self.phase])

    @property
    def polarisation(self) -> str:
        """Direction of motion relative to the wave vector: transverse, longitudinal, or mixed."""
        along, across = np.abs(self.amplitude) / self.strength
        if along <= POLARISED:
            return "transverse"
        return "longitudinal" if across <= POLARISED else "mixed"


@dataclass(frozen=True)
class Tie:
    """Amplitudes of one component that share one parameter, or are fixed."""

    component: int
    """0 for L, along the wave vector, 1 for T, across."""
    waves: tuple[int, ...]
    """Numbers of the waves, from 0."""
    value: float
    """Their common magnitude [unit of the field]; 0: they are fixed at zero."""

    @property
    def name(self) -> str:
        """Name of the parameter, such as "T1" or "T1,2"."""
        return "LT"[self.component] + ",".join(str(w + 1) for w in self.waves)


def real_waves(selection: Selection) -> list[RealWave]:
    """Turn complex amplitudes into real waves, one or two for each."""
    waves: list[RealWave] = []
    for xi, cartesian, star in zip(selection.xi, selection.amplitudes, selection.star, strict=True):
        z = local_frame(xi) @ cartesian
        angle, amplitude, out_of_phase = common_phase(z)
        if out_of_phase <= IN_PHASE:
            waves.append(_real_wave(xi, amplitude, angle, star))
            continue
        for component in (0, 1):
            alone = np.where(np.arange(2) == component, np.abs(z), 0.0)
            angle = float(np.angle(z[component]))
            waves.append(_real_wave(xi, alone, angle, star, component == 1))
    return waves


def _real_wave(
    xi: FloatArray, amplitude: FloatArray, angle: float, star: int, shares_k: bool = False
) -> RealWave:
    """Move the phase to between −1/2 and 1/2 l; 0 and 1/2 stay themselves in spite of rounding."""
    phase = round(angle / np.pi, 12)
    turns = np.ceil(phase - 0.5 - 1e-9)
    along, across = amplitude * (-1.0) ** turns
    k = (2.0 * float(xi[0]), 2.0 * float(xi[1]))
    return RealWave(k, (float(along), float(across)), float(phase - turns) + 0.0, star, shares_k)


def find_ties(waves: list[RealWave]) -> list[Tie]:
    """Find amplitudes that are equal within a star, or zero: T before L, strongest star first."""
    ties = []
    for star in dict.fromkeys(w.star for w in waves):
        members = [k for k, w in enumerate(waves) if w.star == star]
        tolerance = SAME_AMPLITUDE * max(waves[k].strength for k in members)
        for component in (1, 0):
            sizes = {k: abs(waves[k].amplitude[component]) for k in members}
            ties += _clustered(component, sizes, tolerance)
    return ties


def _clustered(component: int, sizes: dict[int, float], tolerance: float) -> list[Tie]:
    zero = tuple(k for k, size in sizes.items() if size <= tolerance)
    ties = [Tie(component, zero, 0.0)] if zero else []
    rest = [k for k, size in sizes.items() if size > tolerance]
    for same in grouped(rest, lambda one, other: abs(sizes[other] - sizes[one]) <= tolerance):
        ties.append(Tie(component, tuple(same), float(np.mean([sizes[k] for k in same]))))
    return ties


def fixed_tie(ties: list[Tie]) -> Tie:
    """The amplitudes that are fixed at ±1: the largest ones."""
    return max(ties, key=lambda tie: tie.value)


def tied_family(waves: list[RealWave], ties: list[Tie], pitch: float) -> ModeFamily:
    """Make the family: amplitudes first, then wave vectors, then phases; ``pitch`` is l [mm]."""
    unit, fixed = np.eye(PER_WAVE * len(waves)), fixed_tie(ties)
    free = [tie for tie in ties if tie is not fixed and tie.value > 0]
    parameters = [
        (_amplitude_column(tie, waves), tie.value / fixed.value, tie.name, "-") for tie in free
    ]
    for w, wave in enumerate(waves):
        if not wave.shares_k:
            stop = w + 1 + sum(other.shares_k for other in waves[w + 1 : w + 2])
            for axis in (0, 1):
                column = unit[PER_WAVE * np.arange(w, stop) + 2 + axis].sum(axis=0)
                parameters.append((column, wave.k[axis], f"k{'xy'[axis]}{w + 1}", "-"))
    for w, wave in enumerate(waves):
        parameters.append((unit[PER_WAVE * w + 4], wave.phase * pitch, f"c{w + 1}", "mm"))
    columns, start, names, units = zip(*parameters, strict=True)
    name, offset = f"{len(waves)} wave{'s' * (len(waves) != 1)}", _amplitude_column(fixed, waves)
    return ModeFamily(name, np.stack(columns, axis=1), offset, np.array(start), names, units)


def _amplitude_column(tie: Tie, waves: list[RealWave]) -> FloatArray:
    """(5 w,) A and B of each wave for a unit of the tied amplitude, signs included."""
    column = np.zeros((len(waves), PER_WAVE))
    for w in tie.waves:
        sign = np.sign(waves[w].amplitude[tie.component])
        column[w, :2] = sign * waves[w].frame[tie.component]
    return column.ravel()


def describe(
    selection: Selection,
    waves: list[RealWave],
    ties: list[Tie],
    family: ModeFamily,
    captured: float,
) -> tuple[str, ...]:
    """Describe the waves, what they have in common, and their share of the field, in words."""
    energy = f"At the start they are {100 * captured:.1f} % of the energy over the material; "
    if selection.growth[-1][0] == len(selection.xi):
        energy += "no further wave could be distinguished from them."
    else:
        energy += f"the next would add {100 * selection.next_gain:.1f} %."
    of_waves = (_stars(waves), energy, *_phases(waves))
    return (*of_waves, *_amplitudes(waves, ties), _family(family, ties))


def number(count: int, noun: str) -> str:
    """Write a count and a noun, such as "two waves"."""
    word = _NUMBERS[count] if count < len(_NUMBERS) else str(count)
    return f"{word} {noun}{'s' * (count != 1)}"


def _stars(waves: list[RealWave]) -> str:
    parts = []
    for star in dict.fromkeys(w.star for w in waves):
        members = [w for w in waves if w.star == star]
        vectors = [f"[{w.k[0]:+.3g}, {w.k[1]:+.3g}]" for w in members if not w.shares_k]
        kinds = sorted({w.polarisation for w in members})
        kind = f", {kinds[0]}" if len(kinds) == 1 and kinds[0] != "mixed" else ""
        parts.append(f"{' and '.join(vectors)} π/l{kind}")
    total = sum(not w.shares_k for w in waves)
    return f"{number(total, 'wave').capitalize()}: {'; then '.join(parts)}."


def _phases(waves: list[RealWave]) -> list[str]:
    pairs, text = sum(w.shares_k for w in waves), []
    if pairs:
        text.append(
            f"In {number(pairs, 'wave')} x and y are out of phase; each of these is written "
            "as a wave along x and a wave along y with the same wave vector."
        )
    phases = np.array([w.phase for w in waves])
    if np.all(np.abs(phases) <= SAME_PHASE):
        text.append("All phases are 0 at the origin: a half turn about it keeps the field.")
    elif np.all(np.abs(phases - 0.5) <= SAME_PHASE):
        text.append("All phases are l/2 at the origin: a half turn about it reverses the field.")
    else:
        text.append("Phases: " + ", ".join(f"{p:+.2f}" for p in phases) + " l.")
    return text


def _amplitudes(waves: list[RealWave], ties: list[Tie]) -> list[str]:
    text = []
    for tie in ties:
        if len(tie.waves) > 1 and tie.value > 0:
            where = ("along", "across")[tie.component]
            values = np.array([waves[w].amplitude[tie.component] for w in tie.waves])
            signs = " ".join("+" if value > 0 else "−" for value in values * values[0])
            text.append(
                f"The amplitude {where} the wave vector is the same in waves "
                f"{', '.join(str(w + 1) for w in tie.waves)} within {100 * SAME_AMPLITUDE:.0f} %, "
                f"signs {signs}."
            )
    split = {w for w, wave in enumerate(waves) if wave.shares_k}
    split |= {w - 1 for w in split}
    zero = [tie.name for tie in ties if tie.value == 0 and not split & set(tie.waves)]
    if zero:
        text.append(f"Zero within {100 * SAME_AMPLITUDE:.0f} %: {', '.join(zero)}.")
    return text


def _family(family: ModeFamily, ties: list[Tie]) -> str:
    free = [name for name in family.names if name[0] not in "kc"]
    if family.name.startswith("square"):
        start = ", ".join(f"{value:.3g}" for value in np.round(family.start, 3) + 0.0)
        return (
            f"This is Eq. (6) of the paper ({family.name}): {number(family.size, 'parameter')}, "
            f"start [{start}]."
        )
    names = f" ({', '.join(free)})" if free else ""
    fixed = f"; {fixed_tie(ties).name} is fixed, since v carries the amplitude" if ties else ""
    return (
        f"{number(family.size, 'parameter').capitalize()}: all wave vectors and phases, and "
        f"{number(len(free), 'amplitude')}{names}{fixed}."
    )
