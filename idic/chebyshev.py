"""Products of Chebyshev polynomials on a box: the slow fields of the ansatz.

A field of total degree D is the sum of c_ij T_i(xi) T_j(eta) over i + j <= D, where xi and eta
run from -1 to 1 across the box: 21 terms for D = 5, 28 for D = 6.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.separable import sum_of_products

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """An axis-parallel rectangle in the physical frame [mm]."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    def __post_init__(self) -> None:
        if not np.isfinite(astuple(self)).all():
            raise InputError(f"expected finite limits of a box [mm], got {astuple(self)}")
        if not (self.x_min < self.x_max and self.y_min < self.y_max):
            raise InputError(
                "expected a box with x_min < x_max and y_min < y_max [mm], got "
                f"({self.x_min}, {self.x_max}, {self.y_min}, {self.y_max})"
            )

    @classmethod
    def centred(cls, width: float, height: float) -> Box:
        """Make the box of this size [mm] around the origin."""
        return cls(-0.5 * width, 0.5 * width, -0.5 * height, 0.5 * height)

    @property
    def centre(self) -> tuple[float, float]:
        """(x, y) of the middle [mm]."""
        return 0.5 * (self.x_min + self.x_max), 0.5 * (self.y_min + self.y_max)

    @property
    def half(self) -> tuple[float, float]:
        """Half the width and half the height [mm]."""
        return 0.5 * (self.x_max - self.x_min), 0.5 * (self.y_max - self.y_min)

    def normalised(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(xi, eta) in [-1, 1] of positions [mm] inside the box."""
        (xc, yc), (hx, hy) = self.centre, self.half
        xi: FloatArray = np.subtract(x, xc, dtype=np.float64) / hx
        eta: FloatArray = np.subtract(y, yc, dtype=np.float64) / hy
        return xi, eta


def orders(degree: int) -> tuple[tuple[int, int], ...]:
    """All (i, j) with i + j <= degree, by rising total degree, x first."""
    return tuple((total - j, j) for total in range(degree + 1) for j in range(total + 1))


def chebyshev(t: ArrayLike, degree: int) -> FloatArray:
    """T_0(t) ... T_degree(t), stacked along a new first axis."""
    t = np.asarray(t, dtype=np.float64)
    values = np.empty((degree + 1, *t.shape))
    values[0] = 1.0
    if degree > 0:
        values[1] = t
    for k in range(2, degree + 1):
        values[k] = 2.0 * t * values[k - 1] - values[k - 2]
    return values


@dataclass(frozen=True)
class ChebyshevField:
    """The space of scalar fields of total degree ``degree`` on ``box``.

    The coefficients are in the order of :func:`orders`; the field has their unit.
    """

    box: Box
    degree: int

    def __post_init__(self) -> None:
        if self.degree < 0:
            raise InputError(f"expected a degree of at least 0, got {self.degree}")

    @property
    def orders(self) -> tuple[tuple[int, int], ...]:
        """(i, j) of each coefficient."""
        return orders(self.degree)

    @property
    def size(self) -> int:
        """Number of coefficients: (degree + 1)(degree + 2)/2."""
        return (self.degree + 1) * (self.degree + 2) // 2

    def square(self, coefficients: ArrayLike) -> FloatArray:
        """(degree + 1, degree + 1) array [i, j], zero where i + j > degree."""
        matrix = np.zeros((self.degree + 1, self.degree + 1))
        i, j = np.array(self.orders).T
        matrix[i, j] = coefficients
        return matrix

    def evaluate(
        self, coefficients: ArrayLike, x: FloatArray, y: FloatArray, out: FloatArray | None = None
    ) -> FloatArray:
        """Evaluate the field at positions [mm] that broadcast together, into ``out`` if given.

        Fast on an open grid, x of shape (1, cols) and y of shape (rows, 1).
        """
        xi, eta = self.box.normalised(x, y)
        table = self.square(coefficients).T
        along_x = np.asarray(np.tensordot(table, chebyshev(xi, self.degree), axes=1), np.float64)
        return sum_of_products(along_x, chebyshev(eta, self.degree), out)

    def basis(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., size): every product T_i T_j at positions [mm] that broadcast together."""
        xi, eta = self.box.normalised(x, y)
        along_x, along_y = chebyshev(xi, self.degree), chebyshev(eta, self.degree)
        return np.stack([along_x[i] * along_y[j] for i, j in self.orders], axis=-1)
