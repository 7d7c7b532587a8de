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
    """A dataclass of dataclasses with other values in the one at a dotted path; "" is itself."""
    name, _, rest = options.partition(".")
    if name:
        values = {name: changed(getattr(thing, name), rest, **values)}
    other: T = replace(thing, **values)  # type: ignore[type-var]
    return other


@dataclass(frozen=True)
class VariedFactor:
    """Something to change."""

    label: str
    """What it is called, with its unit."""
    levels: tuple[float, ...]
    """What it is changed to unless a study says otherwise, for a choice the numbers of its
    ``names``."""
    change: Callable[[StudySetting, Any], StudySetting]
    """The setting with that level."""
    level_of: Callable[[StudySetting], float | None]
    """The level that a setting has, None where it has none."""
    whole: bool = False
    """Whether levels are whole numbers."""
    by_camera: bool = False
    """Whether only a camera's images have a level: float images have no bits, and no contrast."""
    names: tuple[str, ...] = ()

    @classmethod
    def option(cls, label: str, path: str, levels: tuple[float, ...], **kind: Any) -> Self:
        """The option at a dotted path of a :class:`StudySetting`."""
        at, _, name = path.rpartition(".")
        value = attrgetter(path)
        return cls(label, levels, lambda s, v: changed(s, at, **{name: v}), value, **kind)

    @classmethod
    def choice(cls, label: str, option: str, names: tuple[str, ...]) -> VariedFactor:
        """One of several names of an option of the correlation, or none: left to the images."""
        numbers = {name: number for number, name in enumerate(names)}
        return cls(
            label, tuple(numbers.values()),
            lambda s, v: changed(s, "correlation", **{option: names[v]}),
            lambda s: numbers.get(getattr(s.correlation, option)), whole=True, names=names,
        )  # fmt: skip

    def number(self, level: float | str) -> float:
        """A level as a number; InputError if it is none of the factor's."""
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
        """How a level is called."""
        return self.names[round(level)] if self.names else f"{level:g}"

    def set(self, setting: StudySetting, level: float | str) -> StudySetting:
        """Change a setting; InputError if the level is out of the factor's range."""
        number = self.number(level)
        other = self.change(setting, round(number) if self.whole else float(number))
        return changed(other, "correlation", camera=True) if self.by_camera else other

    def base(self, setting: StudySetting) -> float | None:
        """The level of the images that a setting correlates; None where they have none."""
        if self.by_camera and not setting.correlation.camera:
            return None
        return self.level_of(setting)


def _speckle_size(setting: StudySetting, factor: float) -> StudySetting:
    """Everything about the speckle that much larger, its blur included."""
    if not factor > 0.0:
        raise InputError(f"study: expected a speckle_size above 0 times the base's, got {factor}")
    speckle = setting.imaging.speckle
    sizes = {"standard_deviation": speckle.standard_deviation / factor,
             "blur_px": speckle.blur_px * factor}  # fmt: skip
    return changed(setting, "imaging.speckle", **sizes)


def _contrast(setting: StudySetting, contrast: float) -> StudySetting:
    """Grey levels about the same middle."""
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
"""By the names that a study uses."""

BASE = "base"
ERRORS = ("measurement_error_px", "model_error_px", "w_px", "v1_percent")


@dataclass(frozen=True, eq=False)
class SystematicAnalysis:
    """What the table of a systematic study says."""

    rows: pd.DataFrame
    """What succeeded, errors in pixels of the base; ``moved``: rms per component of a measurement's
    difference from the base's on the same speckle [px]."""
    base: Mapping[str, float]
    """Mean errors over the speckles."""
    bases: Mapping[str, float | None]
    """Each factor's level at the base; None where it has none."""


@dataclass(frozen=True)
class SystematicStudy(Study[SystematicAnalysis]):
    """Correlate exact images with one option changed at a time.

    InputError if a factor is unknown, levels are given for one that is not asked for, or a value
    comes twice.
    """

    question: ClassVar[str] = (
        "Without noise a measurement is still wrong. What makes it so? One option of the images "
        "or of the correlation is changed at a time, and the error is split into what the ansatz "
        "can’t describe and what the measurement adds."
    )
    function: ClassVar[str] = f"{__name__}:one_level"

    strain: float = 0.128
    factors: tuple[str, ...] = tuple(FACTORS)
    """What to change, names in :data:`FACTORS`."""
    levels: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    """Other levels than a factor's own, by its name, numbers or names where it has names."""
    seeds_of_speckle: tuple[int, ...] = (0, 1)
    """Every level is measured on each of these speckles."""

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
        """Of the speckles."""
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
        """Make the base's images, which many cases share; the others are made case by case."""
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
        """Errors in pixels of the base, and how far each level moves the measurement."""
        setting = VirtualImagePair.open(folder, table["images"].iloc[0]).setting
        done = table[table["error"] == ""]
        base = done[done["factor"] == BASE]
        # A ligament shows how large a level's own pixels are.
        in_base = base["pixels_per_ligament"].mean() / done["pixels_per_ligament"]
        pixels = {key: done[key] * in_base for key in ERRORS if key.endswith("_px")}
        rows = done.assign(**pixels, moved=_moved(done) / setting.imaging.pixel_size)
        return SystematicAnalysis(
            rows,
            {name: float(base[name].mean()) for name in ERRORS},
            {name: FACTORS[name].base(setting) for name in self.factors},
        )


def _moved(done: pd.DataFrame) -> pd.Series:
    """Rms per component of a measurement's difference from the base's on the same speckle [mm]."""
    base = done[done["factor"] == BASE].set_index("seed")["at_junctions_mm"]

    def moved(row: pd.Series) -> float:
        if row["seed"] not in base.index:
            return float("nan")
        apart = np.subtract(row["at_junctions_mm"], base[row["seed"]])
        return float(np.sqrt(np.mean(apart**2)))

    return done.apply(moved, axis=1)


def one_level(case: Case, folder: Path) -> Row:
    """Image, correlate and set against the truth; images that no other case needs are removed.

    Errors as in :meth:`~modeharvest.validation.studies.study.VirtualImagePair.errors`;
    ``pixels_per_ligament``: its width [px]; ``at_junctions_mm``: displacement (x, y) at the
    junctions between holes [mm].
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
    """(junctions, 2) displacement between four holes each [mm]."""
    s = pair.specimen
    x, y = (
        distance * (np.arange(count + 1, dtype=np.float64) - 0.5 * count)
        for distance, count in ((s.pitch, s.holes_x), (s.row_distance, s.holes_y))
    )
    return pair.ansatz.displacement(result.unknowns, x, y).reshape(-1, 2)
