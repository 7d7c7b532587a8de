"""Photographs of a flat target: where it is in each of them, and how bright that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.interpolation import SplineImage

FloatArray = NDArray[np.float64]

POSE_UNKNOWNS = 5
"""Of a photograph: shift along rows and columns, rotation, contrast, brightness."""


@dataclass(frozen=True)
class Pose:
    """Where the target is in a photograph, and how bright that is.

    T(x) = centre + R (x - centre) + shift, a small rotation from the columns' to the rows' axis.

    Parameters
    ----------
    shift
        (row, col) [px].
    angle
        Rotation [rad].
    contrast, brightness
        c and o: c I + o is as bright as the first photograph.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    angle: float = 0.0
    contrast: float = 1.0
    brightness: float = 0.0

    def stepped(self, step: FloatArray) -> Pose:
        """Add the five unknowns' changes."""
        return Pose(
            (self.shift[0] + float(step[0]), self.shift[1] + float(step[1])),
            self.angle + float(step[2]),
            self.contrast + float(step[3]),
            self.brightness + float(step[4]),
        )


@dataclass(frozen=True, eq=False)
class View:
    """A photograph and what is unknown of it.

    Parameters
    ----------
    spline
        The photograph.
    pose
        Where the target is in it.
    free
        (5,) whether shift (2), rotation, contrast and brightness are unknown.
    distorted
        False if the photograph has no distortion, as one of a known pair.
    border_px
        Width of the margin that is left out: spline and blur know only its mirror image [px].
    """

    spline: SplineImage
    pose: Pose = field(default_factory=Pose)
    free: tuple[bool, ...] = (False,) * POSE_UNKNOWNS
    distorted: bool = True
    border_px: float = 4.0


def with_poses(views: Sequence[View], poses: Sequence[Pose]) -> list[View]:
    """The same views, in other poses."""
    return [replace(view, pose=pose) for view, pose in zip(views, poses, strict=True)]


def lit_alike(
    images: Sequence[NDArray[np.float32]], shifts: FloatArray | None = None
) -> list[Pose]:
    """Poses with (m, 2) shifts [px] that give all images the mean and spread of the first one."""
    mean, spread = float(images[0].mean(dtype=np.float64)), float(images[0].std(dtype=np.float64))
    poses = []
    for n, image in enumerate(images):
        contrast = spread / float(image.std(dtype=np.float64))
        brightness = mean - contrast * float(image.mean(dtype=np.float64))
        row, col = (0.0, 0.0) if shifts is None else shifts[n]
        poses.append(Pose((float(row), float(col)), 0.0, contrast, brightness))
    return poses
