"""The fields whose errors a noise study looks at, on a coarse grid over the material."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.validation.studies.subject import Scene

FloatArray = NDArray[np.float64]

PARTS = {"u": slice(0, 2), "v0": slice(2, 4), "v1": slice(4, 5), "v1 phi1": slice(5, 7)}
"""The fields by their names, and which of the seven components are theirs."""
PER_CELL = 3
"""Points along the edge of a unit cell: the errors are as smooth as the ansatz."""


@dataclass(frozen=True, eq=False)
class Points:
    """Where fields are compared.

    Parameters
    ----------
    scene
        Whose fields.
    rows, cols
        Axes of the coarse grid, in pixels of the images.
    inside
        (rows, cols) True on material; the points are those, row by row.
    """

    scene: Scene
    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, scene: Scene) -> Points:
        """The points of a pair, the same in every worker."""
        grid, mask = scene.images.grid, scene.mask()
        step = max(1, round(scene.specimen.pitch / PER_CELL / grid.pixel_size))
        rows, cols = (np.arange((n % step) // 2, n, step) for n in grid.shape)
        return cls(scene, rows, cols, mask[np.ix_(rows, cols)])

    @property
    def x(self) -> FloatArray:
        """(points,) [mm]."""
        return np.asarray(self.scene.images.grid.x[self.cols[np.nonzero(self.inside)[1]]])

    @property
    def y(self) -> FloatArray:
        """(points,) [mm]."""
        return np.asarray(self.scene.images.grid.y[self.rows[np.nonzero(self.inside)[0]]])

    @property
    def cellular(self) -> NDArray[np.bool_]:
        """(points,) True in the part with holes: elsewhere v1 says little or nothing."""
        a, b = self.scene.specimen.cellular_half_size
        return np.asarray((np.abs(self.x) <= a) & (np.abs(self.y) <= b))

    def fields(self, unknowns: FloatArray) -> FloatArray:
        """(points, 7): u, v0 (2 each), v1, v1 phi1 (2) [mm], in the order of ``PARTS``."""
        ansatz, x, y = self.scene.ansatz, self.x[:, None], self.y[:, None]
        parts = (
            ansatz.displacement(unknowns, x, y),
            ansatz.v0(unknowns, x, y),
            ansatz.v(0, unknowns, x, y)[..., None],
            ansatz.fluctuation(0, unknowns, x, y),
        )
        return np.concatenate([part[:, 0] for part in parts], axis=-1)

    def map(self, values: FloatArray) -> FloatArray:
        """(rows, cols) of values at the points; NaN where there is no material."""
        drawn = np.full(self.inside.shape, np.nan)
        drawn[self.inside] = values
        return drawn
