"""What the paper reads off the spectral densities by eye, as statements a program checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.families.equivalents import mode_equivalent
from modeharvest.idic.families.spectrum import Spectrum
from modeharvest.idic.families.waves import Peak, Wave, explained, find_peaks, fit_waves

FloatArray = NDArray[np.float64]

SECONDARY_PEAK = 0.05
"""A peak may belong to the pattern if it has this share of the largest one's density. A wave half
as strong has a quarter; the holes take more away from a wave that changes sign from cell to cell,
if they lie where it is largest."""
MOST_PEAKS = 8
"""No more peaks than this are looked at."""
MOST_WAVES = 4
"""No more waves than this are fitted."""
GROWTH = 0.05
"""A further wave belongs to the pattern if it describes this much more of the field than those
before; a peak that is there only because the holes repeat another wave describes nothing more."""
SMALLEST_AMPLITUDE = 0.005
"""Mean amplitude of the strongest wave [l] below which there is no pattern."""
SMALLEST_CONTRAST = 100.0
"""Ratio of a peak to the median density of the wave vectors searched that makes it a pattern's."""
LARGE_SHARE = 0.25
"""Share of the field that waves describe, which makes them a pattern, too. A few cells have peaks
so wide that they are most of what is searched, and no contrast: on the paper's specimen 4 x 4 cells
have 1.2 after buckling, but a share of 0.98; before buckling it is below 0.01 everywhere."""
SAME_AMPLITUDE = 1.25
"""Largest ratio of two amplitudes that are called equal."""
IN_PHASE = 0.2
"""Largest share of a wave that may be out of phase between its x and y components."""
NEAR_DIAGONAL = 0.2
"""Largest difference of a wave vector's components from ±1 [π/l] in the square family."""

SQUARE = "square, 7 parameters"


@dataclass(frozen=True)
class Pattern:
    """The reading of a spectrum.

    Parameters
    ----------
    waves
        Those of the pattern, from right to left by direction; empty if there is none.
    largest
        The largest peak outside the edges' lines, pattern or not; None if there is no maximum.
    family
        "square, 7 parameters" if Eq. (mode) of the paper describes it: two waves near the
        diagonals, equal amplitudes in x and in y, the same sign in x and the opposite in y (or
        the reverse); else "unknown", or "none" without waves.
    start
        (7,) start for the mode [-, and mm for a₆, a₇], equivalents resolved; None if the family
        is not the square one.
    start_amplitude
        Amplitude to start v₁φ₁ with: mean amplitude of the waves' y components, with the sign
        that belongs to ``start`` [mm].
    sentences
        What was found, in words.
    """

    waves: tuple[Wave, ...]
    largest: Peak | None
    family: str
    start: tuple[float, ...] | None
    start_amplitude: float
    sentences: tuple[str, ...]

    @property
    def supported(self) -> bool:
        """Whether the parametrisation of Eq. (mode) is supported."""
        return self.family == SQUARE

    @property
    def amplitude_ratio(self) -> tuple[float, float]:
        """Second over first wave's amplitude in x and in y, absolute [-]; NaN if not two."""
        return _amplitude_ratio(self.waves)

    @property
    def relative_sign(self) -> tuple[int, int]:
        """Sign of the second wave relative to the first in x and in y; 0 if not two waves."""
        return _relative_sign(self.waves)


def read_pattern(spectrum: Spectrum) -> Pattern:
    """Find the waves of a long-range correlated pattern and check whether Eq. (mode) fits them."""
    peaks = find_peaks(spectrum)
    if not peaks:
        return _no_pattern(None, "No pattern: no maximum outside the lines of the edges.")
    largest = peaks[0]
    chosen = [p for p in peaks if p.density >= SECONDARY_PEAK * largest.density]
    waves = fit_waves(spectrum, _pursued(spectrum, chosen[:MOST_PEAKS]))
    strength = max(w.strength for w in waves)
    share = explained(spectrum, waves)
    hidden = largest.contrast < SMALLEST_CONTRAST and share < LARGE_SHARE
    if strength < SMALLEST_AMPLITUDE * spectrum.pitch or hidden:
        return _no_pattern(
            largest,
            f"No pattern: the largest peak is at ξ = ({largest.xi[0]:+.2f}, {largest.xi[1]:+.2f}), "
            f"{largest.contrast:.0f} times the median density, with a mean amplitude of "
            f"{1e3 * strength:.1f} µm and {100 * share:.0f} % of the field (a pattern has "
            f"at least {1e3 * SMALLEST_AMPLITUDE * spectrum.pitch:.1f} µm, and "
            f"{SMALLEST_CONTRAST:.0f} times or {100 * LARGE_SHARE:.0f} %).",
        )
    waves.sort(key=lambda w: np.arctan2(w.k[1], w.k[0]))
    return _described(tuple(waves), largest, spectrum.pitch)


