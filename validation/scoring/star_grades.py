"""Grades on the star: attenuation, noise floor, and the metrological efficiency indicator.

At every column, the returned displacements are fitted to the true ones by least squares through the
origin. The slope is the transfer T, the measured share of the wave. Along the centre row alone, it
is the measured over the true amplitude, as in the DIC Challenge; other rows, up to half a period
away, reduce its noise. Over the columns, T is smoothed by local quadratic regression in the
logarithm of the period. The standard error of a smoothed value follows from the columns' scatter
about the curve and its autocorrelation between neighbours.

    l10    the period at which 10 % of the amplitude is lost [px]
    n      standard deviation of v between two images without motion [px]
    n l10  the indicator [px^2]; lower is better

A larger subset edge w raises l10 as w and lowers n as 1/w, so the indicator rates a code and its
shape functions rather than the choice of w. Sources: M. Grédiac, B. Blaysat, F. Sur, Exp. Mech.
57 (2017) 871, doi 10.1007/s11340-017-0279-x; P. L. Reu et al., doi 10.1007/s11340-021-00806-6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from scipy import ndimage

from modeharvest.idic.local.field import LocalField
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.typed import headings, quantity, to_plain
from modeharvest.validation.scoring.star import KEPT, Star, StarSet

RESOLUTION_FORMAT = "modeharvest-resolution-1"
_WIDTH = 0.35
"""Half width of the local regression, in the logarithm of the period."""
_FEWEST_COLUMNS = 20
"""Least number of columns in a local regression, and of a field to be graded."""
_POINTS = 240
"""Number of periods of the curve."""
_SPAN = 3.0
"""Least ratio of the longest to the shortest period that a field must cover."""
_NO_MORE = 0.05
"""The sum of autocorrelations ends where they fall below this."""
_CHALLENGE_DEGREE = 12
"""Degree of the polynomial with which the DIC Challenge smooths its centre row."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Transfer T at every column of a field, (m,) each, by ascending period."""

    period: FloatArray
    """Period of the wave at the column [px]."""
    share: FloatArray
    """T [-]."""
    weight: FloatArray
    """Sum of the squared true displacements from which T is computed [px^2]."""

    @classmethod
    def of(cls, star: Star, field: LocalField, rows: BoolArray) -> Columns:
        """From a field's valid points (in px, on the star's grid) where ``rows`` (n,) is True."""
        used = field.good & rows
        x, y, v = field.x[used], field.y[used], field.u[used, 1]
        true = star.displacement(x, y)[:, 1]
        column, at = np.unique(np.rint(x).astype(int), return_inverse=True)
        both, square = (
            np.asarray(np.bincount(at, values), np.float64) for values in (v * true, true * true)
        )
        enough = square > 0.25 * star.amplitude_px**2
        period = star.period(column[enough])
        return cls(period, both[enough] / square[enough], square[enough])


@dataclass(frozen=True, eq=False)
class Attenuation:
    """A field's transfer T over the period."""

    columns: Columns
    """T from all rows within half a period of the centre."""
    centre: Columns
    """T from the centre row alone, or from the nearest row."""

    @classmethod
    def of(cls, star: Star, field: LocalField) -> Attenuation:
        """From a field in px on the star's grid; InputError with few columns or without wave."""
        with np.errstate(invalid="ignore"):
            inside = (field.x >= -0.5) & (field.x <= star.cols - 0.5)
            near = inside & (np.abs(field.y) <= 0.5 * star.period(field.x))
            row = np.abs(field.y).min(where=field.good, initial=np.inf)
            middle = inside & (np.abs(field.y) <= row + 0.5)
        columns = Columns.of(star, field, near)
        _require_star(columns, star, field)
        return cls(columns, Columns.of(star, field, middle))

    @cached_property
    def period(self) -> FloatArray:
        """(n,) periods of the curve [px]."""
        first, last = self.columns.period[[0, -1]]
        return np.asarray(np.geomspace(first, last, _POINTS))

    @cached_property
    def curve(self) -> tuple[FloatArray, FloatArray]:
        """(n,) smoothed T and its standard error [-] at ``period``; NaN with too few columns."""
        return _smoothed(self.columns, self.period)

    @cached_property
    def finest_px(self) -> float:
        """l10: the shortest period at which T rises through 0.9 [px]; NaN if it never does."""
        return first_rise(self.period, self.curve[0])

    @cached_property
    def finest_se_px(self) -> float:
        """Standard error of :attr:`finest_px` [px]."""
        share, error = self.curve
        slope = np.gradient(share, self.period)
        known = np.isfinite(slope) & np.isfinite(error)
        if not np.isfinite(self.finest_px):
            return float("nan")
        at = [np.interp(self.finest_px, self.period[known], a[known]) for a in (error, slope)]
        return float(at[0] / abs(at[1]))

    @cached_property
    def safe_px(self) -> float:
        """The period above which T stays above 0.9 [px]; NaN if there is none."""
        period, share = self._known
        below = np.flatnonzero(share < KEPT)
        if not len(below) or below[-1] == len(share) - 1:
            return float("nan")
        return first_rise(period[below[-1] :], share[below[-1] :])

    @cached_property
    def challenge_px(self) -> float:
        """l10 as in the DIC Challenge [px]: where a polynomial of degree 12 fitted to T is 0.9.

        T is from the centre row. NaN if it doesn't reach 0.9, or the row has too few points.
        """
        at, share = self.centre.period, self.centre.share
        if len(at) <= 4 * _CHALLENGE_DEGREE:
            return float("nan")
        fit = np.polynomial.Chebyshev.fit(at, share, _CHALLENGE_DEGREE)
        period = np.linspace(at[0], at[-1], 20 * _POINTS)
        return first_rise(period, np.asarray(fit(period), dtype=np.float64))

    @cached_property
    def ripple(self) -> float:
        """Rms deviation of the centre row's T from the curve above l10 [-]: noise and PIB."""
        expected = np.interp(self.centre.period, self.period, self.curve[0])
        long = self.centre.period > np.nan_to_num(self.finest_px, nan=0.0)
        left = (self.centre.share - expected)[long]
        return float(np.sqrt(np.nanmean(left**2))) if len(left) else float("nan")

    def at(self, period: float) -> float:
        """Smoothed T at a period [px]; NaN outside."""
        return float(np.interp(period, *self._known, np.nan, np.nan))

    @property
    def _known(self) -> tuple[FloatArray, FloatArray]:
        """Periods and T where there are enough columns."""
        known = np.isfinite(self.curve[0])
        return self.period[known], self.curve[0][known]


