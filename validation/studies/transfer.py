"""Transfer functions of least-squares fits: subsets, polynomials, and an ansatz near a state.

Local DIC with polynomial shape functions is, to first order, their least-squares fit to the
displacement in the subset, evaluated at its centre: a Savitzky–Golay filter [1]_, [2]_. Global DIC
with polynomials over the whole domain is the same fit over the domain. The measured share of a
wave's amplitude is its transfer T; the finest period is the one with T = 0.9 [2]_.

Near a state a, an ansatz can describe small changes S da of the displacement. Its best fit to a
wave w has the da that minimise the sum of |w - S da|^2 over the material. A correlation weights
the same sum by the speckle's gradient, which averages out over many speckles.

References
----------
.. [1] M. Grédiac, B. Blaysat, F. Sur, Exp. Mech. 57 (2017) 871, doi 10.1007/s11340-017-0279-x.
.. [2] P. L. Reu et al., Exp. Mech. 62 (2022) 639, doi 10.1007/s11340-021-00806-6.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import pandas as pd
from scipy.optimize import brentq

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import fit_displacement
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.validation.scoring.star import KEPT
from modeharvest.validation.studies.buckled import AddedWave, ResolutionSpec

_SCAN = 4001
WAVED = ("v0", "v1")
"""Parts of the ansatz to which waves are added."""
AXES = ("x", "y")
_PERIODS = 80
_SHORTEST, _LONGEST = 0.6, 8.0
"""Shortest period [cells] and longest period [lengths of the specimen]."""
_PHASES = (0.0, 0.5 * np.pi)
QUANTITIES = ("v0", "v1", "v1phi1", "u")
_FLOOR_OF = {"v0": "v0", "v1": "v1phi1"}
"""Field whose noise floor is combined with l10 of a part's waves."""
_SUBSET_PX = 33
"""Edge of the subset for the indicator [px]: by theory it hardly depends on the size."""
Kind = tuple[str, int, int]
"""Part, axis and degree."""


def affine_subset_transfer(width: int, period: FloatArray) -> FloatArray:
    """(...) T at the centre of a square affine subset for waves along one of its edges [-].

    Dirichlet's kernel sin(pi w/p) / (w sin(pi/p)), the same as for a mean over the subset.
    ``width``: its edge w, odd [px]; ``period``: (...) period p of the wave [px].
    """
    phase = np.pi / period
    return np.asarray(np.sin(width * phase) / (width * np.sin(phase)))


def finest_period(transfer: Callable[[FloatArray], FloatArray], low: float, high: float) -> float:
    """The period between ``low`` and ``high`` above which a transfer stays at 0.9 or more.

    ``transfer``: from periods (n,) to T (n,); InputError if T is below 0.9 at the longest period
    or at no period.
    """
    periods = np.asarray(np.geomspace(low, high, _SCAN), dtype=np.float64)
    below = np.flatnonzero(transfer(periods) < KEPT)
    if not len(below) or below[-1] == _SCAN - 1:
        raise InputError(
            f"expected a transfer that rises through {KEPT} between periods of {low:g} and "
            f"{high:g}, got none"
        )
    at = below[-1]
    found = brentq(lambda p: float(transfer(np.array([p]))[0]) - KEPT, periods[at], periods[at + 1])
    return float(found)


