"""Optical distortion as a polynomial over the image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.distortion.mapping import Distortion, require_finite

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PolynomialDistortion(Distortion):
    """S as a polynomial of a total degree, in products of Chebyshev polynomials.

    S(row, col) = sum over i + j <= degree of c_ij T_i(xi) T_j(eta), where xi and eta run from
    -1 to 1 from the first to the last column and row. Beyond the image it goes on as it is.

    Parameters
    ----------
    shape
        (rows, cols) of the image [px].
    coefficients
        (2, n) c_ij along the rows' and the columns' index [px], n = (degree + 1)(degree + 2)/2,
        by rising i + j, in each of them by rising j: 1, xi, eta, T_2(xi), xi eta, T_2(eta), ...
    """

    shape: tuple[int, int]
    coefficients: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        object.__setattr__(self, "coefficients", np.array(self.coefficients, dtype=np.float64))
        if min(self.shape) < 2:
            raise InputError(f"distortion: expected an image of 2 x 2 px or more, got {self.shape}")
        c = self.coefficients
        if c.ndim != 2 or len(c) != 2 or self.size_of(self.degree) != c.shape[1]:
            raise InputError(
                "distortion: expected (2, n) coefficients with n = 1, 3, 6, 10, ... for degree "
                f"0, 1, 2, 3, ..., got shape {c.shape}"
            )
        require_finite(c, "coefficients")

    @staticmethod
    def size_of(degree: int) -> int:
        """Count the coefficients of one component."""
        return (degree + 1) * (degree + 2) // 2

    @staticmethod
    def orders(degree: int) -> tuple[tuple[int, int], ...]:
        """(i, j) of each coefficient: i along the columns' index, j along the rows'."""
        return tuple((total - j, j) for total in range(degree + 1) for j in range(total + 1))

    @property
    def degree(self) -> int:
        """Total degree."""
        return int((np.sqrt(8 * self.coefficients.shape[-1] + 1) - 3) / 2 + 1e-9)

    @cached_property
    def _tables(self) -> tuple[FloatArray, FloatArray]:
        """(2, n, n) coefficients [component, j, i], and (2, 2, n, n) those of the derivatives."""
        n, (rows, cols) = self.degree + 1, self.shape
        table = np.zeros((2, n, n))
        i, j = np.array(self.orders(self.degree)).T
        table[:, j, i] = self.coefficients
        slopes = np.zeros((2, 2, n, n))
        if n > 1:
            slopes[:, 0, :-1, :] = chebyshev.chebder(table, axis=1) * (2.0 / (rows - 1))
            slopes[:, 1, :, :-1] = chebyshev.chebder(table, axis=2) * (2.0 / (cols - 1))
        return table, slopes

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        d_row, d_col = self._evaluate(self._tables[0], row, col)
        return d_row, d_col

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        return self._evaluate(self._tables[1], row, col)

    def basis(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(..., n): every product T_i(xi) T_j(eta), in the order of the coefficients."""
        eta, xi = self._normalised(row, col)
        along_col, along_row = (_powers(t, self.degree) for t in (xi, eta))
        return np.stack([along_col[i] * along_row[j] for i, j in self.orders(self.degree)], axis=-1)

    def _normalised(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        rows, cols = self.shape
        eta = 2.0 * np.asarray(row, dtype=np.float64) / (rows - 1) - 1.0
        xi = 2.0 * np.asarray(col, dtype=np.float64) / (cols - 1) - 1.0
        return eta, xi

    def _evaluate(self, tables: FloatArray, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(..., positions) sums for tables (..., n, n), each by one matrix product along col."""
        eta, xi = self._normalised(row, col)
        along_row, along_col = _powers(eta, self.degree), _powers(xi, self.degree)
        partial = np.tensordot(tables, along_col, axes=1)  # (..., j, positions of col)
        if eta.ndim == 2 and eta.shape[1] == 1 and xi.shape[:1] == (1,):
            return np.asarray(along_row[:, :, 0].T @ partial[..., 0, :])
        axis = tables.ndim - 2
        total = np.take(partial, 0, axis) * along_row[0]
        for j in range(1, len(along_row)):
            total = total + np.take(partial, j, axis) * along_row[j]
        return np.asarray(total)


def _powers(t: FloatArray, degree: int) -> FloatArray:
    """T_0(t) ... T_degree(t), stacked along a new first axis."""
    values = chebyshev.chebvander(t, degree).reshape(*t.shape, degree + 1)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))
