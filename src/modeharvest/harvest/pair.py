"""Two photographs that are correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Pair:
    """What is correlated.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f and g.
    mask, deformed_mask
        (rows, cols) True on material.
    """

    reference: FloatImage
    deformed: FloatImage
    mask: BoolArray
    deformed_mask: BoolArray
