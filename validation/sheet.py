"""What all maps of a specimen share: the outline, the cells that are drawn, the frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.outline import Outline

FloatArray = NDArray[np.float64]
Motion = Callable[[FloatArray, FloatArray], FloatArray]
"""(..., 2) displacement [mm] at positions x, y [mm] that broadcast together."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """What all maps of a specimen share, so that they can be laid over each other.

    Parameters
    ----------
    outline
        Of the specimen.
    grid
        The images' pixels joined to the cells that are drawn.
    factor
        Pixels joined, in each direction.
    limits
        (left, right, bottom, top) of every map [mm].
    """

    outline: Outline
    grid: PixelGrid
    factor: int
    limits: tuple[float, float, float, float]

    @classmethod
    def of(cls, mesh: Mesh, grid: PixelGrid, cells: int = 360) -> Sheet:
        """Make a sheet for a mesh, with about that many cells along the longer side."""
        factor = max(1, round(max(grid.shape) / cells))
        (left, bottom), (right, top) = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        margin = 0.012 * max(right - left, top - bottom)
        limits = (left - margin, right + margin, bottom - margin, top + margin)
        return cls(Outline.of(mesh), grid.binned(factor), factor, limits)

    def average(self, field: FloatArray) -> FloatArray:
        """Average a field (rows, cols) of the images over the cells, NaN left out."""
        known = np.isfinite(field)
        count = self._sum(known.astype(np.float64))
        total = self._sum(np.where(known, field, 0.0))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _sum(self, field: FloatArray) -> FloatArray:
        """Sums over the cells' pixels; rows first, which is several times faster."""
        (rows, cols), n = self.grid.shape, self.factor
        whole = field[: rows * n].reshape(rows, n, -1).sum(axis=1)[:, : cols * n]
        return np.asarray(whole.reshape(rows, cols, n).sum(axis=2))

    def sample(self, field: FloatArray) -> FloatArray:
        """Take the middle pixel of each cell from a field (rows, cols) of the images."""
        rows, cols = self.grid.shape
        n, middle = self.factor, self.factor // 2
        return field[middle : rows * n : n, middle : cols * n : n]

    def moved_nodes(self, motion: Motion | None) -> FloatArray | None:
        """(n, 2) displacement of the mesh's nodes [mm]."""
        if motion is None:
            return None
        x, y = self.outline.nodes.T
        return motion(x[:, None], y[:, None])[:, 0]

    def moved_corners(self, motion: Motion | None) -> tuple[FloatArray, FloatArray]:
        """(rows + 1, cols + 1) positions of the cells' corners [mm], none off the specimen."""
        h = 0.5 * self.grid.pixel_size
        low, high = self.outline.nodes.min(axis=0), self.outline.nodes.max(axis=0)
        x = np.clip(np.append(self.grid.x - h, self.grid.x[-1] + h), low[0], high[0])
        y = np.clip(np.append(self.grid.y + h, self.grid.y[-1] - h), low[1], high[1])
        X, Y = np.meshgrid(x, y)
        if motion is None:
            return X, Y
        u = motion(x[None, :], y[:, None])
        return X + u[..., 0], Y + u[..., 1]
