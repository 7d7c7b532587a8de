"""A specimen's own axes, if it stands obliquely in its photographs, and strains along them.

The first axis is at an angle to x, counter-clockwise [degrees]; the second is perpendicular to it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

_RECTANGLE, _TURNED_DEG = 0.97, 1.0
"""Least share of a rectangle that a specimen with straight sides fills; least angle reported."""


def require_angle(what: str, angle: float) -> None:
    """Raise InputError unless an angle is between -180 and 180 degrees; ``what``: its key."""
    if not abs(angle) <= 180.0:
        same = f"the same axis is at {(angle + 90.0) % 180.0 - 90.0:g}" if np.isfinite(angle) else (
            "give the direction of the specimen's axis")  # fmt: skip
        raise InputError(
            f"{what}: expected degrees from x, counter-clockwise, from -180 to 180, got {angle:g}; "
            f"{same}"
        )


def turned_axes(angle: float) -> FloatArray:
    """(2, 2) axes as rows, turned counter-clockwise from x and y [degrees]."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, s], [-s, c]])


def strains_along(F: FloatArray, angle: float) -> FloatArray:
    """(2,) engineering strains along both axes by a deformation gradient (2, 2); tension > 0."""
    return np.asarray(np.linalg.norm(F @ turned_axes(angle).T, axis=0) - 1.0)


def turned_sides(mask: BoolArray, how: str) -> tuple[str, ...]:
    """Text if a mask (rows, cols) is a rectangle, but for holes, whose sides are turned.

    ``how``: the option or key that takes the angle.
    """
    row, col = np.nonzero(np.diff(mask, axis=1, prepend=False, append=False))
    corners = np.concatenate([np.column_stack([col, half - row]) for half in (-0.5, 0.5)])
    hull = ConvexHull(corners)
    corners = corners[hull.vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    angles = (np.degrees(np.arctan2(sides[:, 1], sides[:, 0])) + 45.0) % 90.0 - 45.0
    turned = (turned_axes(angle) @ corners.T for angle in angles)
    areas = [float(np.prod(np.ptp(points, axis=1))) for points in turned]
    best = int(np.argmin(areas))  # of the smallest rectangle around the material
    angle = float(angles[best])
    if hull.volume < _RECTANGLE * areas[best] or abs(angle) < _TURNED_DEG:
        return ()
    return (
        f"The specimen's sides are turned by {angle:.1f}° from the picture's axes: mean strains, "
        f"and those of gauges, are along its own axes with {how} {angle:.1f}.",
    )
