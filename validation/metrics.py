"""Numbers for vector fields: which mean is meant is said in the name.

"rms" in this project is *per component*: the root of the mean square over both components of
all pixels, as grey-level noise or the noise of a local DIC is quoted. The rms of the vectors'
length is sqrt(2) times that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def lengths(field: FloatArray) -> FloatArray:
    """(...) Euclidean lengths of the vectors of a field (..., 2)."""
    x, y = field[..., 0], field[..., 1]
    return np.asarray(np.sqrt(x * x + y * y))


def describe(field: FloatArray, mask: BoolArray, unit: float = 1.0) -> dict[str, Any]:
    """Bias, rms, percentiles and maximum of a vector field.

    Parameters
    ----------
    field
        (rows, cols, 2).
    mask
        (rows, cols) True where the field counts.
    unit
        The size of the unit to give the numbers in, e.g. the pixel size [mm/px] to turn a
        field in mm into px.

    Returns
    -------
    dict
        ``mean`` and ``rms`` as (x, y); ``rms_per_component``; ``rms_length``, ``median_length``,
        ``p95_length`` and ``max_length`` of the vectors' Euclidean length.
    """
    x, y = (field[..., c][mask] / unit for c in (0, 1))
    mean_squares = float(x @ x) / x.size, float(y @ y) / y.size
    length = np.sqrt(x * x + y * y)
    median, p95, largest = np.quantile(length, (0.5, 0.95, 1.0), overwrite_input=True)
    return {
        "mean": [float(x.mean()), float(y.mean())],
        "rms": [math.sqrt(square) for square in mean_squares],
        "rms_per_component": math.sqrt(0.5 * sum(mean_squares)),
        "rms_length": math.sqrt(sum(mean_squares)),
        "median_length": float(median),
        "p95_length": float(p95),
        "max_length": float(largest),
    }
