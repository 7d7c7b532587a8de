"""The pattern in a spectrum: its waves, whether Eq. (6) fits them, equivalent mode parameters.

The square family of modes is (Eq. (6) of the paper), with θᵢ the arguments of its sines::

    φ = a₁ [−sin θ₁ − sin θ₂] e_x + [sin θ₁ − sin θ₂] e_y
    θ₁ = π/l (a₂ x + a₃ y + a₆)        θ₂ = π/l (a₄ x + a₅ y + a₇)

Only the product v₁φ is observable, and the following changes leave it as it is:

* reversing a wave: (k, c) → (−k, l − c), because sin(π − θ) = sin θ;
* shifting a phase c by a multiple of 2l;
* swapping the two waves, with a₁ → −a₁ and v₁ → −v₁: φ_y changes sign by the swap, φ_x by a₁;
* shifting both phases by l, with v₁ → −v₁.

Shifting *one* phase by l gives another field: the pattern moved by one cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.idic.modes import ModeFamily, square_family
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.idic.spectra.waves import Peak, PlaneWave, explained_share, find_peaks, fit_waves
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

REFERENCE_MODE: tuple[float, ...] = (1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 0.0)
"""The ideal square pattern with the origin at a solid junction between four holes."""


def mode_equivalent(
    mode: ArrayLike, pitch: float, nearest_to: ArrayLike = REFERENCE_MODE
) -> tuple[FloatArray, int]:
    """Find the equivalent parameters (7,) nearest to a given mode, a₁ … a₅ [-], a₆ and a₇ [mm].

    Distance is Euclidean, with the phases in units of the pitch l [mm]. The sign is the factor of
    v₁ that keeps the field v₁φ the same.
    """
    target = _checked(nearest_to)
    scale = np.array([1, 1, 1, 1, 1, 1 / pitch, 1 / pitch])
    candidates = []
    for candidate, sign in _equivalents(_checked(mode), pitch):
        turns = np.round((candidate[5:] - target[5:]) / (2 * pitch))
        candidate[5:] -= 2 * pitch * turns
        candidates.append((float(np.linalg.norm((candidate - target) * scale)), candidate, sign))
    _, best, sign = min(candidates, key=lambda c: c[0])
    return best + 0.0, sign  # adding zero turns -0.0 into 0.0


def mode_deviation(
    mode: ArrayLike, pitch: float, expected: ArrayLike = REFERENCE_MODE
) -> FloatArray:
    """(7,) deviation of a mode from the expected one [%], equivalents resolved.

    For a₁ … a₅ in % of 1, for the phases a₆ and a₇ in % of l.
    """
    nearest, _ = mode_equivalent(mode, pitch, expected)
    difference = nearest - _checked(expected)
    difference[5:] /= pitch
    return 100 * difference


def nearest_origin(mode: ArrayLike, pitch: float) -> ModeFamily:
    """Make Eq. (6) with a given mode as its start, at the origin where phases are smaller."""
    found = []
    for origin in ("junction", "hole"):
        family = square_family(origin)
        start, _ = mode_equivalent(mode, pitch, family.start)
        off = float(np.abs(start[5:]).max()) / pitch
        name = family.name if off <= SAME_PHASE else "square"
        found.append((round(off, 9), replace(family, name=name, start=start)))
    return min(found, key=lambda f: f[0])[1]


def square_parameters(waves: FloatArray, pitch: float) -> tuple[FloatArray, float]:
    """Find the seven parameters of Eq. (6) and v₁ that are nearest to two waves (2, 5).

    Eq. (6) has the signs (−a₁, 1) and (−a₁, −1); other waves are moved by half their length.
    """
    waves = waves.copy()
    turned = np.sign(waves[:, 1]) != (1, -1)
    waves[turned, :2] *= -1.0
    waves[turned, 4] += pitch
    v1 = 0.5 * (waves[0, 1] - waves[1, 1])
    ratio = -0.5 * (waves[0, 0] + waves[1, 0]) / v1
    return np.array([ratio, *waves[:, 2:4].ravel(), *waves[:, 4]]), float(v1)


def _equivalents(a: FloatArray, pitch: float) -> Iterator[tuple[FloatArray, int]]:
    """Generate the 16 equivalents, phases not wrapped."""
    for swap, both, turn1, turn2 in product((False, True), repeat=4):
        sign = 1
        ratio, k1, k2, c1, c2 = a[0], a[1:3], a[3:5], a[5], a[6]
        if swap:
            ratio, k1, k2, c1, c2, sign = -ratio, k2, k1, c2, c1, -sign
        if both:
            c1, c2, sign = c1 + pitch, c2 + pitch, -sign
        if turn1:
            k1, c1 = -k1, pitch - c1
        if turn2:
            k2, c2 = -k2, pitch - c2
        yield np.array([ratio, *k1, *k2, c1, c2]), sign


def _checked(mode: ArrayLike) -> FloatArray:
    a = np.asarray(mode, dtype=np.float64)
    if a.shape != (7,) or not np.isfinite(a).all():
        raise InputError(f"expected 7 finite mode parameters a1 ... a7, got {a.tolist()}")
    return a


SAME_PHASE = 0.01
"""Difference of phases [l] that are called equal: a hundredth of a cell."""
SECONDARY_PEAK = 0.05
"""A peak may belong to the pattern if it has this share of the largest one's density. A wave half
as strong has a quarter; the holes take more away from a wave that changes sign from cell to cell,
if they lie where it is largest."""
MOST_PEAKS = 8
"""Most peaks that are considered."""
MOST_WAVES = 4
"""Most waves that are fitted."""
GROWTH = 0.05
"""A further wave belongs to the pattern if it describes this much more of the field than those
before; a peak that exists only because the holes repeat another wave describes nothing more."""
SMALLEST_AMPLITUDE = 0.005
"""Mean amplitude of the strongest wave [l] below which there is no pattern."""
SMALLEST_CONTRAST = 100.0
"""Least ratio of a pattern's peak to the median density of the wave vectors searched."""
LARGE_SHARE = 0.25
"""Share of the field above which the waves that describe it are a pattern, too. With few cells,
peaks fill most of what is searched, and have no contrast: on the paper's specimen 4 x 4 cells have
1.2 after buckling, but a share of 0.98; before buckling it is below 0.01 everywhere."""
SAME_AMPLITUDE = 1.25
"""Largest ratio of two amplitudes that are called equal."""
IN_PHASE = 0.2
"""Largest share of a wave that may be out of phase between its x and y components."""
NEAR_DIAGONAL = 0.2
"""Largest difference of a wave vector's components from ±1 [π/l] in the square family."""

