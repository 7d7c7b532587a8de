"""What an automatically found mode family is, in sentences for a report."""

from __future__ import annotations

import numpy as np

from modeharvest.idic.families.constraints import (
    SAME_AMPLITUDE,
    SAME_PHASE,
    RealWave,
    Tie,
    held_tie,
)
from modeharvest.idic.families.selection import Selection
from modeharvest.idic.fourier import ModeFamily

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_ACROSS = ("along", "across")


def describe(
    selection: Selection,
    waves: list[RealWave],
    ties: list[Tie],
    family: ModeFamily,
    captured: float,
) -> tuple[str, ...]:
    """Which waves, what they have in common, and how much of the field they are."""
    said = [_stars(waves), _energy(selection, captured)]
    said += _phases(waves)
    said += [*_amplitudes(waves, ties), _family(family, ties)]
    return tuple(said)


def number(count: int, noun: str) -> str:
    """Such as "two waves"."""
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


def _energy(selection: Selection, captured: float) -> str:
    text = f"At the start they are {100 * captured:.1f} % of the energy over the material"
    if selection.growth[-1][0] == len(selection.xi):
        return text + "; no further wave could be told apart from them."
    return text + f"; the next would add {100 * selection.next_gain:.1f} %."


def _phases(waves: list[RealWave]) -> list[str]:
    pairs = [w for w in waves if w.shares_k]
    said = []
    if pairs:
        said.append(
            f"In {number(len(pairs), 'wave')} x and y are out of phase; each of these is written "
            "as a wave along x and a wave along y with the same wave vector."
        )
    phases = np.array([w.phase for w in waves])
    if np.all(np.abs(phases) <= SAME_PHASE):
        said.append("All phases are 0 at the origin: a half turn about it keeps the field.")
    elif np.all(np.abs(phases - 0.5) <= SAME_PHASE):
        said.append("All phases are l/2 at the origin: a half turn about it reverses the field.")
    else:
        said.append("Phases: " + ", ".join(f"{p:+.2f}" for p in phases) + " l.")
    return said


def _amplitudes(waves: list[RealWave], ties: list[Tie]) -> list[str]:
    said = []
    for tie in ties:
        if len(tie.waves) > 1 and tie.value > 0:
            said.append(
                f"The amplitude {_ACROSS[tie.component]} the wave vector is the same in waves "
                f"{', '.join(str(w + 1) for w in tie.waves)} within {100 * SAME_AMPLITUDE:.0f} %, "
                f"signs {_signs(tie, waves)}."
            )
    split = {w for w, wave in enumerate(waves) if wave.shares_k}
    split |= {w - 1 for w in split}
    zero = [tie.name for tie in ties if tie.value == 0 and not split & set(tie.waves)]
    if zero:
        said.append(f"Zero within {100 * SAME_AMPLITUDE:.0f} %: {', '.join(zero)}.")
    return said


def _signs(tie: Tie, waves: list[RealWave]) -> str:
    """Relative to the first."""
    values = np.array([waves[w].amplitude[tie.component] for w in tie.waves])
    return " ".join("+" if value > 0 else "−" for value in values * values[0])


def _family(family: ModeFamily, ties: list[Tie]) -> str:
    free = [name for name in family.names if name[0] not in "kc"]
    if family.name.startswith("square"):
        start = ", ".join(f"{value:.3g}" for value in np.round(family.start, 3) + 0.0)
        return (
            f"This is Eq. (mode) of the paper ({family.name}): {number(family.size, 'parameter')}, "
            f"start [{start}]."
        )
    names = f" ({', '.join(free)})" if free else ""
    held = f"; {held_tie(ties).name} is held, since v carries the amplitude" if ties else ""
    return (
        f"{number(family.size, 'parameter').capitalize()}: all wave vectors and phases, and "
        f"{number(len(free), 'amplitude')}{names}{held}."
    )
