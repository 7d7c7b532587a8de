"""What an automatically found mode family is, in sentences for a report."""

from __future__ import annotations

import numpy as np

from modeharvest.idic.constraints import SAME_AMPLITUDE, SAME_PHASE, RealWave, Tie, held_tie
from modeharvest.idic.fourier import ModeFamily
from modeharvest.idic.selection import Selection

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


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
    said += _amplitudes(waves, ties) if ties else ["Nothing is tied."]
    said.append(_family(family))
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
        said.append("All phases are 0 at the origin: turned by half a turn about it, the field is"
                    " the same.")  # fmt: skip
    elif np.all(np.abs(phases - 0.5) <= SAME_PHASE):
        said.append("All phases are l/2 at the origin: a half turn about it reverses the field.")
    else:
        said.append("Phases: " + ", ".join(f"{p:+.2f}" for p in phases) + " l.")
    return said


def _amplitudes(waves: list[RealWave], ties: list[Tie]) -> list[str]:
    said, held = [], held_tie(ties)
    for tie in ties:
        if len(tie.waves) == 1 or tie.value == 0:
            continue
        signs = "".join("+-"[waves[w].amplitude[tie.component] < 0] for w in tie.waves)
        first = signs[0]
        relative = " ".join("+" if s == first else "−" for s in signs)
        said.append(
            f"|{'AB'[tie.component]}| is the same in waves "
            f"{', '.join(str(w + 1) for w in tie.waves)} within {100 * SAME_AMPLITUDE:.0f} %, "
            f"signs {relative}: one parameter."
        )
    zero = [tie for tie in ties if tie.value == 0 for _ in tie.waves]
    names = [f"{'AB'[t.component]}{w + 1}" for t in ties if t.value == 0 for w in t.waves]
    if zero:
        said.append(f"Held at zero: {', '.join(names)}.")
    said.append(f"Held at ±1, since v carries the amplitude: {held.name}.")
    return said


def _family(family: ModeFamily) -> str:
    start = ", ".join(f"{value:.3g}" for value in np.round(family.start, 3) + 0.0)
    is_paper = family.name.startswith("square")
    kind = "Eq. (mode) of the paper" if is_paper else f"Family {family.name!r}"
    return f"{kind}: {number(family.size, 'parameter')}, start [{start}] ({family.name})."
