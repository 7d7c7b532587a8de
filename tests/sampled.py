"""A field known at pixels, taken at some of them as a local DIC would measure it."""

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
