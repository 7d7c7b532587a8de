"""Systematic errors without noise: one option of the images or of the correlation at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import pandas as pd

from modeharvest.idic.result import Result
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.study import (
    ImagePairSpec,
    Study,
    StudySetting,
    VirtualImagePair,
    outcome_of,
)
from modeharvest.validation.workers import Case, Cases, Row

T = TypeVar("T")
_DEGREES = (2, 3, 4, 5, 6, 7, 8)


def changed(thing: T, options: str, **values: Any) -> T:
    """Replace values in the dataclass at a dotted path of nested dataclasses; "": ``thing``."""
    name, _, rest = options.partition(".")
    if name:
        values = {name: changed(getattr(thing, name), rest, **values)}
    other: T = replace(thing, **values)  # type: ignore[type-var]
    return other


@dataclass(frozen=True)
class VariedFactor:
    """An option of imaging or correlation that a study varies."""

    label: str
    """Name with unit."""
    levels: tuple[float, ...]
    """Default levels; for a choice, the indices of its
    ``names``."""
    change: Callable[[StudySetting, Any], StudySetting]
    """Returns the setting with a given level."""
    level_of: Callable[[StudySetting], float | None]
    """Returns the level of a setting, None if it has none."""
    whole: bool = False
    """Whether levels are whole numbers."""
    by_camera: bool = False
    """Whether only camera images have a level: float images have no bit depth, for example."""
    names: tuple[str, ...] = ()

    @classmethod
    def option(cls, label: str, path: str, levels: tuple[float, ...], **kind: Any) -> Self:
        """A factor, shown as ``label``, for the option at a dotted path of a :class:`StudySetting`.

        ``levels``: values of the option; ``kind``: further fields of the factor.
        """
        at, _, name = path.rpartition(".")
        value = attrgetter(path)
        return cls(label, levels, lambda s, v: changed(s, at, **{name: v}), value, **kind)

    @classmethod
    def choice(cls, label: str, option: str, names: tuple[str, ...]) -> VariedFactor:
        """A factor whose levels are names of a correlation option; no level if left automatic."""
        numbers = {name: number for number, name in enumerate(names)}
        return cls(
            label, tuple(numbers.values()),
            lambda s, v: changed(s, "correlation", **{option: names[v]}),
            lambda s: numbers.get(getattr(s.correlation, option)), whole=True, names=names,
        )  # fmt: skip

    def number(self, level: float | str) -> float:
        """A level as a number; InputError if the factor has no such level."""
        by_name = isinstance(level, str)
        known = self.names if by_name else range(len(self.names))
        if (by_name or self.names) and level not in known:
            expected = f"one of {list(self.names)}" if self.names else "numbers"
            raise InputError(f"study: expected {expected} for {self.label}, got {level!r}")
        number = self.names.index(level) if isinstance(level, str) else level
        if self.whole and number != round(number):
            raise InputError(f"study: expected whole numbers for {self.label}, got {number:g}")
        return number

    def label_of(self, level: float) -> str:
        """Text for a level."""
        return self.names[round(level)] if self.names else f"{level:g}"

    def set(self, setting: StudySetting, level: float | str) -> StudySetting:
        """The setting with this level; InputError if it is out of the factor's range."""
        number = self.number(level)
        other = self.change(setting, round(number) if self.whole else float(number))
        return changed(other, "correlation", camera=True) if self.by_camera else other

    def base(self, setting: StudySetting) -> float | None:
        """The level of the images that a setting correlates; None if they have none."""
        if self.by_camera and not setting.correlation.camera:
            return None
        return self.level_of(setting)


def _speckle_size(setting: StudySetting, factor: float) -> StudySetting:
    """The setting with a speckle coarser by ``factor``, including its blur."""
    if not factor > 0.0:
        raise InputError(f"study: expected a speckle_size above 0 times the base's, got {factor}")
    speckle = setting.imaging.speckle
    sizes = {"standard_deviation": speckle.standard_deviation / factor,
             "blur_px": speckle.blur_px * factor}  # fmt: skip
    return changed(setting, "imaging.speckle", **sizes)


def _contrast(setting: StudySetting, contrast: float) -> StudySetting:
    """The setting with another contrast, about the same mean grey level."""
    speckle = setting.imaging.speckle
    middle = 0.5 * (speckle.dark + speckle.bright)
    middle = min(max(middle, 0.5 * contrast), 1.0 - 0.5 * contrast)
    dark, bright = middle - 0.5 * contrast, middle + 0.5 * contrast
    return changed(setting, "imaging.speckle", dark=dark, bright=bright)


