"""Pairs of images whose displacement is an ansatz, known exactly: shared by the idic tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, Taper, free_family, square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]

UNIT_CELL = 1.0
PIXEL = 0.01
GRID = PixelGrid.centred(360, 320, PIXEL)
DOMAIN = Box.centred(2.6, 3.0)
CELLULAR = Box.centred(2.0, 2.4)
COARSE = 8
STEP = 1e-6
"""Of finite differences [mm]: Newton needs no more digits of a gradient than these leave."""


def one_mode() -> Ansatz:
    return Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], UNIT_CELL)


def two_modes() -> Ansatz:
    """Make a square mode and a free one of a single wave, of different lengths and supports."""
    square = FourierMode.scaled(square_family("hole"), UNIT_CELL, Taper(CELLULAR, 0.5))
    single = FourierMode.scaled(
        free_family([[0.3, 1.0, 1.2, 0.4, 0.1]]), 0.8, Taper(Box(-0.9, 1.0, -1.0, 1.1), 0.3)
    )
    return Ansatz(DOMAIN, (square, single), v0_degree=3, v_degree=2)


def random_unknowns(ansatz: Ansatz, seed: int, size: float = 0.01) -> FloatArray:
    """Disturb every unknown of the start by about ``size``."""
    rng = np.random.default_rng(seed)
    return ansatz.initial_guess(0.03, 0.8) + size * rng.normal(size=ansatz.size)


def inner_mask(margin_mm: float = 0.0) -> NDArray[np.bool_]:
    """Select the pixels inside the domain, less a margin."""
    inside_x = abs(GRID.x) < DOMAIN.x_max - margin_mm
    inside_y = abs(GRID.y) < DOMAIN.y_max - margin_mm
    return inside_y[:, None] & inside_x[None, :]


def smooth_mask(ansatz: Ansatz) -> NDArray[np.bool_]:
    """Leave out 12 px on either side of the kinks of the tapers.

    The displacement's gradient jumps there, so does the deformed image's, and no spline follows
    a jump; 12 px away its ringing has decayed by 0.43^12 = 4e-5.
    """
    keep_x, keep_y = np.ones(GRID.cols, dtype=np.bool_), np.ones(GRID.rows, dtype=np.bool_)
    for mode in ansatz.modes:
        box, width = mode.taper.cellular, mode.taper.width
        for kink in (box.x_min - width, box.x_min, box.x_max, box.x_max + width):
            keep_x &= abs(GRID.x - kink) > 12 * PIXEL
        for kink in (box.y_min - width, box.y_min, box.y_max, box.y_max + width):
            keep_y &= abs(GRID.y - kink) > 12 * PIXEL
    return inner_mask() & keep_y[:, None] & keep_x[None, :]


@dataclass(frozen=True, eq=False)
class CosinePattern:
    """A band-limited grey-level field: a sum of plane waves with periods of 14 to 150 px."""

    wave_vectors: FloatArray
    phases: FloatArray

    @classmethod
    def random(cls, seed: int = 0, count: int = 40) -> CosinePattern:
        rng = np.random.default_rng(seed)
        period = 14.0 * (150 / 14) ** rng.uniform(0, 1, count) * PIXEL
        angle = rng.uniform(0, np.pi, count)
        k = 2 * np.pi / period[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return cls(k, rng.uniform(0, 2 * np.pi, count))

    def __call__(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Grey levels, of standard deviation 1/sqrt(2), at positions [mm]."""
        total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for (kx, ky), phase in zip(self.wave_vectors, self.phases, strict=True):
            total += np.cos(kx * x + ky * y + phase)
        grey: FloatArray = total / np.sqrt(len(self.phases))
        return grey


Pattern = Callable[[FloatArray, FloatArray], FloatArray]


def speckle(seed: int = 2, grid: PixelGrid = GRID) -> Pattern:
    """Make the speckle of the virtual experiments, exact at any position [mm]."""
    exact = Speckle(SpeckleSpec(seed=seed), grid.shape)
    return lambda x, y: exact(*grid.to_px(x, y))


def inverted(
    displacement: Callable[[FloatArray], FloatArray], at: FloatArray, tolerance: float
) -> FloatArray:
    """(..., 2): X with X + u(X) = x at positions x (..., 2) [mm], to a tolerance [mm]."""
    x = at.reshape(-1, 2)
    reference = x.copy()
    if at.ndim == 3 and min(at.shape[:2]) > 4 * COARSE:  # an image's: every eighth pixel first
        few = inverted(displacement, at[::COARSE, ::COARSE], 1e-6) - at[::COARSE, ::COARSE]
        where = np.indices(at.shape[:2]) / COARSE
        for i in (0, 1):
            reference[:, i] += map_coordinates(few[..., i], where, mode="nearest").ravel()
    left = np.arange(len(x))
    for n in range(300):
        points = reference[left]
        u = displacement(points)
        step = x[left] - u - points
        reference[left] += step
        far = abs(step).max(axis=1) > tolerance
        left, points, u, step = left[far], points[far], u[far], step[far]
        if not len(left):
            return reference.reshape(at.shape)
        if n < 10:  # Newton; after that, for what lies at kinks, plain fixed-point iteration
            gradient = np.stack(
                [(displacement(points + h) - u) / STEP for h in STEP * np.eye(2)], axis=-1
            )
            reference[left] = points + _solved(np.eye(2) + gradient, step)
    raise AssertionError(f"the inverse mapping has not converged: {abs(step).max()} mm")


def reference_points(ansatz: Ansatz, a: FloatArray, grid: PixelGrid = GRID) -> FloatArray:
    """(rows, cols, 2): X with X + u(X) = x at the pixels x, solved to rounding."""

    def displacement(points: FloatArray) -> FloatArray:
        # Far outside the domain the polynomials run away; nothing is sampled there.
        return ansatz.displacement_at(a, np.clip(points, (-1.5, -1.7), (1.5, 1.7)))

    return inverted(displacement, np.stack(np.meshgrid(grid.x, grid.y), axis=-1), 1e-13)


@lru_cache(maxsize=4)
def _points_of_last(ansatz: Ansatz, a: bytes, grid: PixelGrid) -> FloatArray:
    """Those of the unknowns' bytes: many speckles are displaced alike."""
    return reference_points(ansatz, np.frombuffer(a), grid)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """(n, 2) of matrices (n, 2, 2) and right-hand sides (n, 2)."""
    (p, q), (r, s) = np.moveaxis(matrix, 0, -1)
    x, y = right.T
    return np.stack([s * x - q * y, p * y - r * x], axis=-1) / (p * s - q * r)[:, None]


def image_pair(
    pattern: Pattern, ansatz: Ansatz, a: FloatArray, grid: PixelGrid = GRID
) -> tuple[FloatArray, FloatArray]:
    """Make f on the grid, and g(x + u(x)) = f(x)."""
    reference = _points_of_last(ansatz, a.tobytes(), grid)
    f = pattern(*np.meshgrid(grid.x, grid.y))
    return f, pattern(reference[..., 0], reference[..., 1])
