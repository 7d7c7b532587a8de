"""Grades on the star: finest period, noise floor, metrological efficiency indicator.

    l10    the period at which 10 % of the amplitude are lost [px]
    n      standard deviation of v between two images without motion [px]
    n l10  the indicator [px^2]; the less, the better

A larger subset raises l10 as its edge w and lowers n as 1/w, so that the indicator rates a code and
its shape functions rather than the choice of w. Sources: M. Grédiac, B. Blaysat, F. Sur, Exp. Mech.
57 (2017) 871, doi 10.1007/s11340-017-0279-x; P. L. Reu et al., doi 10.1007/s11340-021-00806-6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from modeharvest.idic.local.field import LocalField
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.typed import headings, quantity, to_plain
from modeharvest.validation.scoring.attenuation import Attenuation
from modeharvest.validation.scoring.star import KEPT, Star, StarSet

RESOLUTION_FORMAT = "modeharvest-resolution-1"


@dataclass(frozen=True, eq=False)
class StarGrading:
    """Codes graded on a star set."""

    star_set: StarSet
    grades: tuple[StarGrade, ...]
    """The best first."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Why other codes were not graded."""

    @property
    def notes(self) -> list[str]:
        """What a reader has to know."""
        refused = [f"not graded: {why}" for why in self.refused.values()]
        return [*refused, *(note for grade in self.grades for note in grade.notes)]


@dataclass(frozen=True)
class GradeNumbers:
    """A code's grade in numbers, most with what heads the table's columns; NaN where not known."""

    name: str
    safe_px: float
    """Period from which on less than 10 % are lost for good [px]."""
    shortest_px: float
    longest_px: float
    """The shortest and the longest period measured [px]."""
    finest_px: float = quantity("l10", "px")
    finest_se_px: float = quantity("± l10", "px")
    noise_px: float = quantity("n", "px")
    noise_se_px: float = quantity("± n", "px")
    indicator_px2: float = quantity("n l10", "px²")
    indicator_se_px2: float = quantity("± n l10", "px²")
    challenge_px: float = quantity("l10, centre row", "px")
    ripple_percent: float = quantity("ripple", "%")
    left_percent: float = quantity("left at the longest", "%")
    points: int = quantity("points")
    returned_percent: float = quantity("returned", "%")

    @classmethod
    def of(cls, grade: StarGrade) -> GradeNumbers:
        """All that is known of a code."""
        found, noise = grade.attenuation, grade.noise
        shortest, longest = (float(period) for period in found.period[[0, -1]])
        return cls(
            grade.name, found.safe_px, shortest, longest, found.finest_px, found.finest_se_px,
            np.nan if noise is None else noise.v_px, np.nan if noise is None else noise.v_se_px,
            grade.indicator_px2, grade.indicator_se_px2, found.challenge_px, 100.0 * found.ripple,
            100.0 * found.at(longest), grade.moved.x.size, 100.0 * grade.moved.valid_share,
        )  # fmt: skip


GRADE_COLUMNS = headings(GradeNumbers)
"""Of the table, by the names of the numbers."""


def grade_numbers(grade: StarGrade) -> dict[str, Any]:
    """A code's grade as plain values, units in the names; None where not known."""
    return dict(to_plain(GradeNumbers.of(grade)))


def star_summary(grading: StarGrading) -> dict[str, Any]:
    """The content of ``resolution.json``: codes, the best first, and their curves."""
    codes = []
    for grade in grading.grades:
        found = grade.attenuation
        share, error = found.curve
        curve = {"period_px": found.period, "left": share, "standard_error": error}
        codes.append({**grade_numbers(grade), **to_plain({"noise": grade.noise, "curve": curve})})
    star_set = grading.star_set
    return {"format": RESOLUTION_FORMAT, "benchmark": star_set.id, "spec": star_set.info["spec"],
            "codes": codes, "remarks": grading.notes}  # fmt: skip


def star_csv_lines(grades: Sequence[StarGrade]) -> Iterator[str]:
    """The table as CSV."""
    yield ",".join(["name", *GRADE_COLUMNS.values()])
    for grade in grades:
        row = grade_numbers(grade)
        values = [row[key] for key in GRADE_COLUMNS]
        cells = ["" if v is None else f"{v:.6g}" for v in values]
        yield ",".join([f'"{grade.name}"', *cells])


_PARTS = 10
"""Stretches of the image whose scatters give the standard error of the noise floor."""
_FEWEST_POINTS = 100
_TOO_LOUD = 0.7
"""A scatter of the field without motion above this share of the star's is no noise."""


