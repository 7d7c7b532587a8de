"""The optics of a harvest: a distortion that is given, or calibrated from images of a target."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.errors import InputError
from modeharvest.files import read_json, write_json
from modeharvest.harvest.experiment import DistortionTable
from modeharvest.harvest.inputs import named_files
from modeharvest.idic.calibration.calibrate import calibrate
from modeharvest.idic.calibration.result import Calibration, DegreeTrial
from modeharvest.imaging.distortion.files import read_distortion, write_distortion
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.distortion.undistort import PolynomialDistortion
from modeharvest.imaging.photographs.photograph import read_photograph
from modeharvest.progress import Progress, silent
from modeharvest.reading import reading

_ARRAYS = ("shifts", "shifts_sd", "angles", "angles_sd", "matches", "covariance")


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


def calibrate_lens(
    table: DistortionTable, base: Path, folder: Path, progress: Progress = silent
) -> None:
    """Calibrate from the images of a target; leaves ``distortion.json``, ``calibration.json``.

    Raises
    ------
    InputError
        If a file can't be used, or the images don't determine the distortion.
    """
    images = [read_photograph(file).image for file in named_files(base, table.calibration)]
    shifts = [(row, col) for col, row in table.shifts] or None
    found = calibrate(images, shifts, progress=progress)
    write_distortion(folder / "distortion.json", found.distortion)
    content: dict[str, Any] = {name: getattr(found, name).tolist() for name in _ARRAYS}
    content["trials"] = [asdict(trial) for trial in found.trials]
    content |= {"noise_sd": found.noise_sd, "fixed": found.fixed, "sentences": found.sentences}
    write_json(folder / "calibration.json", content)


def calibrated_lens(folder: Path) -> Optics:
    """What :func:`calibrate_lens` left."""
    path = folder / "calibration.json"
    with reading(path, "a calibration", "remove it, and harvest again"):
        distortion, content = read_distortion(folder / "distortion.json"), read_json(path)
        if not isinstance(distortion, PolynomialDistortion):  # that is what is calibrated
            raise InputError("expected a polynomial in distortion.json beside it, got another kind")
        calibration = Calibration(
            distortion=distortion,
            trials=tuple(DegreeTrial(**trial) for trial in content["trials"]),
            noise_sd=float(content["noise_sd"]),
            fixed=int(content["fixed"]),
            sentences=tuple(map(str, content["sentences"])),
            **{name: np.array(content[name], dtype=np.float64) for name in _ARRAYS},
        )
        return Optics(distortion, calibration)
