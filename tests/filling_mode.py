"""Correlations of a speckle whose mode fills the image: shared by the tests of starts and noise."""

from __future__ import annotations

from functools import cache

import manufactured
import numpy as np
from manufactured import DOMAIN, GRID, PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.result import Result

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# A mode that fills the image. Where a taper ends inside it, the displacement has a kink, and
# the deformed image is no longer smooth: no spline follows it to 1e-5 px.
EVERYWHERE = Taper(Box.centred(3.4, 3.8), 0.5)
MASK = manufactured.inner_mask(0.1)
STRAIN = 0.05


def square(unit_cell: float = 1.0) -> Ansatz:
    mode = FourierMode.scaled(square_family("junction"), unit_cell, EVERYWHERE)
    return Ansatz(DOMAIN, (mode,))


def disturbed(ansatz: Ansatz, amplitude: float, seed: int = 0) -> FloatArray:
    """Unknowns whose displacement reaches 11 px for an amplitude of 1.5 mm."""
    rng = np.random.default_rng(seed)
    a = ansatz.initial_guess(STRAIN, amplitude)
    for c in (0, 1):
        a[ansatz.v0_slice(c)] += 0.003 * rng.normal(size=ansatz.v0_space.size)
    for i, mode in enumerate(ansatz.modes):
        a[ansatz.v_slice(i)][1:] += 0.05 * rng.normal(size=ansatz.v_space.size - 1)
        a[ansatz.phi_slice(i)] += 0.02 * rng.normal(size=mode.family.size)
    return a


@cache
def case(unit_cell: float = 1.0) -> tuple[Ansatz, FloatArray, FloatArray, FloatArray]:
    """Ansatz, true unknowns, f and g."""
    ansatz = square(unit_cell)
    a = disturbed(ansatz, 1.5 if unit_cell == 1.0 else 1.0)
    return (ansatz, a, *manufactured.image_pair(manufactured.speckle(), ansatz, a))


def rms_px(u: FloatArray, other: FloatArray, mask: BoolArray = MASK) -> float:
    """Rms length of the difference of two displacements [px]."""
    return float(np.sqrt((((u - other)[mask]) ** 2).sum(axis=-1).mean()) / PIXEL)


def error_px(result: Result, truth: FloatArray, mask: BoolArray = MASK) -> float:
    return rms_px(result.displacement(), result.ansatz.displacement(truth, GRID.x, GRID.y), mask)
