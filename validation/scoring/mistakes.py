"""Mistakes in what a field means, recognised by how much better it would fit without them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.fields.local_field import LocalField
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
Truth = Callable[[FloatArray, FloatArray], FloatArray]
"""(n, 2) true displacement [mm] at positions x, y (n,) [mm]; NaN off the material."""
Reading = tuple[FloatArray, FloatArray, FloatArray]

_POINTS = 4000
_BETTER = 3.0
"""A reading whose median error is so many times smaller is what was meant."""
_SMALL_PX = 0.02
"""A field with a smaller median error is what it says [px]."""


def mistakes(field: LocalField, truth: Truth, grid: PixelGrid) -> tuple[str, ...]:
    """Sentences about what the field probably means instead of what was declared; often none.

    Parameters
    ----------
    field
        As declared.
    truth
        The true displacement anywhere.
    grid
        The reference image's pixels.
    """
    x, y, u = field.valid_points()
    some = np.linspace(0, len(x) - 1, min(len(x), _POINTS)).astype(int)
    x, y, u = x[some], y[some], u[some]
    declared, known = _median_px((x, y, u), truth, grid)
    if not declared > _SMALL_PX:
        return ()
    found = {
        words: _median_px(reading, truth, grid)
        for words, reading in _readings(x, y, u, grid).items()
    }
    fair = {words: error for words, (error, count) in found.items() if 2 * count >= known}
    if not fair:
        return ()
    words = min(fair, key=fair.__getitem__)
    if not fair[words] * _BETTER < declared:
        return ()
    return (
        f"{field.source}: the median error of {declared:.3g} px would be {fair[words]:.3g} px if "
        f"{words}; check what the file holds",
    )


def _readings(x: FloatArray, y: FloatArray, u: FloatArray, grid: PixelGrid) -> dict[str, Reading]:
    """What a field that was misunderstood would be: positions and displacements [mm]."""
    up, h = u * [1.0, -1.0], grid.pixel_size
    row, col = grid.to_px(x, y)
    turned = grid.to_mm(col, row)
    upside_down = grid.to_mm(grid.rows - 1 - row, col)
    readings: dict[str, Reading] = {
        "the positions were those of the deformed image": (x - u[:, 0], y - u[:, 1], u),
        "u led from the deformed image back to the reference": (x + u[:, 0], y + u[:, 1], -u),
        "u and v had the other sign": (x, y, -u),
        "v had the other sign": (x, y, up),
        "u had the other sign": (x, y, -up),
        "the y axis pointed the other way": (*upside_down, up),
        "u and v were exchanged": (x, y, u[:, ::-1]),
        "rows and columns were exchanged": (*turned, -u[:, ::-1]),
    }
    for by, name in ((1, "(1, 1)"), (-1, "(-1, -1)")):
        words = f"the first pixel's centre were {name} in the file's count from what was declared"
        readings[words] = (x - by * h, y + by * h, u)
    return readings


def _median_px(reading: Reading, truth: Truth, grid: PixelGrid) -> tuple[float, int]:
    """Median length of the error [px], and at how many points on the material."""
    x, y, u = reading
    length = np.linalg.norm(u - truth(x, y), axis=1) / grid.pixel_size
    known = np.isfinite(length)
    if not known.any():
        return float("inf"), 0
    return float(np.median(length[known])), int(known.sum())
