"""What each degree shows and costs: finest periods, noise floors, indicators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.speckle import Speckle
from modeharvest.validation.resolution.curves import AXES, WAVED, Curves
from modeharvest.validation.resolution.measure import Subject
from modeharvest.validation.resolution.transfer import finest_period, subset_noise, subset_transfer

FloatArray = NDArray[np.float64]

QUANTITIES = ("v0", "v1", "v1phi1", "u")
FLOOR_OF = {"v0": "v0", "v1": "v1phi1"}
"""Whose noise counts against the waves of a part."""
_SUBSET_PX = 33
"""A subset whose indicator stands for all: theory gives nearly the same for every size."""


@dataclass(frozen=True)
class Degree:
    """A degree of v0 and v1, and what it costs.

    Parameters
    ----------
    degree, unknowns
        Of the ansatz.
    finest_px
        l10 of waves by part and axis, as "v0 x" [px].
    floor_px
        n by quantity, :data:`QUANTITIES`, by 2 s^2 M^-1 of the buckled images [px].
    indicator_px2
        n l10 by part; l10 is the geometric mean of both axes' [px^2].
    held_px2
        That of v1 phi1 without motion, its phi1 held [px^2].
    """

    degree: int
    unknowns: int
    finest_px: Mapping[str, float]
    floor_px: Mapping[str, float]
    indicator_px2: Mapping[str, float]
    held_px2: float


def degrees_of(done: pd.DataFrame, subject: Subject, curves: Curves) -> list[Degree]:
    """Every degree whose floor is known."""
    floors = done[done["task"] == "floor"]
    buckled = floors[floors["motion"] == "buckled"].sort_values("degree")
    still = floors[floors["motion"] == "still"].set_index("degree")
    if not len(buckled):
        raise InputError("study: expected the noise floor of a degree at least, got none")
    return [
        _degree(row, still["v1phi1"].get(row["degree"], np.nan), subject, curves)
        for _, row in buckled.iterrows()
    ]


def _degree(row: pd.Series, held: float, subject: Subject, curves: Curves) -> Degree:
    """One of them; ``held`` is the floor of v1 phi1 without motion [px]."""
    degree, px = int(row["degree"]), subject.buckled.pixel_size
    finest = {
        f"{part} {name}": curves.finest(part, axis, degree) / px
        for part in WAVED
        for axis, name in enumerate(AXES)
    }
    mean = {part: float(np.sqrt(finest[f"{part} x"] * finest[f"{part} y"])) for part in WAVED}
    floor = {name: float(row[name]) for name in QUANTITIES}
    indicator = {part: floor[FLOOR_OF[part]] * mean[part] for part in WAVED}
    unknowns = int(row["unknowns"])
    return Degree(degree, unknowns, finest, floor, indicator, float(held) * mean["v1"])


def subset_indicator(subject: Subject) -> float:
    """n l10 of an affine subset on the same speckle under the same noise, by theory [px^2]."""
    grid = subject.buckled.grid
    speckle = Speckle(subject.buckled.speckle, grid.shape)
    row, col = np.meshgrid(np.arange(0.0, grid.rows, 7), np.arange(0.0, grid.cols, 7))
    slope = float(np.sqrt(np.mean(speckle.gradient(row, col) ** 2)))
    floor = np.sqrt(2.0) * subject.noise / slope * subset_noise(_SUBSET_PX, 1)
    finest = finest_period(lambda p: subset_transfer(_SUBSET_PX, 1, p), 10.0, 1000.0)
    return float(floor * finest)
