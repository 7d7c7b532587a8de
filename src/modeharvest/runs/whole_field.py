"""The whole displacement of a virtual experiment: how its images are measured, and the files."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.idic.finite_element.files import read_result, write_result, write_vtu
from modeharvest.idic.finite_element.measure import (
    FiniteElementOptions,
    Law,
    measure_displacement,
)
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, write_json
from modeharvest.util.progress import Progress

_SECONDS = "timings.json"


@dataclass(frozen=True)
class WholeFieldOptions:
    """How the whole displacement is measured, from an ansatz' result, on a mesh of the material."""

    measure: bool = False
    """Whether it is measured at all: that costs more than the rest of the run."""
    camera: bool = True
    """Whether in the images as a camera gives them, quantised, or in the exact ones."""
    element_px: float = 24.0
    """Edge length of the elements [px]."""
    edge_element_px: float = 12.0
    """The same along edges."""
    cutoff_px: float | None = None
    """Cut-off wavelength of the regularisation [px]; None: found from the images."""
    material_law: bool = False
    """Whether to regularise by the equilibrium of the experiment's own material."""

    def __post_init__(self) -> None:
        self.on_mesh(None)

    def on_mesh(self, law: Law | None) -> FiniteElementOptions:
        """The engine's options."""
        return FiniteElementOptions(
            self.element_px, self.edge_element_px, cutoff_px=self.cutoff_px, law=law
        )

    def of(self, experiment: Experiment, pixel_size: float) -> FiniteElementOptions:
        """The engine's options for an experiment, whose two ends along x are loaded."""
        if not self.material_law:
            return self.on_mesh(None)
        end = experiment.specimen.half_size[0]

        def is_loaded(points: FloatArray) -> BoolArray:
            return np.asarray(np.abs(np.abs(points[:, 0]) - end) < pixel_size)

        return self.on_mesh(Law(experiment.material, is_loaded))


@dataclass(frozen=True)
class WholeFields:
    """The files of whole displacements in a folder, one for each strain, and what they took."""

    folder: Path

    def path(self, strain: float) -> Path:
        """The HDF5 file of a strain; the VTU beside it has the same name."""
        return self.folder / f"displacement_{round(1e4 * strain):04d}.h5"

    def measure(
        self,
        pair: ImagePair,
        strain: float,
        start: Result,
        options: FiniteElementOptions,
        progress: Progress,
    ) -> tuple[Path, Path]:
        """Measure a pair of images at a strain and write what was found; returns the files.

        Raises InputError where there is nothing to measure on, with the way around.
        """
        begin, path = time.perf_counter(), self.path(strain)

        def tell(done: float, total: float, what: str) -> None:
            progress(done, total, f"{what}, strain {100 * strain:.2f} %")

        try:
            found = measure_displacement(pair, start, options=options, progress=tell)
        except InputError as error:
            raise InputError(
                f"whole displacement at strain {strain:g}: {error}; or leave it out: "
                "[whole_field] measure = false, --no-whole-field"
            ) from error
        write_result(path, found)
        write_vtu(path.with_suffix(".vtu"), found)
        seconds = {**self._seconds(), path.stem: time.perf_counter() - begin}
        write_json(self.folder / _SECONDS, seconds)
        return path, path.with_suffix(".vtu")

    def read(self, strain: float) -> NodalResult:
        """The whole displacement at a strain; InputError if its file is missing or damaged."""
        return read_result(self.path(strain))

    def seconds(self, strain: float) -> float:
        """What its measurement took [s]."""
        return float(self._seconds().get(self.path(strain).stem, float("nan")))

    def _seconds(self) -> Mapping[str, float]:
        path = self.folder / _SECONDS
        return dict(read_json(path)) if path.exists() else {}
