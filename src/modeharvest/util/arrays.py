"""Names of array types, for annotations."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Floating-point numbers of double precision."""
FloatImage = NDArray[np.float32]
"""Floating-point numbers of single precision."""
ComplexArray = NDArray[np.complex128]
"""Complex numbers of double precision."""
IntArray = NDArray[np.int64]
"""Integers of 64 bits."""
BoolArray = NDArray[np.bool_]
"""True or False."""