@dataclass(frozen=True)
class NoiseFloor:
    """What is measured where nothing moves."""

    v_px: float
    u_px: float
    """Standard deviations along y and x [px]."""
    v_se_px: float
    """Standard error of ``v_px``, from the scatter between stretches of the image [px]."""
    mean_px: tuple[float, float]
    """(u, v) along x and y up [px]."""
    points: int
    returned: float
    """Share of the points with a displacement [-]."""

    @classmethod
    def of(cls, star: Star, still: LocalField) -> NoiseFloor:
        """Of a field in px on the star's grid; InputError if points are few, or something moves."""
        x, _, u = still.valid_points()
        if len(x) < _FEWEST_POINTS:
            few = f"{_FEWEST_POINTS} points or more without motion, got {len(x)}"
            raise InputError(f"{still.source}: expected {few}")
        sd = u.std(axis=0)
        if sd[1] > _TOO_LOUD * star.amplitude_px / np.sqrt(2.0):
            raise InputError(
                f"{still.source}: expected the field of two images without motion, got a standard "
                f"deviation of {sd[1]:.3g} px; is it the star's, or in another unit than px?"
            )
        mean = u.mean(axis=0)
        squares = (u[:, 1] - mean[1]) ** 2
        by_part = [part.mean() for part in np.array_split(squares[np.argsort(x)], _PARTS)]
        variance_se = np.std(by_part, ddof=1) / np.sqrt(_PARTS)
        v_se = float(variance_se / (2.0 * sd[1])) if sd[1] > 0.0 else 0.0
        mean_px = float(mean[0]), float(mean[1])
        return cls(float(sd[1]), float(sd[0]), v_se, mean_px, still.x.size, still.valid_share)


@dataclass(frozen=True, eq=False)
class StarGrade:
    """A code's grade."""

    star: Star
    moved: LocalField
    still: LocalField | None = None
    """Fields of the deformed image and without motion, in px on the star's grid; None if there is
    none."""
    attenuation: Attenuation = field(init=False)
    noise: NoiseFloor | None = field(init=False)

    def __post_init__(self) -> None:
        noise = None if self.still is None else NoiseFloor.of(self.star, self.still)
        object.__setattr__(self, "attenuation", Attenuation.of(self.star, self.moved))
        object.__setattr__(self, "noise", noise)

    @property
    def name(self) -> str:
        """Of the code."""
        return self.moved.source

    @property
    def indicator_px2(self) -> float:
        """n l10 [px^2]; NaN if one of them isn't known."""
        noise = float("nan") if self.noise is None else self.noise.v_px
        return noise * self.attenuation.finest_px

    @property
    def indicator_se_px2(self) -> float:
        """Its standard error [px^2]."""
        if self.noise is None or not self.noise.v_px > 0.0:
            return float("nan")
        found, noise = self.attenuation, self.noise
        relative = np.hypot(noise.v_se_px / noise.v_px, found.finest_se_px / found.finest_px)
        return float(relative * self.indicator_px2)

    @cached_property
    def error_px(self) -> FloatArray:
        """(n, 2) returned less true displacement at the points of ``moved`` [px]; NaN if lost."""
        error = self.moved.u - self.star.displacement(self.moved.x, self.moved.y)
        return np.where(self.moved.good[:, None], error, np.nan)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader has to know."""
        found, notes = self.attenuation, []
        low, high = found.columns.period[[0, -1]]
        if not np.isfinite(found.finest_px):
            above = np.nanmin(found.curve[0]) >= KEPT
            share = "less than 10 %" if above else "10 % or more"
            notes.append(
                f"{self.name}: {share} of the amplitude is lost at all periods measured, "
                f"{low:.4g} to {high:.4g} px, so that l10 is not known; nothing is extrapolated"
            )
        elif not np.isclose(found.safe_px, found.finest_px):
            notes.append(
                f"{self.name}: beyond {found.finest_px:.4g} px more than 10 % are lost again; only "
                + (f"from {found.safe_px:.4g} px on less is" if np.isfinite(found.safe_px)
                   else "at no longer period is it less for good")
            )  # fmt: skip
        if self.still is None:
            notes.append(f"{self.name}: no field without motion was given, so n is not known")
        if self.moved.lost:
            size = self.moved.x.size
            notes.append(f"{self.name}: {self.moved.lost} of {size} points were not measured")
        return tuple(notes)


def ranked_grades(grades: Sequence[StarGrade]) -> list[StarGrade]:
    """The best first: by the indicator; then those without one, by l10."""

    def key(grade: StarGrade) -> tuple[float, ...]:
        return tuple(np.nan_to_num([grade.indicator_px2, grade.attenuation.finest_px], nan=np.inf))

    return sorted(grades, key=key)
