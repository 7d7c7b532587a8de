"""What a measurement's systematic error may depend on: one factor changed, all else as it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from modeharvest.errors import InputError
from modeharvest.idic.setup import Identification
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.validation.studies.subject import PAPERS_TAPER


@dataclass(frozen=True)
class Setting:
    """How a pair is imaged and correlated.

    Parameters
    ----------
    imaging, correlation
        As everywhere.
    taper
        Width over which the mode fades out [unit cells].

    Raises
    ------
    InputError
        If the taper has no width.
    """

    imaging: ImagingSpec
    correlation: Identification
    taper: float = PAPERS_TAPER

    def __post_init__(self) -> None:
        if not self.taper > 0.0:
            raise InputError(f"study: expected a taper wider than 0 unit cells, got {self.taper}")

    def imaged(self, **options: Any) -> Setting:
        """With other options of the imaging."""
        return replace(self, imaging=replace(self.imaging, **options))

    def speckled(self, **options: Any) -> Setting:
        """With another speckle."""
        return self.imaged(speckle=replace(self.imaging.speckle, **options))

    def sensed(self, **options: Any) -> Setting:
        """With another sensor."""
        return self.imaged(sensor=replace(self.imaging.sensor, **options))

    def correlated(self, **options: Any) -> Setting:
        """With other options of the correlation."""
        return replace(self, correlation=replace(self.correlation, **options))


@dataclass(frozen=True)
class Factor:
    """Something to change.

    Parameters
    ----------
    label
        What it is called, with its unit.
    levels
        What it is changed to unless a study says otherwise.
    change
        The setting with that level.
    base
        The level that a setting has; None where it has none (float images have no bits).
    whole
        Whether levels are whole numbers.
    names
        Of levels that are a choice and not a size: their numbers count these.
    """

    label: str
    levels: tuple[float, ...]
    change: Callable[[Setting, Any], Setting]
    base: Callable[[Setting], float | None]
    whole: bool = False
    names: tuple[str, ...] = ()

    @classmethod
    def choice(cls, label: str, option: str, names: tuple[str, ...]) -> Factor:
        """One of several names of an option of the correlation."""
        return cls(
            label,
            tuple(range(len(names))),
            lambda s, v: s.correlated(**{option: names[v]}),
            lambda s: _number(names, getattr(s.correlation, option)),
            whole=True,
            names=names,
        )

    def number(self, level: float | str) -> float:
        """A level as a number; InputError if there is no such name."""
        if isinstance(level, str):
            if level not in self.names:
                expected = f"one of {list(self.names)}" if self.names else "numbers"
                raise InputError(f"study: expected {expected} for {self.label}, got {level!r}")
            return self.names.index(level)
        return level

    def told(self, level: float) -> str:
        """A level in words."""
        return self.names[round(level)] if self.names else f"{level:g}"

    def set(self, setting: Setting, level: float) -> Setting:
        """Change a setting.

        Raises
        ------
        InputError
            If the level is out of the factor's range.
        """
        if self.names and level not in range(len(self.names)):
            raise InputError(
                f"study: expected one of {list(self.names)} for {self.label}, got {level:g}"
            )
        if self.whole and level != round(level):
            raise InputError(f"study: expected whole numbers for {self.label}, got {level:g}")
        return self.change(setting, round(level) if self.whole else level)


def _speckle_size(setting: Setting, factor: float) -> Setting:
    """Everything about the speckle that much larger, its blur included."""
    if not factor > 0.0:
        raise InputError(f"study: expected a speckle_size above 0 times the base's, got {factor}")
    speckle = setting.imaging.speckle
    return setting.speckled(
        standard_deviation=speckle.standard_deviation / factor, blur_px=speckle.blur_px * factor
    )


def _contrast(setting: Setting, contrast: float) -> Setting:
    """Grey levels about the same middle, seen by a camera: float images know no contrast."""
    speckle = setting.imaging.speckle
    middle = 0.5 * (speckle.dark + speckle.bright)
    middle = min(max(middle, 0.5 * contrast), 1.0 - 0.5 * contrast)
    changed = setting.speckled(dark=middle - 0.5 * contrast, bright=middle + 0.5 * contrast)
    return changed.correlated(camera=True)


def _camera(setting: Setting, level: float) -> float | None:
    """A level that only a camera's images have."""
    return level if setting.correlation.camera else None


def _number(names: tuple[str, ...], chosen: str | None) -> int | None:
    """Of a name; None for a choice that is left to the images."""
    return None if chosen is None else names.index(chosen)


FACTORS: dict[str, Factor] = {
    "order": Factor(
        "order of the spline [-]", (3, 5, 11), lambda s, v: s.correlated(order=v),
        lambda s: s.correlation.order, whole=True,
    ),
    "gradient": Factor.choice(
        "gradient that weighs the residual", "gradient", ("deformed", "reference")
    ),
    "speckle_size": Factor(
        "size of the speckle [times the base's]", (0.5, 0.7, 1.0, 1.4, 2.0), _speckle_size,
        lambda s: 1.0,
    ),
    "contrast": Factor(
        "contrast of camera images [fraction of full scale]", (0.05, 0.1, 0.2, 0.4, 0.8),
        _contrast,
        lambda s: _camera(s, s.imaging.speckle.bright - s.imaging.speckle.dark),
    ),
    "blur": Factor(
        "blur of the speckle [px]", (1.5, 2.0, 3.0, 4.0, 6.0), lambda s, v: s.speckled(blur_px=v),
        lambda s: s.imaging.speckle.blur_px,
    ),
    "bits": Factor(
        "bits of camera images [-]", (4, 6, 8, 10, 12),
        lambda s, v: s.imaged(bits=v).correlated(camera=True),
        lambda s: _camera(s, s.imaging.bits), whole=True,
    ),
    "fill_factor": Factor(
        "fill factor of the sensor [-]", (0.0, 0.25, 0.5, 0.75, 1.0),
        lambda s, v: s.sensed(fill_factor=v), lambda s: s.imaging.sensor.fill_factor,
    ),
    "pixel_size": Factor(
        "pixel [mm]", (0.01, 0.014, 0.02, 0.028, 0.04), lambda s, v: s.imaged(pixel_size=v),
        lambda s: s.imaging.pixel_size,
    ),
    "v0_degree": Factor(
        "degree of v0 [-]", (2, 3, 4, 5, 6, 7, 8), lambda s, v: s.correlated(v0_degree=v),
        lambda s: s.correlation.v0_degree, whole=True,
    ),
    "v_degree": Factor(
        "degree of v1 [-]", (2, 3, 4, 5, 6, 7, 8), lambda s, v: s.correlated(v_degree=v),
        lambda s: s.correlation.v_degree, whole=True,
    ),
    "taper": Factor(
        "width of the mode's taper [unit cells]", (0.125, 0.25, 0.5, 0.75, 1.0),
        lambda s, v: replace(s, taper=v), lambda s: s.taper,
    ),
    "edge_px": Factor(
        "pixels left out at edges [px]", (0, 1, 2, 3, 5, 8), lambda s, v: s.correlated(edge_px=v),
        lambda s: s.correlation.edge_px, whole=True,
    ),
}  # fmt: skip
"""By the names that a study uses."""
