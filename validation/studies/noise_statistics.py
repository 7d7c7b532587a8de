"""Statistics of a noise study: paired realisations, levels of noise, bounds, coverage.

Realisations come in pairs, n and -n. What the mean of a pair's two errors leaves is of second order
in the noise, so that a bias shows long before it would out of the scatter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.validation.studies.noise import COVARIANCES, PARTS, FieldPoints

_NORMAL_95 = 1.959964
"""Half the width of a 95 % interval [standard deviations]."""


@dataclass(frozen=True, eq=False)
class Estimate:
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
class PairedErrors:
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
    def standardised(self) -> PairedErrors:
        """What counts in units of the bound, flat: everything weighs alike."""
        kept = self.of(self.counted)
        return PairedErrors(
            kept.errors / kept.bound, kept.told / kept.bound, np.ones_like(kept.bound)
        )

    def of(self, part: NDArray[np.bool_]) -> PairedErrors:
        """Some of the quantities: those where ``part``, of the bound's shape, is True."""
        return PairedErrors(self.errors[:, :, part], self.told[:, :, part], self.bound[part])

    def against(self, factor: FloatArray) -> PairedErrors:
        """The same errors, bound and error bars ``factor`` (...) as large."""
        return PairedErrors(self.errors, factor * self.told, factor * self.bound)

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
    def ratio(self) -> Estimate:
        """Rms error over rms bound [-]."""
        squares = (self.of(self.counted).errors ** 2).mean(axis=(1, 2))
        value = float(np.sqrt(squares.mean()) / self.rms_bound)
        scatter = float(squares.std(ddof=1) / squares.mean() / np.sqrt(len(squares)))
        return Estimate(value, 0.5 * value * scatter)

    @property
    def bias(self) -> Estimate:
        """Rms of the mean error, freed from what is left of the scatter, over rms bound [-]."""
        even, count = self.of(self.counted).errors.mean(axis=1), len(self.errors)
        mean_square = float((even.mean(axis=0) ** 2).mean())
        scatter = float((even.var(axis=0, ddof=1) / count).mean())
        bias = np.sqrt(max(0.0, mean_square - scatter))
        return Estimate(float(bias / self.rms_bound), float(np.sqrt(scatter) / self.rms_bound))

    @property
    def coverage(self) -> Estimate:
        """Share of the 95 % intervals that hold the truth [-]."""
        shares = self._inside[:, :, self.counted].mean(axis=(1, 2))
        return Estimate(float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(len(shares))))

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


Levels = Mapping[float, Mapping[str, PairedErrors]]
"""For each level of noise, in order, the errors of the "unknowns" and of the fields."""


@dataclass(frozen=True, eq=False)
class NoiseErrors:
    """Standard deviations, or errors.

    Parameters
    ----------
    unknowns
        (..., n), each in its own unit.
    fields
        (..., points, 7) [mm], see :data:`~modeharvest.validation.studies.noise.PARTS`.
    """

    unknowns: FloatArray
    fields: FloatArray

    @classmethod
    def of(cls, flat: FloatArray, n: int) -> NoiseErrors:
        """From (..., n + 7 points), as the cases store it."""
        fields = flat[..., n:]
        return cls(flat[..., :n], fields.reshape(*fields.shape[:-1], -1, 7))

    def parts(self) -> dict[str, FloatArray]:
        """By their names."""
        fields = {name: self.fields[..., part] for name, part in PARTS.items()}
        return {"unknowns": self.unknowns, **fields}


@dataclass(frozen=True, eq=False)
class NoiseFreeCase:
    """The end without noise.

    Parameters
    ----------
    row
        Of the table.
    """

    row: pd.Series

    @classmethod
    def of(cls, table: pd.DataFrame) -> NoiseFreeCase:
        """The case without noise; InputError if it failed."""
        found = table[(table["error"] == "") & (table["level"] == 0.0)]
        if not len(found):
            raise InputError("study: expected the case without noise to succeed, got none that did")
        return cls(found.iloc[0])

    @property
    def unknowns(self) -> FloatArray:
        """(n,) what all errors are told against."""
        return np.array(self.row["unknowns"])

    def told(self, cause: str) -> NoiseErrors:
        """Standard deviations for noise of 1 by one of the ``LADDER``."""
        flat = np.array(self.row["told"][COVARIANCES.index(cause)], dtype=np.float64)
        return NoiseErrors.of(flat, len(self.row["unknowns"]))

    def factors(self, cause: str) -> dict[str, FloatArray]:
        """How much larger than the bound they are: 1 where there is none."""
        found = {}
        for (name, sd), bound in zip(
            self.told(cause).parts().items(), self.told("bound").parts().values(), strict=True
        ):
            known = np.isfinite(bound) & (bound > 0.0)
            found[name] = np.divide(sd, bound, out=np.ones_like(bound), where=known)
        return found


def read_levels(table: pd.DataFrame, home: NoiseFreeCase, points: FieldPoints) -> Levels:
    """The errors of all realisations, and their bound 2 s²M⁻¹.

    Raises
    ------
    InputError
        If no level has two whole pairs.
    """
    noisy = table[(table["error"] == "") & (table["level"] > 0.0)]
    found = {}
    for level, part in noisy.groupby("level"):
        by_pair = [pair.sort_values("sign") for _, pair in part.groupby("pair") if len(pair) == 2]
        if len(by_pair) >= 2:
            found[float(level)] = _read_level(float(level), by_pair, home, points)
    if not found:
        raise InputError("study: expected two whole pairs of realisations at a level, got fewer")
    return found


def against_bound(levels: Levels, home: NoiseFreeCase, cause: str) -> Levels:
    """Set the same errors against another bound, and let error bars know of what it knows."""
    factors = home.factors(cause)
    return {
        level: {name: pairs.against(factors[name]) for name, pairs in parts.items()}
        for level, parts in levels.items()
    }


def _read_level(
    level: float, by_pair: list[pd.DataFrame], home: NoiseFreeCase, points: FieldPoints
) -> dict[str, PairedErrors]:
    def column(name: str) -> FloatArray:
        return np.array([[np.array(v, dtype=np.float64) for v in pair[name]] for pair in by_pair])

    true, a = home.unknowns, column("unknowns")
    fields = np.array([[points.fields(one) for one in pair] for pair in a]) - points.fields(true)
    errors, told = NoiseErrors(a - true, fields), NoiseErrors.of(column("told"), len(true))
    least = home.told("bound")
    least.fields[~points.cellular, PARTS["v1"]] = 0.0  # where phi1 fades out it does not count
    found = {}
    for name, off in errors.parts().items():
        bound = level * least.parts()[name]
        known = np.isfinite(bound)  # the others are not determined by the images
        found[name] = PairedErrors(
            np.where(known, off, 0.0), told.parts()[name], np.where(known, bound, 0.0)
        )
    return found
