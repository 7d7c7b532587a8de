"""Chebyshev polynomials on a box, and the gain and offset of the grey levels expanded in them.

A field of total degree D is the sum of c_ij T_i(xi) T_j(eta) over i + j <= D, where xi and eta run
from -1 to 1 across the box: 21 terms for D = 5, 28 for D = 6. v0, every v_i, the gain 1 + b and the
offset c in f(x) = (1 + b(x)) g(x + u(x)) + c(x) are such fields.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike

from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError


def sum_of_products(
    along_x: FloatArray, along_y: FloatArray, out: FloatArray | None = None
) -> FloatArray:
    """Sum over k the products along_x[k] * along_y[k], (n, ...) each, which broadcast together.

    On an open grid, along_x of shape (n, 1, cols) and along_y of shape (n, rows, 1), it is a matrix
    product, and some ten times faster than going through all pixels n times.
    """
    if along_x.ndim == 3 and along_x.shape[1] == 1 and along_y.shape[2:] == (1,):
        return np.matmul(along_y[:, :, 0].T, along_x[:, 0, :], out=out)
    total = np.multiply(along_x[0], along_y[0], out=out)
    for x, y in zip(along_x[1:], along_y[1:], strict=True):
        total = np.add(total, x * y, out=out)
    return np.asarray(total)


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

    def contains(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """(...) True for positions (...) [mm] inside, or on the border."""
        inside = (x >= self.x_min) & (x <= self.x_max) & (y >= self.y_min) & (y <= self.y_max)
        return np.asarray(inside)

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
    values = chebvander(t, degree).reshape(*t.shape, degree + 1)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


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
        """Coefficients as an array [i, j], (degree + 1, degree + 1), zero where i + j > degree."""
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


@dataclass(frozen=True)
class Brightness:
    """Which of gain and offset are unknowns, and their polynomial degrees."""

    gain_degree: int | None = None
    """Total degree of b, 0 to 6; 0 is one number for the image, None (the default) no gain."""
    offset_degree: int | None = None
    """Total degree of c, in the same way."""

    def __post_init__(self) -> None:
        for _, degree in self._each:
            if degree is not None and not (isinstance(degree, int) and 0 <= degree <= 6):
                raise InputError(
                    "brightness: expected a degree of gain and offset, 0 (even) to 6, or 'none', "
                    f"got {degree!r}"
                )

    @classmethod
    def of(cls, degree: int | str) -> Brightness:
        """Gain and offset of one degree, or neither if it is "none": as in options and cases."""
        number: Any = None if degree == "none" else degree
        return cls(number, number)

    @property
    def degree(self) -> int | None:
        """The higher degree of both; None if there is neither."""
        return max(self.degrees, default=None)

    @property
    def degrees(self) -> tuple[int, ...]:
        """Degrees of those of gain and offset that are unknowns, the gain's first."""
        return tuple(degree for _, degree in self._each if degree is not None)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum(len(orders(d)) for d in self.degrees)

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each unknown: ``gain[0,0]``, ``offset[1,0]``."""
        return tuple(
            f"{name}[{i},{j}]"
            for name, degree in self._each
            if degree is not None
            for i, j in orders(degree)
        )

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each unknown."""
        return tuple("-" if name.startswith("gain") else "grey levels" for name in self.names)

    def evaluate(
        self, box: Box, coefficients: ArrayLike, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The gain 1 + b [-] and the offset c [grey levels] at positions that broadcast [mm]."""
        values = [
            np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
            if degree is None
            else ChebyshevField(box, degree).evaluate(part, x, y)
            for (_, degree), part in zip(self._each, self._split(coefficients), strict=True)
        ]
        return 1.0 + values[0], values[1]

    def squares(self, coefficients: ArrayLike) -> FloatArray:
        """(2, D + 1, D + 1) coefficients [i, j] of b and of c, zeros where not an unknown."""
        size = max(self.degrees, default=0) + 1
        result = np.zeros((2, size, size))
        for square, (_, degree), part in zip(
            result, self._each, self._split(coefficients), strict=True
        ):
            if degree is not None:
                i, j = np.array(orders(degree)).T
                square[i, j] = part
        return result

    def fields(self, first: int) -> tuple[int, int]:
        """Indices of the base fields of gain and offset, counted from ``first``; 0 for none."""
        gain = 0 if self.gain_degree is None else first
        offset = 0 if self.offset_degree is None else first + (gain > 0)
        return gain, offset

    @property
    def _each(self) -> tuple[tuple[str, int | None], ...]:
        return ("gain", self.gain_degree), ("offset", self.offset_degree)

    def _split(self, coefficients: ArrayLike) -> tuple[FloatArray, FloatArray]:
        values = np.asarray(coefficients, dtype=np.float64)
        gains = 0 if self.gain_degree is None else len(orders(self.gain_degree))
        return values[:gains], values[gains:]
