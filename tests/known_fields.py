"""Displacement fields that are known: Eq. (6) of the paper, fields taken at some pixels."""

from __future__ import annotations

import numpy as np

from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.grid import PixelGrid


def sampled_field(
    u: np.ndarray, grid: PixelGrid, mask: np.ndarray, step: int, source: str = "sampled"
) -> LocalField:
    """(rows, cols, 2) u [mm] at every ``step``-th pixel of the mask."""
    row, col = np.mgrid[step // 2 : grid.rows : step, step // 2 : grid.cols : step]
    row, col = (i[mask[row, col]] for i in (row, col))
    x, y = grid.to_mm(row, col)
    return LocalField(x, y, u[row, col], source=source)


def square_mode(mode: object, pitch: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., 2) Eq. (6), unscaled and without taper, of a₁ … a₅ [-], a₆ and a₇ [mm]."""
    a = np.asarray(mode, dtype=np.float64)
    first = np.sin(np.pi / pitch * (a[1] * x + a[2] * y + a[5]))
    second = np.sin(np.pi / pitch * (a[3] * x + a[4] * y + a[6]))
    return np.stack([-a[0] * (first + second), first - second], axis=-1)
