"""A speckled plate with a round hole under a known displacement: shared by test_whole_*."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manufactured import inverted, speckle
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair, Truth

FloatArray = NDArray[np.float64]
Displacement = Callable[[FloatArray], FloatArray]
Material = Callable[[FloatArray], NDArray[np.bool_]]

GRID = PixelGrid.centred(220, 260, 0.01)
HALF_SIZE, RADIUS = np.array([1.1, 0.9]), 0.35
"""Of the plate and of its hole [mm]."""


def is_material(points: FloatArray) -> NDArray[np.bool_]:
    """Whether points (..., 2) of the reference show the plate."""
    return (abs(points) <= HALF_SIZE).all(axis=-1) & (
        np.hypot(*np.moveaxis(points, -1, 0)) > RADIUS
    )


def quadratic_field(points: FloatArray) -> FloatArray:
    """(..., 2) a displacement of up to 7 px with second gradients of 0.02/mm."""
    x, y = np.moveaxis(points, -1, 0)
    return np.stack(
        [0.02 - 0.03 * x + 0.01 * y + 0.01 * x * y, -0.01 + 0.02 * y - 0.008 * x**2], axis=-1
    )


def plate_pair(
    u: Displacement, noise: float = 0.0, seed: int = 0, material: Material = is_material
) -> ImagePair:
    """Images of the plate before and after a displacement u (..., 2) [mm], with its truth."""
    at = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
    before, pattern = inverted(u, at, 1e-12), speckle(3, GRID)
    mask, deformed_mask = material(at), material(before)
    f = np.where(mask, pattern(at[..., 0], at[..., 1]), 0.0)
    g = np.where(deformed_mask, pattern(before[..., 0], before[..., 1]), 0.0)
    random = np.random.default_rng(seed)
    f, g = (image + noise * random.standard_normal(GRID.shape) for image in (f, g))
    truth = Truth.of(displacement=np.where(mask[..., None], u(at), np.nan))
    return ImagePair(f, g, GRID, mask, deformed_mask, truth)