_option, _choice = VariedFactor.option, VariedFactor.choice
FACTORS: dict[str, VariedFactor] = {
    "order": _option("order of the spline [-]", "correlation.order", (3, 5, 11), whole=True),
    "gradient": _choice("gradient that weighs the residual", "gradient", ("deformed", "reference")),
    "speckle_size": VariedFactor(
        "size of the speckle [times the base's]", (0.5, 0.7, 1.0, 1.4, 2.0), _speckle_size,
        lambda s: 1.0,
    ),
    "contrast": VariedFactor(
        "contrast of camera images [fraction of full scale]", (0.05, 0.1, 0.2, 0.4, 0.8),
        _contrast, lambda s: s.imaging.speckle.bright - s.imaging.speckle.dark, by_camera=True,
    ),
    "blur": _option(
        "blur of the speckle [px]", "imaging.speckle.blur_px", (1.5, 2.0, 3.0, 4.0, 6.0)
    ),
    "bits": _option(
        "bits of camera images [-]", "imaging.bits", (4, 6, 8, 10, 12), whole=True, by_camera=True
    ),
    "fill_factor": _option(
        "fill factor of the sensor [-]", "imaging.sensor.fill_factor", (0.0, 0.25, 0.5, 0.75, 1.0)
    ),
    "pixel_size": _option("pixel [mm]", "imaging.pixel_size", (0.01, 0.014, 0.02, 0.028, 0.04)),
    "v0_degree": _option("degree of v0 [-]", "correlation.v0_degree", _DEGREES, whole=True),
    "v_degree": _option("degree of v1 [-]", "correlation.v_degree", _DEGREES, whole=True),
    "taper": _option(
        "width of the mode's taper [unit cells]", "taper", (0.125, 0.25, 0.5, 0.75, 1.0)
    ),
    "edge_px": _option(
        "pixels left out at edges [px]", "correlation.edge_px", (0, 1, 2, 3, 5, 8), whole=True
    ),
}  # fmt: skip
"""Factors by their names in a study."""

BASE = "base"
ERRORS = ("measurement_error_px", "model_error_px", "w_px", "v1_percent")


@dataclass(frozen=True, eq=False)
class SystematicAnalysis:
    """Evaluation of the table of a systematic study."""

    rows: pd.DataFrame
    """Cases that succeeded, errors in pixels of the base; ``moved``: rms per component of the
    difference from the base's measurement on the same speckle [px]."""
    base: Mapping[str, float]
    """Mean errors of the base over the speckles."""
    bases: Mapping[str, float | None]
    """Each factor's level at the base; None if it has none."""


