"""The optics of a harvest: a distortion that is given, or calibrated from images of a target."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from modeharvest.harvest.experiment import Experiment
from modeharvest.harvest.prepare import named_files
from modeharvest.idic.calibration import calibrate
from modeharvest.idic.calibration_result import Calibration
from modeharvest.imaging.distortion_files import read_distortion, write_distortion
from modeharvest.imaging.distortion_map import Distortion
from modeharvest.imaging.photographs import read_photograph
from modeharvest.progress import Progress, silent


@dataclass(frozen=True, eq=False)
class Optics:
    """What is known of the lens.

    Parameters
    ----------
    distortion
        S of the paper's Eq. (r2); None for none.
    calibration
        How it was found, if it was not given.
    """

    distortion: Distortion | None = None
    calibration: Calibration | None = None


def find_optics(
    experiment: Experiment, base: Path, path: Path, progress: Progress = silent
) -> Optics:
    """Read or calibrate the distortion; what was calibrated is left in ``path`` (JSON).

    Raises
    ------
    InputError
        If a file can't be used, or the calibration images don't determine the distortion.
    """
    table = experiment.distortion
    if table.file:
        return Optics(read_distortion(base / table.file))
    if not table.calibration:
        return Optics()
    images = [read_photograph(file).image for file in named_files(base, table.calibration)]
    shifts = [(row, col) for col, row in table.shifts] or None
    calibration = calibrate(images, shifts, progress=progress)
    write_distortion(path, calibration.distortion)
    return Optics(calibration.distortion, calibration)
