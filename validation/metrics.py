"""Numbers for vector fields: which mean is meant is said in the name.

"rms" in this project is *per component*: the root of the mean square over both components of
all pixels, as grey-level noise or the noise of a local DIC is quoted. The rms of the vectors'
length is sqrt(2) times that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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
    values = field[mask] / unit
    length = np.hypot(values[:, 0], values[:, 1])
    return {
        "mean": values.mean(axis=0).tolist(),
        "rms": np.sqrt(np.mean(values**2, axis=0)).tolist(),
        "rms_per_component": float(np.sqrt(np.mean(values**2))),
        "rms_length": float(np.sqrt(np.mean(length**2))),
        "median_length": float(np.median(length)),
        "p95_length": float(np.percentile(length, 95)),
        "max_length": float(length.max()),
    }
