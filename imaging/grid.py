"""Conversion of pixels and millimetres: the only place where the y axis is flipped.

Physical frame: x right, y up, in mm. Image frame: column right, row *down*, in px, whole
numbers at pixel centres. Displacements everywhere in the project are components along the
physical axes (y up), whether in mm or in px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError


@dataclass(frozen=True)
class PixelGrid:
    """A regular grid of square pixels laid over the physical plane."""

    rows: int
    cols: int
    """Image size [px]."""
    pixel_size: float
    """Edge of a pixel [mm/px]."""
    x0: float
    y0: float
    """Position of the centre of pixel (row 0, column 0), the upper left one [mm]."""

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or not self.pixel_size > 0:
            raise InputError(
                "expected an image of at least 1 x 1 px and a positive pixel size, got "
                f"{self.rows} x {self.cols} px at {self.pixel_size} mm/px"
            )

    @classmethod
    def centred(cls, rows: int, cols: int, pixel_size: float) -> PixelGrid:
        """Make the grid of pixels of an edge [mm] whose image centre is at the physical origin."""
        x0, y0 = -0.5 * (cols - 1) * pixel_size, 0.5 * (rows - 1) * pixel_size
        return cls(rows, cols, pixel_size, x0, y0)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) [px]."""
        return self.rows, self.cols

    @property
    def x(self) -> FloatArray:
        """(cols,) x of the pixel centres [mm], ascending."""
        return np.asarray(self.x0 + self.pixel_size * np.arange(self.cols), dtype=np.float64)

    @property
    def y(self) -> FloatArray:
        """(rows,) y of the pixel centres [mm], descending."""
        return np.asarray(self.y0 - self.pixel_size * np.arange(self.rows), dtype=np.float64)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the image's outer edge [mm], as matplotlib wants it."""
        h = 0.5 * self.pixel_size
        return self.x[0] - h, self.x[-1] + h, self.y[-1] - h, self.y[0] + h

    def to_mm(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Physical position (x, y) [mm] of image positions (row, col) [px]."""
        x = self.x0 + self.pixel_size * np.asarray(col, dtype=np.float64)
        y = self.y0 - self.pixel_size * np.asarray(row, dtype=np.float64)
        return x, y

    def to_px(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Image position (row, col) [px] of physical positions (x, y) [mm]."""
        col = np.subtract(x, self.x0, dtype=np.float64) / self.pixel_size
        row = np.subtract(self.y0, y, dtype=np.float64) / self.pixel_size
        return np.asarray(row), np.asarray(col)

    def binned(self, factor: int) -> PixelGrid:
        """The grid of blocks of ``factor`` x ``factor`` pixels; incomplete blocks are dropped."""
        rows, cols, h = self.rows // factor, self.cols // factor, self.pixel_size * factor
        shift = 0.5 * (factor - 1) * self.pixel_size
        return PixelGrid(rows, cols, h, self.x0 + shift, self.y0 - shift)
