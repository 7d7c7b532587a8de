"""The outline of material that is known from a mask image: where no mesh says where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray
from skimage.measure import approximate_polygon, find_contours

from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.outline import Outline

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CELLS = 900
"""Along the mask's longer side, at most about that many cells; an outline needs no more."""
_TOLERANCE = 0.3  # cells that corners may be off, once straight runs have become one edge


@dataclass(frozen=True, eq=False)
class PolygonOutline(Outline):
    """An outline whose edges are straight."""

    def path(self, displacement: FloatArray | None = None) -> Path:
        """The outline, displaced by (n, 2) at its corners [mm]; holes stay open when filled."""
        moved = self.nodes if displacement is None else self.nodes + displacement
        vertices: list[FloatArray] = [np.empty((0, 2))]
        codes: list[np.uint8] = []
        for loop in self.loops:
            vertices += [moved[loop[:, 0]], moved[loop[:1, 0]]]
            codes += [Path.MOVETO, *[Path.LINETO] * (len(loop) - 1), Path.CLOSEPOLY]
        return Path(np.vstack(vertices), codes)


def outline_of_mask(mask: BoolArray, grid: PixelGrid, least: float = 0.0) -> PolygonOutline:
    """Follow the edge of a mask.

    Parameters
    ----------
    mask
        (rows, cols) True on material.
    grid
        Its pixels.
    least
        Area [mm²] below which holes and islands are left out, as specks.

    Returns
    -------
    PolygonOutline
        Off the mask's edge by at most about a third of a cell; none for an empty mask.
    """
    factor = max(1, round(max(grid.shape) / CELLS))
    cells = grid.binned(factor)
    cover = np.pad(_joined(mask, factor), 1)  # or what touches the image's edge would stay open
    nodes: list[FloatArray] = [np.empty((0, 2))]
    loops, count = [], 0
    for contour in find_contours(cover, 0.5):  # type: ignore[no-untyped-call]
        rounded = approximate_polygon(contour, _TOLERANCE)  # type: ignore[no-untyped-call]
        corners = rounded[:-1] - 1.0
        x, y = cells.to_mm(corners[:, 0], corners[:, 1])
        if len(corners) < 3 or _area(x, y) <= least:
            continue
        first = count + np.arange(len(corners))
        loops.append(np.stack([first, first, np.roll(first, -1)], axis=1))
        nodes.append(np.stack([x, y], axis=1))
        count += len(corners)
    return PolygonOutline(np.vstack(nodes), tuple(loops))


def _joined(mask: BoolArray, factor: int) -> NDArray[np.float32]:
    """Share of material in blocks of pixels; incomplete blocks are dropped."""
    rows, cols = (size // factor for size in mask.shape)
    blocks = mask[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _area(x: FloatArray, y: FloatArray) -> float:
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
