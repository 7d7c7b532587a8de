"""Jets: functions of a deformation gradient with their first two derivatives, in numpy.

What UFL does symbolically for dolfinx is done here with numbers, so that a material's one energy
gives stress and tangent where dolfinx isn't: ``material.energy(gradient_jet(F))``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modeharvest.util.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Jet:
    """Values (k,) with derivatives by the four components of F: (4, k) and (4, 4, k)."""

    value: FloatArray
    slope: FloatArray
    curvature: FloatArray

    def of(self, value: FloatArray, first: FloatArray, second: FloatArray) -> Jet:
        """A function of this, by its value and its first two derivatives."""
        bent = second * self.slope[:, None] * self.slope
        return Jet(value, first * self.slope, first * self.curvature + bent)

    def __add__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(
                self.value + other.value, self.slope + other.slope, self.curvature + other.curvature
            )
        return Jet(self.value + other, self.slope, self.curvature)

    def __mul__(self, other: Jet | float) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value * other, self.slope * other, self.curvature * other)
        mixed = self.slope[:, None] * other.slope
        return Jet(
            self.value * other.value,
            self.value * other.slope + other.value * self.slope,
            self.value * other.curvature
            + other.value * self.curvature
            + mixed
            + mixed.swapaxes(0, 1),
        )

    def __pow__(self, m: float) -> Jet:
        x = self.value
        return self.of(x**m, m * x ** (m - 1.0), m * (m - 1.0) * x ** (m - 2.0))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Jet:
        return self * -1.0

    def __sub__(self, other: Jet | float) -> Jet:
        return self + -other

    def __rsub__(self, other: float) -> Jet:
        return -self + other

    def __truediv__(self, other: Jet | float) -> Jet:
        return self * other**-1.0

    def __rtruediv__(self, other: float) -> Jet:
        return self**-1.0 * other


class JetMatrix:
    """F as a 2 x 2 matrix of jets, and the functions of it that UFL calls by the same names."""

    def __init__(self, F: FloatArray) -> None:
        count, self._entries = len(F), dict[tuple[int, int], Jet]()
        for i in (0, 1):
            for j in (0, 1):
                slope = np.zeros((4, count))
                slope[2 * i + j] = 1.0
                self._entries[i, j] = Jet(F[:, i, j], slope, np.zeros((4, 4, count)))

    def __getitem__(self, at: tuple[int, int]) -> Jet:
        return self._entries[at]

    @staticmethod
    def det(F: JetMatrix) -> Jet:
        """Determinant."""
        return F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]

    @staticmethod
    def inner(F: JetMatrix, G: JetMatrix) -> Jet:
        """F : G."""
        return sum((F[i, j] * G[i, j] for i in (0, 1) for j in (0, 1)), start=F[0, 0] * 0.0)

    @staticmethod
    def ln(x: Jet) -> Jet:
        """Natural logarithm."""
        inverse = np.asarray(1.0 / x.value)
        return x.of(np.log(x.value), inverse, -inverse * inverse)

    @staticmethod
    def sqrt(x: Jet) -> Jet:
        """Square root."""
        return x**0.5

    @staticmethod
    def lt(x: Jet, y: float) -> BoolArray:
        """Where x < y."""
        return np.asarray(x.value < y)

    @staticmethod
    def conditional(where: BoolArray, x: Jet | float, y: Jet | float) -> Jet:
        """The first where that holds, else the second."""
        like = x if isinstance(x, Jet) else y
        assert isinstance(like, Jet)
        x, y = (part if isinstance(part, Jet) else like * 0.0 + part for part in (x, y))
        return Jet(
            np.where(where, x.value, y.value),
            np.where(where, x.slope, y.slope),
            np.where(where, x.curvature, y.curvature),
        )


def stress_and_tangent(material: Any, F: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k, 2, 2) P = dW/dF and (k, 2, 2, 2, 2) dP/dF [MPa] of a material at F (k, 2, 2) [-]."""
    W = material.energy(JetMatrix(F))
    slope, curvature = W.slope.T.reshape(-1, 2, 2), np.moveaxis(W.curvature, -1, 0)
    return slope, curvature.reshape(-1, 2, 2, 2, 2)
