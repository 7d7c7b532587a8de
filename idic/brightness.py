"""How brightness and contrast may differ between two images, as unknowns of a correlation.

f(x) = (1 + b(x)) g(x + u(x)) + c(x): the gain 1 + b and the offset c vary slowly, as Chebyshev
polynomials of a total degree over the ansatz's domain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.chebyshev import Box, ChebyshevField

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Brightness:
    """Which of gain and offset are unknowns, and how finely they vary.

    Parameters
    ----------
    gain_degree
        Total degree of b; 0 is one number for the whole image, None (the default) no gain.
    offset_degree
        Total degree of c, likewise.
    """

    gain_degree: int | None = None
    offset_degree: int | None = None

    def __post_init__(self) -> None:
        for name, degree in (("gain", self.gain_degree), ("offset", self.offset_degree)):
            if degree is not None and not 0 <= degree <= 6:
                raise InputError(
                    f"brightness: expected a degree of the {name} from 0 to 6, or none, got "
                    f"{degree}"
                )

    @property
    def degrees(self) -> tuple[int, ...]:
        """Those that are unknowns, the gain's first."""
        return tuple(d for d in (self.gain_degree, self.offset_degree) if d is not None)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum((d + 1) * (d + 2) // 2 for d in self.degrees)

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each unknown: ``gain[0,0]``, ``offset[1,0]``."""
        return tuple(
            f"{name}[{i},{j}]"
            for name, degree in self._parts
            for i, j in ChebyshevField(_ANY, degree).orders
        )

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each unknown."""
        return tuple("-" if name.startswith("gain") else "grey levels" for name in self.names)

    def evaluate(
        self, box: Box, coefficients: ArrayLike, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The gain 1 + b [-] and the offset c [grey levels] at positions that broadcast [mm]."""
        b, c = self._split(coefficients)
        values = [
            np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
            if degree is None
            else ChebyshevField(box, degree).evaluate(part, x, y)
            for degree, part in ((self.gain_degree, b), (self.offset_degree, c))
        ]
        return 1.0 + values[0], values[1]

    def squares(self, coefficients: ArrayLike) -> FloatArray:
        """(2, D + 1, D + 1) coefficients [i, j] of b and of c, zeros where not an unknown."""
        result = np.zeros((2, max(self.degrees, default=0) + 1, max(self.degrees, default=0) + 1))
        degrees = (self.gain_degree, self.offset_degree)
        for k, (degree, part) in enumerate(zip(degrees, self._split(coefficients), strict=True)):
            if degree is not None:
                square = ChebyshevField(_ANY, degree).square(part)
                result[k, : degree + 1, : degree + 1] = square
        return result

    def fields(self, first: int) -> tuple[int, int]:
        """Numbers of the base fields of gain and offset, from ``first`` on; 0 for none."""
        gain = 0 if self.gain_degree is None else first
        offset = 0 if self.offset_degree is None else first + (gain > 0)
        return gain, offset

    @property
    def _parts(self) -> list[tuple[str, int]]:
        both = (("gain", self.gain_degree), ("offset", self.offset_degree))
        return [(name, degree) for name, degree in both if degree is not None]

    def _split(self, coefficients: ArrayLike) -> tuple[FloatArray, FloatArray]:
        values = np.asarray(coefficients, dtype=np.float64)
        d = self.gain_degree
        gains = 0 if d is None else (d + 1) * (d + 2) // 2
        return values[:gains], values[gains:]


_ANY = Box(-1.0, 1.0, -1.0, 1.0)  # the order of the coefficients doesn't depend on the box
