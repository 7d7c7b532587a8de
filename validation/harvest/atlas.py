"""What all pictures of a harvest share: outline, frame, and which photographs are shown."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.validation.harvest.mask_outline import outline_of_mask
from modeharvest.validation.harvest.run import Harvest, HarvestedFrame
from modeharvest.validation.outline import Outline
from modeharvest.validation.sheet import Motion, Sheet

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MOST = 6
"""Photographs with pictures of their own, at most; numbers are told of all."""
FINE, SMOOTH, COARSE = 640, 320, 160
"""Cells along a map's longer side: as fine as speckles, as patterns, as error bars."""
SHAPE = 0.16
"""Largest displacement that modes are drawn with [l]."""
_SPECK = 0.01  # l²: holes and islands smaller than that are not drawn
_LEVELS = (0.5, 99.5)  # percentiles of the reference's grey levels, drawn black and white


@dataclass(frozen=True, eq=False)
class HarvestAtlas:
    """A harvest with the frames that its maps are drawn in.

    Parameters
    ----------
    harvest
        What is shown.
    """

    harvest: Harvest
    _sheets: dict[int, Sheet] = field(default_factory=dict, repr=False)

    @cached_property
    def shown(self) -> tuple[HarvestedFrame, ...]:
        """The frames with pictures: those around buckling, and evenly spaced ones."""
        frames, moments = self.harvest.frames, self.harvest.timeline
        if len(frames) <= MOST:
            return frames
        has_pattern = [m.has_pattern for m in moments] if len(moments) == len(frames) else []
        first = has_pattern.index(True) if True in has_pattern else 0
        chosen = {max(0, first - 1), first, len(frames) - 1}
        for k in np.linspace(0, len(frames) - 1, MOST).round().astype(int):
            if len(chosen) < MOST:
                chosen.add(int(k))
        return tuple(frames[k] for k in sorted(chosen))

    @cached_property
    def outline(self) -> Outline:
        """Of the material in the reference."""
        harvest = self.harvest
        found = outline_of_mask(harvest.mask, harvest.grid, _SPECK * harvest.pitch**2)
        return found if len(found.nodes) else outline_of_mask(
            np.ones_like(harvest.mask), harvest.grid)  # fmt: skip

    def sheet(self, cells: int = SMOOTH) -> Sheet:
        """The frame of maps with about that many cells along the longer side."""
        if cells not in self._sheets:
            grid = self.harvest.grid
            factor = max(1, round(max(grid.shape) / cells))
            low, high = self.outline.nodes.min(axis=0), self.outline.nodes.max(axis=0)
            margin = 0.012 * float((high - low).max())
            limits = (low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
            self._sheets[cells] = Sheet(self.outline, grid.binned(factor), factor, limits)
        return self._sheets[cells]

    @cached_property
    def levels(self) -> tuple[float, float]:
        """Grey levels of the reference that are drawn black and white."""
        step = max(1, max(self.harvest.grid.shape) // 700)
        low, high = np.percentile(self.harvest.reference[::step, ::step], _LEVELS)
        return float(low), float(max(high, low + 1e-12))

    def grey(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """Grey levels of a photograph as 0 (black) to 1 (white)."""
        low, high = self.levels
        return np.clip((np.asarray(image, dtype=np.float32) - np.float32(low))
                       / np.float32(high - low), 0.0, 1.0)  # fmt: skip

    def seen(self, values: FloatArray, cells: int = SMOOTH) -> FloatArray:
        """Values on a sheet; NaN off the material, where the ansatz means nothing."""
        return np.where(self.material(cells), values, np.nan)

    def material(self, cells: int = SMOOTH) -> BoolArray:
        """Which cells of a sheet have material in the reference."""
        sheet, mask = self.sheet(cells), self.harvest.mask
        (rows, cols), n = sheet.grid.shape, sheet.factor
        blocks = mask[: rows * n, : cols * n].reshape(rows, n, cols, n)
        return np.asarray(blocks.any(axis=(1, 3)))

    @staticmethod
    def motion(frame: HarvestedFrame) -> Motion:
        """The displacement that was measured in a frame."""
        result = frame.result
        return lambda x, y: result.ansatz.displacement(result.unknowns, x, y)
