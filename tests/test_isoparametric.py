"""Guards the inverse mapping: every pixel of every valid mesh found once, to rounding."""

from collections.abc import Iterator
from functools import cache

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import non_positive_jacobians, require_positive_jacobian
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate
from modeharvest.util.elements import reference_element, shape_functions, shape_gradients
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ELEMENTS = ("T3", "T6", "Q4", "Q8", "Q9")
ACCEPTED_PX = 1e-10  # the residual that truth files promise
BOUNDARY_PX = 0.02  # nearer to an boundary than this, its polygon of chords can't tell


# Independent of the code under test: shape functions from the textbook -------------------------


def textbook(element: str, xi: FloatArray) -> FloatArray:
    """Shape functions as Zienkiewicz & Taylor (vol. 1, ch. 8) print them: (..., k)."""
    s, t = xi[..., 0], xi[..., 1]
    if element == "T3":
        return np.stack([1 - s - t, s, t], axis=-1)
    if element == "T6":
        a, b, c = 1 - s - t, s, t
        return np.stack(
            [a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a],
            axis=-1,
        )
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    if element == "Q4":
        return np.stack([(1 + p * s) * (1 + q * t) / 4 for p, q in corners], axis=-1)
    if element == "Q8":
        corner = [(1 + p * s) * (1 + q * t) * (p * s + q * t - 1) / 4 for p, q in corners]
        sides = [
            (1 - s * s) * (1 - t) / 2,
            (1 + s) * (1 - t * t) / 2,
            (1 - s * s) * (1 + t) / 2,
            (1 - s) * (1 - t * t) / 2,
        ]
        return np.stack(corner + sides, axis=-1)

    def line(p: int, x: FloatArray) -> FloatArray:
        return 1 - x * x if p == 0 else x * (x + p) / 2

    order = [*corners, (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)]
    return np.stack([line(p, s) * line(q, t) for p, q in order], axis=-1)


def boundary(element: str, nodes: FloatArray, per_side: int = 80) -> FloatArray:
    """(points, 2) the boundary of one element, counter-clockwise, as a fine polygon."""
    u = np.linspace(0, 1, per_side, endpoint=False)[:, None]
    count = 3 if element[0] == "T" else 4
    corners = reference_element(element).nodes[:count]
    sides = [corners[k] + u * (corners[(k + 1) % count] - corners[k]) for k in range(count)]
    return textbook(element, np.vstack(sides)) @ nodes


