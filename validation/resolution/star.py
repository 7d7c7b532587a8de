"""The star pattern of DIC Challenge 2.0: a wave whose period grows along the image, exactly imaged.

With the row i down and the column j, in px, from the centre of the upper left pixel,

    v(i, j) = A cos(2 pi (i - c) / p(j)) down,  u = 0,  p(j) = p_1 + (p_2 - p_1) j / (cols - 1),

c the centre row: there the motion is A at all columns, and what a code measures along it, over A,
is how much of a wave of each period it sees. By default 4000 x 501 px, A = 0.5 px, periods from 10
to 300 px, as in P. L. Reu et al., Exp. Mech. 62 (2022) 639, doi 10.1007/s11340-021-00806-6.

The displacement belongs to points of the *reference*: a deformed pixel shows the point X with
X + u(X) = x, found to rounding, where the speckle is evaluated, not interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle import Speckle, SpeckleSpec
from modeharvest.memory import require_memory

FloatArray = NDArray[np.float64]

_BYTES_PER_PIXEL = 300.0
"""Of making the images."""
_STEEPEST = 0.9
"""Largest derivative of the motion, 2 pi A / p [-]: at 1 the image folds."""
_NEAR = 1e-3
"""From here on Newton's method converges [px]."""


@dataclass(frozen=True)
class Star:
    """The wave and the image it is in.

    Parameters
    ----------
    rows, cols
        Size of the image [px]; an odd number of rows has a centre row.
    amplitude_px
        A [px].
    shortest_px, longest_px
        Periods at the first and at the last column [px].

    Raises
    ------
    InputError
        If the image would nearly fold, or is too small.
    """

    rows: int = 501
    cols: int = 4000
    amplitude_px: float = 0.5
    shortest_px: float = 10.0
    longest_px: float = 300.0

    def __post_init__(self) -> None:
        if self.rows < 31 or self.rows % 2 == 0 or self.cols < 100:
            raise InputError(
                "star: expected an odd number of rows, at least 31, and at least 100 columns, got "
                f"{self.rows} x {self.cols} px"
            )
        require_memory(
            _BYTES_PER_PIXEL * self.rows * self.cols, f"a star of {self.rows} x {self.cols} px",
            "take fewer --rows or --cols",
        )  # fmt: skip
        steepest = 2.0 * np.pi * self.amplitude_px / self.shortest_px
        if not (0.0 < steepest <= _STEEPEST and 0.0 < self.shortest_px < self.longest_px < np.inf):
            raise InputError(
                f"star: expected 0 < 2 pi amplitude <= {_STEEPEST} shortest period, and a longer "
                "longest one, got an amplitude "
                f"of {self.amplitude_px} px and periods of {self.shortest_px} to "
                f"{self.longest_px} px"
            )

    @property
    def centre_row(self) -> int:
        """The row where the motion is A everywhere."""
        return self.rows // 2

    @property
    def grid(self) -> PixelGrid:
        """The pixels, with a px for the unit of length: x = column, y = 0 at the centre row, up."""
        return PixelGrid(self.rows, self.cols, 1.0, 0.0, float(self.centre_row))

    def period(self, col: ArrayLike) -> FloatArray:
        """(...) period of the wave at columns (...) [px]."""
        share = np.asarray(col, dtype=np.float64) / (self.cols - 1)
        return np.asarray(self.shortest_px + (self.longest_px - self.shortest_px) * share)

    def column(self, period: ArrayLike) -> FloatArray:
        """(...) columns at which the wave has these periods (...) [px]."""
        share = np.subtract(period, self.shortest_px) / (self.longest_px - self.shortest_px)
        return np.asarray((self.cols - 1) * share, dtype=np.float64)

    def down(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """v, positive down, at points of the reference (row, col) that broadcast together [px]."""
        phase = 2.0 * np.pi * np.subtract(row, self.centre_row) / self.period(col)
        return np.asarray(self.amplitude_px * np.cos(phase))

    def displacement(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2) u along x and up at points of :attr:`grid` (...) [px]."""
        v = self.down(np.subtract(self.centre_row, y), x)
        return np.stack([np.zeros_like(v), -v], axis=-1)

    def came_from(self) -> tuple[FloatArray, float]:
        """(rows, cols) row X of the point that each deformed pixel shows, and max |X + v(X) - x|.

        The fixed point of X = x - v(X), which each step brings nearer by 2 pi A / p at least, then
        Newton's steps down to rounding; columns stay what they are. Both in px.
        """
        row = np.arange(self.rows, dtype=np.float64)[:, None]
        wave = 2.0 * np.pi / self.period(np.arange(self.cols))
        point = np.broadcast_to(row, (self.rows, self.cols)).copy()
        before = np.inf
        while True:
            phase = wave * (point - self.centre_row)
            error = point + self.amplitude_px * np.cos(phase) - row
            largest = float(np.abs(error).max())
            if largest >= 0.5 * before:  # Newton's steps have come down to rounding
                return point, largest
            if largest < _NEAR:
                error /= 1.0 - self.amplitude_px * wave * np.sin(phase)
                before = largest
            point -= error


def fine_speckle(seed: int = 0) -> SpeckleSpec:
    """A speckle for subsets from 9 px on: grains of 5 px (width of its autocorrelation).

    Noise of a tenth of full scale is cut off at neither end.
    """
    return SpeckleSpec(standard_deviation=0.1, blur_px=1.0, dark=0.1, bright=0.9, seed=seed)


@dataclass(frozen=True, eq=False)
class StarImages:
    """The exact images of a star.

    Parameters
    ----------
    star
        The wave.
    speckle
        What moves with it.
    """

    star: Star = field(default_factory=Star)
    speckle: SpeckleSpec = field(default_factory=fine_speckle)

    def render(self) -> tuple[FloatArray, FloatArray, float]:
        """(rows, cols) f and g [fraction of full scale], and the inversion's residual [px]."""
        pattern = Speckle(self.speckle, (self.star.rows, self.star.cols))
        row, residual_px = self.star.came_from()
        col = np.broadcast_to(np.arange(self.star.cols, dtype=np.float64), row.shape)
        return pattern.image(), pattern.exact(row, col), residual_px
