"""Statistics of errors that noise makes, from realisations that come in pairs, n and -n.

What the mean of a pair's two errors leaves is of second order in the noise, so that a bias shows
long before it would out of the scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_NORMAL_95 = 1.959964
"""Half the width of a 95 % interval [standard deviations]."""


@dataclass(frozen=True, eq=False)
class Share:
    """A number and its standard error.

    Parameters
    ----------
    value, error
        Both in the same unit.
    """

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.error:.3f}".replace("-", "−")


@dataclass(frozen=True, eq=False)
class Pairs:
    """Errors under noise.

    Parameters
    ----------
    errors
        (pairs, 2, ...) of the realisations n and -n, in any unit.
    told
        Same shape: the standard deviations that each result tells of itself.
    bound
        (...): the least standard deviations there can be; 0 for what no noise moves (a mode
        outside its support), which does not count.
    """

    errors: FloatArray
    told: FloatArray
    bound: FloatArray

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(...): True where there is something to be off."""
        return np.asarray(self.bound > 0.0)

    @property
    def standardised(self) -> Pairs:
        """What counts in units of the bound, flat: everything weighs alike."""
        kept = self.of(self.counted)
        return Pairs(kept.errors / kept.bound, kept.told / kept.bound, np.ones_like(kept.bound))

    def of(self, part: NDArray[np.bool_]) -> Pairs:
        """Some of the quantities: those where ``part``, of the bound's shape, is True."""
        return Pairs(self.errors[:, :, part], self.told[:, :, part], self.bound[part])

    def against(self, factor: FloatArray) -> Pairs:
        """The same errors, bound and error bars ``factor`` (...) as large."""
        return Pairs(self.errors, factor * self.told, factor * self.bound)

    # -- each quantity by itself; NaN for what does not count ---------------------------------

    @property
    def ratios(self) -> FloatArray:
        """(...): rms error over bound [-]."""
        return self._over_bound(np.sqrt((self.errors**2).mean(axis=(0, 1))))

    @property
    def biases(self) -> FloatArray:
        """(...): mean error over bound [-]."""
        return self._over_bound(self.errors.mean(axis=(0, 1)))

    @property
    def covered(self) -> FloatArray:
        """(...): share of the 95 % intervals that hold the truth [-]."""
        return np.asarray(np.where(self.counted, self._inside.mean(axis=(0, 1)), np.nan))

    # -- all that count together --------------------------------------------------------------

    @property
    def rms_bound(self) -> float:
        """Rms of the bound."""
        return float(np.sqrt((self.bound[self.counted] ** 2).mean()))

    @property
    def ratio(self) -> Share:
        """Rms error over rms bound [-]."""
        squares = (self.of(self.counted).errors ** 2).mean(axis=(1, 2))
        value = float(np.sqrt(squares.mean()) / self.rms_bound)
        scatter = float(squares.std(ddof=1) / squares.mean() / np.sqrt(len(squares)))
        return Share(value, 0.5 * value * scatter)

    @property
    def bias(self) -> Share:
        """Rms of the mean error, freed from what is left of the scatter, over rms bound [-]."""
        even, count = self.of(self.counted).errors.mean(axis=1), len(self.errors)
        mean_square = float((even.mean(axis=0) ** 2).mean())
        scatter = float((even.var(axis=0, ddof=1) / count).mean())
        bias = np.sqrt(max(0.0, mean_square - scatter))
        return Share(float(bias / self.rms_bound), float(np.sqrt(scatter) / self.rms_bound))

    @property
    def coverage(self) -> Share:
        """Share of the 95 % intervals that hold the truth [-]."""
        shares = self._inside[:, :, self.counted].mean(axis=(1, 2))
        return Share(float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(len(shares))))

    @property
    def told_over_error(self) -> float:
        """Rms of the standard deviations told over the rms error [-]."""
        kept = self.of(self.counted)
        return float(np.sqrt((kept.told**2).mean() / (kept.errors**2).mean()))

    def _over_bound(self, values: FloatArray) -> FloatArray:
        return np.asarray(
            np.divide(values, self.bound, out=np.full(values.shape, np.nan), where=self.counted)
        )

    @property
    def _inside(self) -> FloatArray:
        return np.asarray(np.abs(self.errors) < _NORMAL_95 * self.told, dtype=np.float64)
