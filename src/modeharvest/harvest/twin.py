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
        twin.json           where the stage really went; written last
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.case import TwinCase
from modeharvest.errors import InputError
from modeharvest.fem.field import Solution
from modeharvest.files import atomic, read_json, write_json
from modeharvest.imaging.calibration_target import photograph_target
from modeharvest.imaging.distorted import seen_points
from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion, write_distortion
from modeharvest.imaging.imageset import ImageSet, image_key, is_complete, make_images
from modeharvest.imaging.io import write_image
from modeharvest.progress import Progress, silent
from modeharvest.stages import digest
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
    key = digest([image_key(solution, strains, spec), plain(case.calibration)])
    if _is_finished(twin, key):
        return twin
    _discard(twin)
    solution.write(truth / "solution.h5")
    images = make_images(solution, strains, spec, truth / "images", progress)
    _copy_photographs(images, photographs)
    lens = spec.lens(images.grid.shape)
    assert lens is not None
    write_distortion(truth / "distortion.json", lens)
    target, seen = case.calibration, seen_points(lens, images.grid.shape)
    shots = photograph_target(target, spec.speckle, seen, spec.sensor, spec.bits)
    for k, (name, levels) in enumerate(shots):
        progress(k, len(target.shifts_px), "images: calibration")
        write_image(photographs / f"{name}.tif", levels)
    with atomic(twin.experiment) as temporary:
        temporary.write_text(_experiment_text(case, images), "utf-8")
    write_json(
        truth / _SIDECAR,
        {
            "key": key,
            "stage_shifts_row_col_px": target.true_shifts.tolist(),
            "photographs": {p.name: p.stat().st_size for p in sorted(photographs.glob("*.tif"))},
        },
    )
    return twin


def _is_finished(twin: Twin, key: str) -> bool:
    """Whether all is there, of the listed sizes, and of that key."""
    try:
        info, images = twin.info, twin.folder / "truth" / "images"
        sizes: dict[str, int] = info["photographs"]
        whole = all((twin.experiment.parent / n).stat().st_size == s for n, s in sizes.items())
        whole = whole and is_complete(images, ImageSet.read(images).info["key"])
        return whole and bool(info["key"] == key) and twin.experiment.is_file()
    except (InputError, OSError, KeyError, TypeError):
        return False


def _discard(twin: Twin) -> None:
    """Take away an older or an unfinished twin's photographs, the mark of completeness first."""
    (twin.folder / "truth" / _SIDECAR).unlink(missing_ok=True)
    for pattern in ("reference*.tif", "deformed_*.tif", "calibration_*.tif"):
        for path in twin.experiment.parent.glob(pattern):
            path.unlink()


def _copy_photographs(images: ImageSet, folder: Path) -> None:
    """Leave the exposures, and a second one of the reference, from which noise is measured."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, source in _exposures(images):
        shutil.copyfile(images.folder / source, folder / f"{name}.tif")
    spec, again = images.spec, "reference_2"
    sensor = spec.sensor
    light = sensor.light(again) / sensor.light("reference")
    irradiance = light * (images.reference() - sensor.offset) / sensor.gain
    levels = sensor.expose(irradiance.astype(np.float32), spec.bits, again)
    write_image(folder / f"{again}.tif", levels)


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