def _pursued(spectrum: Spectrum, peaks: list[Peak]) -> list[Peak]:
    """Take the largest peak, then whichever describes most of what is left (matching pursuit)."""
    chosen, left, share = [peaks[0]], peaks[1:], explained(spectrum, peaks[:1])
    while left and len(chosen) < MOST_WAVES:
        shares = [explained(spectrum, [*chosen, peak]) for peak in left]
        best = int(np.argmax(shares))
        if shares[best] < (1.0 + GROWTH) * share:
            break
        chosen.append(left.pop(best))
        share = shares[best]
    return chosen


def _no_pattern(largest: Peak | None, sentence: str) -> Pattern:
    return Pattern((), largest, "none", None, 0.0, (sentence,))


def _described(waves: tuple[Wave, ...], largest: Peak, pitch: float) -> Pattern:
    """Check the observations behind Eq. (mode), one sentence each."""
    vectors = " and ".join(f"[{w.k[0]:+.3f}, {w.k[1]:+.3f}]" for w in waves)
    count = {1: "One wave", 2: "Two waves"}.get(len(waves), f"{len(waves)} waves")
    said = [f"{count}, {vectors} π/l; the largest peak is {largest.contrast:.0f} times the median."]
    if len(waves) != 2:
        said.append("Eq. (mode) is not supported: it has two waves.")
        return Pattern(waves, largest, "unknown", None, 0.0, tuple(said))
    checks = (_directions(waves), _equality(waves), _signs(waves, pitch), _standing(waves))
    said += [sentence for _, sentence in checks]
    if not all(passed for passed, _ in checks):
        said.append("Eq. (mode) is not supported by these observations.")
        return Pattern(waves, largest, "unknown", None, 0.0, tuple(said))
    start, amplitude = _square_start(waves, pitch)
    numbers = ", ".join(f"{value:.2f}" for value in np.round(start, 2) + 0.0)
    said.append(f"Eq. (mode) is supported: {SQUARE}, start [{numbers}].")
    return Pattern(waves, largest, SQUARE, tuple(float(v) for v in start), amplitude, tuple(said))


def _directions(waves: tuple[Wave, ...]) -> tuple[bool, str]:
    near = all(abs(abs(k) - 1) <= NEAR_DIAGONAL for w in waves for k in w.k)
    passed = near and waves[0].k[0] * waves[1].k[0] < 0
    return passed, (
        f"Their directions are {'' if passed else 'not '}the two diagonals with a wavelength of "
        "2 cells along each axis."
    )


def _equality(waves: tuple[Wave, ...]) -> tuple[bool, str]:
    ratio = _amplitude_ratio(waves)
    passed = all(1 / SAME_AMPLITUDE <= r <= SAME_AMPLITUDE for r in ratio)  # false for NaN, too
    return passed, (
        f"Amplitude of the second over the first: {ratio[0]:.2f} in x and {ratio[1]:.2f} in y, "
        f"{'equal' if passed else 'not equal'} within a factor of {SAME_AMPLITUDE}."
    )


def _signs(waves: tuple[Wave, ...], pitch: float) -> tuple[bool, str]:
    # Moving one wave by half its length turns both signs, so their product is what counts.
    names = {1: "the same sign", -1: "opposite signs", 0: "no sign"}
    sx, sy = _relative_sign(waves)
    return sx * sy == -1, (
        f"They have {names[sx]} in x and {names[sy]} in y, with phases of "
        f"{round(waves[0].phase / pitch, 2) + 0.0:.2f} l and "
        f"{round(waves[1].phase / pitch, 2) + 0.0:.2f} l from the origin."
    )


def _standing(waves: tuple[Wave, ...]) -> tuple[bool, str]:
    worst = max(w.out_of_phase for w in waves)
    return worst <= IN_PHASE, (
        f"The x and y components of each wave are {'' if worst <= IN_PHASE else 'not '}in phase "
        f"({100 * worst:.0f} % out of it at most)."
    )


def _amplitude_ratio(waves: tuple[Wave, ...]) -> tuple[float, float]:
    if len(waves) != 2:
        return float("nan"), float("nan")
    first, second = (np.abs(w.amplitude) for w in waves)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = second / first
    return float(ratio[0]), float(ratio[1])


def _relative_sign(waves: tuple[Wave, ...]) -> tuple[int, int]:
    if len(waves) != 2:
        return 0, 0
    signs = np.sign(np.prod([w.amplitude for w in waves], axis=0))
    return int(signs[0]), int(signs[1])


def _square_start(waves: tuple[Wave, ...], pitch: float) -> tuple[FloatArray, float]:
    """Parameters of Eq. (mode): the signs (−a₁, 1) and (−a₁, −1), reached by phases of l."""
    amplitude = np.array([w.amplitude for w in waves])
    phase = np.array([w.phase for w in waves])
    turn = np.sign(amplitude[:, 1]) != (1, -1)
    amplitude[turn] *= -1
    phase[turn] += pitch
    v1 = 0.5 * (amplitude[0, 1] - amplitude[1, 1])
    ratio = -0.5 * (amplitude[0, 0] + amplitude[1, 0]) / v1
    mode = np.array([ratio, *waves[0].k, *waves[1].k, *phase])
    start, sign = mode_equivalent(mode, pitch)
    return start, float(sign * v1)
