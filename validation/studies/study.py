"""Base of all studies: the class of a study, and pairs of virtual images that workers open.

A pair is described once, made once, and opened by workers. In a study's folder::

    solution.h5            the exact displacements
    pairs/NAME.json        a pair, its imaging and its correlation; NAME is its digest
    images/KEY/            the images; KEY is the digest of everything they depend on
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
    """Width over which the mode tapers off outside the cellular part [unit cells]; InputError if it
    is not positive."""

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
    """Returns the exact displacements; called when they are first needed, because the simulation
    takes long and not every study needs them."""

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
        """Imaging and correlation, unless a study says otherwise."""
        return StudySetting(self.imaging, self.correlation)

    def describe(self, folder: Path, strain: float, setting: StudySetting | None = None) -> str:
        """Write to a study's folder what a worker needs to open a pair; return the pair's name.

        ``strain``: of the deformed image [-], InputError if the solution has no snapshot there;
        ``setting``: replaces the specification's own.
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
    """A pair of virtual images with the options of its correlation."""

    images: ImageSet
    strain: float
    """Nominal strain of the deformed image [-]."""
    specimen: Specimen
    setting: StudySetting

    @classmethod
    def open(cls, folder: Path, name: str, progress: Progress = silent) -> VirtualImagePair:
        """Open a pair written by :meth:`ImagePairSpec.describe`; its images are made if missing.

        Open it once before the workers do. InputError if there is no such pair, or the folder has
        another solution than the pair's.
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
        """Folder of the images of a pair; several pairs may share it."""
        return folder / "images" / str(_description(folder, name)["images"])

    def discard(self) -> None:
        """Remove the images from the disk, as a study that varies them makes many."""
        shutil.rmtree(self.images.folder, ignore_errors=True)

    @property
    def options(self) -> SquareLatticeOptions:
        """Options of the correlation."""
        return self.setting.correlation

    @property
    def ansatz(self) -> Ansatz:
        """The paper's ansatz for this specimen."""
        usual = self.options.ansatz(self.specimen)
        (mode,) = usual.modes
        taper = replace(mode.taper, width=self.setting.taper * self.specimen.pitch)
        return replace(usual, modes=(replace(mode, taper=taper),))

    def initial_guess(self) -> FloatArray:
        """(n,) the standard initial guess of the unknowns."""
        return self.ansatz.initial_guess(self.strain, self.options.start_amplitude)

    @property
    def pair(self) -> ImagePair:
        """The images, exact or a camera's according to the options; cached for the next case."""
        return _read_pair(self.images.folder, self.strain, self.options.camera)

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True on material in the reference image."""
        return self.pair.masks[0]

    def correlate(self, start: FloatArray | None = None, pair: ImagePair | None = None) -> Result:
        """Correlate this pair or a noisy one, from the standard initial guess or ``start`` (n,)."""
        guess = self.initial_guess() if start is None else start
        options = self.options.options()
        return correlate(pair or self.pair, self.ansatz, guess=guess, options=options)

    def matched(self, result: Result, pair: ImagePair | None = None) -> MatchedImages:
        """The images of this pair, or of a noisy one, matched by a result."""
        return MatchedImages.of(result, pair or self.pair, self.options.edge_px)

    def compare(self, result: Result) -> Comparison:
        """Compare a result with the truth and with the best fit of its ansatz."""
        guess, camera = self.initial_guess(), self.options.camera
        return compare(self.images, self.strain, result, guess, camera)

    def errors(self, result: Result) -> Row:
        """Errors of a result against the truth, for a row of a study's table.

        See ``error_parts`` and ``v1_percent`` of :class:`~modeharvest.validation.truth.Comparison`.
        """
        found = self.compare(result)
        return {**found.error_parts(), "v1_percent": found.v1_percent(self.specimen)}


def outcome_of(result: Result) -> Row:
    """Outcome of a correlation, for a row of a study's table."""
    return {
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "residual": result.residual_rms,
    }


def noisy(pair: ImagePair, level: float, rng: np.random.Generator, sign: float = 1.0) -> ImagePair:
    """The pair with white noise of standard deviation ``level``, times ``sign``, in both images."""
    n = rng.normal(scale=level, size=(2, *pair.reference.shape)).astype(np.float32)
    n *= np.float32(sign)
    return pair.with_images(pair.reference + n[0], pair.deformed + n[1])


def _description(folder: Path, name: str) -> dict[str, Any]:
    return dict(read_json(folder / "pairs" / f"{name}.json"))


@lru_cache(maxsize=1)
def _read_pair(folder: Path, strain: float, camera: bool) -> ImagePair:
    return ImageSet.read(folder).pair(strain, camera=camera)


A = TypeVar("A")
"""Type of a study's evaluation, a dataclass."""


class Study(ABC, Generic[A]):
    """A study, with its options in a frozen dataclass; new studies: docs/how-to/studies.md."""

    question: ClassVar[str]
    """The study's question, for the report."""
    function: ClassVar[str]
    """The "package.module:name" of the function that runs one case."""
    most: ClassVar[int] = 100_000
    """Largest number of repetitions in a study; each is a case with a file."""
    measures_mode: ClassVar[bool] = False
    """Whether the mode's parameters must be free."""
    seeded: ClassVar[str] = "noise"
    """Name of the random quantity generated from ``seed``."""
    strain: float
    """Nominal strain of the deformed image [-]."""
    seed: int

    @property
    def seeds(self) -> str:
        """The seeds of all random numbers, as text for the report."""
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
        """Raise InputError if a value occurs twice."""
        if len(set(values)) < len(values):
            raise InputError(f"study: expected {name} that differ, got {list(values)}")

    @abstractmethod
    def quick(self) -> Self:
        """The same study with fewer cases, for a first result."""

    @abstractmethod
    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Make what the cases share (images) in ``folder``; return the cases with their seeds."""

    @abstractmethod
    def analyse(self, table: pd.DataFrame, folder: Path) -> A:
        """Evaluate the table, which has a row for each case; failed cases have an ``error``."""
