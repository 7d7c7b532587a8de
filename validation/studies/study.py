"""What all studies share: the protocol, pairs of virtual images, and their error against the truth.

A pair is described once, made once, and opened by workers. In a study's folder::

    solution.h5            the exact displacements
    subjects/NAME.json     a pair, how it is imaged and how it is correlated; NAME is its digest
    images/KEY/            the images, under the digest of all that they depend on
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, write_json
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import digest
from modeharvest.validation.truth import compare, describe
from modeharvest.validation.workers import Case

Images = tuple[NDArray[np.float32], NDArray[np.float32]]

_SPEC = TypeAdapter(ImagingSpec)
PAPERS_TAPER = 0.5
"""Width over which a mode fades out beside the cellular part [unit cells]."""


@dataclass(frozen=True, eq=False)
class ImagePairSpec:
    """A simulated experiment, and how it is imaged and correlated unless a study says otherwise.

    Parameters
    ----------
    experiment
        What was simulated.
    imaging
        How it is imaged.
    correlation
        How it is correlated.
    load
        Gives the exact displacements; called when they are first needed, because simulating them
        takes long and not every study asks for them.
    """

    experiment: Experiment
    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    load: Callable[[], Solution]

    @cached_property
    def solution(self) -> Solution:
        """The exact displacements."""
        return self.load()

    def describe(
        self,
        folder: Path,
        strain: float,
        imaging: ImagingSpec | None = None,
        correlation: SquareLatticeOptions | None = None,
        taper: float = PAPERS_TAPER,
    ) -> str:
        """Leave in ``folder`` what a worker needs to open a pair; returns the pair's name.

        Parameters
        ----------
        folder
            Of the study.
        strain
            Nominal strain of the deformed image [-].
        imaging, correlation
            Instead of the subject's own.
        taper
            Width over which the mode fades out [unit cells].

        Raises
        ------
        InputError
            If the solution has no snapshot at that strain.
        """
        have = sorted({s.nominal_strain for s in self.solution.snapshots})
        if not any(abs(strain - e) < 1e-9 for e in have):
            raise InputError(
                f"study: expected a strain among {have}, which the solution has, got {strain}"
            )
        spec = imaging or self.imaging
        description = {
            "images": image_key(self.solution, spec, (strain,))[:16],
            "strain": strain,
            "imaging": _SPEC.dump_python(spec, mode="json"),
            "specimen": vars(self.experiment.specimen),
            "correlation": vars(correlation or self.correlation),
            "taper": taper,
        }
        name = digest(description)[:16]
        if not (folder / "solution.h5").is_file():
            self.solution.write(folder / "solution.h5")
        write_json(folder / "subjects" / f"{name}.json", description)
        return name


@dataclass(frozen=True, eq=False)
class VirtualImagePair:
    """A pair of images and how to correlate it: what a worker keeps between cases.

    Parameters
    ----------
    images
        The set.
    strain
        Its nominal strain [-].
    specimen
        Of the images.
    how
        The correlation.
    taper
        Width over which the mode fades out [unit cells].
    """

    images: ImageSet
    strain: float
    specimen: Specimen
    how: SquareLatticeOptions
    taper: float = PAPERS_TAPER

    @classmethod
    def open(cls, folder: Path, name: str, progress: Progress = silent) -> VirtualImagePair:
        """The pair that :meth:`Subject.describe` described; its images are made if need be.

        Where several workers open the same pair, it is to be opened once before.

        Raises
        ------
        InputError
            If there is no such pair, or the folder's solution is not the one it is of.
        """
        described = _description(folder, name)
        return cls(
            _image_set(folder, described, progress),
            float(described["strain"]),
            Specimen(**described["specimen"]),
            SquareLatticeOptions(**described["correlation"]),
            float(described["taper"]),
        )

    @staticmethod
    def images_folder(folder: Path, name: str) -> Path:
        """Where the images of a pair are, or will be; pairs may share theirs."""
        return folder / "images" / str(_description(folder, name)["images"])

    def discard(self) -> None:
        """Remove the images from the disk: there are many where a study varies them."""
        shutil.rmtree(self.images.folder, ignore_errors=True)

    @property
    def ansatz(self) -> Ansatz:
        """The paper's, on this specimen."""
        usual = self.how.ansatz(self.specimen)
        (mode,) = usual.modes
        taper = replace(mode.taper, width=self.taper * self.specimen.pitch)
        return replace(usual, modes=(replace(mode, taper=taper),))

    def start(self) -> FloatArray:
        """The standard start."""
        return self.ansatz.initial_guess(self.strain, self.how.start_amplitude)

    def pair(self) -> Images:
        """(rows, cols) f and g, as the identification wants them: exact, or a camera's."""
        return _read_pair(self.images.folder, self.strain, self.how.camera)

    def correlate(self, start: FloatArray | None = None, pair: Images | None = None) -> Result:
        """Correlate the pair, or a noisy one, from the standard start or another."""
        f, g = self.pair() if pair is None else pair
        images = ImagePair(f, g, self.images.grid, *self.masks())
        begin = self.start() if start is None else start
        return correlate(images, self.ansatz, guess=begin, options=self.how.options())

    def masks(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(rows, cols) True on material, of the reference and of the deformed image."""
        return _read_masks(self.images.folder, self.strain)

    def mask(self) -> NDArray[np.bool_]:
        """(rows, cols) True on material of the reference."""
        return self.masks()[0]


def _description(folder: Path, name: str) -> dict[str, Any]:
    return dict(read_json(folder / "subjects" / f"{name}.json"))


def _image_set(folder: Path, described: dict[str, Any], progress: Progress) -> ImageSet:
    """The images of a pair, made if they are not there."""
    own = folder / "images" / described["images"]
    try:
        images = ImageSet.read(own)
        if images.is_whole():
            return images
    except InputError:
        pass
    solution, strain = Solution.read(folder / "solution.h5"), float(described["strain"])
    spec = _SPEC.validate_python(described["imaging"])
    if image_key(solution, spec, (strain,))[:16] != described["images"]:
        raise InputError(
            f"expected the solution of this study in {folder / 'solution.h5'}, found another; "
            "take another folder for another experiment"
        )
    return make_images(solution, spec, own, (strain,), progress)


@lru_cache(maxsize=1)
def _read_pair(folder: Path, strain: float, camera: bool) -> Images:
    images = ImageSet.read(folder)
    return images.reference(camera=camera), images.deformed(strain, camera=camera)


@lru_cache(maxsize=1)
def _read_masks(folder: Path, strain: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    images = ImageSet.read(folder)
    return images.mask(), images.deformed_mask(strain)


class Study(Protocol):
    """A question, as options in a frozen dataclass.

    One's own needs these and a module-level function for one case: see docs/studies.md.
    """

    strain: float
    """Of the deformed image [-]."""

    @property
    def question(self) -> str:
        """What is asked, in a sentence or two, for the report."""

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""

    @property
    def seeds(self) -> str:
        """The seeds of all that is random, in words, for the report."""

    def require(self, correlation: SquareLatticeOptions) -> None:
        """Raise InputError if the correlation contradicts the study."""

    def quick(self) -> Self:
        """The same question with fewer cases: a first look."""

    def prepare(self, subject: ImagePairSpec, folder: Path, progress: Progress) -> tuple[Case, ...]:
        """Make what the cases share (images) in ``folder``; returns the cases.

        The random choices of a case follow from a seed that it holds.
        """


def require_mode(correlation: SquareLatticeOptions) -> None:
    """Raise InputError where the mode is held: nothing of it would be measured."""
    if correlation.fixed_mode:
        raise InputError(
            "study: expected correlation.fixed_mode = false, got true: nothing of the mode would "
            "be found"
        )


MOST = 100_000
"""Of what is repeated in a study; each is a case and its file."""


def require_different(name: str, values: tuple[Any, ...]) -> None:
    """Raise InputError if a value comes twice."""
    if len(set(values)) < len(values):
        raise InputError(f"study: expected {name} that differ, got {list(values)}")


def error_parts(scene: VirtualImagePair, result: Result) -> dict[str, float]:
    """Set a result against the truth of its images and the best fit of its ansatz.

    Parameters
    ----------
    scene
        What was measured.
    result
        The measurement.

    Returns
    -------
    dict
        ``w_px``, ``best_px``, ``lost_px``: rms per component of truth - IDIC, truth - best fit
        and IDIC - best fit [px]; ``v1_percent``: rms difference of v1 from the best fit's over
        the cellular material, of the largest of the best fit's.
    """
    found = compare(scene.images, scene.strain, result, scene.start(), camera=scene.how.camera)
    parts = {"w_px": found.w, "best_px": found.best_error, "lost_px": found.idic_to_best}
    px = found.grid.pixel_size
    rms = {
        name: float(describe(part, found.mask, px)["rms_per_component"])
        for name, part in parts.items()
    }
    a, b = scene.specimen.cellular_half_size
    x, y = np.abs(found.grid.x)[None, :], np.abs(found.grid.y)[:, None]
    inside = found.mask & (x <= a) & (y <= b)
    v, at_best = (fit.v(0)[inside] for fit in (result, found.best))
    apart = float(np.sqrt(np.mean((v - at_best) ** 2)) / np.abs(at_best).max())
    return {**rms, "v1_percent": 100.0 * apart}