def winding(polygon: FloatArray, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """How often a polygon goes round each point (n, 2), and the points' distances from it."""
    dx, dy = polygon.T[:, None] - points.T[..., None]
    sx, sy = np.roll(polygon.T, -1, axis=1) - polygon.T
    left = sy * dx - sx * dy > 0.0
    below = dy <= 0.0
    next_below = np.roll(below, -1, axis=1)
    up, down = below & ~next_below & left, ~below & next_below & ~left
    turns = np.count_nonzero(up, axis=1) - np.count_nonzero(down, axis=1)
    along = np.clip((dx * sx + dy * sy) / -(sx**2 + sy**2), 0.0, 1.0)
    nearest = np.sqrt(((dx + along * sx) ** 2 + (dy + along * sy) ** 2).min(axis=1))
    return turns, nearest


# Meshes -------------------------------------------------------------------------------------


def limited(base: FloatArray, change: FloatArray, cells: IntArray, element: str) -> FloatArray:
    """Add as much of ``change`` to ``base`` as leaves Jacobians positive, less 3 %."""
    low, high = 0.0, 1.0
    if not non_positive_jacobians(base + change, cells, element).size:
        return base + change
    for _ in range(12):
        middle = 0.5 * (low + high)
        if non_positive_jacobians(base + middle * change, cells, element).size:
            high = middle
        else:
            low = middle
    return base + 0.97 * low * change


def single(element: str, seed: int, amplitude: float) -> tuple[FloatArray, IntArray]:
    """One element with all nodes shifted at random, close to where it would fold."""
    reference = reference_element(element)
    rng = np.random.default_rng(seed)
    change = amplitude * rng.standard_normal(reference.nodes.shape)
    cells = np.arange(len(change))[None, :]
    return limited(reference.nodes, change, cells, element), cells


# Node order of the elements that fill one square of 3 x 3 lattice points, [row][column].
_SQUARE = [(0, 0), (0, 2), (2, 2), (2, 0), (0, 1), (1, 2), (2, 1), (1, 0), (1, 1)]
_LOWER = [(0, 0), (0, 2), (2, 2), (0, 1), (1, 2), (1, 1)]
_UPPER = [(0, 0), (2, 2), (2, 0), (1, 1), (2, 1), (1, 0)]
FILLING = {
    "T3": [_LOWER[:3], _UPPER[:3]],
    "T6": [_LOWER, _UPPER],
    "Q4": [_SQUARE[:4]],
    "Q8": [_SQUARE[:8]],
    "Q9": [_SQUARE],
}


def patch(n: int, seed: int, amplitude: float, element: str = "T6") -> tuple[FloatArray, IntArray]:
    """Cut n x n squares [0, n]^2 into elements with shifted vertices and bulged sides."""
    number = np.arange((2 * n + 1) ** 2).reshape(2 * n + 1, 2 * n + 1)
    y, x = np.divmod(number.ravel(), 2 * n + 1)
    nodes = np.column_stack([x, y]) / 2.0
    cells = np.array(
        [
            [number[j + row, i + col] for row, col in order]
            for j in range(0, 2 * n, 2)
            for i in range(0, 2 * n, 2)
            for order in FILLING[element]
        ]
    )
    rng = np.random.default_rng(seed)
    change = amplitude * rng.standard_normal(nodes.shape)
    return limited(nodes, change, cells, element), cells


def patch_boundary(nodes: FloatArray, n: int, element: str = "T6") -> FloatArray:
    """Trace the boundary of a patch as a fine polygon, counter-clockwise."""
    number = np.arange((2 * n + 1) ** 2).reshape(2 * n + 1, 2 * n + 1)
    sides = [number[0], number[:, -1], number[-1, ::-1], number[::-1, 0]]
    u = np.linspace(0, 1, 80, endpoint=False)[:, None]
    parts = []
    for side in sides:
        for k in range(0, 2 * n, 2):
            a, m, b = nodes[side[k]], nodes[side[k + 1]], nodes[side[k + 2]]
            if element in ("T3", "Q4"):
                m = (a + b) / 2
            parts.append((1 - u) * (1 - 2 * u) * a + 4 * u * (1 - u) * m + u * (2 * u - 1) * b)
    return np.vstack(parts)


def grid_over(nodes: FloatArray, size: int) -> PixelGrid:
    """Lay a grid of about ``size`` px over the nodes' box, a little more, at an odd offset."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    h = float((high - low).max()) / size
    shape = np.ceil((high - low) / h).astype(int) + 7
    return PixelGrid(int(shape[1]), int(shape[0]), h, low[0] - 3.3 * h, high[1] + 2.7 * h)


def pixel_centres(grid: PixelGrid) -> FloatArray:
    """(rows * cols, 2) positions [mm]."""
    x, y = np.meshgrid(grid.x, grid.y)
    return np.column_stack([x.ravel(), y.ravel()])


def assert_maps_back(
    located: Located, nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid
) -> None:
    """Textbook shape functions at the local coordinates give the pixel centres again."""
    mask = located.mask
    N = textbook(element, located.xi[mask])
    position = np.einsum("pk,pkc->pc", N, nodes[cells[located.element[mask]]])
    off = (position - pixel_centres(grid)[mask.ravel()]) / grid.pixel_size
    assert np.hypot(*off.T).max(initial=0.0) <= ACCEPTED_PX
    assert located.max_residual_px <= ACCEPTED_PX
    inside = located.xi[mask]
    if element[0] == "T":
        assert np.column_stack([inside, 1 - inside.sum(axis=1)]).min(initial=0) > -1e-8
    else:
        assert np.abs(inside).max(initial=0) < 1 + 1e-8


# Elements -------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ELEMENTS)
def test_shape_functions_are_the_textbook_ones(element: str) -> None:
    xi = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    np.testing.assert_allclose(shape_functions(element, xi), textbook(element, xi), atol=1e-14)
    step = 1e-6
    for axis, gradient in enumerate(np.moveaxis(shape_gradients(element, xi), -1, 0)):
        d = step * np.eye(2)[axis]
        difference = (textbook(element, xi + d) - textbook(element, xi - d)) / (2 * step)
        np.testing.assert_allclose(gradient, difference, atol=1e-9)  # rounding 1e-16 / 1e-6


@pytest.mark.parametrize("element", ELEMENTS)
@settings(deadline=None, derandomize=True, max_examples=25)
@given(seed=st.integers(0, 10**6), amplitude=st.floats(0.02, 1.0))
def test_an_element_owns_the_pixels_that_its_boundary_encloses(
    element: str, seed: int, amplitude: float
) -> None:
    nodes, cells = single(element, seed, amplitude)
    grid = grid_over(nodes, 25)
    located = locate(nodes, cells, element, grid)
    assert_maps_back(located, nodes, cells, element, grid)
    turns, distance = winding(boundary(element, nodes), pixel_centres(grid))
    clear = distance > BOUNDARY_PX * grid.pixel_size
    np.testing.assert_array_equal(located.mask.ravel()[clear], turns[clear] > 0)


@pytest.mark.parametrize("element", ELEMENTS)
@settings(deadline=None, derandomize=True, max_examples=25)
@given(seed=st.integers(0, 10**6), where=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_any_point_comes_back(element: str, seed: int, where: tuple[float, float]) -> None:
    """Points inside, on edges and on corners."""
    nodes, cells = single(element, seed, 0.15)
    s, t = where
    xi = np.array([s, (1 - s) * t] if element[0] == "T" else [2 * s - 1, 2 * t - 1])
    x, y = textbook(element, xi) @ nodes
    located = locate(nodes, cells, element, PixelGrid(1, 1, 0.05, float(x), float(y)))
    assert located.element.item() == 0
    # 0.97 of the way to a fold, the map may shrink lengths a few hundred times.
    np.testing.assert_allclose(located.xi[0, 0], xi, atol=1e-10)


# Meshes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ELEMENTS)
@settings(deadline=None, derandomize=True, max_examples=8)
@given(seed=st.integers(0, 10**6), amplitude=st.floats(0.02, 0.4), size=st.integers(20, 50))
def test_every_pixel_of_a_patch_is_found_exactly_once(
    element: str, seed: int, amplitude: float, size: int
) -> None:
    n = 3
    nodes, cells = patch(n, seed, amplitude, element)
    grid = grid_over(nodes[np.unique(cells)], size)
    located = locate(nodes, cells, element, grid)
    assert_maps_back(located, nodes, cells, element, grid)
    alone = [locate(nodes, cells[[e]], element, grid) for e in range(len(cells))]
    claims = np.array([a.mask for a in alone])
    turns, distance = winding(patch_boundary(nodes, n, element), pixel_centres(grid))
    clear = distance > BOUNDARY_PX * grid.pixel_size
    covered = turns.reshape(grid.shape)
    # Each element alone claims what it claims in company, and no pixel is claimed more often
    # than the boundary goes round it; bulged edges of the boundary may cross each other.
    np.testing.assert_array_equal(located.mask, claims.any(axis=0))
    np.testing.assert_array_equal(located.element[located.mask], claims.argmax(0)[located.mask])
    np.testing.assert_array_equal(claims.sum(axis=0).ravel()[clear], covered.ravel()[clear])


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("shape", [(80, 9000), (9000, 80)])
def test_residuals_are_as_small_at_the_end_of_a_large_image(
    element: str, shape: tuple[int, int]
) -> None:
    """A double at 4 500 px from the origin is good to 1e-12 px."""
    h = 0.01
    nodes, cells = patch(3, 3, 0.3, element)
    grid = PixelGrid.centred(*shape, h)
    end = np.array([grid.x[-40], grid.y[-40]])
    nodes = (nodes - 1.5) * 20 * h + end  # elements of 20 px
    located = locate(nodes, cells, element, grid)
    assert located.mask.sum() > 3000
    assert_maps_back(located, nodes, cells, element, grid)


@pytest.mark.parametrize("element", ["Q4", "Q8", "Q9"])
def test_pixels_on_edges_and_nodes_belong_to_the_lowest_element(element: str) -> None:
    """Squares of 4 px with nodes on pixel centres: (3 * 4 + 1)^2 px, each owner known."""
    n, h = 3, 0.25  # binary fractions: the edges hit the centres to the last bit
    reference = reference_element(element)
    corners = np.array([[i, j] for j in range(n) for i in range(n)])
    nodes = (corners[:, None] + (reference.nodes + 1) / 2).reshape(-1, 2)
    cells = np.arange(len(nodes)).reshape(n * n, -1)
    grid = PixelGrid(15, 15, h, -h, n + h)
    located = locate(nodes, cells, element, grid)
    x, y = np.meshgrid(grid.x, grid.y)
    first_i, first_j = np.maximum(np.ceil(x) - 1, 0), np.maximum(np.ceil(y) - 1, 0)
    inside = (x >= 0) & (x <= n) & (y >= 0) & (y <= n)
    np.testing.assert_array_equal(located.element, np.where(inside, first_j * n + first_i, -1))
    assert located.mask.sum() == 13**2


def test_neighbours_share_an_edge_without_gap_whatever_its_curve() -> None:
    """Pixel grids laid through points of a curved shared edge, one pixel each."""
    nodes, cells = patch(2, 8, 0.12)
    for u in np.linspace(0, 1, 41):
        a, m, b = nodes[cells[0, [2, 5, 0]]]  # the diagonal that elements 0 and 1 share
        x, y = (1 - u) * (1 - 2 * u) * a + 4 * u * (1 - u) * m + u * (2 * u - 1) * b
        located = locate(nodes, cells, "T6", PixelGrid(1, 1, 0.02, float(x), float(y)))
        assert located.element.item() == 0


def test_mirror_images() -> None:
    nodes, cells = patch(3, 21, 0.1)
    nodes = nodes - 1.5
    u = np.random.default_rng(2).standard_normal(nodes.shape)
    grid = PixelGrid.centred(64, 80, 0.0625)
    located = locate(nodes, cells, "T6", grid)
    swapped = cells[:, [0, 2, 1, 5, 4, 3]]
    mirrored = locate(nodes * [-1, 1], swapped, "T6", grid)
    np.testing.assert_array_equal(mirrored.element, located.element[:, ::-1])
    np.testing.assert_allclose(
        interpolate(mirrored, swapped, "T6", u),
        interpolate(located, cells, "T6", u)[:, :, ::-1],
        atol=1e-11,
    )


@pytest.fixture
def restored_threads() -> Iterator[None]:
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("restored_threads")
def test_threads_do_not_change_a_bit() -> None:
    nodes, cells = patch(4, 5, 0.12)
    grid = grid_over(nodes, 300)
    many = locate(nodes, cells, "T6", grid)
    numba.set_num_threads(1)
    one = locate(nodes, cells, "T6", grid)
    for name in ("element", "xi", "residual_px"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


def test_image_far_from_the_mesh_is_background() -> None:
    nodes, cells = patch(1, 0, 0.0)
    located = locate(nodes, cells, "T6", PixelGrid(5, 6, 0.1, 10.0, 10.0))
    assert not located.mask.any()
    assert located.max_residual_px == 0.0
    assert np.isnan(interpolate(located, cells, "T6", nodes)).all()


# Interpolation --------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ELEMENTS)
def test_linear_fields_are_exact_on_curved_elements(element: str) -> None:
    nodes, cells = single(element, 4, 0.1)
    grid = grid_over(nodes, 40)
    located = locate(nodes, cells, element, grid)
    x, y = np.meshgrid(grid.x, grid.y)
    values = interpolate(located, cells, element, nodes @ [[0.3, 1.0], [-0.7, 2.0]] + [5.0, -1.0])
    expected = np.stack([0.3 * x - 0.7 * y + 5.0, x + 2.0 * y - 1.0])
    assert located.mask.sum() > 400
    np.testing.assert_allclose(values[:, located.mask], expected[:, located.mask], atol=1e-13)
    assert np.isnan(values[:, ~located.mask]).all()


@pytest.mark.parametrize("element", ["T6", "Q8", "Q9"])
def test_quadratic_fields_are_exact_on_straight_elements(element: str) -> None:
    nodes = reference_element(element).nodes @ [[1.0, 0.3], [-0.2, 0.8]]
    cells = np.arange(len(nodes))[None, :]
    grid = grid_over(nodes, 40)
    located = locate(nodes, cells, element, grid)

    def quadratic(x: FloatArray, y: FloatArray) -> FloatArray:
        return 1 + x - 2 * y + 3 * x * x - x * y + 0.5 * y * y

    values = interpolate(located, cells, element, quadratic(*nodes.T)[:, None])[0]
    expected = quadratic(*np.meshgrid(grid.x, grid.y))
    assert located.mask.sum() > 400
    np.testing.assert_allclose(values[located.mask], expected[located.mask], atol=1e-13)


# Validity -------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ELEMENTS)
def test_clockwise_elements_are_refused_by_number(element: str) -> None:
    nodes = reference_element(element).nodes
    both = np.vstack([nodes, nodes * [-1, 1] + [5, 0]])  # the second one is mirrored
    cells = np.arange(len(both)).reshape(2, -1)
    with pytest.raises(InputError, match=r"snapshot 7: .* got 1 without, the first is element 1"):
        locate(both, cells, element, PixelGrid.centred(8, 8, 0.1), "snapshot 7")


@pytest.mark.parametrize(("at", "refused"), [(0.24, True), (0.25, True), (0.2505, False)])
def test_side_node_at_the_quarter_point_is_the_limit(at: float, refused: bool) -> None:
    """With a mid-side at a quarter of a straight side the Jacobian vanishes at the corner."""
    nodes = reference_element("T6").nodes.copy()
    nodes[3] = [at, 0.0]
    assert bool(non_positive_jacobians(nodes, np.arange(6)[None], "T6").size) is refused


@cache
def sampled_gradients(element: str) -> FloatArray:
    """(2, k, 101 * 101) gradients of the shape functions all over an element."""
    u = np.linspace(0, 1, 101)
    s, t = (a.ravel() for a in np.meshgrid(u, u))
    xi = np.column_stack([s, (1 - s) * t]) if element[0] == "T" else np.column_stack([s, t]) * 2 - 1
    return np.ascontiguousarray(shape_gradients(element, xi).T)


@pytest.mark.parametrize("element", ELEMENTS)
@settings(deadline=None, derandomize=True, max_examples=60)
@given(seed=st.integers(0, 10**6), amplitude=st.floats(0.05, 0.6))
def test_refused_exactly_where_the_jacobian_fails(
    element: str, seed: int, amplitude: float
) -> None:
    reference = reference_element(element)
    rng = np.random.default_rng(seed)
    nodes = reference.nodes + amplitude * rng.standard_normal(reference.nodes.shape)
    refused = bool(non_positive_jacobians(nodes, np.arange(len(nodes))[None], element).size)
    (a, b), (c, d) = np.einsum("ikp,kc->cip", sampled_gradients(element), nodes)
    determinant = a * d - b * c
    if determinant.min() <= 0:
        assert refused
    elif refused:  # then the least value lies between the samples, which are 0.02 apart
        assert determinant.min() < 0.02 * np.abs(determinant).max()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_lost_nodes_are_refused_by_number(value: float) -> None:
    nodes, cells = patch(1, 0, 0.0)
    nodes[4, 1] = value
    with pytest.raises(InputError, match=r"finite node positions, .* the first is node 4"):
        locate(nodes, cells, "T6", PixelGrid.centred(8, 8, 0.1))


def test_valid_mesh_passes() -> None:
    nodes, cells = patch(3, 1, 0.2)
    require_positive_jacobian(nodes, cells, "T6")


@pytest.mark.parametrize("flat", [0.0, 1e-9, 1e-5, 1e-3, 0.3])
def test_straight_triangles_and_hardly_curved_ones_cover_the_same_pixels(flat: float) -> None:
    """Corners at pixel centres, sides along rows or nearly so: on an affine map and on no such one.

    Moved mid-sides by 1e-11 px make Newton's method take over, with ends on curved sides.
    """
    rng, grid = np.random.default_rng(3), PixelGrid(41, 41, 1.0, 0.0, 0.0)
    corners = np.round(rng.uniform(2.0, 38.0, (200, 3, 2))) - [0.0, 40.0]
    corners[:, 1, 1] = corners[:, 0, 1] + flat * rng.uniform(-1.0, 1.0, 200)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    corners[area < 0] = corners[area < 0][:, [1, 0, 2]]
    seen = 0
    for triangle in corners[np.abs(area) > 2.0]:
        middle = 0.5 * (triangle + np.roll(triangle, -1, axis=0))
        six = np.vstack([triangle, middle + 1e-11 * rng.standard_normal((3, 2))])
        straight = locate(triangle, np.arange(3)[None, :], "T3", grid)
        curved = locate(six, np.arange(6)[None, :], "T6", grid)
        np.testing.assert_array_equal(straight.mask, curved.mask)
        np.testing.assert_allclose(straight.xi, curved.xi, atol=1e-9)
        assert straight.max_residual_px < ACCEPTED_PX
        seen += int(straight.mask.sum())
    assert seen > 10_000
