"""Virtual calibration photographs of a flat speckled target that a stage shifts.

The target fills the image and moves rigidly, so any other apparent motion is due to the lens. The
point of the target that the first photograph shows at the ideal position x is at x + t in a
photograph with shift t. A pixel p shows the target at phi_S^-1(p) - t, evaluated exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.distortion.lens import Positions
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within


@dataclass(frozen=True)
class CalibrationTarget:
    """A target and its stage's shifts; InputError if a value is out of its range."""

    shifts_px: tuple[tuple[float, float], ...] = (
        (0.0, 0.0), (100.0, 0.0), (0.0, 100.0), (-250.0, 60.0), (60.0, -250.0), (200.0, 200.0),
    )  # fmt: skip
    """Intended shifts (along columns, along rows) [px], one for each photograph."""
    stage_sd_px: float = 0.3
    """Standard deviation of the stage's error in each component of each shift [px]."""
    seed: int = 0
    """Seed of the stage's errors and of the target's speckle."""
    speckle: SpeckleSpec | None = None
    """The target's pattern, whose seeds are ignored; None for the specimen's pattern."""

    def __post_init__(self) -> None:
        if not self.shifts_px or not np.isfinite(self.shifts_px).all():
            what = "finite shifts (along columns, along rows) [px]"
            raise InputError(f"calibration: expected {what}, got {self.shifts_px}")
        require_within("calibration: expected a stage_sd_px", self.stage_sd_px, 0.0, 1000.0)
        require_within("calibration: expected a seed", self.seed, 0)

    @property
    def true_shifts(self) -> FloatArray:
        """(m, 2) actual shifts of the stage, along (rows, columns) [px]."""
        intended = np.array(self.shifts_px)[:, ::-1]
        error = np.random.default_rng(self.seed).normal(0.0, 1.0, intended.shape)
        return np.asarray(intended + self.stage_sd_px * error)


def photograph_target(
    target: CalibrationTarget, speckle: SpeckleSpec, points: Positions, sensor: Sensor, bits: int
) -> Iterator[tuple[str, NDArray[np.uint8] | NDArray[np.uint16]]]:
    """Make the photographs one by one: name ("calibration_00", ...) and (rows, cols) grey levels.

    target, sensor, bits : shifts and pattern; the camera.
    speckle : the pattern if ``target.speckle`` is None; its seeds are ignored.
    points : (row, col), each (rows, cols) [px]: the ideal positions that the pixels show.
    """
    rows, cols = points[0].shape
    speckle = replace(target.speckle or speckle, seed=target.seed)
    if speckle.ink is not None:
        speckle = replace(speckle, ink=replace(speckle.ink, seed=target.seed))
    pattern = Speckle(speckle, (rows, cols))
    for k, (down, right) in enumerate(target.true_shifts):
        name = f"calibration_{k:02d}"
        irradiance = pattern(points[0] - down, points[1] - right).astype(np.float32)
        yield name, sensor.expose(np.float32(sensor.illumination(name)) * irradiance, bits, name)