def tangent_fit(
    ansatz: Ansatz, unknowns: FloatArray, points: FloatArray, waves: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Best fits of k waves (m, 2, k) [mm] by an ansatz linearised at ``unknowns``.

    Returns the changes of v0 and of v1 phi1 at ``points`` (m, 2) [mm], (m, 2, k) each; u's is both.
    """
    x, y = points.T
    S = ansatz.sensitivities(unknowns, x[:, None], y[:, None])[:, 0]
    flat = S.reshape(-1, ansatz.size)
    scale = np.sqrt((flat**2).sum(axis=0))
    q, r = np.linalg.qr(flat / scale)
    step = np.linalg.solve(r, q.T @ waves.reshape(len(flat), -1)) / scale[:, None]
    slow = 2 * ansatz.v0_space.size
    return S[..., :slow] @ step[:slow], S[..., slow:] @ step[slow:]


def wave_share(found: FloatArray, wave: FloatArray) -> FloatArray:
    """(k,) regression slopes of measured fields (m, 2, k) on the waves (m, 2, k) [-]."""
    return np.asarray((found * wave).sum(axis=(0, 1)) / (wave**2).sum(axis=(0, 1)))


@dataclass(frozen=True, eq=False)
class TransferCurves:
    """Transfers T over the period."""

    periods: FloatArray
    """(n,) periods, ascending [mm]."""
    own: dict[Kind, FloatArray]
    whole: dict[Kind, FloatArray]
    """By (part, axis, degree): share (n,) of a wave measured in its own part, and in the whole
    displacement, averaged over both phases [-]."""

    @classmethod
    def of(cls, spec: ResolutionSpec, degrees: Sequence[int], progress: Progress = silent) -> Self:
        """Fit waves of v0 and v1 along both axes at all degrees."""
        buckled, points = spec.buckled, spec.points
        pitch, longer = buckled.specimen.pitch, 2.0 * max(buckled.specimen.half_size)
        periods = np.asarray(np.geomspace(_SHORTEST * pitch, _LONGEST * longer, _PERIODS))
        own: dict[Kind, FloatArray] = {}
        whole: dict[Kind, FloatArray] = {}
        kinds = [(part, axis) for part in WAVED for axis in range(len(AXES))]
        waves = np.stack(
            [buckled.wave_at(AddedWave(part, axis, float(period), phase, 1.0), points)
             for part, axis in kinds for period in periods for phase in _PHASES], axis=-1
        )  # fmt: skip
        for degree in counted(degrees, progress, "resolution: best fits"):
            ansatz, start = buckled.ansatz(degree, degree), buckled.start(degree, degree)
            parts = dict(zip(WAVED, tangent_fit(ansatz, start, points, waves), strict=True))
            for k, (part, axis) in enumerate(kinds):
                here = slice(k * 2 * _PERIODS, (k + 1) * 2 * _PERIODS)
                for found, fit in ((own, parts[part]), (whole, parts["v0"] + parts["v1"])):
                    found[part, axis, degree] = _over_phases(fit[..., here], waves[..., here])
        return cls(periods, own, whole)

    def at(self, part: str, axis: int, degree: int, period: float) -> float:
        """T [-] of a wave along an axis in its own part, "v0" or "v1", at a period [mm]."""
        return float(np.interp(period, self.periods, self.own[part, axis, degree]))

    def finest(self, part: str, axis: int, degree: int) -> float:
        """l10 [mm], the period above which less than 10 % is lost; InputError if there is none."""
        periods, curve = self.periods, self.own[part, axis, degree]
        return finest_period(lambda p: np.interp(p, periods, curve), periods[0], periods[-1])

    def cross_talk(self) -> tuple[float, float]:
        """Largest share of one part's wave measured in the other: at all periods, above l10."""
        everywhere = resolved = 0.0
        for key, own in self.own.items():
            other = np.abs(self.whole[key] - own)
            everywhere = max(everywhere, float(other.max()))
            resolved = max(resolved, float(other[self.periods >= self.finest(*key)].max()))
        return everywhere, resolved


def _over_phases(found: FloatArray, wave: FloatArray) -> FloatArray:
    """(n,) shares of waves (m, 2, 2 n); the two phases of a wave are weighted by their power."""
    power = (wave**2).sum(axis=(0, 1)).reshape(-1, len(_PHASES))
    shares = wave_share(found, wave).reshape(-1, len(_PHASES))
    return np.asarray((shares * power).sum(axis=1) / power.sum(axis=1))


@dataclass(frozen=True, eq=False)
class Passband:
    """Transfer of patterns with another wavelength than the mode's; (n,) each [-]."""

    stretch: FloatArray
    """Wave numbers of the pattern over the mode's."""
    added: FloatArray
    """Measured share of a small such pattern added to the mode: a linear filter."""
    itself: FloatArray
    """Measured share if the whole pattern has this wavelength, by a nonlinear fit that starts from
    the mode."""
    wavelength_error: FloatArray
    """Relative error of the wave numbers in that fit."""

    @classmethod
    def of(cls, spec: ResolutionSpec, degree: int) -> Passband:
        """Compute it for one degree of v0 and v1."""
        points, buckled = spec.points, spec.buckled
        ansatz, start = buckled.ansatz(degree, degree), buckled.start(degree, degree)
        stretch = np.concatenate([np.linspace(0.05, 0.8, 26), np.linspace(0.82, 1.3, 33)])
        waves = np.stack([_stretched(spec, s, points) for s in stretch], axis=-1)
        itself, error = np.full((2, stretch.size), np.nan)
        for k in np.flatnonzero(np.abs(stretch - 1.0) <= 0.18):
            itself[k], error[k] = _refitted(spec, degree, float(stretch[k]))
        v0, v1 = tangent_fit(ansatz, start, points, waves)
        added = wave_share(v0 + v1, waves)
        return cls(stretch, added, itself, error)

    @property
    def retuned(self) -> float:
        """Largest |stretch - 1| up to which the fit finds the whole pattern, both ways [-]."""
        whole, off = self.itself > 0.999, np.abs(self.stretch - 1.0)
        lost = off[~whole & np.isfinite(self.itself)].min(initial=np.inf)
        return float(off[whole & (off < lost)].max(initial=0.0))


def _stretched(spec: ResolutionSpec, stretch: float, points: FloatArray) -> FloatArray:
    """(..., 2) the pattern with the mode's wave numbers times ``stretch``, v1 = 1 mm [mm]."""
    ansatz, a = spec.buckled.truth
    a = a.copy()
    a[ansatz.v_slice(0)] = 1.0
    phi = ansatz.phi_slice(0)
    a[phi.start + 1 : phi.start + 5] *= stretch
    at = points[..., None, 0], points[..., None, 1]
    return np.asarray(ansatz.fluctuation(0, a, *at)[..., 0, :])


def _refitted(spec: ResolutionSpec, degree: int, stretch: float) -> tuple[float, float]:
    """Share of a stretched pattern found by a fit from the mode; relative wave number error."""
    buckled = spec.buckled
    step = 4.0 * buckled.pixel_size
    cols, rows = (2 * int(np.ceil(half / step)) + 1 for half in buckled.specimen.half_size)
    grid = PixelGrid.centred(rows, cols, step)
    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    mask = buckled.material(at[..., 0], at[..., 1])
    pattern = buckled.pattern * _stretched(spec, stretch, at)
    u = pattern.copy()
    u[..., 0] -= buckled.strain * at[..., 0]
    ansatz, start = buckled.ansatz(degree, degree), buckled.start(degree, degree)
    try:
        found = fit_displacement(u, grid, ansatz, start, mask)
    except InputError:
        return float("nan"), float("nan")
    fluctuation = found.fluctuation(0)[mask][..., None]
    error = float(np.abs(np.abs(found.mode_parameters(0)[1:5]) / stretch - 1.0).max())
    return float(wave_share(fluctuation, pattern[mask][..., None])[0]), error


@dataclass(frozen=True)
class DegreeResolution:
    """Resolution and noise floor for one degree of v0 and v1."""

    degree: int
    unknowns: int
    finest_px: Mapping[str, float]
    """l10 of waves by part and axis, as "v0 x" [px]."""
    floor_px: Mapping[str, float]
    """Noise floor n by quantity (:data:`QUANTITIES`), by 2 s^2 M^-1 of the buckled images [px]."""
    indicator_px2: Mapping[str, float]
    """n l10 by part, with the geometric mean of l10 over both axes [px^2]."""
    fixed_px2: float
    """n l10 of v1 phi1 with n from images without motion [px^2]."""


def degrees_of(
    done: pd.DataFrame, spec: ResolutionSpec, curves: TransferCurves
) -> list[DegreeResolution]:
    """Every degree whose floor is known; InputError if there is none."""
    floors = done[done["task"] == "floor"]
    buckled = floors[floors["motion"] == "buckled"].sort_values("degree")
    still = floors[floors["motion"] == "still"].set_index("degree")["v1phi1"]
    if not len(buckled):
        raise InputError("study: expected the noise floor of a degree at least, got none")
    found = []
    for _, row in buckled.iterrows():
        degree = int(row["degree"])
        finest = {
            f"{part} {name}": curves.finest(part, axis, degree) / spec.buckled.pixel_size
            for part in WAVED
            for axis, name in enumerate(AXES)
        }
        mean = {part: float(np.sqrt(finest[f"{part} x"] * finest[f"{part} y"])) for part in WAVED}
        floor = {name: float(row[name]) for name in QUANTITIES}
        indicator = {part: floor[_FLOOR_OF[part]] * mean[part] for part in WAVED}
        fixed = float(still.get(degree, np.nan)) * mean["v1"]
        found.append(
            DegreeResolution(degree, int(row["unknowns"]), finest, floor, indicator, fixed)
        )
    return found


def subset_indicator(spec: ResolutionSpec) -> float:
    """Theoretical n l10 of an affine subset for the same speckle and noise [px^2].

    Noise is averaged over the subset: n = sqrt(2) s / (w G), with the rms gradient G of the speckle
    along the displacement [1/px].
    """
    grid = spec.buckled.grid
    speckle = Speckle(spec.buckled.speckle, grid.shape)
    row, col = np.meshgrid(np.arange(0.0, grid.rows, 7), np.arange(0.0, grid.cols, 7))
    slope = float(np.sqrt(np.mean(speckle.gradient(row, col) ** 2)))
    floor = np.sqrt(2.0) * spec.noise / slope / _SUBSET_PX
    finest = finest_period(lambda p: affine_subset_transfer(_SUBSET_PX, p), 10.0, 1000.0)
    return float(floor * finest)
