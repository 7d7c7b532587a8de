"""Onset of buckling in a series of images: pattern amplitude over strain, pitchfork estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.photograph.axes import strains_along
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.identifiability import OBSERVABLE
from modeharvest.util.arrays import FloatArray

_FIT = 3
"""Least number of images with a pattern for the fit of a pitchfork."""


@dataclass(frozen=True)
class ImageAmplitude:
    """One image of a test; pixels are rms per component."""

    name: str
    strain: float
    """Mean nominal compression of the cellular part along the load, from v0 [-]."""
    amplitude_px: float
    """Rms of v1 phi1; with several modes the root of the sum of their squares [px]."""
    model_error_px: float
    noise_px: float
    """Standard deviation of v1 phi1 by the images' noise [px]."""

    @property
    def has_pattern(self) -> bool:
        """Whether the pattern exceeds noise and model error by the factor OBSERVABLE."""
        return self.amplitude_px > OBSERVABLE * max(self.model_error_px, self.noise_px)


@dataclass(frozen=True)
class Buckling:
    """Onset of the pattern in a sequence of images."""

    before: float
    after: float
    """Strains of the last image without a pattern and of the first with one [-]; NaN if there is
    none."""
    estimate: float
    """Critical strain, assuming that the amplitude grows with the square root of the strain beyond
    it, as after a pitchfork bifurcation [-]; NaN with fewer than three images that have a
    pattern."""
    text: str
    """The result as text."""


def mean_strain(result: Result, cellular: Box, angle: float = 0.0) -> tuple[float, float]:
    """Mean nominal compression of a part of the specimen along its axes [-].

    By its mean deformation gradient: from the mean positions of opposite edges, displaced by v0. A
    rotation gives no strain. ``angle``: from x to the first axis, counter-clockwise [degrees].
    """
    along = np.linspace(0.02, 0.98, 33)
    x_sides = np.array([cellular.x_min, cellular.x_max])
    y_sides = np.array([cellular.y_min, cellular.y_max])
    x, y = (sides[0] + along * np.ptp(sides) for sides in (x_sides, y_sides))
    v0, a = result.ansatz.v0, result.unknowns
    moved = (v0(a, x_sides, y).mean(axis=0), v0(a, x, y_sides).mean(axis=1))
    apart = np.diag([np.ptp(x_sides), np.ptp(y_sides)])
    edges = [edge + u[1] - u[0] for edge, u in zip(apart, moved, strict=True)]
    along, across = -strains_along(np.column_stack(edges) / apart.diagonal(), angle)
    return float(along), float(across)


def load_axis(strains: FloatArray) -> int:
    """Axis of a test's load, 0 for x or 1 for y: that along which its images compress most.

    ``strains`` (n, 2): compression of each image [-]. Tension counts half, because a compressed
    specimen widens across its load.
    """
    return int(np.argmax(np.maximum(strains, -0.5 * strains).max(axis=0)))


def find_buckling(moments: Sequence[ImageAmplitude]) -> Buckling:
    """Find the onset of the pattern in a sequence of images, in the order of the test.

    If the specimen is unloaded again, only the images up to the largest strain are used.
    """
    nan = float("nan")
    last = int(np.argmax([m.strain for m in moments])) if moments else -1
    loading = list(moments[: last + 1])
    shown = [m for m in loading if m.has_pattern]
    if not shown:
        return Buckling(
            nan, nan, nan, "No image shows a pattern that stands out of noise and model error."
        )
    first, estimate = shown[0], _pitchfork(shown)
    at_first = f"{100 * first.strain:.2f} %"
    plain = [m for m in loading if not m.has_pattern and m.strain < first.strain]
    if not plain:
        text = f"Every image shows the pattern, from a strain of {at_first} on."
        return Buckling(nan, first.strain, estimate, text)
    before = plain[-1]
    between = f"{100 * before.strain:.2f} % ({before.name}) and {at_first} ({first.name})"
    text = f"The pattern appears between strains of {between}."
    if np.isfinite(estimate):
        text += f" Its growth points back to {100 * estimate:.2f} %."
    return Buckling(before.strain, first.strain, estimate, text)


def _pitchfork(shown: Sequence[ImageAmplitude]) -> float:
    """Strain at which the squared amplitude, fitted as linear in the strain, is zero [-]."""
    if len(shown) < _FIT:
        return float("nan")
    few = shown[:_FIT]
    slope, at_zero = np.polyfit([m.strain for m in few], [m.amplitude_px**2 for m in few], 1)
    return float(-at_zero / slope) if slope > 0 else float("nan")
