"""Error of a measurement against a known displacement: its parts and statistics.

u_true - u_idic is what the paper calls the microfluctuation field w. It has two parts:

* u_true - u_best, the model (ansatz) error: u_best is the best possible fit of the ansatz;
* u_best - u_idic, the additional measurement error.

The grey-level residual shows the effect of both in the images. In this project, "rms" is
*per component*: the root of the mean square over both components of all pixels, as grey-level noise
or the noise of a local DIC is quoted. The rms of the vectors' length is sqrt(2) times as large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import best_fit
from modeharvest.idic.result import Result
from modeharvest.idic.solver.assembly import Assembly, residual
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage

_BAND = 256  # rows


def lengths(field: FloatArray) -> FloatArray:
    """(...) Euclidean lengths of the vectors of a field (..., 2)."""
    x, y = field[..., 0], field[..., 1]
    squares = np.asarray(x * x)
    squares += y * y
    return np.sqrt(squares, out=squares)


def rms(values: NDArray[Any]) -> float:
    """Root of the mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class VectorStatistics:
    """Bias, rms and percentiles of a vector field."""

    mean: tuple[float, float]
    rms: tuple[float, float]
    """Both are (x, y)."""
    rms_per_component: float
    rms_length: float
    median_length: float
    p95_length: float
    max_length: float
    """The last four are statistics of the vectors' Euclidean length."""

    @classmethod
    def of(cls, field: FloatArray, mask: BoolArray, unit: float = 1.0) -> VectorStatistics:
        """Statistics of a field (rows, cols, 2) on a mask (rows, cols), divided by ``unit``."""
        x, y = (field[..., c][mask] / unit for c in (0, 1))
        mean_squares = float(x @ x) / x.size, float(y @ y) / y.size
        length = np.sqrt(x * x + y * y)
        median, p95, largest = np.quantile(length, (0.5, 0.95, 1.0), overwrite_input=True)
        return cls(
            (float(x.mean()), float(y.mean())),
            (math.sqrt(mean_squares[0]), math.sqrt(mean_squares[1])),
            math.sqrt(0.5 * sum(mean_squares)), math.sqrt(sum(mean_squares)),
            float(median), float(p95), float(largest),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Comparison:
    """Truth, measurement and best possible fit of one snapshot, in the reference frame."""

    strain: float
    """Nominal strain [-]."""
    grid: PixelGrid
    mask: BoolArray
    """(rows, cols) True on material of the reference image."""
    displacement: FloatArray
    """(rows, cols, 2) the truth [mm]; NaN outside the mask."""
    result: Result
    best: Result
    """The measurement, and the best fit of its ansatz to the truth."""
    residual: FloatImage
    """(rows, cols) f - g(x + u) [grey levels, fraction of full scale]; NaN where not compared."""

    # The error fields are recomputed at each access: that is fast, and storing them needs memory.
    @property
    def w(self) -> FloatArray:
        """(rows, cols, 2) microfluctuation field, truth - IDIC [mm]."""
        return self._error(self.result)

    @property
    def best_error(self) -> FloatArray:
        """(rows, cols, 2) truth - best fit [mm]: the model (ansatz) error."""
        return self._error(self.best)

    @property
    def idic_to_best(self) -> FloatArray:
        """(rows, cols, 2) IDIC - best fit [mm]: the measurement error; NaN outside the mask."""
        w = self.w
        return np.subtract(self.best_error, w, out=w)

    def _error(self, fit: Result) -> FloatArray:
        """(rows, cols, 2) truth - fit [mm]; by bands of rows, to save memory."""
        error = np.empty_like(self.displacement)
        for top in range(0, self.grid.rows, _BAND):
            rows = slice(top, top + _BAND)
            found = fit.ansatz.displacement(fit.unknowns, self.grid.x, self.grid.y[rows])
            np.subtract(self.displacement[rows], found, out=error[rows])
        return error

    def statistics(self) -> dict[str, VectorStatistics]:
        """Statistics of the error ``w`` and its parts ``best_fit``, ``idic_to_best_fit`` [px]."""
        parts = {"w": "w", "best_fit": "best_error", "idic_to_best_fit": "idic_to_best"}
        mask, px = self.mask, self.grid.pixel_size
        return {n: VectorStatistics.of(getattr(self, part), mask, px) for n, part in parts.items()}

    def error_parts(self) -> dict[str, float]:
        """Rms per component of truth - IDIC, truth - best fit and IDIC - best fit [px]."""
        w, model, measurement = (part.rms_per_component for part in self.statistics().values())
        return {"w_px": w, "model_error_px": model, "measurement_error_px": measurement}

    def cellular(self, specimen: Specimen) -> BoolArray:
        """(rows, cols) True on material of the cellular part."""
        a, b = specimen.cellular_half_size
        x, y = np.abs(self.grid.x)[None, :], np.abs(self.grid.y)[:, None]
        return self.mask & (x <= a) & (y <= b)

    def v1_percent(self, specimen: Specimen) -> float:
        """Rms difference of v1 from the best fit's v1 over the cellular part [% of its maximum]."""
        inside = self.cellular(specimen)
        v, at_best = (fit.v(0)[inside] for fit in (self.result, self.best))
        return 100.0 * float(np.sqrt(np.mean((v - at_best) ** 2)) / np.abs(at_best).max())


def compare(
    images: ImageSet, strain: float, result: Result, start: FloatArray, camera: bool = False
) -> Comparison:
    """Compare a result with the truth of its image set.

    ``start``: (n,) initial guess of the measurement. The best fit is computed from there and from
    the result; the one with the lower cost is used. ``camera``: whether the images are quantised.
    """
    grid, mask, truth = images.grid, images.mask(), images.truth(strain)
    best = best_fit(truth, result, guesses=(start,))
    f, g = images.reference(camera=camera), images.deformed(strain, camera=camera)
    left = residual(Assembly(result.ansatz, grid, mask), result.unknowns, f, SplineImage.of(g))
    return Comparison(strain, grid, mask, truth.displacement, result, best, left)


def pattern_field(result: Result, grid: PixelGrid | None = None) -> FloatArray:
    """(rows, cols, 2) the pattern: sum of v_i phi_i over all modes [mm]."""
    parts = [result.fluctuation(i, grid) for i in range(len(result.ansatz.modes))]
    return np.asarray(np.sum(parts, axis=0)) if len(parts) > 1 else parts[0]


def pattern_size(comparison: Comparison, specimen: Specimen) -> tuple[float, float, float]:
    """Largest length of the pattern, v1 phi1 or the sum over several modes, over material [px].

    Three values: in the cellular part, without its outermost ring of cells, in its corner cells.
    """
    grid, (a, b) = comparison.grid, specimen.cellular_half_size
    x, y = np.abs(grid.x)[None, :], np.abs(grid.y)[:, None]
    length = lengths(pattern_field(comparison.result)) / grid.pixel_size
    outermost = 0.5 * specimen.row_distance + specimen.cell_heights[1]
    outer_x, outer_y = x > a - specimen.pitch, y > b - outermost
    cellular = comparison.cellular(specimen)
    anywhere, inner, corners = (
        float(np.max(length, initial=0.0, where=part))
        for part in (cellular, cellular & ~outer_x & ~outer_y, cellular & outer_x & outer_y)
    )
    return anywhere, inner, corners
