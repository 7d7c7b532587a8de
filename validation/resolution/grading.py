"""Codes graded on the star: finest period, noise floor, metrological efficiency indicator.

    l10    the period at which 10 % of the amplitude are lost [px]
    n      standard deviation of v between two images without motion [px]
    n l10  the indicator [px^2]; the less, the better

A larger subset raises l10 as its edge w and lowers n as 1/w, so that the indicator tells a code and
its shape functions rather than the choice of w. Sources: M. Grédiac, B. Blaysat, F. Sur, Exp. Mech.
57 (2017) 871, doi 10.1007/s11340-017-0279-x; P. L. Reu et al., doi 10.1007/s11340-021-00806-6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.validation.resolution.attenuation import Attenuation
from modeharvest.validation.resolution.star import Star
from modeharvest.validation.resolution.transfer import KEPT

FloatArray = NDArray[np.float64]

_PARTS = 10
"""Stretches of the image whose scatters tell how sure the noise floor is."""
_FEWEST_POINTS = 100
_TOO_LOUD = 0.7
"""A scatter of the field without motion above this share of the star's is no noise."""


@dataclass(frozen=True)
class NoiseFloor:
    """What is measured where nothing moves.

    Parameters
    ----------
    v_px, u_px
        Standard deviations along y and x [px].
    v_se_px
        Standard error of ``v_px`` [px], from the scatter between stretches of the image.
    mean_px
        (u, v) mean along x and y up [px].
    points, returned
        Points of the field, and the share of them with a displacement [-].
    """

    v_px: float
    u_px: float
    v_se_px: float
    mean_px: tuple[float, float]
    points: int
    returned: float

    @classmethod
    def of(cls, star: Star, still: LocalField) -> NoiseFloor:
        """From a field without motion, in px on the star's grid.

        Raises
        ------
        InputError
            If there are few points, or something moves.
        """
        x, _, u = still.valid_points()
        if len(x) < _FEWEST_POINTS:
            raise InputError(
                f"{still.source}: expected {_FEWEST_POINTS} points or more without motion, got "
                f"{len(x)}"
            )
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
        return cls(
            v_px=float(sd[1]),
            u_px=float(sd[0]),
            v_se_px=float(variance_se / (2.0 * sd[1])) if sd[1] > 0.0 else 0.0,
            mean_px=(float(mean[0]), float(mean[1])),
            points=still.x.size,
            returned=still.valid_share,
        )


@dataclass(frozen=True, eq=False)
class StarGrade:
    """A code's grade.

    Parameters
    ----------
    star
        The wave.
    moved
        The field of the deformed image, in px on the star's grid.
    still
        The field without motion; None if there is none.
    """

    star: Star
    moved: LocalField
    still: LocalField | None = None
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
        found = self.attenuation
        relative = np.hypot(
            self.noise.v_se_px / self.noise.v_px, found.finest_se_px / found.finest_px
        )
        return float(relative * self.indicator_px2)

    @cached_property
    def error_px(self) -> FloatArray:
        """(n, 2) returned less true displacement at the points of ``moved`` [px]; NaN if lost."""
        error = self.moved.u - self.star.displacement(self.moved.x, self.moved.y)
        return np.where(self.moved.good[:, None], error, np.nan)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader has to know, in sentences."""
        found, said = self.attenuation, []
        low, high = found.columns.period[[0, -1]]
        if not np.isfinite(found.finest_px):
            above = np.nanmin(found.curve[0]) >= KEPT
            share = "less than 10 %" if above else "10 % or more"
            said.append(
                f"{self.name}: {share} of the amplitude is lost at all periods measured, "
                f"{low:.4g} to {high:.4g} px, so that l10 is not known; nothing is extrapolated"
            )
        elif not np.isclose(found.safe_px, found.finest_px):
            said.append(
                f"{self.name}: beyond {found.finest_px:.4g} px more than 10 % are lost again; only "
                + (f"from {found.safe_px:.4g} px on less is" if np.isfinite(found.safe_px)
                   else "at no longer period is it less for good")
            )  # fmt: skip
        if self.still is None:
            said.append(f"{self.name}: no field without motion was given, so n is not known")
        lost = self.moved.lost
        if lost:
            said.append(f"{self.name}: {lost} of {self.moved.x.size} points were not measured")
        return tuple(said)


def ranked(grades: Sequence[StarGrade]) -> list[StarGrade]:
    """The best first: by the indicator; then those without one, by l10."""

    def key(grade: StarGrade) -> tuple[float, float]:
        return (
            np.nan_to_num(grade.indicator_px2, nan=np.inf),
            np.nan_to_num(grade.attenuation.finest_px, nan=np.inf),
        )

    return sorted(grades, key=key)
