"""Compressible hyperelastic materials in plane strain, each defined by its energy alone.

UFL differentiates the energy W(F) to the first Piola-Kirchhoff stress P and the tangent, so
a new material is one frozen dataclass with one method. F is the 2 x 2 in-plane deformation
gradient; the stretch out of the plane is 1. UFL is imported only where an energy is computed, so
that constants can be given and checked without it. Without UFL, an energy is evaluated for F as a
matrix of jets, numbers with their first two derivatives, by :func:`stress_and_tangent`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.typed import made, nearest


@dataclass(frozen=True)
class Ogden:
    """Compressible Ogden material with any number of terms, no isochoric split.

    W = sum_i c_i/m_i^2 (l1^m_i + l2^m_i + l3^m_i - 3 - m_i ln J) + kappa/2 (J - 1)^2

    with the principal stretches l1, l2 and l3 = 1. Small strain: shear modulus mu = sum(c_i)/2,
    Lame's lambda = kappa, Poisson's ratio nu = kappa/(2 (kappa + mu)). The form is that of van Bree
    et al., Comput. Methods Appl. Mech. Eng. 372 (2020) 113333; the default constants are this
    project's choice (mu = 0.60 MPa, nu = 0.45), because the paper's own are not public.
    """

    moduli: tuple[float, ...] = (1.2,)
    """c_i [MPa]."""
    exponents: tuple[float, ...] = (3.0,)
    """m_i [-], other than 0."""
    kappa: float = 5.4
    """Constant of the volumetric term [MPa]."""

    def __post_init__(self) -> None:
        if len(self.moduli) != len(self.exponents) or not self.moduli:
            got = f"{len(self.moduli)} and {len(self.exponents)}"
            raise InputError(f"Ogden material: expected as many moduli as exponents, got {got}")
        if 0.0 in self.exponents or sum(self.moduli) <= 0 or self.kappa <= 0:
            raise InputError(
                "Ogden material: expected nonzero exponents, a positive sum of moduli and a "
                f"positive kappa, got {self}"
            )

    def energy(self, F: Any) -> Any:
        """W(F) [MPa]."""
        ufl = functions_of(F)
        J = ufl.det(F)
        terms = [
            c / m**2 * (power_sum_of_stretches(F, m) - 2.0 - m * ufl.ln(J))
            for c, m in zip(self.moduli, self.exponents, strict=True)
        ]
        return sum(terms) + 0.5 * self.kappa * (J - 1.0) ** 2


@dataclass(frozen=True)
class TwoTermI1:
    """W = c1 (I1 - 3) + c2 (I1 - 3)^2 - 2 c1 ln J + K/2 (J - 1)^2 [MPa], with I1 = tr C + 1.

    Bertoldi, Boyce, Deschanel, Prange & Mullin, J. Mech. Phys. Solids 56 (2008) 2642-2668, doi
    10.1016/j.jmps.2008.03.006; defaults are theirs (nu = 0.490).
    """

    c1: float = 0.55
    c2: float = 0.3
    bulk: float = 55.0
    """K [MPa]."""

    def __post_init__(self) -> None:
        if not (self.c1 > 0 and self.c2 >= 0 and self.bulk > 0):
            raise InputError(f"I1 material: expected c1 > 0, c2 >= 0 and bulk > 0, got {self}")

    def energy(self, F: Any) -> Any:
        """W(F) [MPa]."""
        ufl = functions_of(F)
        J = ufl.det(F)
        i1 = ufl.inner(F, F) + 1.0
        return (
            self.c1 * (i1 - 3.0)
            + self.c2 * (i1 - 3.0) ** 2
            - 2.0 * self.c1 * ufl.ln(J)
            + 0.5 * self.bulk * (J - 1.0) ** 2
        )


def functions_of(F: Any) -> Any:
    """Namespace of det, inner, ln, sqrt, lt, conditional for F: of UFL or of :class:`JetMatrix`."""
    if isinstance(F, JetMatrix):
        return JetMatrix
    import ufl

    return ufl


@runtime_checkable
class Material(Protocol):
    """Anything that has a strain energy density."""

    def energy(self, F: Any) -> Any:
        """Strain energy density W [MPa] as a UFL expression of F (2 x 2) [-]."""


MATERIALS: dict[str, type[Any]] = {"ogden": Ogden, "two-term-I1": TwoTermI1}
"""Material classes by their ``kind`` in a case file."""


def material_table(material: Any) -> dict[str, Any]:
    """Kind (the class's name) and constants of a material, as stored in solutions."""
    return {"kind": type(material).__name__, **vars(material)}


def material_of(table: Mapping[str, Any]) -> Material:
    """The material of a table, with ``kind`` as in a case file or as in a solution.

    InputError for an unknown kind or constant, or a value out of range.
    """
    constants = dict(table)
    kinds = {**MATERIALS, **{kind.__name__: kind for kind in MATERIALS.values()}}
    kind = constants.pop("kind", None)
    if kind not in kinds:
        raise InputError(f"material: expected a kind, got {kind!r}{nearest(str(kind), [*kinds])}")
    material: Material = made(kinds[kind], constants)
    return material


def power_sum_of_stretches(F: Any, m: float) -> Any:
    """l1^m + l2^m of a 2 x 2 deformation gradient [-], smooth where the stretches coincide.

    The square root in the formula for the stretches has no derivative at l1 = l2, although
    the symmetric sum has all of them. With l1/l2 = exp(2 eta),

        l1^m + l2^m = 2 J^(m/2) cosh(m eta),    sinh(eta)^2 = s,
        s = ((F11 - F22)^2 + (F12 + F21)^2) / (4 J),

    where s >= 0 is a smooth function of F, free of cancellation. cosh(m asinh(sqrt(s))) is
    analytic in s; near s = 0 its power series is used, elsewhere the closed form.
    """
    ufl = functions_of(F)
    J = ufl.det(F)
    s = ((F[0, 0] - F[1, 1]) ** 2 + (F[0, 1] + F[1, 0]) ** 2) / (4.0 * J)
    factor = partial(_cosh_m_asinh_sqrt, ufl, m=m)
    return 2.0 * J ** (0.5 * m) * (s.through(factor) if isinstance(s, Jet) else factor(s))


_SERIES_LIMIT = 0.02
_SERIES_TERMS = 9  # the first omitted term is below 1e-15 at the limit for |m| <= 10


def _cosh_m_asinh_sqrt(ufl: Any, s: Any, m: float) -> Any:
    near = ufl.lt(s, _SERIES_LIMIT)
    # The closed form must stay differentiable even where it isn't used: 0 * NaN is NaN.
    root = ufl.sqrt(ufl.conditional(near, _SERIES_LIMIT, s))
    growth = (root + ufl.sqrt(1.0 + root**2)) ** m
    closed = 0.5 * (growth + 1.0 / growth)
    return ufl.conditional(near, _series(s, m), closed)


def _series(s: Any, m: float) -> Any:
    """Taylor series of cosh(m asinh(sqrt(s))), by Horner's rule.

    y(s) solves s (1 + s) y'' + (1/2 + s) y' = m^2/4 y, which gives the ratio of coefficients
    a_{k+1}/a_k = (m^2/4 - k^2) / ((k + 1) (k + 1/2)); for an even m the series ends.
    """
    coefficients = [1.0]
    for k in range(_SERIES_TERMS):
        ratio = (0.25 * m**2 - k**2) / ((k + 1.0) * (k + 0.5))
        coefficients.append(coefficients[-1] * ratio)
    *others, value = coefficients
    for a in reversed(others):
        value = value * s + a
    return value


@dataclass(frozen=True, eq=False)
class Jet:
    """Values (k,) with first (4, k) and second (4, 4, k) derivatives by F's four components."""

    value: FloatArray
    slope: FloatArray
    curvature: FloatArray

    def of(self, value: FloatArray, first: FloatArray, second: FloatArray) -> Jet:
        """A function of this jet, given its value and first two derivatives."""
        bent = second * self.slope[:, None] * self.slope
        return Jet(value, first * self.slope, first * self.curvature + bent)

    def through(self, function: Callable[[Jet], Jet]) -> Jet:
        """A function of this jet, differentiated by one variable instead of by four."""
        if not len(self.slope):
            return function(self)
        zero = 0.0 * self.value
        y = function(Jet(self.value, 1.0 + zero[None], zero[None, None]))
        return self.of(y.value, y.slope[0], y.curvature[0, 0])

    def __add__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            parts = zip(vars(self).values(), vars(other).values(), strict=True)
            return Jet(*(own + more for own, more in parts))
        return Jet(self.value + other, self.slope, self.curvature)

    def __mul__(self, other: Jet | float) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value * other, self.slope * other, self.curvature * other)
        mixed = self.slope[:, None] * other.slope
        slope = self.value * other.slope + other.value * self.slope
        bent = self.value * other.curvature + other.value * self.curvature
        return Jet(self.value * other.value, slope, bent + mixed + mixed.swapaxes(0, 1))

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
    """F as a 2 x 2 matrix of jets, with functions named as in UFL."""

    def __init__(self, F: FloatArray, derivatives: int = 4) -> None:
        (count, d), self._entries = (len(F), derivatives), dict[tuple[int, int], Jet]()
        for i in (0, 1):
            for j in (0, 1):
                slope = np.zeros((d, count))
                slope[2 * i + j :][:1] = 1.0
                self._entries[i, j] = Jet(F[:, i, j], slope, np.zeros((d, d, count)))

    def __getitem__(self, at: tuple[int, int]) -> Jet:
        return self._entries[at]

    @staticmethod
    def det(F: JetMatrix) -> Jet:
        """Determinant."""
        return F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]

    @staticmethod
    def inner(F: JetMatrix, G: JetMatrix) -> Jet:
        """Double contraction F : G."""
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
        """True where x < y."""
        return np.asarray(x.value < y)

    @staticmethod
    def conditional(where: BoolArray, x: Jet | float, y: Jet | float) -> Jet:
        """``x`` where ``where`` is True, else ``y``."""
        like = x if isinstance(x, Jet) else y
        assert isinstance(like, Jet)
        x, y = (part if isinstance(part, Jet) else like * 0.0 + part for part in (x, y))
        parts = zip(vars(x).values(), vars(y).values(), strict=True)
        return Jet(*(np.where(where, own, other) for own, other in parts))


def stress_and_tangent(material: Any, F: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k, 2, 2) P = dW/dF and (k, 2, 2, 2, 2) dP/dF [MPa] of a material at F (k, 2, 2) [-]."""
    W = material.energy(JetMatrix(F))
    slope, curvature = W.slope.T.reshape(-1, 2, 2), np.moveaxis(W.curvature, -1, 0)
    return slope, curvature.reshape(-1, 2, 2, 2, 2)
