"""Loading of a lattice in a case; the quantity that the load e stands for, and its text."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modeharvest.fem.lattice import options
from modeharvest.fem.lattice.options import MacroLoading
from modeharvest.util.errors import InputError


@dataclass(frozen=True)
class LoadQuantity:
    """The quantity that a load parameter e [-] stands for."""

    name: str = "strain"
    """Name of the quantity: "strain", "stress" or "load factor"."""
    unit: str = "%"
    """Unit of the quantity, "" for a factor."""
    per_load: float = 100.0
    """Value of the quantity at e = 1, in ``unit``."""

    @classmethod
    def of(cls, loading: MacroLoading) -> LoadQuantity:
        """Strain if only F̄ is prescribed (apart from free sides), stress if only P̄ is.

        Stress is the component largest in magnitude [MPa]. If both grow, it is the factor e itself.
        """
        stress = float(np.abs(loading.dead).max())
        if not stress:
            return cls()
        return cls("load factor", "", 1.0) if loading.rate.any() else cls("stress", "MPa", stress)

    def text(self, load: float, digits: int = 4) -> str:
        """A load with its unit, such as "8.805 %", "0.0121 MPa" or "e = 0.3"."""
        value = f"{self.per_load * load:.{digits}g}".replace("-", "−")
        return f"{value} {self.unit}" if self.unit else f"e = {value}"

    def in_units(self, outcome: str) -> str:
        """The text of an analysis with its loads, such as "e = 0.2", as this quantity's values."""
        return re.sub(r"e = (\d[\d.e-]*\d|\d)", lambda e: self.text(float(e[1]), 6), outcome)

    @property
    def axis(self) -> str:
        """Label of the quantity for the axis of a diagram."""
        nominal = "nominal " * (self.name == "strain")
        return f"load: {nominal}{self.name} [{self.unit}]" if self.unit else "load factor e [-]"


STRAIN = LoadQuantity()


Component = float | Literal["free"]
_ZERO = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True)
class Loading:
    """Loading of the lattice; the load parameter e multiplies all rates."""

    kind: Literal["uniaxial", "uniaxial-strain", "equibiaxial", "shear", "prescribed"] = "uniaxial"
    """Compression by the nominal strain e: "uniaxial" (lateral side free), "uniaxial-strain" (no
    lateral strain) or "equibiaxial". "shear": planes y = const slide along x by e. Or "prescribed":
    the rates below."""
    axis: Literal["x", "y"] = "x"
    """Direction of compression, "x" or "y", for the first two kinds."""
    gradient: tuple[tuple[Component, Component], tuple[Component, Component]] | None = None
    """dF̄/de, row by row [-]; "free" where mean stress is prescribed. Kind "prescribed" only."""
    stress: tuple[tuple[float, float], tuple[float, float]] | None = None
    """dP̄/de, row by row [MPa], where the gradient is free. Kind "prescribed" only."""
    angle: float = 0.0
    """Angle of the loading's axes x and y, counter-clockwise from the lattice's x and y [deg]."""

    def __post_init__(self) -> None:
        if self.kind == "prescribed" and self.gradient is None:
            example = '[[-1.0, 0.0], [0.0, "free"]]'
            raise InputError(
                f'loading: expected the gradient of "prescribed", such as {example}, got none'
            )
        if self.kind != "prescribed" and (self.gradient or self.stress):
            raise InputError(
                f'loading: expected gradient and stress with kind = "prescribed", got {self.kind!r}'
            )
        self.macro()

    def macro(self) -> options.MacroLoading:
        """The macroscopic loading of the equilibrium equations, in the lattice's axes."""
        if self.gradient is not None:
            (a, b), (c, d) = self.gradient
            rates = (_rate(a), _rate(b)), (_rate(c), _rate(d))
            return options.MacroLoading(rates, self.stress or _ZERO, math.radians(self.angle))
        axis = "xy".index(self.axis)
        along_axes = {
            "uniaxial": options.uniaxial(axis),
            "uniaxial-strain": options.uniaxial_strain(axis),
            "equibiaxial": options.equibiaxial(),
            "shear": options.simple_shear(),
        }[self.kind]
        return replace(along_axes, angle=math.radians(self.angle))

    @property
    def quantity(self) -> LoadQuantity:
        """The quantity that the load e stands for."""
        return LoadQuantity.of(self.macro())

    @property
    def name(self) -> str:
        """Description of the loading, for tables and figures."""
        words = self.kind.replace("-", " ")
        words += f" along {self.axis}" if self.kind.startswith("uniaxial") else ""
        return words + (f", axes turned by {self.angle:g}°" if self.angle else "")

    @property
    def is_isotropic(self) -> bool:
        """Whether the loaded lattice keeps its rotational symmetry."""
        (a, b), (c, d) = self.macro().gradient
        return a is not None and a == d and b == 0 == c


def _rate(component: Component) -> float | None:
    return None if component == "free" else float(component)
