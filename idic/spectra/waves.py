"""Plane waves in displacement fields: spectral peaks, their selection, and least-squares fits.

In a field known at pixels, peaks are searched away from the lines that the specimen's edges cause.
The jump of the mean deformation at a vertical edge spreads energy along ξ2 = 0, at a horizontal
edge along ξ1 = 0, about l/L wide, L being the material's height or width. As the holes repeat with
the period l, copies of the lines lie at whole numbers of ξ1 and ξ2. Wave vectors within two such
widths (``EDGE_LINE_WIDTHS``) of a whole number in either component are left out, unless they stand
out against the line. A line decreases slowly along its length, where a wave is a peak (one of the
three waves of a hexagonal lattice lies on such a line).

A wave makes a peak. Its amplitude and phase can't be taken from û alone, because the holes couple
waves whose vectors differ by whole numbers of 1/l, as the diagonals of the square pattern do: a
third of one appears at the other. Therefore all waves are fitted at once, by least squares over the
material, under a Hann taper that excludes the edges.

In a periodic field on a mesh, the spectral density shows where waves may be, not how large they
are: the holes couple waves that differ by a vector of the reciprocal lattice, so a wave appears at
each of those (see above). What counts is the share of the field's energy over the material that the
waves explain together, by least squares.

Waves are added as stars: peaks of equal density and wavelength, which a symmetry of the field may
map to each other, stay together. The first star is that of the largest peak; after it, the
star that explains most of the rest is next (orthogonal matching pursuit, Pati, Rezaiifar &
Krishnaprasad, 1993, doi 10.1109/ACSSC.1993.342465).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from modeharvest.idic.spectra.lattice_spectrum import LatticePeak, LatticeSpectrum, MeshQuadrature
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.util.arrays import ComplexArray, FloatArray
from modeharvest.util.errors import InputError

T = TypeVar("T")
EDGE_LINE_WIDTHS = 2.0
"""Distance from whole numbers of ξ [l/L] within which a maximum is taken for an edge line."""
LINE_CONTRAST = 10.0
"""Least ratio of a wave's maximum on a line to the largest density 1.5 to 2.5 l/L further along it,
either way: a wave's own side lobes give 20, the lines of the paper's specimen before buckling less
than 3."""


@dataclass(frozen=True)
class Peak:
    """A maximum of S_xx + S_yy outside the edges' lines."""

    xi: tuple[float, float]
    """(ξ1, ξ2) [1/l], in the half plane ξ2 > 0, or ξ1 > 0 on its border, since S(−ξ) = S(ξ)."""
    density: float
    """S_xx + S_yy there [mm⁶]."""
    contrast: float
    """That density over the median of all wave vectors searched [-]."""


@dataclass(frozen=True)
class PlaneWave:
    """A plane wave A sin(π/l (k·x + c)), directed upwards (k_y > 0) or, if level, to the right."""

    k: tuple[float, float]
    """Wave vector [π/l]; (1, 1) is a wavelength of 2l along both axes."""
    amplitude: tuple[float, float]
    """(x, y) amplitudes with their signs [mm], averaged under the Hann taper."""
    phase: float
    """Shift c [mm], between −l/2 and l/2; the rest is in the signs."""
    out_of_phase: float
    """Share of the wave that isn't described by a common phase of x and y [-]; 0 for a sine."""

    @property
    def xi(self) -> tuple[float, float]:
        """Wave vector [1/l], as on the axes of the spectral densities."""
        return self.k[0] / 2, self.k[1] / 2

    @property
    def strength(self) -> float:
        """Length of the amplitude vector [mm]."""
        return float(np.hypot(*self.amplitude))

    @property
    def row(self) -> FloatArray:
        """(5,) A, B [mm], kx, ky [-] and c [mm]."""
        return np.array([*self.amplitude, *self.k, self.phase])