def first_rise(period: FloatArray, share: FloatArray) -> float:
    """The first period at which a piecewise linear curve rises through 0.9; NaN if none."""
    known = np.isfinite(share)
    p, t = period[known], share[known]
    rises = np.flatnonzero((t[:-1] < KEPT) & (t[1:] >= KEPT))
    if not len(rises):
        return float("nan")
    k = rises[0]
    return float(p[k] + (KEPT - t[k]) * (p[k + 1] - p[k]) / (t[k + 1] - t[k]))


def _smoothed(columns: Columns, period: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Local quadratic regression of T in ln(period), and its standard errors."""
    at = np.log(columns.period)
    rows = np.array([_regression(at - t, columns.weight) for t in np.log(period)])
    share = rows @ columns.share
    known = np.isfinite(share)
    left = columns.share - np.interp(columns.period, period[known], share[known])
    return np.asarray(share), np.sqrt(_memory(left) * (rows**2 @ left**2))


def _regression(offset: FloatArray, weight: FloatArray) -> FloatArray:
    """(m,) weight of each column in the fitted value at offset 0; NaN with too few columns."""
    near = np.clip(1.0 - np.abs(offset / _WIDTH) ** 3, 0.0, None) ** 3 * weight
    if np.count_nonzero(near) < _FEWEST_COLUMNS:
        return np.full(offset.shape, np.nan)
    basis = np.vander(offset / _WIDTH, 3, increasing=True)
    weighted = basis * near[:, None]
    return np.asarray(weighted @ np.linalg.pinv(basis.T @ weighted, hermitian=True)[0])


def _memory(left: FloatArray) -> float:
    """Correlation length of neighbouring columns [columns]: 1 + 2 sum of autocorrelations."""
    size = np.sqrt(ndimage.uniform_filter1d(left**2, max(3, len(left) // 10)))
    z = left / np.maximum(size, np.finfo(float).tiny)
    lags = len(z) // 10
    rho = np.array([np.mean(z[: len(z) - k] * z[k:]) for k in range(lags + 1)]) / np.mean(z**2)
    ends = np.flatnonzero(rho < _NO_MORE)
    return float(1.0 + 2.0 * rho[1 : ends[0] if len(ends) else None].sum())


def _require_star(columns: Columns, star: Star, field: LocalField) -> None:
    """Raise InputError unless the field covers enough periods and shows the longest ones."""
    if len(columns.period) < _FEWEST_COLUMNS:
        raise InputError(
            f"{field.source}: expected displacements at {_FEWEST_COLUMNS} columns or more within "
            f"half a period of the centre row {star.centre_row}, got {len(columns.period)}; "
            "measure about the centre row, all along the image"
        )
    first, last = columns.period[[0, -1]]
    if last < _SPAN * first:
        raise InputError(
            f"{field.source}: expected columns over periods from {star.shortest_px:g} to "
            f"{star.longest_px:g} px, got {first:.4g} to {last:.4g} px only; measure all along "
            "the image"
        )
    long = columns.period >= np.sqrt(first * last)
    share = float(np.average(columns.share[long], weights=columns.weight[long]))
    if 0.5 < share < 1.5:
        return
    u, v = (float(np.sqrt(np.mean(field.u[field.good, c] ** 2))) for c in (0, 1))
    why = "is it the field without motion, or of other images?"
    if -1.5 < share < -0.5:
        why = "v has the other sign: y_axis up or down?"
    elif u > 3.0 * v:
        why = "u and v look exchanged"
    elif not 0.1 < abs(share) < 10.0 and v > 0.0:
        why += " Or are displacements in another unit than px?"
    raise InputError(
        f"{field.source}: expected the star's wave of {star.amplitude_px:g} px along y, got "
        f"{share:.3g} times it at periods above {columns.period[long][0]:.3g} px; {why}"
    )


@dataclass(frozen=True, eq=False)
class StarGrading:
    """Codes graded on a star set."""

    star_set: StarSet
    grades: tuple[StarGrade, ...]
    """Grades, the best first."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Reasons why other codes were not graded."""

    @property
    def notes(self) -> list[str]:
        """Notes for the reader: refused codes, and the notes of each grade."""
        refused = [f"not graded: {why}" for why in self.refused.values()]
        return [*refused, *(note for grade in self.grades for note in grade.notes)]


@dataclass(frozen=True)
class GradeNumbers:
    """A code's grade in numbers, most with a heading of the table's column; NaN if unknown."""

    name: str
    safe_px: float
    """Period above which less than 10 % is lost throughout [px]."""
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
        """All numbers of a code's grade."""
        found, noise = grade.attenuation, grade.noise
        shortest, longest = (float(period) for period in found.period[[0, -1]])
        return cls(
            grade.name, found.safe_px, shortest, longest, found.finest_px, found.finest_se_px,
            np.nan if noise is None else noise.v_px, np.nan if noise is None else noise.v_se_px,
            grade.indicator_px2, grade.indicator_se_px2, found.challenge_px, 100.0 * found.ripple,
            100.0 * found.at(longest), grade.moved.x.size, 100.0 * grade.moved.valid_share,
        )  # fmt: skip


GRADE_COLUMNS = headings(GradeNumbers)
"""Headings of the table's columns, by the names of the numbers."""


def grade_numbers(grade: StarGrade) -> dict[str, Any]:
    """A code's grade as plain values, with units in the names; None if unknown."""
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
"""Number of image sections; their scatter gives the standard error of the noise floor."""
_FEWEST_POINTS = 100
_TOO_LOUD = 0.7
"""Scatter of the field without motion, relative to the star's, above which it isn't noise."""


@dataclass(frozen=True)
class NoiseFloor:
    """Statistics of the displacement measured without motion."""

    v_px: float
    u_px: float
    """Standard deviations along y and x [px]."""
    v_se_px: float
    """Standard error of ``v_px``, from the scatter between sections of the image [px]."""
    mean_px: tuple[float, float]
    """Mean displacement (u, v) along x and y (up) [px]."""
    points: int
    returned: float
    """Share of the points with a displacement [-]."""

    @classmethod
    def of(cls, star: Star, still: LocalField) -> NoiseFloor:
        """From a field in px on the star's grid; InputError with few points, or with motion."""
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
    """Fields measured with and without motion, in px on the star's grid; ``still`` is None if not
    measured."""
    attenuation: Attenuation = field(init=False)
    noise: NoiseFloor | None = field(init=False)

    def __post_init__(self) -> None:
        noise = None if self.still is None else NoiseFloor.of(self.star, self.still)
        object.__setattr__(self, "attenuation", Attenuation.of(self.star, self.moved))
        object.__setattr__(self, "noise", noise)

    @property
    def name(self) -> str:
        """Name of the code."""
        return self.moved.source

    @property
    def indicator_px2(self) -> float:
        """n l10 [px^2]; NaN if n or l10 is unknown."""
        noise = float("nan") if self.noise is None else self.noise.v_px
        return noise * self.attenuation.finest_px

    @property
    def indicator_se_px2(self) -> float:
        """Standard error of ``indicator_px2`` [px^2]."""
        if self.noise is None or not self.noise.v_px > 0.0:
            return float("nan")
        found, noise = self.attenuation, self.noise
        relative = np.hypot(noise.v_se_px / noise.v_px, found.finest_se_px / found.finest_px)
        return float(relative * self.indicator_px2)

    @cached_property
    def error_px(self) -> FloatArray:
        """(n, 2) returned minus true displacement at the points of ``moved`` [px]; NaN if lost."""
        error = self.moved.u - self.star.displacement(self.moved.x, self.moved.y)
        return np.where(self.moved.good[:, None], error, np.nan)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader about this grade."""
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
    """The grades by ascending indicator, then those without one by ascending l10."""
    numbers = attrgetter("indicator_px2", "attenuation.finest_px")
    return sorted(grades, key=lambda grade: tuple(np.nan_to_num(numbers(grade), nan=np.inf)))
