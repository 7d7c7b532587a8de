"""The errors of a noise study's realisations, level by level, and what to set them against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.validation.studies.noise.causes import LADDER
from modeharvest.validation.studies.noise.fields import PARTS, Points
from modeharvest.validation.studies.noise.statistics import Pairs

FloatArray = NDArray[np.float64]
Levels = Mapping[float, Mapping[str, Pairs]]
"""For each level of noise, in order, the errors of the "unknowns" and of the fields."""


@dataclass(frozen=True, eq=False)
class Told:
    """Standard deviations, or errors.

    Parameters
    ----------
    unknowns
        (..., n), each in its own unit.
    fields
        (..., points, 7) [mm], see :data:`~modeharvest.validation.studies.noise.fields.PARTS`.
    """

    unknowns: FloatArray
    fields: FloatArray

    @classmethod
    def of(cls, flat: FloatArray, n: int) -> Told:
        """From (..., n + 7 points), as the cases store it."""
        fields = flat[..., n:]
        return cls(flat[..., :n], fields.reshape(*fields.shape[:-1], -1, 7))

    def parts(self) -> dict[str, FloatArray]:
        """By their names."""
        fields = {name: self.fields[..., part] for name, part in PARTS.items()}
        return {"unknowns": self.unknowns, **fields}


@dataclass(frozen=True, eq=False)
class WithoutNoise:
    """The end without noise.

    Parameters
    ----------
    row
        Of the table.
    """

    row: pd.Series

    @classmethod
    def of(cls, table: pd.DataFrame) -> WithoutNoise:
        """The case without noise; InputError if it failed."""
        found = table[(table["error"] == "") & (table["level"] == 0.0)]
        if not len(found):
            raise InputError("study: expected the case without noise to succeed, got none that did")
        return cls(found.iloc[0])

    @property
    def unknowns(self) -> FloatArray:
        """(n,) what all errors are told against."""
        return np.array(self.row["unknowns"])

    def told(self, cause: str) -> Told:
        """Standard deviations for noise of 1 by one of the ``LADDER``."""
        flat = np.array(self.row["told"][LADDER.index(cause)], dtype=np.float64)
        return Told.of(flat, len(self.row["unknowns"]))

    def factors(self, cause: str) -> dict[str, FloatArray]:
        """How much larger than the bound they are: 1 where there is none."""
        found = {}
        for (name, sd), bound in zip(
            self.told(cause).parts().items(), self.told("bound").parts().values(), strict=True
        ):
            known = np.isfinite(bound) & (bound > 0.0)
            found[name] = np.divide(sd, bound, out=np.ones_like(bound), where=known)
        return found


def read_levels(table: pd.DataFrame, home: WithoutNoise, points: Points) -> Levels:
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


def against(levels: Levels, home: WithoutNoise, cause: str) -> Levels:
    """Set the same errors against another bound, and let error bars know of what it knows."""
    factors = home.factors(cause)
    return {
        level: {name: pairs.against(factors[name]) for name, pairs in parts.items()}
        for level, parts in levels.items()
    }


def _read_level(
    level: float, by_pair: list[pd.DataFrame], home: WithoutNoise, points: Points
) -> dict[str, Pairs]:
    def column(name: str) -> FloatArray:
        return np.array([[np.array(v, dtype=np.float64) for v in pair[name]] for pair in by_pair])

    true, a = home.unknowns, column("unknowns")
    fields = np.array([[points.fields(one) for one in pair] for pair in a]) - points.fields(true)
    errors, told = Told(a - true, fields), Told.of(column("told"), len(true))
    least = home.told("bound")
    least.fields[~points.cellular, PARTS["v1"]] = 0.0  # where phi1 fades out it does not count
    found = {}
    for name, off in errors.parts().items():
        bound = level * least.parts()[name]
        known = np.isfinite(bound)  # the others are not determined by the images
        found[name] = Pairs(
            np.where(known, off, 0.0), told.parts()[name], np.where(known, bound, 0.0)
        )
    return found
