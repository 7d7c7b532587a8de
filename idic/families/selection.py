"""Which plane waves make up a periodic field: chosen among its peaks, fitted all at once.

The spectral density says where waves may be, not how large they are: the holes couple waves that
differ by a vector of the lattice of holes, so a wave shows up at each of those (see ``waves``).
What counts is how much of the field's energy over the material the waves explain together, by
least squares.

Waves are added as stars: peaks of equal density and wavelength, which a symmetry of the field may
turn into each other, stay together. The first star is that of the largest peak; from then on the
star that explains most of what is left is next (orthogonal matching pursuit, Pati, Rezaiifar &
Krishnaprasad, 1993, doi 10.1109/ACSSC.1993.342465).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.families.lattice_spectrum import LatticePeak, LatticeSpectrum
from modeharvest.idic.families.quadrature import Quadrature

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PEAK_SHARE = 0.02
"""Least density of a candidate, of the largest peak's. A wave this weak is 14 % as strong, and
what a fit over the holes' gaps can't tell from others only makes it ill-conditioned."""
SAME_DENSITY = 0.02
"""Relative difference of densities that are called equal, 1 % of the amplitude. Symmetric meshes
reach 1e-7."""
SAME_LENGTH = 1e-3
"""Relative difference of wave numbers that are called equal: for lattices given with few digits."""
GROWTH = 0.04
"""A star of waves is worth its parameters if it explains this much more of the energy: it moves
the material by a fifth of the field's amplitude."""
LARGEST_CONDITION = 1e3
"""Of the least-squares matrix of unit waves over the material. Beyond, two waves differ mostly in
the holes, and their amplitudes grow and cancel each other in the material."""
MOST_WAVES = 12
"""The search ends here; it is longer than any family that can be identified from images."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The waves chosen, and how the energy explained grew with their number.

    Parameters
    ----------
    xi
        (w, 2) wave vectors [1/l].
    amplitudes
        (w, 2) complex z [unit of the field]: the waves' sum is Im Σ z exp(2πi ξ·x/l).
    star
        (w,) which of the stars each belongs to, from 0.
    captured
        Share of ∫ |u|² over the material that they explain [-].
    growth
        (number of waves, share), also beyond those chosen.
    """

    xi: FloatArray
    amplitudes: ComplexArray
    star: tuple[int, ...]
    captured: float
    growth: tuple[tuple[int, float], ...]

    @property
    def next_gain(self) -> float:
        """What the next star would have explained in addition [-]; 0 if there is none left."""
        later = [share for count, share in self.growth if count > len(self.xi)]
        return later[0] - self.captured if later else 0.0


class WaveFit:
    """Least squares over the material with any of some plane waves.

    Parameters
    ----------
    rule
        Quadrature over the material.
    field
        (q, 2) what to fit, at its points, without mean.
    xi
        (c, 2) wave vectors of all candidates [1/l].
    pitch
        l [mm].
    """

    def __init__(self, rule: Quadrature, field: FloatArray, xi: FloatArray, pitch: float) -> None:
        phases = 2.0 * np.pi / pitch * rule.positions @ xi.T
        # The mean isn't the waves' business: a rigid translation is v0's.
        basis = rule.without_mean(np.hstack([np.sin(phases), np.cos(phases)]))
        weighted = rule.weights[:, None] * basis
        self.count = len(xi)
        self._gram, self._right = weighted.T @ basis, weighted.T @ field
        self._size = np.sqrt(np.diag(self._gram))
        self._energy = rule.product(field, field)

    def solve(self, chosen: list[int]) -> tuple[ComplexArray, float, float]:
        """Complex amplitudes (w, 2), share of the energy explained, condition number."""
        rows = np.array(chosen + [k + self.count for k in chosen])
        scale = self._size[rows]
        gram = self._gram[np.ix_(rows, rows)] / np.outer(scale, scale)
        right = self._right[rows] / scale[:, None]
        solution = np.linalg.lstsq(gram, right, rcond=1e-13)[0]
        share = float(np.sum(solution * right)) / self._energy
        fit = solution / scale[:, None]
        half = len(chosen)
        return fit[:half] + 1j * fit[half:], share, float(np.linalg.cond(gram))


def select_waves(
    spectrum: LatticeSpectrum, rule: Quadrature, field: FloatArray, growth: float = GROWTH
) -> Selection:
    """Add stars of waves until the next would explain less than ``growth`` of the energy.

    Parameters
    ----------
    spectrum
        Of the field.
    rule
        Quadrature over the material.
    field
        (q, 2) the field at its points, without mean.
    growth
        Least share of the energy that a further star must add [-].

    Raises
    ------
    InputError
        If ``growth`` is not between 0 and 1.
    """
    if not 0 < growth < 1:
        raise InputError(f"mode family: expected a growth between 0 and 1, got {growth}")
    stars = _stars(spectrum)
    xi = np.array([wave for star in stars for wave in star])
    fit = WaveFit(rule, field, xi, spectrum.pitch)
    starts = np.cumsum([0] + [len(star) for star in stars])
    left = {k: list(range(starts[k], starts[k + 1])) for k in range(len(stars))}
    order, curve = _pursued(fit, left)
    kept = 1
    while kept < len(curve) and curve[kept][1] - curve[kept - 1][1] >= growth:
        kept += 1
    waves = [wave for star in order[:kept] for wave in star]
    amplitudes, captured, _ = fit.solve(waves)
    labels = tuple(s for s, star in enumerate(order[:kept]) for _ in star)
    return Selection(xi[waves], amplitudes, labels, captured, tuple(curve))


def _stars(spectrum: LatticeSpectrum) -> list[list[tuple[float, float]]]:
    """Peaks worth considering, those that symmetry may exchange together, from right to left."""
    stars: list[list[LatticePeak]] = []
    for peak in spectrum.peaks:
        if peak.density < PEAK_SHARE * spectrum.peaks[0].density:
            break
        home = next((star for star in stars if _exchangeable(star[0], peak)), None)
        if home is None:
            stars.append([peak])
        else:
            home.append(peak)
    return [
        sorted((peak.xi for peak in star), key=lambda xi: np.arctan2(xi[1], xi[0]))
        for star in stars
    ]


def _exchangeable(first: LatticePeak, other: LatticePeak) -> bool:
    """Whether two peaks have the same density and the same wavelength."""
    lengths = np.hypot(*first.xi), np.hypot(*other.xi)
    same_length = abs(lengths[1] - lengths[0]) <= SAME_LENGTH * lengths[0]
    return bool(same_length and other.density >= (1.0 - SAME_DENSITY) * first.density)


def _pursued(
    fit: WaveFit, left: dict[int, list[int]]
) -> tuple[list[list[int]], list[tuple[int, float]]]:
    """Stars in the order in which they explain most, and the share after each."""
    order = [left.pop(0)]
    curve = [(len(order[0]), fit.solve(order[0])[1])]
    while True:
        have = [wave for star in order for wave in star]
        best, most = None, curve[-1][1]
        for key, star in left.items():
            if len(have) + len(star) > MOST_WAVES:
                continue
            _, share, condition = fit.solve(have + star)
            if share > most and condition <= LARGEST_CONDITION:
                best, most = key, share
        if best is None:
            return order, curve
        order.append(left.pop(best))
        curve.append((sum(len(star) for star in order), most))
