"""Guards the count of pixels on which a specimen lies twice, and that neighbours aren't counted."""

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.util.elements import reference_element

FloatArray = NDArray[np.float64]
H = 0.125  # mm/px, a binary fraction: edges and nodes lie exactly on pixel centres
GRID = PixelGrid.centred(81, 81, H)


def count(nodes: FloatArray, element: str, grid: PixelGrid = GRID) -> int:
    cells = np.arange(len(nodes)).reshape(-1, len(reference_element(element).nodes))
    return locate(nodes, cells, element, grid).doubly_covered


@pytest.mark.parametrize("element", ["Q4", "Q8", "Q9"])
@pytest.mark.parametrize(("shift", "expected"), [(2.0, 0), (1.5, 3 * 15), (1.0, 7 * 15)])
def test_squares_overlap_by_what_they_share(element: str, shift: float, expected: int) -> None:
    """Sides of 2 mm are 16 px: pixels strictly inside both, which touching edges are not."""
    square = reference_element(element).nodes
    moved = np.add(square, [shift, 0.0])
    assert count(np.vstack([square, moved]), element) == expected
    assert count(np.vstack([moved, square]), element) == expected


@pytest.mark.parametrize("element", ["T3", "T6"])
def test_triangles_that_share_a_diagonal_do_not_overlap_and_crossed_ones_do(element: str) -> None:
    lower = reference_element(element).nodes * 2.0
    assert count(np.vstack([lower, 2.0 - lower]), element) == 0
    # The square of 1 mm between the two right angles is common to both.
    assert count(np.vstack([lower, 1.0 - lower]), element) == 7 * 7


def test_three_layers_are_counted_once_a_pixel() -> None:
    square = reference_element("Q4").nodes
    assert count(np.vstack([square, square, square]), "Q4") == 15 * 15
