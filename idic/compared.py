"""What a correlation compared at its end: the images and pixels that error bars have to be made of.

The deformed image as it is has edges at its holes, and pixels that land there took no part. A
curvature that sees them is none of the cost's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.error_bars import leftover_covariance, softness
from modeharvest.idic.normal_equations import Assembly
from modeharvest.idic.pyramid import FULL, prepare
from modeharvest.idic.result import Result
from modeharvest.idic.warp import landed

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Compared:
    """What a result was found with.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f, and g continued into its holes [grey levels].
    used
        (rows, cols) True on the pixels that count.
    order
        Of the spline.
    """

    reference: NDArray[np.float32]
    deformed: NDArray[np.float32]
    used: BoolArray
    order: int

    @classmethod
    def of(
        cls,
        result: Result,
        images: tuple[NDArray[Any], NDArray[Any]],
        masks: tuple[BoolArray | None, BoolArray | None],
        edge_px: int,
    ) -> Compared:
        """Prepare the images once more as the last level of a correlation did.

        Parameters
        ----------
        result
            Of the correlation.
        images, masks
            (rows, cols) f and g, and where they show material; None if not known.
        edge_px
            Of :class:`~modeharvest.idic.correlate.CorrelationOptions`.
        """
        grid, order = result.grid, result.order
        pair = prepare(*images, grid, *masks, FULL, edge_px, order)
        used = pair.mask
        if pair.allowed is not None:
            every = Assembly(result.ansatz, grid, pair.mask)
            used, _ = landed(every, result.unknowns, pair.reference, pair.deformed, pair.allowed)
        row, col = np.indices(grid.shape, dtype=np.float64)
        deformed = pair.deformed.sample(row, col)[0].astype(np.float32)
        return cls(pair.reference, deformed, used, order)

    def softness(self, result: Result) -> FloatArray:
        """(n, n) H⁻¹, see :func:`~modeharvest.idic.error_bars.softness`."""
        return softness(result, self.reference, self.deformed, self.used, self.order)

    def leftover_covariance(
        self, result: Result, block: float, soft: FloatArray | None = None
    ) -> FloatArray:
        """(n, n) by what the ansatz leaves over.

        Parameters
        ----------
        result
            Of the correlation.
        block, soft
            See :func:`~modeharvest.idic.error_bars.leftover_covariance`.
        """
        return leftover_covariance(
            result, self.reference, self.deformed, self.used, block, self.order, soft
        )
