"""What resolution is where the displacement is an ansatz: waves, noise, and their product."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from modeharvest.errors import InputError
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress, silent
from modeharvest.validation.campaign import Case, grid
from modeharvest.validation.resolution.buckled import Buckled
from modeharvest.validation.resolution.curves import AXES, WAVED, Curves
from modeharvest.validation.resolution.measure import MOTIONS, Subject, one_case
from modeharvest.validation.studies.study import MOST, require_different, require_mode
from modeharvest.validation.studies.subject import Subject as Experiment


@dataclass(frozen=True)
class Resolution:
    """Small waves of v0 and v1 on a buckled specimen, and noise, against the polynomial degree.

    Parameters
    ----------
    strain
        Nominal compression of the base motion [-].
    pattern
        Its v1, the same everywhere [mm].
    degrees
        Of v0 and v1 alike.
    measured
        Those of them that images are measured with, too.
    amplitude_px
        Of a wave [px].
    noise
        Standard deviation in each image [fraction of full scale].
    realisations
        Of the noise.
    seed
        Of the noise.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    strain: float = 0.128
    pattern: float = 7.0
    degrees: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    measured: tuple[int, ...] = (3, 5, 7)
    amplitude_px: float = 0.5
    noise: float = 0.01
    realisations: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        require_different("degrees", self.degrees)
        if not self.degrees or not all(1 <= d <= 12 for d in self.degrees):
            raise InputError(f"study: expected degrees from 1 to 12, got {list(self.degrees)}")
        if not self.measured or not set(self.measured) <= set(self.degrees):
            raise InputError(
                f"study: expected measured degrees among {list(self.degrees)}, got "
                f"{list(self.measured)}"
            )
        if not (0.0 < self.amplitude_px <= 2.0 and 0.0 < self.noise < 0.1):
            raise InputError(
                "study: expected an amplitude above 0 and up to 2 px and noise above 0 and below "
                f"0.1 of full scale, got {self.amplitude_px} and {self.noise}"
            )
        if self.pattern == 0.0 or not 2 <= self.realisations <= MOST or self.seed < 0:
            raise InputError(
                f"study: expected a pattern that is not 0 mm, 2 to {MOST} realisations and a seed "
                f"of 0 or more, got {self.pattern}, {self.realisations} and {self.seed}"
            )

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "How fine a change of v0 and v1 does an ansatz of polynomials show, and what noise "
            "does each degree cost? Small waves on a buckled specimen are measured; the period "
            "at which 10 % of their amplitude is lost, times the noise floor, is the "
            "metrological efficiency indicator of DIC Challenge 2.0, carried over to "
            "parametrised fields."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{one_case.__module__}:{one_case.__name__}"

    @property
    def seeds(self) -> str:
        """Of the noise."""
        return f"seed {self.seed} of the noise"

    def require(self, correlation: Identification) -> None:
        """The mode is measured, in exact images, and brightness is none of the question."""
        require_mode(correlation)
        if correlation.camera or correlation.brightness().size:
            raise InputError(
                "study: expected correlation.camera = false and neither gain nor offset, got "
                "others: waves are measured in exact images"
            )

    def quick(self) -> Self:
        """Fewer degrees measured, fewer realisations."""
        middle = self.measured[len(self.measured) // 2]
        return replace(self, measured=(middle,), realisations=max(2, self.realisations // 2))

    def prepare(
        self, subject: Experiment, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Say what is measured; the cases are waves, noise, and the floors of exact images."""
        buckled = Buckled(
            subject.experiment.specimen,
            subject.correlation,
            subject.imaging.speckle,
            subject.imaging.pixel_size,
            self.strain,
            self.pattern,
        )
        measured = Subject(buckled, self.measured, self.amplitude_px, self.noise)
        base: Case = {
            "subject": measured.write(folder), "task": "floor", "motion": "buckled", "part": "",
            "axis": 0, "period": 0.0, "phase": 0.0, "degree": 0, "number": 0, "seed": self.seed,
        }  # fmt: skip
        floors = grid(base, motion=tuple(MOTIONS), degree=self.degrees)
        noise = grid(
            {**base, "task": "noise"}, motion=tuple(MOTIONS), number=range(self.realisations)
        )
        curves = Curves.of(measured, self.measured, progress)
        waves = [
            {**base, "task": "wave", "part": part, "axis": axis, "phase": phase,
             "period": round(curves.finest(part, axis, degree), 3)}
            for part in WAVED
            for axis in range(len(AXES))
            for degree in self.measured
            for phase in (0.0, 0.5 * np.pi)
        ]  # fmt: skip
        return (*waves, *noise, *floors)
