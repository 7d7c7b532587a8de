"""Distortions with unknown coefficients, for a calibration to find."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np

from modeharvest.imaging.distortion.lens import CameraDistortion, Distortion, PolynomialDistortion
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError


class DistortionModel(Protocol):
    """Turns coefficients c into a distortion, and says how S depends on them."""

    @property
    def start(self) -> FloatArray:
        """(k,) coefficients to begin with."""

    @property
    def scale(self) -> FloatArray:
        """(k,) changes of the coefficients that change S by about 1 px."""

    def distortion(self, c: FloatArray) -> Distortion:
        """The distortion of these coefficients."""

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the coefficients."""


@dataclass(frozen=True)
class PolynomialModel:
    """Polynomials of a total degree, all of their terms or those above the affine ones."""

    shape: tuple[int, int]
    """(rows, cols) of the image [px]."""
    degree: int
    """Total degree, at least 1."""
    fixed: int = 3
    """How many terms of each component are zero: 3, the affine ones, where shifts are not known; 1,
    the constant, where they are; 0 if all are observable."""

    def __post_init__(self) -> None:
        if self.fixed not in (0, 1, 3) or self.terms < 1:
            raise InputError(
                "expected a degree above that of the fixed terms (0, 1 or 3 of them), got degree "
                f"{self.degree} and {self.fixed} fixed terms"
            )

    @property
    def terms(self) -> int:
        """Count the unknown coefficients of one component."""
        return PolynomialDistortion.size_of(self.degree) - self.fixed

    @property
    def start(self) -> FloatArray:
        """(k,) zeros: no distortion."""
        return np.zeros(2 * self.terms)

    @property
    def scale(self) -> FloatArray:
        """(k,) ones: a Chebyshev polynomial is at most 1."""
        return np.ones(2 * self.terms)

    def distortion(self, c: FloatArray) -> PolynomialDistortion:
        """The distortion of these coefficients: first all along rows, then all along columns."""
        full = np.zeros((2, self.terms + self.fixed))
        full[:, self.fixed :] = c.reshape(2, self.terms)
        return PolynomialDistortion(self.shape, full)

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the coefficients."""
        basis = self.distortion(c).basis(row, col)[:, self.fixed :].T
        zero = np.zeros_like(basis)
        return np.array([np.concatenate([basis, zero]), np.concatenate([zero, basis])])

    def of_degree(self, c: FloatArray, degree: int) -> tuple[PolynomialModel, FloatArray]:
        """The model of another degree; coefficients in it, cut or continued by zeros."""
        other = replace(self, degree=degree)
        full, kept = np.zeros((2, other.terms)), min(self.terms, other.terms)
        full[:, :kept] = c.reshape(2, self.terms)[:, :kept]
        return other, full.ravel()


@dataclass(frozen=True)
class CameraModel:
    """A camera, some parameters of which are unknown."""

    camera: CameraDistortion
    """The parameters that are known, and where the unknown ones begin."""
    unknown: tuple[str, ...] = ("cx", "cy", "k1", "k2", "k3")
    """Names among cx, cy and k1 ... p2; not focal lengths: another f with other k is that S."""

    def __post_init__(self) -> None:
        known = tuple(f.name for f in fields(CameraDistortion))[2:]
        if not self.unknown or not set(self.unknown) <= set(known):
            what = f"unknown camera parameters among {known}"
            raise InputError(f"expected {what}, got {self.unknown}")

    @property
    def start(self) -> FloatArray:
        """(k,) parameters of the camera given."""
        return np.array([getattr(self.camera, name) for name in self.unknown])

    @property
    def scale(self) -> FloatArray:
        """(k,) changes of the parameters that change S by about 1 px at the image's corner."""
        row, col = np.zeros(1), np.zeros(1)  # the upper left one
        slopes = [np.abs(self._coefficient(n, row, col)).max() for n in self.unknown]
        return 1.0 / np.maximum(slopes, 1e-3)

    def distortion(self, c: FloatArray) -> CameraDistortion:
        """The camera with these parameters."""
        return replace(self.camera, **dict(zip(self.unknown, map(float, c), strict=True)))

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the parameters."""
        model = replace(self, camera=self.distortion(c))
        return np.stack([model._coefficient(name, row, col) for name in self.unknown], axis=1)

    def _coefficient(self, name: str, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, n) derivative of S with respect to one parameter."""
        if name in ("cx", "cy"):  # S depends on p - c alone
            return -self.camera.gradient(row, col)[:, 0 if name == "cy" else 1]
        lens = self.camera
        x, y = lens.normalised(row, col)
        s = x * x + y * y
        if name == "p1":
            return np.stack([lens.fy * (s + 2 * y * y), lens.fx * 2 * x * y])
        if name == "p2":
            return np.stack([lens.fy * 2 * x * y, lens.fx * (s + 2 * x * x)])
        top, below = (1.0 + part for part in lens.radial(s))
        power = {"k1": s, "k2": s**2, "k3": s**3, "k4": s, "k5": s**2, "k6": s**3}[name]
        slope = power / below if name in ("k1", "k2", "k3") else -power * top / below**2
        return np.stack([lens.fy * y * slope, lens.fx * x * slope])
