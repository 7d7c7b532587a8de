"""The in-silico twin of a real experiment: photographs as a user has them, the truth apart.

::

    experiment/             what a user would have, and nothing else
        experiment.toml     files, pixel size, cell size
        reference.tif  reference_2.tif  deformed_0820.tif ...    as the camera stores them
        calibration_00.tif ...                                   a target that a stage shifts
    truth/
        solution.h5         what the finite elements found
        images/             noise-free images, masks and truth (modeharvest.imaging.imageset)
        distortion.json     of the lens
        twin.json           where the stage really went
    stages.json             whether all that is finished
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.case import TwinCase
from modeharvest.errors import InputError
from modeharvest.fem.field import Solution
from modeharvest.files import atomic, copy_whole, read_json, write_json
from modeharvest.imaging.calibration_target import photograph_target
from modeharvest.imaging.distorted import seen_points
from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion, write_distortion
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.io import write_image
from modeharvest.progress import Progress, silent
from modeharvest.stages import Stages, stage_key
from modeharvest.typed import plain

FloatArray = NDArray[np.float64]

_SIDECAR = "twin.json"


@dataclass(frozen=True)
class Twin:
    """A finished twin on disk.

    Parameters
    ----------
    folder
        Where it is.
    """

    folder: Path

    @property
    def experiment(self) -> Path:
        """The file that a harvest starts from."""
        return self.folder / "experiment" / "experiment.toml"

    @property
    def solution(self) -> Solution:
        """The true displacements, on the mesh."""
        return Solution.read(self.folder / "truth" / "solution.h5")

    @property
    def images(self) -> ImageSet:
        """Noise-free images through the lens, and the truth on the ideal grid."""
        return ImageSet.read(self.folder / "truth" / "images")

    @property
    def distortion(self) -> AnyDistortion:
        """The lens."""
        return read_distortion(self.folder / "truth" / "distortion.json")

    @property
    def shifts(self) -> FloatArray:
        """(m, 2) where the stage was at the calibration, along (rows, columns) [px]."""
        return np.array(self.info["stage_shifts_row_col_px"], dtype=np.float64)

    @property
    def info(self) -> dict[str, Any]:
        """The content of ``twin.json``."""
        found: dict[str, Any] = read_json(self.folder / "truth" / _SIDECAR)
        return found


def make_twin(
    case: TwinCase, solution: Solution, folder: Path | str, progress: Progress = silent
) -> Twin:
    """Make (or find finished) the photographs of a twin, and its truth.

    Parameters
    ----------
    case
        Of a twin, such as the shipped "paper-real-twin".
    solution
        Of the case's experiment.
    folder
        Where; made if it doesn't exist.
    progress
        Listener.

    Raises
    ------
    InputError
        If the case has no distortion, an image doesn't fit, or the disk refuses.
    """
    twin, spec, strains = Twin(Path(folder)), case.imaging, case.experiment.strains
    if spec.distortion is None:
        raise InputError("twin: expected an [imaging.distortion] to calibrate, got none")
    truth, photographs = twin.folder / "truth", twin.experiment.parent
    key = stage_key([image_key(solution, strains, spec), plain(case.calibration), case.title])

    def work() -> list[Path]:
        solution.write(truth / "solution.h5")
        images = make_images(solution, strains, spec, truth / "images", progress)
        taken = _copy_photographs(images, photographs)
        lens = spec.lens(images.grid.shape)
        assert lens is not None
        write_distortion(truth / "distortion.json", lens)
        target, seen = case.calibration, seen_points(lens, images.grid.shape)
        shots = photograph_target(target, spec.speckle, seen, spec.sensor, spec.bits)
        for k, (name, levels) in enumerate(shots):
            progress(k, len(target.shifts_px), "images: calibration")
            taken.append(photographs / f"{name}.tif")
            write_image(taken[-1], levels)
        with atomic(twin.experiment) as temporary:
            temporary.write_text(_experiment_text(case, images), "utf-8")
        shifts = {"stage_shifts_row_col_px": target.true_shifts.tolist()}
        write_json(truth / _SIDECAR, shifts)
        own = (truth / name for name in ("solution.h5", "distortion.json", _SIDECAR))
        return [*images.files, *taken, *own, twin.experiment]

    Stages(twin.folder).do("twin", key, work)
    return twin


def _copy_photographs(images: ImageSet, folder: Path) -> list[Path]:
    """Leave the exposures, and a second one of the reference, from which noise is measured."""
    paths = []
    for name, source in _exposures(images):
        paths.append(folder / f"{name}.tif")
        copy_whole(images.folder / source, paths[-1])
    spec, again = images.spec, "reference_2"
    sensor = spec.sensor
    light = sensor.light(again) / sensor.light("reference")
    irradiance = light * (images.reference() - sensor.offset) / sensor.gain
    levels = sensor.expose(irradiance.astype(np.float32), spec.bits, again)
    write_image(folder / f"{again}.tif", levels)
    return [*paths, folder / f"{again}.tif"]


def _exposures(images: ImageSet) -> Iterator[tuple[str, str]]:
    for entry in (images.info["reference"], *images.info["snapshots"]):
        yield Path(entry["image"]).stem, entry["camera_image"]


def _experiment_text(case: TwinCase, images: ImageSet) -> str:
    """The TOML file that a user would write."""
    deformed = ", ".join(f'"{name}.tif"' for name, _ in _exposures(images) if name != "reference")
    about = ", ".join(f"({col:g}, {row:g})" for col, row in case.calibration.shifts_px)
    return f"""\
title = "{case.title}"

[images]
reference = "reference.tif"
deformed = [{deformed}]
repeats = ["reference_2.tif"]      # the same state once more: tells the camera's noise

[scale]
pixel_size = {case.imaging.pixel_size:g}                  # [mm/px]

[specimen]
cell_size = {case.experiment.specimen.pitch:g}                    # [mm], from hole to hole

[distortion]
# The stage was moved by about
# {about} px
# (along columns, along rows), not exactly enough to be of use.
calibration = ["calibration_*.tif"]

[correlation]
gain_degree = 0                    # the light was not the same in all photographs
"""
