"""Where a mode lives: 1 over the cellular region, fading linearly into the bulk around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.chebyshev import Box

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Taper:
    """The factor tau(x) = tau_x(x) tau_y(y) of a mode.

    Parameters
    ----------
    cellular
        Region where tau = 1 [mm].
    width
        Distance over which tau falls linearly to 0 outside it [mm]; the paper takes half the
        size of the unit cell.
    """

    cellular: Box
    width: float

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise InputError(f"expected a taper wider than 0 mm, got {self.width} mm")

    def along_x(self, x: ArrayLike) -> FloatArray:
        """tau_x [-] at x [mm]."""
        return _ramp(x, self.cellular.x_min, self.cellular.x_max, self.width)

    def along_y(self, y: ArrayLike) -> FloatArray:
        """tau_y [-] at y [mm]."""
        return _ramp(y, self.cellular.y_min, self.cellular.y_max, self.width)


def _ramp(t: ArrayLike, low: float, high: float, width: float) -> FloatArray:
    t = np.asarray(t, dtype=np.float64)
    outside = np.maximum(low - t, t - high)
    return np.clip(1.0 - outside / width, 0.0, 1.0)