SQUARE = "square, 7 parameters"


@dataclass(frozen=True)
class WavePattern:
    """The pattern found in a spectrum."""

    waves: tuple[PlaneWave, ...]
    """Waves of the pattern, from right to left by direction; empty if there is none."""
    largest: Peak | None
    """The largest peak outside the edges' lines, pattern or not; None if there is no maximum."""
    text: tuple[str, ...]
    start: tuple[float, ...] | None = None
    """(7,) start for the mode [-, and mm for a₆, a₇], equivalents resolved; None if the family is
    not the square one."""
    start_amplitude: float = 0.0
    """Initial amplitude of v₁φ₁: mean amplitude of the waves' y components, with the sign that
    belongs to ``start`` [mm]."""

    @property
    def family(self) -> str:
        """Either "square, 7 parameters", if Eq. (6) describes it, "unknown", or "none".

        The square family consists of two waves near the diagonals, of equal amplitudes in x and in
        y, with the same sign in x and opposite signs in y (or the reverse).
        """
        if self.start is not None:
            return SQUARE
        return "unknown" if self.waves else "none"


def read_pattern(spectrum: Spectrum) -> WavePattern:
    """Find the waves of a long-range correlated pattern and check whether Eq. (6) fits them."""
    peaks = find_peaks(spectrum)
    if not peaks:
        return WavePattern((), None, ("No pattern: no maximum outside the lines of the edges.",))
    largest = peaks[0]
    chosen = [p for p in peaks if p.density >= SECONDARY_PEAK * largest.density]
    waves = fit_waves(spectrum, _pursued(spectrum, chosen[:MOST_PEAKS]))
    strength = max(w.strength for w in waves)
    share = explained_share(spectrum, waves)
    hidden = largest.contrast < SMALLEST_CONTRAST and share < LARGE_SHARE
    if strength < SMALLEST_AMPLITUDE * spectrum.pitch or hidden:
        why = (
            f"No pattern: the largest peak is at ξ = ({largest.xi[0]:+.2f}, {largest.xi[1]:+.2f}), "
            f"{largest.contrast:.0f} times the median density, with a mean amplitude of "
            f"{1e3 * strength:.1f} µm and {100 * share:.0f} % of the field (a pattern has "
            f"at least {1e3 * SMALLEST_AMPLITUDE * spectrum.pitch:.1f} µm, and "
            f"{SMALLEST_CONTRAST:.0f} times or {100 * LARGE_SHARE:.0f} %)."
        )
        return WavePattern((), largest, (why,))
    waves.sort(key=lambda w: np.arctan2(w.k[1], w.k[0]))
    return _described(tuple(waves), largest, spectrum.pitch)