@dataclass(frozen=True)
class SystematicStudy(Study[SystematicAnalysis]):
    """Correlate exact images with one option changed at a time.

    InputError if a factor is unknown, levels are given for a factor that is not varied, or a value
    occurs twice.
    """

    question: ClassVar[str] = (
        "Without noise a measurement is still wrong. What makes it so? One option of the images "
        "or of the correlation is changed at a time, and the error is split into what the ansatz "
        "can’t describe and what the measurement adds."
    )
    function: ClassVar[str] = f"{__name__}:one_level"

    strain: float = 0.128
    factors: tuple[str, ...] = tuple(FACTORS)
    """Factors to vary, names in :data:`FACTORS`."""
    levels: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    """Levels by factor name, instead of the default ones: numbers, or names for a choice."""
    seeds_of_speckle: tuple[int, ...] = (0, 1)
    """Seeds of the speckles; every level is measured on each of them."""

    def __post_init__(self) -> None:
        unknown = [name for name in (*self.factors, *self.levels) if name not in FACTORS]
        if unknown or not self.factors:
            known = list(FACTORS)
            raise InputError(f"study: expected factors among {known}, got {unknown or 'none'}")
        if without := [name for name in self.levels if name not in self.factors]:
            wanted = f"levels of the factors {list(self.factors)} only"
            raise InputError(f"study: expected {wanted}, got some of {without}")
        if not self.seeds_of_speckle or min(self.seeds_of_speckle) < 0:
            got = list(self.seeds_of_speckle)
            raise InputError(f"study: expected a seed of a speckle at least, from 0 on, got {got}")
        self.require_different("factors", self.factors)
        self.require_different("seeds_of_speckle", self.seeds_of_speckle)
        for name, levels in self.levels.items():
            if not levels:
                raise InputError(f"study: expected at least one level of {name}, got none")
            self.require_different(f"levels of {name}", self._levels(name))

    @property
    def seeds(self) -> str:
        """The seeds of the speckles, as text."""
        plural = "s" if len(self.seeds_of_speckle) > 1 else ""
        return f"seed{plural} {', '.join(map(str, self.seeds_of_speckle))} of the speckle"

    def quick(self) -> Self:
        """One speckle, and three levels of each factor: the first, the middle, the last."""
        levels = {}
        for name in self.factors:
            own = self._levels(name)
            levels[name] = tuple(own[k] for k in sorted({0, len(own) // 2, len(own) - 1}))
        return replace(self, levels=levels, seeds_of_speckle=self.seeds_of_speckle[:1])

    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Make the images of the base, shared by many cases; others are made case by case."""
        cases = []
        for seed in self.seeds_of_speckle:
            base = changed(spec.setting, "imaging.speckle", seed=seed)
            own = spec.describe(folder, self.strain, base)
            images = VirtualImagePair.open(folder, own, progress).images.folder
            cases.append({"factor": BASE, "level": 0.0, "seed": seed, "images": own, "keep": True})
            for name in self.factors:
                for level in self._levels(name):
                    setting = FACTORS[name].set(base, level)
                    described = spec.describe(folder, self.strain, setting)
                    if described != own:
                        shared = VirtualImagePair.images_folder(folder, described) == images
                        cases.append({"factor": name, "level": float(level), "seed": seed,
                                      "images": described, "keep": shared})  # fmt: skip
        return tuple(cases)

    def _levels(self, name: str) -> tuple[float, ...]:
        factor = FACTORS[name]
        return tuple(factor.number(level) for level in self.levels.get(name, factor.levels))

    def analyse(self, table: pd.DataFrame, folder: Path) -> SystematicAnalysis:
        """Errors in pixels of the base, and the change of the measurement by each level."""
        setting = VirtualImagePair.open(folder, table["images"].iloc[0]).setting
        done = table[table["error"] == ""]
        base = done[done["factor"] == BASE]
        # The width of a ligament in pixels gives the pixel size of each level.
        in_base = base["pixels_per_ligament"].mean() / done["pixels_per_ligament"]
        pixels = {key: done[key] * in_base for key in ERRORS if key.endswith("_px")}
        rows = done.assign(**pixels, moved=_moved(done) / setting.imaging.pixel_size)
        return SystematicAnalysis(
            rows,
            {name: float(base[name].mean()) for name in ERRORS},
            {name: FACTORS[name].base(setting) for name in self.factors},
        )


def _moved(done: pd.DataFrame) -> pd.Series:
    """Rms per component of the difference from the base's measurement, same speckle [mm]."""
    base = done[done["factor"] == BASE].set_index("seed")["at_junctions_mm"]

    def moved(row: pd.Series) -> float:
        if row["seed"] not in base.index:
            return float("nan")
        apart = np.subtract(row["at_junctions_mm"], base[row["seed"]])
        return float(np.sqrt(np.mean(apart**2)))

    return done.apply(moved, axis=1)


def one_level(case: Case, folder: Path) -> Row:
    """Image, correlate and compare with the truth; images that no other case needs are removed.

    Errors as in :meth:`~modeharvest.validation.studies.study.VirtualImagePair.errors`;
    ``pixels_per_ligament``: width of a ligament [px]; ``at_junctions_mm``: displacement (x, y) at
    the junctions between holes [mm].
    """
    pair = VirtualImagePair.open(folder, case["images"])
    ligament = pair.specimen.largest_diameter - pair.specimen.diameter
    try:
        result = pair.correlate()
        return {
            **pair.errors(result),
            **outcome_of(result),
            "pixels": result.pixels,
            "pixels_per_ligament": ligament / pair.images.grid.pixel_size,
            "at_junctions_mm": _at_junctions(pair, result).ravel().tolist(),
        }
    finally:
        if not case["keep"]:
            pair.discard()


def _at_junctions(pair: VirtualImagePair, result: Result) -> FloatArray:
    """(junctions, 2) displacement at the centres between four holes [mm]."""
    s = pair.specimen
    x, y = (
        distance * (np.arange(count + 1, dtype=np.float64) - 0.5 * count)
        for distance, count in ((s.pitch, s.holes_x), (s.row_distance, s.holes_y))
    )
    return pair.ansatz.displacement(result.unknowns, x, y).reshape(-1, 2)
