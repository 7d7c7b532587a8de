"""Photographs of a perforated specimen whose displacement is known: files as a user has them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from manufactured import inverted
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]
Displacement = Callable[[FloatArray], FloatArray]
"""From points (..., 2) of the reference to displacements (..., 2) [mm]."""

NOISE = 2.0
DARK = 20.0


@dataclass(frozen=True, eq=False)
class Photographed:
    """A rectangle with round holes, in front of a dark background.

    Parameters
    ----------
    grid
        Pixels of the photographs.
    boundary
        Of the specimen [mm].
    holes
        (n, 2) centres [mm].
    diameter
        Of the holes [mm].
    seed
        Of the speckle.
    """

    grid: PixelGrid
    boundary: Box
    holes: FloatArray
    diameter: float
    seed: int = 2

    def material(self, points: FloatArray) -> NDArray[np.bool_]:
        """(rows, cols) whether points (rows, cols, 2) of the reference are material."""
        x, y = points[..., 0], points[..., 1]
        inside = (abs(x - self._middle[0]) < self.boundary.half[0]) & (
            abs(y - self._middle[1]) < self.boundary.half[1]
        )
        for a, b in self.holes:
            inside &= np.hypot(x - a, y - b) > 0.5 * self.diameter
        return np.asarray(inside)

    @property
    def _middle(self) -> tuple[float, float]:
        box = self.boundary
        return 0.5 * (box.x_min + box.x_max), 0.5 * (box.y_min + box.y_max)

    @property
    def points(self) -> FloatArray:
        """(rows, cols, 2) the pixels' positions [mm]."""
        return np.stack(np.meshgrid(self.grid.x, self.grid.y), axis=-1)

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(rows, cols) True on the reference's material."""
        return self.material(self.points)

    def image(self, displacement: Displacement | None = None, exposure: int = 0) -> FloatArray:
        """(rows, cols) grey levels of a state, 8 bits, with the camera's noise."""
        at = self.points if displacement is None else self.came_from(displacement)
        speckle = Speckle(SpeckleSpec(seed=self.seed), self.grid.shape)
        shown = 60.0 + 180.0 * speckle(*self.grid.to_px(at[..., 0], at[..., 1]))
        noise = np.random.default_rng(exposure).normal(size=shown.shape)
        levels = np.where(self.material(at), shown, DARK) + NOISE * noise
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)

    def came_from(self, displacement: Displacement) -> FloatArray:
        """(rows, cols, 2) X with X + u(X) at the pixels, to 3e-5 px."""
        return inverted(displacement, self.points, 3e-5 * self.grid.pixel_size)

    def save(self, folder: Path, states: dict[str, Displacement | None]) -> None:
        """Write a photograph of each state, and of the reference."""
        for n, (name, state) in enumerate({"reference": None, **states}.items()):
            tifffile.imwrite(folder / f"{name}.tif", self.image(state, exposure=n))


def of(ansatz: Ansatz, unknowns: FloatArray) -> Displacement:
    """An ansatz' displacement, of constant strain beyond its domain's doubled size."""
    return lambda points: ansatz.displacement_at(unknowns, points.reshape(-1, 2)).reshape(
        points.shape
    )


def lattice_points(vectors: FloatArray, box: Box, origin: tuple[float, float]) -> FloatArray:
    """(n, 2) the points of a lattice inside a box [mm]."""
    n = np.arange(-40, 41)
    steps = np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2)
    found = np.array(origin) + steps @ vectors
    x, y = found.T
    return found[(box.x_min < x) & (x < box.x_max) & (box.y_min < y) & (y < box.y_max)]