def find_peaks(spectrum: Spectrum) -> list[Peak]:
    """Find the maxima of S_xx + S_yy outside the edges' lines, or clear ones on a line, by size."""
    xi1, xi2, both = spectrum.window(1.0)
    S = both.sum(axis=-1)
    lobes = [spectrum.pitch / size for size in spectrum.extent]
    on1, on2 = (
        np.abs(xi - np.round(xi)) < min(0.3, EDGE_LINE_WIDTHS * lobe)
        for xi, lobe in zip((xi1, xi2), lobes, strict=True)
    )
    searched = (~on2 & (xi2 > 0))[:, None] & ~on1
    if not searched.any() or not S.max() > 0:
        return []
    median = float(np.median(S[searched]))
    # Two maxima closer than a main lobe's width, l/L, are one.
    distance = max(1, round(min(lobes) / (xi1[1] - xi1[0])))
    # Maxima of the whole plane within what is searched: the foot of a line isn't one of them.
    maxima = maximum_filter(S, 2 * distance + 1) == S
    found = [*np.argwhere(maxima & searched)]
    # On one of the edges' lines, but not where two cross, maxima that stand out.
    half_plane = (xi2[:, None] > 0.5 * lobes[1]) | (xi1 > 0.5 * lobes[0])
    half_plane &= xi2[:, None] > -0.5 * lobes[1]
    for r, c in np.argwhere(maxima & (on1 != on2[:, None]) & half_plane):
        along, at, xi, lobe = (S[:, c], r, xi2, lobes[1]) if on1[c] else (S[r], c, xi1, lobes[0])
        away = np.abs(xi - xi[at]) / lobe
        beside = along[(away >= 1.5) & (away <= 2.5)]
        if beside.size and S[r, c] >= LINE_CONTRAST * beside.max():
            found.append(np.array([r, c]))
    peaks = [
        Peak((float(xi1[c]), float(xi2[r])), float(S[r, c]), float(S[r, c]) / median)
        for r, c in found
    ]
    return sorted(peaks, key=lambda p: -p.density)


def fit_waves(spectrum: Spectrum, peaks: Sequence[Peak]) -> list[PlaneWave]:
    """Fit plane waves near the given peaks, all at once, wave vectors included.

    Each wave vector stays within half a main lobe, l/2L, of its peak.
    """
    weight = _taper(spectrum)
    start = np.array([p.xi for p in peaks])
    reach = 0.5 * spectrum.pitch / np.array(spectrum.extent)

    def loss(step: FloatArray) -> float:
        return -_amplitudes(spectrum, weight, start + reach * step.reshape(-1, 2))[1]

    found = minimize(loss, np.zeros(start.size), method="L-BFGS-B", bounds=[(-1, 1)] * start.size)
    xi = start + reach * found.x.reshape(-1, 2)
    z, _ = _amplitudes(spectrum, weight, xi)
    return [_wave(*pair, spectrum.pitch) for pair in zip(xi, z, strict=True)]


def explained_share(spectrum: Spectrum, waves: Sequence[PlaneWave | Peak]) -> float:
    """Share of the field's square, under the Hann taper, that the waves describe together [-]."""
    return _amplitudes(spectrum, _taper(spectrum), np.array([w.xi for w in waves]))[1]


def common_phase(z: ComplexArray) -> tuple[float, FloatArray, float]:
    """Split off the phase that two complex amplitudes have in common.

    Returns the angle [rad], the (2,) real amplitudes, and the share of z that is out of phase.
    """
    angle = 0.5 * float(np.angle(np.sum(z**2)))
    turned = z * np.exp(-1j * angle)
    return angle, turned.real, float(np.linalg.norm(turned.imag) / np.linalg.norm(turned))


def _wave(xi: FloatArray, z: ComplexArray, pitch: float) -> PlaneWave:
    angle, amplitude, out_of_phase = common_phase(z)
    return PlaneWave(
        k=(2 * float(xi[0]), 2 * float(xi[1])),
        amplitude=(float(amplitude[0]), float(amplitude[1])),
        phase=angle / np.pi * pitch,
        out_of_phase=out_of_phase,
    )


def _taper(spectrum: Spectrum) -> FloatArray:
    """(q, p) Hann taper over the bounding box of the material."""
    across, up = (
        0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(c.size) + 0.5) / c.size)
        for c in (spectrum.x, spectrum.y)
    )
    return np.asarray(np.outer(up, across), dtype=np.float64)


def _amplitudes(
    spectrum: Spectrum, taper: FloatArray, xi: FloatArray
) -> tuple[ComplexArray, float]:
    """Weighted least squares for given wave vectors.

    Returns (n, 2) complex amplitudes z [mm], the wave being Im(z exp(2πi ξ·x/l)), and the share of
    the field's weighted square that they explain.
    """
    # Products of sines and cosines are those of sums and differences of their wave vectors, and
    # at a wave vector a sum over all bins is two small products of matrices.
    tapered = taper[..., None] * spectrum.source
    projected = spectrum.sum_over(tapered, xi)
    pairs = xi[:, None] - xi[None, :], xi[:, None] + xi[None, :]
    weight = (taper * spectrum.coverage)[..., None]
    minus, plus = (spectrum.sum_over(weight, of)[..., 0] for of in pairs)
    normal = 0.5 * np.block(
        [[(minus - plus).real, (plus + minus).imag], [(plus - minus).imag, (minus + plus).real]]
    )
    right = np.concatenate([projected.imag, projected.real])
    solution = np.linalg.solve(normal, right)
    total = float(np.sum(tapered * spectrum.source))
    explained = float(np.sum(solution * right)) / total
    return solution[: len(xi)] + 1j * solution[len(xi) :], explained


