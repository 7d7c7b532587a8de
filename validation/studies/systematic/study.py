"""What makes the measurement wrong without any noise? One factor at a time around a base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.result import Result
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress, silent
from modeharvest.validation.campaign import Case
from modeharvest.validation.studies.against_truth import against_truth
from modeharvest.validation.studies.study import require_different
from modeharvest.validation.studies.subject import Scene, Subject
from modeharvest.validation.studies.systematic.factors import FACTORS, Setting

FloatArray = NDArray[np.float64]

BASE = "base"
_QUICK_LEVELS = 3


@dataclass(frozen=True)
class Systematic:
    """Correlate exact images with one option changed at a time.

    Parameters
    ----------
    strain
        Of the deformed image [-].
    factors
        What to change: names in :data:`modeharvest.validation.studies.systematic.factors.FACTORS`.
    levels
        Other levels than a factor's own, by its name: numbers, or names where it has names.
    seeds_of_speckle
        Every level is measured on each of these speckles.

    Raises
    ------
    InputError
        If a factor is unknown, levels are given for one that is not asked for, or a value comes
        twice.
    """

    strain: float = 0.128
    factors: tuple[str, ...] = tuple(FACTORS)
    levels: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    seeds_of_speckle: tuple[int, ...] = (0, 1)

    def __post_init__(self) -> None:
        unknown = [name for name in (*self.factors, *self.levels) if name not in FACTORS]
        if unknown or not self.factors:
            raise InputError(
                f"study: expected factors among {list(FACTORS)}, got {unknown or 'none'}"
            )
        without = [name for name in self.levels if name not in self.factors]
        if without:
            raise InputError(
                f"study: expected levels of the factors {list(self.factors)} only, got some of "
                f"{without}"
            )
        if not self.seeds_of_speckle or min(self.seeds_of_speckle) < 0:
            raise InputError(
                "study: expected at least one seed of a speckle, of 0 or more, got "
                f"{list(self.seeds_of_speckle)}"
            )
        require_different("factors", self.factors)
        require_different("seeds_of_speckle", self.seeds_of_speckle)
        for name, levels in self.levels.items():
            if not levels:
                raise InputError(f"study: expected at least one level of {name}, got none")
            require_different(f"levels of {name}", self._levels(name))

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "Without noise a measurement is still wrong. What makes it so? One option of the "
            "images or of the correlation is changed at a time, and the error is split into what "
            "the ansatz can’t describe and what the measurement adds."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{__name__}:one_level"

    @property
    def seeds(self) -> str:
        """Of the speckles."""
        plural = "s" if len(self.seeds_of_speckle) > 1 else ""
        return f"seed{plural} {', '.join(map(str, self.seeds_of_speckle))} of the speckle"

    def require(self, correlation: Identification) -> None:
        """Accept any correlation."""

    def quick(self) -> Self:
        """One speckle, and three levels of each factor: the first, the middle, the last."""
        levels = {}
        for name in self.factors:
            own = self._levels(name)
            some = {0, len(own) // 2, len(own) - 1}
            levels[name] = tuple(own[k] for k in sorted(some))
        return replace(self, levels=levels, seeds_of_speckle=self.seeds_of_speckle[:1])

    def prepare(
        self, subject: Subject, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Make the base's images, which many cases share; the others are made case by case.

        Raises
        ------
        InputError
            If a level is out of its range.
        """
        cases = []
        for seed in self.seeds_of_speckle:
            base = Setting(subject.imaging, subject.correlation).speckled(seed=seed)
            own = _described(subject, folder, self.strain, base)
            images = Scene.open(folder, own, progress).images.folder
            cases.append({"factor": BASE, "level": 0.0, "seed": seed, "subject": own, "keep": True})
            for name in self.factors:
                for level in self._levels(name):
                    setting = FACTORS[name].set(base, level)
                    described = _described(subject, folder, self.strain, setting)
                    if described != own:
                        shared = Scene.images_folder(folder, described) == images
                        cases.append({"factor": name, "level": float(level), "seed": seed,
                                      "subject": described, "keep": shared})  # fmt: skip
        return tuple(cases)

    def _levels(self, name: str) -> tuple[float, ...]:
        factor = FACTORS[name]
        return tuple(factor.number(level) for level in self.levels.get(name, factor.levels))


def _described(subject: Subject, folder: Path, strain: float, setting: Setting) -> str:
    return subject.describe(folder, strain, setting.imaging, setting.correlation, setting.taper)


def one_level(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Image, correlate and set against the truth.

    Parameters
    ----------
    case
        One of :meth:`Systematic.prepare`.
    folder
        Of the study. Images that no other case needs are removed again.

    Returns
    -------
    dict
        The errors of :func:`~modeharvest.validation.studies.against_truth.against_truth`, how
        the correlation ended, and the displacement at the junctions between holes.
    """
    scene = Scene.open(folder, case["subject"])
    try:
        return _measured(scene)
    finally:
        if not case["keep"]:
            scene.discard()


def _measured(scene: Scene) -> dict[str, Any]:
    result = scene.correlate()
    specimen = scene.specimen
    ligament = specimen.pitch - specimen.diameter
    return {
        **against_truth(scene, result),
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "residual": result.residual_rms,
        "pixels": result.pixels,
        "pixels_per_ligament": ligament / scene.images.grid.pixel_size,
        "at_junctions_mm": _at_junctions(scene, result).ravel().tolist(),
    }


def _at_junctions(scene: Scene, result: Result) -> FloatArray:
    """(junctions, 2) displacement between four holes each, whatever the pixels [mm]."""
    specimen = scene.specimen
    x, y = (
        specimen.pitch * (np.arange(count + 1, dtype=np.float64) - 0.5 * count)
        for count in (specimen.holes_x, specimen.holes_y)
    )
    return scene.ansatz.displacement(result.unknowns, x, y).reshape(-1, 2)
