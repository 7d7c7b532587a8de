"""What all studies share: the frame of a study, and pairs of virtual images that workers open.

A pair is described once, made once, and opened by workers. In a study's folder::

    solution.h5            the exact displacements
    pairs/NAME.json        a pair, how it is imaged and how it is correlated; NAME is its digest
    images/KEY/            the images, under the digest of all that they depend on
"""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import pandas as pd

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import MatchedImages
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.util.progress import Progress, silent
from modeharvest.util.typed import made, to_plain
from modeharvest.validation.truth import Comparison, compare
from modeharvest.validation.workers import Cases, Row, leave


@dataclass(frozen=True)
class StudySetting:
    """How a pair is imaged and correlated."""

    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    taper: float = 0.5
    """Width over which the mode fades out beside the cellular part [unit cells]; InputError if it
    has none."""

    def __post_init__(self) -> None:
        if not self.taper > 0.0:
            raise InputError(f"study: expected a taper wider than 0 unit cells, got {self.taper}")


@dataclass(frozen=True, eq=False)
class ImagePairSpec:
    """A simulated experiment, and how it is imaged and correlated unless a study says otherwise."""

    experiment: Experiment
    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    load: Callable[[], Solution]
    """Gives the exact displacements; called when they are first needed, because simulating them
    takes long and not every study asks for them."""

    def __post_init__(self) -> None:
        if (specimen := self.experiment.specimen).is_staggered:
            raise InputError(
                "study: expected a specimen in square or rectangular stacking, which one mode "
                f"measures, got {specimen.stacking} stacking"
            )

    @cached_property
    def solution(self) -> Solution:
        """The exact displacements."""
        return self.load()

    @property
    def setting(self) -> StudySetting:
        """How it is imaged and correlated unless a study says otherwise."""
        return StudySetting(self.imaging, self.correlation)

    def describe(self, folder: Path, strain: float, setting: StudySetting | None = None) -> str:
        """Leave in a study's folder what a worker needs to open a pair; returns the pair's name.

        ``strain``: of the deformed image [-], an InputError if the solution has no snapshot there;
        ``setting``: instead of the specification's own.
        """
        have = sorted({s.nominal_strain for s in self.solution.snapshots})
        if not any(abs(strain - e) < 1e-9 for e in have):
            raise InputError(
                f"study: expected a strain among {have}, which the solution has, got {strain}"
            )
        setting = setting or self.setting
        if not (folder / "solution.h5").is_file():
            self.solution.write(folder / "solution.h5")
        description = {
            "images": image_key(self.solution, setting.imaging, (strain,))[:16],
            "strain": strain,
            "specimen": self.experiment.specimen,
            "setting": setting,
        }
        return leave(to_plain(description), folder, "pairs/{}.json")


