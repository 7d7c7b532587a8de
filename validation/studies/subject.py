"""What a study is about: a specimen's exact displacements, how it is imaged and correlated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from modeharvest.errors import InputError
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.files import read_json, write_json
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import Identification
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.progress import Progress, silent
from modeharvest.stages import digest

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Subject:
    """A simulated experiment, an imaging spec and an identification.

    Parameters
    ----------
    experiment
        What was simulated.
    imaging
        How it is imaged.
    correlation
        How it is correlated.
    solution
        The exact displacements.
    """

    experiment: Experiment
    imaging: ImagingSpec
    correlation: Identification
    solution: Solution

    def images(
        self, strain: float, folder: Path, spec: ImagingSpec | None = None,
        progress: Progress = silent,
    ) -> str:  # fmt: skip
        """Make (or find) a pair of images with its truth; returns the name to find it again by.

        Beside the images it leaves all that a worker needs to correlate them.

        Raises
        ------
        InputError
            If the solution has no snapshot at that strain.
        """
        spec = spec or self.imaging
        have = [s.nominal_strain for s in self.solution.snapshots]
        if not any(abs(strain - e) < 1e-9 for e in have):
            raise InputError(
                f"study: expected a strain among {sorted(set(have))}, which were simulated, got "
                f"{strain}"
            )
        how = {
            "specimen": vars(self.experiment.specimen),
            "correlation": vars(self.correlation),
            "strain": strain,
        }
        adapter = TypeAdapter(ImagingSpec)
        name = digest([how, adapter.dump_python(spec, mode="json"), _key(self.solution, strain)])[
            :16
        ]
        make_images(self.solution, (strain,), spec, folder / "images" / name, progress)
        write_json(folder / "images" / name / "subject.json", how)
        return name


def _key(solution: Solution, strain: float) -> list[Any]:
    """Numbers that tell one solution from another."""
    u = solution.at(strain).displacement
    return [len(u), float(np.abs(u).sum()), float((u * u).sum())]


@dataclass(frozen=True, eq=False)
class Scene:
    """A pair of images in memory, and how to correlate it: what a worker keeps between cases.

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
    """

    images: ImageSet
    strain: float
    specimen: Specimen
    how: Identification

    @classmethod
    def open(cls, folder: Path, name: str) -> Scene:
        """The pair that :meth:`Subject.images` made; read once in each process."""
        return _opened(folder / "images" / name)

    @property
    def ansatz(self) -> Ansatz:
        """The paper's, on this specimen."""
        return self.how.ansatz(self.specimen)

    def start(self) -> FloatArray:
        """The standard start."""
        return self.how.start(self.ansatz, self.strain)

    def pair(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(rows, cols) f and g, as the identification wants them: exact, or a camera's."""
        return _pair(self.images.folder, self.strain, self.how.camera)

    def correlate(self, start: FloatArray | None = None) -> Result:
        """Correlate the pair; from the standard start by default."""
        f, g = self.pair()
        mask, deformed_mask = _masks(self.images.folder, self.strain)
        begin = self.start() if start is None else start
        grid, options = self.images.grid, self.how.options()
        return correlate(f, g, grid, self.ansatz, begin, mask, deformed_mask, options)

    def mask(self) -> NDArray[np.bool_]:
        """(rows, cols) True on material of the reference."""
        return _masks(self.images.folder, self.strain)[0]


@lru_cache(maxsize=2)
def _opened(folder: Path) -> Scene:
    how = read_json(folder / "subject.json")
    return Scene(
        ImageSet.read(folder),
        float(how["strain"]),
        Specimen(**how["specimen"]),
        Identification(**how["correlation"]),
    )


@lru_cache(maxsize=1)
def _pair(
    folder: Path, strain: float, camera: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    images = ImageSet.read(folder)
    return images.reference(camera=camera), images.deformed(strain, camera=camera)


@lru_cache(maxsize=1)
def _masks(folder: Path, strain: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    images = ImageSet.read(folder)
    return images.mask(), images.deformed_mask(strain)
