"""Guards the one place where y is flipped: pixels to millimetres and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

GRIDS = st.builds(
    PixelGrid,
    rows=st.integers(1, 3000),
    cols=st.integers(1, 3000),
    pixel_size=st.floats(1e-3, 1.0),
    x0=st.floats(-50, 50),
    y0=st.floats(-50, 50),
)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(grid=GRIDS, row=st.floats(-100, 3000), col=st.floats(-100, 3000))
def test_pixels_to_mm_and_back(grid: PixelGrid, row: float, col: float) -> None:
    back = grid.to_px(*grid.to_mm(row, col))
    # A position of up to 3050 mm is rounded to 2.3e-13 mm, that is 2.3e-10 of a 1e-3 mm pixel.
    np.testing.assert_allclose(back, (row, col), atol=1e-9)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(grid=GRIDS)
def test_rows_run_down_and_columns_run_right(grid: PixelGrid) -> None:
    x, y = grid.to_mm(np.arange(grid.rows)[:, None], np.arange(grid.cols)[None, :])
    np.testing.assert_array_equal(x.ravel(), grid.x)
    np.testing.assert_array_equal(y.ravel(), grid.y)
    assert (np.diff(grid.x) > 0).all()
    assert (np.diff(grid.y) < 0).all()


@pytest.mark.parametrize("shape", [(4, 6), (5, 7), (4, 7), (1, 1)])
def test_centred_grid_is_symmetric(shape: tuple[int, int]) -> None:
    grid = PixelGrid.centred(*shape, 0.25)  # a binary fraction: symmetric to the last bit
    np.testing.assert_array_equal(grid.x, -grid.x[::-1])
    np.testing.assert_array_equal(grid.y, -grid.y[::-1])
    left, right, bottom, top = grid.extent
    assert (right - left, top - bottom) == (0.25 * shape[1], 0.25 * shape[0])


def test_binned_pixels_are_the_means_of_their_blocks() -> None:
    grid = PixelGrid(10, 13, 0.02, -1.0, 3.0)
    coarse = grid.binned(3)
    assert coarse.shape == (3, 4)
    np.testing.assert_allclose(coarse.x, grid.x[:12].reshape(4, 3).mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(coarse.y, grid.y[:9].reshape(3, 3).mean(axis=1), rtol=1e-14)


@pytest.mark.parametrize("bad", [(0, 5, 0.1), (5, 0, 0.1), (5, 5, 0.0), (5, 5, float("nan"))])
def test_refuses_empty_images_and_pixels(bad: tuple[int, int, float]) -> None:
    with pytest.raises(InputError, match="expected an image of at least 1 x 1 px"):
        PixelGrid(*bad, 0.0, 0.0)