def _pursued(spectrum: Spectrum, peaks: list[Peak]) -> list[Peak]:
    """Take the largest peak, then whichever describes most of the rest (matching pursuit)."""
    chosen, left, share = [peaks[0]], peaks[1:], explained_share(spectrum, peaks[:1])
    while left and len(chosen) < MOST_WAVES:
        shares = [explained_share(spectrum, [*chosen, peak]) for peak in left]
        best = int(np.argmax(shares))
        if shares[best] < (1.0 + GROWTH) * share:
            break
        chosen.append(left.pop(best))
        share = shares[best]
    return chosen


def _described(waves: tuple[PlaneWave, ...], largest: Peak, pitch: float) -> WavePattern:
    """Check the properties that Eq. (6) assumes, with one line of text each."""
    vectors = " and ".join(f"[{w.k[0]:+.3f}, {w.k[1]:+.3f}]" for w in waves)
    count = {1: "One wave", 2: "Two waves"}.get(len(waves), f"{len(waves)} waves")
    text = [f"{count}, {vectors} π/l; the largest peak is {largest.contrast:.0f} times the median."]
    if len(waves) != 2:
        text.append("Eq. (6) is not supported: it has two waves.")
        return WavePattern(waves, largest, tuple(text))
    checks = (_directions(waves), _equality(waves), _signs(waves, pitch), _standing(waves))
    text += [line for _, line in checks]
    if not all(passed for passed, _ in checks):
        text.append("Eq. (6) is not supported by these observations.")
        return WavePattern(waves, largest, tuple(text))
    mode, v1 = square_parameters(np.array([w.row for w in waves]), pitch)
    start, sign = mode_equivalent(mode, pitch)
    numbers = ", ".join(f"{value:.2f}" for value in np.round(start, 2) + 0.0)
    text.append(f"Eq. (6) is supported: {SQUARE}, start [{numbers}].")
    return WavePattern(waves, largest, tuple(text), tuple(float(v) for v in start), sign * v1)


def _directions(waves: tuple[PlaneWave, ...]) -> tuple[bool, str]:
    near = all(abs(abs(k) - 1) <= NEAR_DIAGONAL for w in waves for k in w.k)
    passed = near and waves[0].k[0] * waves[1].k[0] < 0
    return passed, (
        f"Their directions are {'' if passed else 'not '}the two diagonals with a wavelength of "
        "2 cells along each axis."
    )


def _equality(waves: tuple[PlaneWave, ...]) -> tuple[bool, str]:
    first, second = (np.abs(w.amplitude) for w in waves)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = second / first
    passed = bool(np.all((ratio >= 1 / SAME_AMPLITUDE) & (ratio <= SAME_AMPLITUDE)))  # NaN neither
    return passed, (
        f"Amplitude of the second over the first: {ratio[0]:.2f} in x and {ratio[1]:.2f} in y, "
        f"{'equal' if passed else 'not equal'} within a factor of {SAME_AMPLITUDE}."
    )


def _signs(waves: tuple[PlaneWave, ...], pitch: float) -> tuple[bool, str]:
    # Moving one wave by half its length turns both signs, so their product is what counts.
    names = {1: "the same sign", -1: "opposite signs", 0: "no sign"}
    sx, sy = (int(sign) for sign in np.sign(np.prod([w.amplitude for w in waves], axis=0)))
    return sx * sy == -1, (
        f"They have {names[sx]} in x and {names[sy]} in y, with phases of "
        f"{round(waves[0].phase / pitch, 2) + 0.0:.2f} l and "
        f"{round(waves[1].phase / pitch, 2) + 0.0:.2f} l from the origin."
    )


def _standing(waves: tuple[PlaneWave, ...]) -> tuple[bool, str]:
    worst = max(w.out_of_phase for w in waves)
    return worst <= IN_PHASE, (
        f"The x and y components of each wave are {'' if worst <= IN_PHASE else 'not '}in phase "
        f"({100 * worst:.0f} % out of it at most)."
    )
