"""Optical distortion of OpenCV's camera model.

Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html, without thin prisms and tilts.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.distortion.mapping import Distortion, require_finite

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class CameraDistortion(Distortion):
    """The lens of OpenCV's camera model (Brown-Conrady, with its rational extension).

    With x = (col - cx) / fx, y = (row - cy) / fy and r^2 = x^2 + y^2 an ideal position is seen at

        x' = x q + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y q + p1 (r^2 + 2 y^2) + 2 p2 x y,
        q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

    col' = cx + fx x', row' = cy + fy y'. The ideal image has the same fx, fy, cx, cy.

    Parameters
    ----------
    fx, fy
        Focal lengths [px].
    cx, cy
        Principal point, column and row [px]; whole numbers are pixel centres, as in OpenCV.
    k1, k2, p1, p2, k3, k4, k5, k6
        Coefficients [-], in OpenCV's order.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        require_finite(np.array(astuple(self)), "camera parameters")
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise InputError(
                f"distortion: expected focal lengths above 0 px, got {self.fx} and {self.fy}"
            )

    def _normalised(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        x: FloatArray = np.subtract(col, self.cx, dtype=np.float64) / self.fx
        y: FloatArray = np.subtract(row, self.cy, dtype=np.float64) / self.fy
        return x, y

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        x, y = self._normalised(row, col)
        x2, y2, xy = x * x, y * y, x * y
        s = x2 + y2
        top = s * (self.k1 + s * (self.k2 + s * self.k3))
        below = s * (self.k4 + s * (self.k5 + s * self.k6))
        more = (top - below) / (1.0 + below)  # q - 1 without cancellation
        d_col = self.fx * (x * more + 2.0 * self.p1 * xy + self.p2 * (s + 2.0 * x2))
        d_row = self.fy * (y * more + self.p1 * (s + 2.0 * y2) + 2.0 * self.p2 * xy)
        return np.asarray(d_row), np.asarray(d_col)

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        x, y = np.broadcast_arrays(*self._normalised(row, col))
        s = x * x + y * y
        top = s * (self.k1 + s * (self.k2 + s * self.k3))
        below = s * (self.k4 + s * (self.k5 + s * self.k6))
        more = (top - below) / (1.0 + below)
        d_top = self.k1 + s * (2.0 * self.k2 + 3.0 * s * self.k3)
        d_below = self.k4 + s * (2.0 * self.k5 + 3.0 * s * self.k6)
        slope = 2.0 * (d_top - (1.0 + more) * d_below) / (1.0 + below)  # dq/dx = slope x
        p1, p2 = self.p1, self.p2
        xx = more + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        yy = more + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        aspect = self.fy / self.fx
        return np.array([[yy, aspect * xy], [xy / aspect, xx]])
