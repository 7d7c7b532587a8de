"""What ansätze of several degrees make of waves of all periods: best fits, no images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.correlate import fit_displacement
from modeharvest.imaging.grid import PixelGrid
from modeharvest.progress import Progress, silent
from modeharvest.validation.resolution.buckled import Buckled, Wave
from modeharvest.validation.resolution.measure import Subject
from modeharvest.validation.resolution.tangent import Tangent, share
from modeharvest.validation.resolution.transfer import finest_period

FloatArray = NDArray[np.float64]

Kind = tuple[str, int, int]
"""Part, axis and degree."""
WAVED = ("v0", "v1")
"""What a wave is of."""
AXES = ("x", "y")
_PERIODS = 80
_SHORTEST, _LONGEST = 0.6, 8.0
"""Of the periods, in cells and in lengths of the specimen."""
_PHASES = (0.0, 0.5 * np.pi)


@dataclass(frozen=True, eq=False)
class Curves:
    """Transfers T over the period.

    Parameters
    ----------
    periods
        (n,) [mm], ascending.
    own, whole
        For each (part, axis, degree) the share (n,) of a wave that is found in its own part, and
        in the whole displacement, over both phases [-].
    """

    periods: FloatArray
    own: dict[Kind, FloatArray]
    whole: dict[Kind, FloatArray]

    @classmethod
    def of(cls, subject: Subject, degrees: Sequence[int], progress: Progress = silent) -> Curves:
        """Fit waves of v0 and v1 along both axes at all degrees."""
        buckled, points = subject.buckled, subject.points
        pitch, longer = buckled.specimen.pitch, 2.0 * max(buckled.specimen.half_size)
        periods = np.asarray(np.geomspace(_SHORTEST * pitch, _LONGEST * longer, _PERIODS))
        own: dict[Kind, FloatArray] = {}
        whole: dict[Kind, FloatArray] = {}
        kinds = [(part, axis) for part in WAVED for axis in range(len(AXES))]
        waves = np.concatenate(
            [_waves(buckled, part, axis, periods, points) for part, axis in kinds], axis=-1
        )
        for n, degree in enumerate(degrees):
            progress(n, len(degrees), "resolution: best fits")
            start = subject.start(degree, "buckled")
            fit = Tangent(subject.ansatz(degree, "buckled"), start, points).fit(waves)
            for k, (part, axis) in enumerate(kinds):
                here = slice(k * 2 * _PERIODS, (k + 1) * 2 * _PERIODS)
                wave = waves[..., here]
                for found, among in ((own, fit.of(part)), (whole, fit.whole)):
                    found[part, axis, degree] = _over_phases(among[..., here], wave)
        progress(len(degrees), len(degrees), "resolution: best fits")
        return cls(periods, own, whole)

    def at(self, part: str, axis: int, degree: int, period: float) -> float:
        """T of a wave in its own part at a period [mm]."""
        return float(np.interp(period, self.periods, self.own[part, axis, degree]))

    def finest(self, part: str, axis: int, degree: int) -> float:
        """l10 [mm]: the period from which on less than 10 % of the amplitude is lost.

        Raises
        ------
        InputError
            If there is none among the periods.
        """
        curve = self.own[part, axis, degree]

        def transfer(period: FloatArray) -> FloatArray:
            return np.asarray(np.interp(period, self.periods, curve))

        return finest_period(transfer, float(self.periods[0]), float(self.periods[-1]))

    def cross_talk(self) -> tuple[float, float]:
        """Largest share of a wave of one part found in the other: at any period, from l10 on."""
        everywhere, resolved = [], []
        for key, own in self.own.items():
            other = np.abs(self.whole[key] - own)
            everywhere.append(other.max())
            resolved.append(other[self.periods >= self.finest(*key)].max())
        return float(max(everywhere)), float(max(resolved))


def _over_phases(found: FloatArray, wave: FloatArray) -> FloatArray:
    """(n,) shares of waves (m, 2, 2 n), those of the two phases weighted by their power."""
    power = (wave**2).sum(axis=(0, 1)).reshape(-1, len(_PHASES))
    shares = share(found, wave).reshape(-1, len(_PHASES))
    return np.asarray((shares * power).sum(axis=1) / power.sum(axis=1))


def _waves(
    buckled: Buckled, part: str, axis: int, periods: FloatArray, points: FloatArray
) -> FloatArray:
    """(m, 2, 2 n) waves of amplitude 1 mm in both phases."""
    made = [
        buckled.wave_at(Wave(part, axis, float(period), phase, 1.0), points)
        for period in periods
        for phase in _PHASES
    ]
    return np.stack(made, axis=-1)


@dataclass(frozen=True, eq=False)
class Passband:
    """What becomes of a pattern of another wavelength than the mode's.

    Parameters
    ----------
    stretch
        (n,) its wave numbers over the mode's [-].
    added
        (n,) share that is found of a small one beside the mode [-]: a filter.
    itself
        (n,) share that is found of the pattern itself where it is that long, by a fit that starts
        from the mode [-].
    wavelength_error
        (n,) relative error of the wavelength that fit finds [-].
    """

    stretch: FloatArray
    added: FloatArray
    itself: FloatArray
    wavelength_error: FloatArray

    @classmethod
    def of(cls, subject: Subject, degree: int) -> Passband:
        """At one degree of v0 and v1."""
        points = subject.points
        ansatz, start = subject.ansatz(degree, "buckled"), subject.start(degree, "buckled")
        stretch = np.concatenate([np.linspace(0.05, 0.8, 26), np.linspace(0.82, 1.3, 33)])
        waves = np.stack([_stretched(subject, s, points) for s in stretch], axis=-1)
        added = share(Tangent(ansatz, start, points).fit(waves).whole, waves)
        near = np.abs(stretch - 1.0) <= 0.18
        itself, error = np.full(stretch.shape, np.nan), np.full(stretch.shape, np.nan)
        for k in np.flatnonzero(near):
            itself[k], error[k] = _refitted(subject, degree, float(stretch[k]))
        return cls(stretch, added, itself, error)

    @property
    def retuned(self) -> float:
        """How far off its wave numbers may be for the pattern to be found whole, both ways [-]."""
        whole, off = self.itself > 0.999, np.abs(self.stretch - 1.0)
        lost = off[~whole & np.isfinite(self.itself)].min(initial=np.inf)
        return float(off[whole & (off < lost)].max(initial=0.0))


def _stretched(subject: Subject, stretch: float, points: FloatArray) -> FloatArray:
    """(..., 2) the pattern with wave numbers so many times the mode's, v1 = 1 mm."""
    ansatz, a = subject.buckled.truth
    a = a.copy()
    a[ansatz.v_slice(0)] = 1.0
    phi = ansatz.phi_slice(0)
    a[phi.start + 1 : phi.start + 5] *= stretch
    at = points[..., None, 0], points[..., None, 1]
    return np.asarray(ansatz.fluctuation(0, a, *at)[..., 0, :])


def _refitted(subject: Subject, degree: int, stretch: float) -> tuple[float, float]:
    """Share of a stretched pattern that a fit from the mode finds; its wave number's error."""
    buckled = subject.buckled
    size = np.array(buckled.specimen.half_size)
    step = 4.0 * buckled.pixel_size
    cols, rows = (2 * int(np.ceil(half / step)) + 1 for half in size)
    grid = PixelGrid.centred(rows, cols, step)
    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    mask = buckled.material(at[..., 0], at[..., 1])
    pattern = buckled.pattern * _stretched(subject, stretch, at)
    u = pattern.copy()
    u[..., 0] -= buckled.strain * at[..., 0]
    ansatz = subject.ansatz(degree, "buckled")
    try:
        found = fit_displacement(u, grid, ansatz, subject.start(degree, "buckled"), mask)
    except InputError:
        return float("nan"), float("nan")
    fluctuation = found.fluctuation(0)[mask][..., None]
    wave_numbers = found.mode_parameters(0)[1:5]
    error = float(np.abs(np.abs(wave_numbers) / stretch - 1.0).max())
    return float(share(fluctuation, pattern[mask][..., None])[0]), error
