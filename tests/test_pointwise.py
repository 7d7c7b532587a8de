"""Guards the inverse mapping at points anywhere: as the raster finds it, and beyond the raster."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_isoparametric import ELEMENTS, FILLING, patch, single, textbook

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate, locate_points
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

ACCEPTED_PX = 1e-10  # the residual that truth files promise
H = 1 / 32  # mm/px, a binary fraction
GRID = PixelGrid(200, 210, H, -1.0, 5.2)
elements = pytest.mark.parametrize("element", ELEMENTS)


def inside(element: str, rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 2) random local coordinates, evenly over the reference domain."""
    xi = rng.uniform(0.0, 1.0, (count, 2))
    if element[0] == "T":
        return np.where(xi.sum(axis=1, keepdims=True) > 1.0, 1.0 - xi, xi)
    return 2.0 * xi - 1.0


@elements
def test_at_whole_pixels_it_is_the_raster(element: str) -> None:
    nodes, cells = patch(4, 3, 0.08, element)
    raster = locate(nodes, cells, element, GRID)
    row, col = np.ogrid[: GRID.rows, : GRID.cols]
    found = locate_points(nodes, cells, element, GRID, row, col)
    np.testing.assert_array_equal(found.element, raster.element)
    # Both leave residuals of rounding; an almost folded element turns 1e-13 px into more.
    np.testing.assert_allclose(found.xi, raster.xi, atol=1e-9)
    assert 0.0 < found.max_residual_px <= ACCEPTED_PX


@elements
@given(seed=st.integers(0, 10_000))
def test_finds_points_where_they_were_put(element: str, seed: int) -> None:
    """In a patch of elements close to folding, each a random distance from its fold."""
    rng = np.random.default_rng(seed)
    nodes, cells = patch(3, seed, 10.0 ** rng.uniform(-2, 0), element)
    owner = rng.integers(0, len(cells), 300)
    xi = inside(element, rng, owner.size)
    x, y = np.einsum("pk,pkd->dp", textbook(element, xi), nodes[cells[owner]])
    row, col = (a.reshape(20, 15) for a in GRID.to_px(x, y))
    found = locate_points(nodes, cells, element, GRID, row, col)
    assert found.mask.all()
    assert found.max_residual_px <= ACCEPTED_PX
    # Elements don't overlap, but a bulged patch may stick out of itself: the same place counts.
    back = np.einsum(
        "pk,pkd->dp",
        textbook(element, found.xi.reshape(-1, 2)),
        nodes[cells[found.element.ravel()]],
    )
    np.testing.assert_allclose(back, [x, y], atol=ACCEPTED_PX * H * 2)
    assert (found.element.ravel() == owner).mean() > 0.9


@elements
def test_one_element_close_to_folding(element: str) -> None:
    """Newton's method from the middle fails here and there; then the search has to find it."""
    for seed in range(40):
        nodes, cells = single(element, seed, 1.0)
        xi = inside(element, np.random.default_rng(seed), 400)
        row, col = GRID.to_px(*(textbook(element, xi) @ nodes).T)
        found = locate_points(nodes, cells, element, GRID, row[:, None], col[:, None])
        assert found.mask.all()
        assert found.max_residual_px <= ACCEPTED_PX


@elements
def test_shared_edges_and_nodes_belong_to_the_lowest_number(element: str) -> None:
    n = 3
    nodes, cells = patch(n, 0, 0.0, element)
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    row, col = GRID.to_px(x, y)
    found = locate_points(nodes, cells, element, GRID, row, col).element
    per_square = len(FILLING[element])
    for j in range(n + 1):
        for i in range(n + 1):
            square = max(j - 1, 0) * n + max(i - 1, 0)
            assert found[j, i] // per_square == square


def test_no_point_is_missing_and_none_is_found_outside() -> None:
    n, rng = 4, np.random.default_rng(5)
    nodes, cells = patch(n, 0, 0.0)
    shift = 0.2 * np.stack([np.sin(2 * nodes[:, 1]), np.cos(2 * nodes[:, 0])], axis=1)
    interior = ((nodes > 0.01) & (nodes < n - 0.01)).all(axis=1)
    nodes = nodes + 0.5 * interior[:, None] * shift  # bulged within a straight boundary
    x, y = rng.uniform(-0.3, n + 0.3, (2, 300, 300))
    found = locate_points(nodes, cells, "T6", GRID, *GRID.to_px(x, y))
    square = (np.minimum(x, y) >= 0.0) & (np.maximum(x, y) <= n)
    np.testing.assert_array_equal(found.mask, square)
    for field in (found.xi[..., 0], found.xi[..., 1], found.residual_px):
        np.testing.assert_array_equal(np.isnan(field), ~square)


def test_far_away_and_nan_are_nowhere() -> None:
    nodes, cells = patch(2, 0, 0.05)
    row = np.array([[np.nan, 1e9, -1e9, 0.0, np.inf, 120.0]])
    col = np.array([[50.0, 50.0, 50.0, 1e300, 50.0, 60.0]])
    found = locate_points(nodes, cells, "T6", GRID, row, col)
    np.testing.assert_array_equal(found.mask, [[False] * 5 + [True]])


def test_a_folded_mesh_is_refused() -> None:
    nodes, cells = patch(2, 0, 0.0)
    with pytest.raises(InputError, match="bent plate: expected T6 elements with positive"):
        locate_points(nodes * [-1.0, 1.0], cells, "T6", GRID, 0.0, [[0.0]], "bent plate")
