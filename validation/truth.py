"""The parts of a measurement's error, kept apart.

u_true - u_idic is what the paper calls the microfluctuation field w. It has two parts:

* u_true - u_best, what the ansatz can't say: ``best`` is its best possible fit to the truth;
* u_best - u_idic, what the measurement loses on top of that.

The grey-level residual is what remains visible of all this in the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.progress import Progress, silent

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Truth, measurement and best possible fit of one snapshot, in the reference frame.

    Parameters
    ----------
    strain
        Nominal strain [-].
    grid
        The pixels.
    mask
        (rows, cols) True on material of the reference image.
    displacement
        (rows, cols, 2) the truth [mm]; NaN outside the mask.
    result
        What IDIC found.
    best
        The best fit of the same ansatz to the truth.
    residual
        (rows, cols) f - g(x + u) [grey levels, fraction of full scale]; NaN where not compared.
    """

    strain: float
    grid: PixelGrid
    mask: BoolArray
    displacement: FloatArray
    result: Result
    best: Result
    residual: FloatArray

    @cached_property
    def w(self) -> FloatArray:
        """(rows, cols, 2) microfluctuation field, truth - IDIC [mm]."""
        return self.displacement - self.result.displacement()

    @cached_property
    def best_error(self) -> FloatArray:
        """(rows, cols, 2) truth - best fit [mm]: what the model can't say."""
        return self.displacement - self.best.displacement()

    @property
    def idic_to_best(self) -> FloatArray:
        """(rows, cols, 2) IDIC - best fit [mm]: what the measurement loses; NaN off the mask."""
        return self.best_error - self.w


def compare(
    images: ImageSet, strain: float, result: Result, start: FloatArray, camera: bool = False,
    progress: Progress = silent,
) -> Comparison:  # fmt: skip
    """Set a result against the truth of its image set.

    Parameters
    ----------
    images
        The set that the result was measured on.
    strain
        Which of its snapshots [-].
    result
        The measurement.
    start
        (n,) unknowns that the measurement started from: the best fit is searched from there
        and from the result, and the better of the two is taken.
    camera
        Whether the quantised images were measured.
    progress
        Listener.
    """
    grid, mask = images.grid, images.mask()
    truth = images.truth(strain).displacement
    fits = [
        fit_displacement(truth, grid, result.ansatz, begin, mask, progress=progress)
        for begin in (result.unknowns, start)
    ]
    best = min(fits, key=lambda fit: fit.residual_rms)
    residual = result.residual(
        images.reference(camera=camera), images.deformed(strain, camera=camera)
    )
    return Comparison(strain, grid, mask, truth, result, best, np.where(mask, residual, np.nan))


@dataclass(frozen=True)
class PatternSize:
    """How strong the pattern v1 phi1 is: the largest length of the vector field [px].

    Parameters
    ----------
    anywhere
        Over the material of the cellular part.
    inner
        Without the outermost ring of unit cells.
    corners
        Over the four corner cells.
    """

    anywhere: float
    inner: float
    corners: float


def pattern_size(comparison: Comparison, specimen: Specimen) -> PatternSize:
    """Measure the identified pattern by regions of the specimen."""
    grid = comparison.grid
    a, b = specimen.cellular_half_size
    x, y = np.abs(grid.x)[None, :], np.abs(grid.y)[:, None]
    length = np.linalg.norm(comparison.result.fluctuation(), axis=-1) / grid.pixel_size
    outer_x, outer_y = x > a - specimen.pitch, y > b - specimen.pitch

    def largest(where: BoolArray) -> float:
        return float(np.max(length, initial=0.0, where=where))

    cellular = comparison.mask & (x <= a) & (y <= b)
    return PatternSize(
        largest(cellular),
        largest(cellular & ~outer_x & ~outer_y),
        largest(cellular & outer_x & outer_y),
    )