PEAK_SHARE = 0.02
"""Least density of a candidate, over the largest peak's. A wave this weak has 14 % of the
amplitude; candidates that a fit can't tell apart in the material only make it ill-conditioned."""
SAME_DENSITY = 0.02
"""Relative difference up to which densities are equal: 1 % in amplitude; symmetric meshes 1e-7."""
SAME_LENGTH = 1e-3
"""Relative difference of wave numbers that are called equal: for lattices given with few digits."""
GROWTH = 0.04
"""Least share of the energy that a further star of waves must explain to be worth its parameters:
it moves the material by a fifth of the field's amplitude."""
LARGEST_CONDITION = 1e3
"""Largest condition number of the least-squares matrix of unit waves over the material. Beyond it,
two waves differ mostly in the holes, and their amplitudes grow and cancel in the material."""
MOST_WAVES = 12
"""Most waves in the search: more than any family that can be identified from images has."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The waves chosen, and how the energy explained grew with their number."""

    xi: FloatArray
    """(w, 2) wave vectors [1/l]."""
    amplitudes: ComplexArray
    """(w, 2) complex z [unit of the field]: the waves' sum is Im Σ z exp(2πi ξ·x/l)."""
    star: tuple[int, ...]
    """(w,) number of the star that each belongs to, from 0."""
    growth: tuple[tuple[int, float], ...]
    """(number of waves, share of ∫ |u|² over the material), also beyond those chosen."""

    @property
    def next_gain(self) -> float:
        """Share that the next star would have explained in addition [-]; 0 if none is left."""
        shares = [share for count, share in self.growth if count >= len(self.xi)]
        return shares[1] - shares[0] if len(shares) > 1 else 0.0


class WaveFit:
    """Least-squares fits over the material by any subset of some plane waves.

    The field (q, 2), without mean, is given at the points of the quadrature; the candidates' wave
    vectors are (c, 2) [1/l], and l is ``pitch`` [mm].
    """

    def __init__(
        self, rule: MeshQuadrature, field: FloatArray, xi: FloatArray, pitch: float
    ) -> None:
        phases = 2.0 * np.pi / pitch * rule.positions @ xi.T
        # Without the mean: a rigid translation belongs to v0.
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
    spectrum: LatticeSpectrum, rule: MeshQuadrature, field: FloatArray, growth: float = GROWTH
) -> Selection:
    """Add stars of waves until the next would explain less than ``growth`` of the energy.

    The field (q, 2), without mean, is given at the points of the quadrature. Raises InputError if
    ``growth`` is not between 0 and 1.
    """
    if not 0 < growth < 1:
        raise InputError(f"mode family: expected a growth between 0 and 1, got {growth}")
    stars = _stars(spectrum)
    xi = np.array([wave for star in stars for wave in star])
    fit = WaveFit(rule, field, xi, spectrum.pitch)
    first = np.cumsum([0] + [len(star) for star in stars])
    left = {k: list(range(first[k], first[k + 1])) for k in range(len(stars))}
    order, curve = _pursued(fit, left)
    kept = 1
    while kept < len(curve) and curve[kept][1] - curve[kept - 1][1] >= growth:
        kept += 1
    waves = [wave for star in order[:kept] for wave in star]
    amplitudes, _, _ = fit.solve(waves)
    labels = tuple(s for s, star in enumerate(order[:kept]) for _ in star)
    return Selection(xi[waves], amplitudes, labels, tuple(curve))


def _stars(spectrum: LatticeSpectrum) -> list[list[tuple[float, float]]]:
    """Peaks that are candidates, those that symmetry may exchange together, from right to left."""
    peaks = spectrum.peaks
    considered = [peak for peak in peaks if peak.density >= PEAK_SHARE * peaks[0].density]
    return [
        sorted((peak.xi for peak in star), key=lambda xi: np.arctan2(xi[1], xi[0]))
        for star in grouped(considered, _exchangeable)
    ]


def grouped(items: Iterable[T], alike: Callable[[T, T], bool]) -> list[list[T]]:
    """Group each item with the first item of an earlier group that it is like, or begin a group."""
    groups: list[list[T]] = []
    for item in items:
        own = next((group for group in groups if alike(group[0], item)), None)
        if own is None:
            groups.append([item])
        else:
            own.append(item)
    return groups


def _exchangeable(first: LatticePeak, other: LatticePeak) -> bool:
    """Whether two peaks have the same density and the same wavelength."""
    lengths = np.hypot(*first.xi), np.hypot(*other.xi)
    same_length = abs(lengths[1] - lengths[0]) <= SAME_LENGTH * lengths[0]
    return bool(same_length and other.density >= (1.0 - SAME_DENSITY) * first.density)


def _pursued(
    fit: WaveFit, left: dict[int, list[int]]
) -> tuple[list[list[int]], list[tuple[int, float]]]:
    """Stars in the order in which they explain most, and the share explained after each."""
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
