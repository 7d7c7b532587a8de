"""Optical distortion given on a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from modeharvest.errors import InputError
from modeharvest.imaging.distortion.mapping import Distortion, require_finite

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SampledDistortion(Distortion):
    """S given on a grid, with a bicubic spline through it.

    Beyond the grid it goes on linearly from the edge.

    Parameters
    ----------
    rows, cols
        (n,) and (m,) positions of the grid's lines [px], ascending, at least 4 of each.
    field
        (2, n, m) S along the rows' and the columns' index [px].
    """

    rows: FloatArray
    cols: FloatArray
    field: FloatArray

    def __post_init__(self) -> None:
        for name in ("rows", "cols", "field"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
            require_finite(getattr(self, name), name)
        if any(a.ndim != 1 or a.size < 4 or (np.diff(a) <= 0).any() for a in self._axes):
            raise InputError(
                "distortion: expected at least 4 ascending rows and cols of a sampled field [px], "
                f"got {self.rows.size} and {self.cols.size}"
            )
        if self.field.shape != (2, self.rows.size, self.cols.size):
            raise InputError(
                f"distortion: expected a field of shape {(2, self.rows.size, self.cols.size)} "
                f"like its rows and cols, got {self.field.shape}"
            )

    @property
    def _axes(self) -> tuple[FloatArray, FloatArray]:
        return self.rows, self.cols

    @cached_property
    def _splines(self) -> tuple[RectBivariateSpline, RectBivariateSpline]:
        along_row, along_col = (RectBivariateSpline(*self._axes, f, s=0) for f in self.field)
        return along_row, along_col

    def _evaluate(
        self, row: ArrayLike, col: ArrayLike, orders: tuple[tuple[int, int], ...]
    ) -> tuple[list[tuple[FloatArray, ...]], FloatArray, FloatArray]:
        """Derivatives of both components at the nearest point of the grid, and how far that is."""
        row, col = np.asarray(row, dtype=np.float64), np.asarray(col, dtype=np.float64)
        near_row = np.clip(row, self.rows[0], self.rows[-1])
        near_col = np.clip(col, self.cols[0], self.cols[-1])
        is_grid = row.ndim == 2 and row.shape[1] == 1 and col.shape[:1] == (1,)
        found = []
        for spline in self._splines:
            if is_grid and (np.diff(row[:, 0]) > 0).all() and (np.diff(col[0]) > 0).all():
                # Where the axes were clipped they don't ascend strictly, which is allowed.
                at = near_row[:, 0], near_col[0]
                values = tuple(spline(*at, dx=i, dy=j) for i, j in orders)
            else:
                values = tuple(spline.ev(near_row, near_col, dx=i, dy=j) for i, j in orders)
            found.append(values)
        return found, row - near_row, col - near_col

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        found, dr, dc = self._evaluate(row, col, ((0, 0), (1, 0), (0, 1), (1, 1)))
        d_row, d_col = (s + s_r * dr + (s_c + s_rc * dr) * dc for s, s_r, s_c, s_rc in found)
        return d_row, d_col

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        found, dr, dc = self._evaluate(row, col, ((1, 0), (0, 1), (1, 1)))
        return np.array([[s_r + s_rc * dc, s_c + s_rc * dr] for s_r, s_c, s_rc in found])
