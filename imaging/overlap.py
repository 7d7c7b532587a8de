"""Material that lies on top of itself, as where ligaments touch after buckling.

A pixel belongs to the covering element of the lowest number. Looked for again in the opposite
order it belongs to the one of the highest; where that is another one, and the pixel isn't just
on an edge that the two share, the specimen overlaps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.elements import reference_element
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.isoparametric import Located, locate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CLEAR_OF_EDGES = 1e-6  # in xi, eta; pixels on an edge come out within some 1e-9


def doubly_covered(
    located: Located, nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid
) -> int:
    """Count the pixels that lie inside more than one element.

    Parameters
    ----------
    located, nodes, cells, element, grid
        What :func:`modeharvest.imaging.isoparametric.locate` gave, and what it was given.
    """
    reverse = locate(nodes, cells[::-1], element, grid)
    last = len(cells) - 1 - reverse.element
    two = located.mask & (last != located.element)
    triangular = reference_element(element).triangular
    depth = np.minimum(*(_depth(each.xi[two], triangular) for each in (located, reverse)))
    return int(np.count_nonzero(depth > _CLEAR_OF_EDGES))


def _depth(xi: FloatArray, triangular: bool) -> FloatArray:
    """How far inside the reference domain local coordinates (n, 2) lie."""
    if triangular:
        return np.asarray(np.minimum(xi.min(axis=1), 1.0 - xi.sum(axis=1)))
    return np.asarray(1.0 - np.abs(xi).max(axis=1))