@dataclass(frozen=True, eq=False)
class VirtualImagePair:
    """A pair of images and how to correlate it."""

    images: ImageSet
    strain: float
    """Of the deformed image [-]."""
    specimen: Specimen
    setting: StudySetting

    @classmethod
    def open(cls, folder: Path, name: str, progress: Progress = silent) -> VirtualImagePair:
        """The pair that :meth:`ImagePairSpec.describe` described; its images are made if need be.

        To be opened once before workers do. InputError if there is no such pair, or the folder's
        solution is not the one it is of.
        """
        described = _description(folder, name)
        strain, specimen = float(described["strain"]), made(Specimen, described["specimen"])
        setting, own = made(StudySetting, described["setting"]), cls.images_folder(folder, name)
        try:
            images = ImageSet.read(own)
            if images.is_whole():
                return cls(images, strain, specimen, setting)
        except InputError:
            pass
        solution = Solution.read(folder / "solution.h5")
        if image_key(solution, setting.imaging, (strain,))[:16] != own.name:
            raise InputError(
                f"expected the solution of this study in {folder / 'solution.h5'}, found another; "
                "take another folder for another experiment"
            )
        images = make_images(solution, setting.imaging, own, (strain,), progress)
        return cls(images, strain, specimen, setting)

    @staticmethod
    def images_folder(folder: Path, name: str) -> Path:
        """Where the images of a pair are, or will be; pairs may share theirs."""
        return folder / "images" / str(_description(folder, name)["images"])

    def discard(self) -> None:
        """Remove the images from the disk: there are many where a study varies them."""
        shutil.rmtree(self.images.folder, ignore_errors=True)

    @property
    def options(self) -> SquareLatticeOptions:
        """Of the correlation."""
        return self.setting.correlation

    @property
    def ansatz(self) -> Ansatz:
        """The paper's, on this specimen."""
        usual = self.options.ansatz(self.specimen)
        (mode,) = usual.modes
        taper = replace(mode.taper, width=self.setting.taper * self.specimen.pitch)
        return replace(usual, modes=(replace(mode, taper=taper),))

    def initial_guess(self) -> FloatArray:
        """(n,) the standard initial guess of the unknowns."""
        return self.ansatz.initial_guess(self.strain, self.options.start_amplitude)

    @property
    def pair(self) -> ImagePair:
        """The images as the options want them: exact, or a camera's; kept for the next case."""
        return _read_pair(self.images.folder, self.strain, self.options.camera)

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True on material of the reference."""
        return self.pair.masks[0]

    def correlate(self, start: FloatArray | None = None, pair: ImagePair | None = None) -> Result:
        """Correlate the pair, or a noisy one, from the standard initial guess or another."""
        guess = self.initial_guess() if start is None else start
        options = self.options.options()
        return correlate(pair or self.pair, self.ansatz, guess=guess, options=options)

    def matched(self, result: Result, pair: ImagePair | None = None) -> MatchedImages:
        """What a correlation of the pair, or of a noisy one, compared at its solution."""
        return MatchedImages.of(result, pair or self.pair, self.options.edge_px)

    def compare(self, result: Result) -> Comparison:
        """Set a result against the truth and the best fit of its ansatz."""
        guess, camera = self.initial_guess(), self.options.camera
        return compare(self.images, self.strain, result, guess, camera)

    def errors(self, result: Result) -> Row:
        """Errors of a result against the truth, for a row of a study's table.

        By :meth:`~modeharvest.validation.truth.Comparison.error_parts` and ``v1_percent`` of it.
        """
        found = self.compare(result)
        return {**found.error_parts(), "v1_percent": found.v1_percent(self.specimen)}


def outcome_of(result: Result) -> Row:
    """How a correlation ended, for a row of a study's table."""
    return {
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "residual": result.residual_rms,
    }


def noisy(pair: ImagePair, level: float, rng: np.random.Generator, sign: float = 1.0) -> ImagePair:
    """The pair with white noise of that standard deviation, or its negative, in both images."""
    n = rng.normal(scale=level, size=(2, *pair.reference.shape)).astype(np.float32)
    n *= np.float32(sign)
    return pair.with_images(pair.reference + n[0], pair.deformed + n[1])


def _description(folder: Path, name: str) -> dict[str, Any]:
    return dict(read_json(folder / "pairs" / f"{name}.json"))


@lru_cache(maxsize=1)
def _read_pair(folder: Path, strain: float, camera: bool) -> ImagePair:
    return ImageSet.read(folder).pair(strain, camera=camera)


A = TypeVar("A")
"""What a study's table says, as a dataclass."""


class Study(ABC, Generic[A]):
    """A question, as options in a frozen dataclass; see docs/how-to/studies.md for one's own."""

    question: ClassVar[str]
    """What is asked, for the report."""
    function: ClassVar[str]
    """The "package.module:name" of what runs one case."""
    most: ClassVar[int] = 100_000
    """Of what is repeated in a study; each is a case and its file."""
    measures_mode: ClassVar[bool] = False
    """Whether the mode's parameters have to be free."""
    seeded: ClassVar[str] = "noise"
    """What is random, from ``seed``."""
    strain: float
    """Of the deformed image [-]."""
    seed: int

    @property
    def seeds(self) -> str:
        """The seeds of all that is random, as text for the report."""
        return f"seed {self.seed} of the {self.seeded}"

    def require(self, correlation: SquareLatticeOptions) -> None:
        """Raise InputError if the correlation contradicts the study."""
        if self.measures_mode and correlation.fixed_mode:
            raise InputError(
                "study: expected correlation.fixed_mode = false, got true: nothing of the mode "
                "would be found"
            )

    @staticmethod
    def require_different(name: str, values: tuple[Any, ...]) -> None:
        """Raise InputError if a value comes twice."""
        if len(set(values)) < len(values):
            raise InputError(f"study: expected {name} that differ, got {list(values)}")

    @abstractmethod
    def quick(self) -> Self:
        """The same question with fewer cases: a first look."""

    @abstractmethod
    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Make what the cases share (images) in ``folder``; returns them, each with its seed."""

    @abstractmethod
    def analyse(self, table: pd.DataFrame, folder: Path) -> A:
        """What a table with a row for each case says; failed ones have an ``error``."""
