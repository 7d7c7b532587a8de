"""J'J and J'r from moments against the explicit Jacobian and against differences of the cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import manufactured
import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Brightness, ChebyshevField
from modeharvest.idic.solver.assembly import Assembly, NormalEquations
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

# Wider than a block of the kernel (256 px), and off-centre, so that a flip can't hide.
GRID = PixelGrid(61, 290, 0.011, -1.45, 0.55)
ANSATZES = {
    "no mode": lambda: Ansatz(manufactured.DOMAIN, v0_degree=2),
    "one mode": manufactured.one_mode,
    "two modes": manufactured.two_modes,
    "gain and offset": lambda: replace(manufactured.one_mode(), brightness=Brightness(1, 2)),
    "offset alone": lambda: Ansatz(
        manufactured.DOMAIN, v0_degree=2, brightness=Brightness(offset_degree=0)
    ),
}


def perforated() -> NDArray[np.bool_]:
    """Leave out some discs, all of one row and the surroundings."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    mask = (abs(x) < 1.3) & (y < 0.5)
    for centre in (-0.9, -0.1, 0.8):
        mask &= np.hypot(x - centre, y - 0.2) > 0.15
    mask[40] = False
    return mask


def images(seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Two unrelated smooth random images, so that the residual is as large as the images."""
    noise = np.random.default_rng(seed).normal(size=(2, *GRID.shape))
    f, g = (np.float32(5 * ndimage.gaussian_filter(n, 2.0)) for n in noise)
    return f, g


def dense(
    ansatz: Ansatz, a: FloatArray, mask: NDArray[np.bool_], f: NDArray[np.float32], g: SplineImage
) -> tuple[FloatArray, FloatArray]:
    """(pixels, n) J and (pixels,) r, in the obvious way; pixels off the image left out."""
    u = ansatz.displacement(a, GRID.x, GRID.y)[mask] / GRID.pixel_size
    row, col = np.nonzero(mask)
    value, d_row, d_col = g.sample(row - u[:, 1], col + u[:, 0])
    gradient = np.stack([d_col, -d_row], axis=-1) / GRID.pixel_size
    on = np.isfinite(value)
    sensitivities = ansatz.sensitivities(a, GRID.x[None, :], GRID.y[:, None])[mask]
    gain, offset = (b[mask] for b in ansatz.gain_and_offset(a, GRID.x, GRID.y))
    J = gain[:, None] * np.einsum("pc,pcn->pn", gradient, sensitivities)
    x, y = (at[mask] for at in np.meshgrid(GRID.x, GRID.y))
    spaces = [
        (value, ansatz.brightness.gain_degree),
        (1.0 + 0 * value, ansatz.brightness.offset_degree),
    ]
    columns = [
        field[:, None] * ChebyshevField(ansatz.domain, degree).basis(x, y)
        for field, degree in spaces
        if degree is not None
    ]
    J[:, ansatz.size - ansatz.brightness.size :] = np.hstack([*columns, J[:, :0]])
    return J[on], (f[mask] - gain * value - offset)[on]


def assert_same(got: NormalEquations, J: FloatArray, r: FloatArray) -> None:
    """To the rounding of sums over 10^4 pixels, relative to each entry's natural size."""
    expected = J.T @ J
    size = np.sqrt(np.diag(expected))
    scale = size[:, None] * size[None, :]
    np.testing.assert_array_less(abs(got.matrix - expected), 1e-11 * scale + 1e-300)
    np.testing.assert_array_less(
        abs(got.gradient + J.T @ r), 1e-11 * size * np.linalg.norm(r) + 1e-300
    )
    assert got.cost == pytest.approx(0.5 * r @ r, rel=1e-12)


@pytest.mark.parametrize("order", [3, 5])
@pytest.mark.parametrize("name", ANSATZES)
def test_images_against_the_explicit_jacobian(name: str, order: int) -> None:
    ansatz, mask = ANSATZES[name](), perforated()
    a = manufactured.random_unknowns(ansatz, 1, 0.03)
    f, g = images()
    spline = SplineImage.of(g, order)
    got = Assembly(ansatz, GRID, mask).images(a, f, spline)
    J, r = dense(ansatz, a, mask, f, spline)
    assert_same(got, J, r)
    assert got.pixels == len(r)
    assert got.outside_image == mask.sum() - len(r)
    assert got.mean_square == pytest.approx((r**2).mean())


def test_pixels_that_leave_the_image_are_counted_and_take_no_part() -> None:
    ansatz, mask = manufactured.one_mode(), np.ones(GRID.shape, dtype=np.bool_)
    a = ansatz.initial_guess()
    a[0] = 100.5 * GRID.pixel_size  # 100.5 px to the right
    f, g = images()
    spline = SplineImage.of(g)
    got = Assembly(ansatz, GRID, mask).images(a, f, spline)
    J, r = dense(ansatz, a, mask, f, spline)
    assert got.outside_image == mask.sum() - len(r) >= 100 * GRID.rows
    assert_same(got, J, r)


@pytest.mark.parametrize("name", ["no mode", "one mode", "two modes"])
def test_displacement_against_the_explicit_jacobian(name: str) -> None:
    ansatz, mask = ANSATZES[name](), perforated()
    a = manufactured.random_unknowns(ansatz, 2, 0.1)
    target = np.random.default_rng(3).normal(size=(*GRID.shape, 2))
    target[~mask] = np.nan
    got = Assembly(ansatz, GRID, mask).displacement(a, target)
    J = ansatz.sensitivities(a, GRID.x[None, :], GRID.y[:, None])[mask]
    r = (target - ansatz.displacement(a, GRID.x, GRID.y))[mask]
    assert_same(got, J.reshape(-1, ansatz.size), r.ravel())
    assert got.pixels == 2 * mask.sum()


Evaluate = Callable[[FloatArray], NormalEquations]


def image_cost(ansatz: Ansatz) -> Evaluate:
    f, g = images()
    mask = perforated()
    # Far enough from the border that no pixel leaves: the cost would jump.
    mask &= (abs(GRID.x) < 1.1) & (abs(GRID.y[:, None] - 0.22) < 0.12)
    assembly, spline = Assembly(ansatz, GRID, mask), SplineImage.of(g)
    return lambda a: assembly.images(a, f, spline)


def displacement_cost(ansatz: Ansatz) -> Evaluate:
    target = np.random.default_rng(3).normal(size=(*GRID.shape, 2))
    assembly = Assembly(ansatz, GRID, perforated())
    return lambda a: assembly.displacement(a, target)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("one mode", image_cost),
        ("two modes", image_cost),
        ("gain and offset", image_cost),
        ("one mode", displacement_cost),
        ("two modes", displacement_cost),
    ],
)
def test_gradient_against_differences_of_the_cost(
    name: str, make: Callable[[Ansatz], Evaluate]
) -> None:
    ansatz = ANSATZES[name]()
    evaluate = make(ansatz)
    a = manufactured.random_unknowns(ansatz, 4, 0.02)
    here = evaluate(a)
    assert here.outside_image == 0
    # Steps of 1e-5 standard deviations of a residual: each moves the cost by 1e-5 of its size.
    h = 1e-5 * np.sqrt(2 * here.cost / np.diag(here.matrix))
    differences = [
        (evaluate(a + s).cost - evaluate(a - s).cost) / (2 * s.max()) for s in np.diag(h)
    ]
    natural = np.sqrt(2 * here.cost * np.diag(here.matrix))
    # Rounding 1e-15/1e-5 and curvature 1e-10 times the (large) third derivative.
    np.testing.assert_allclose(here.gradient / natural, differences / natural, atol=1e-7)


@pytest.fixture
def threads() -> Iterator[int]:
    """How many threads numba may use at most; whatever a test sets is undone."""
    before = numba.get_num_threads()
    yield numba.config.NUMBA_NUM_THREADS
    numba.set_num_threads(before)


def test_result_does_not_depend_on_the_number_of_threads(threads: int) -> None:
    if threads < 2:
        pytest.skip("needs two threads; one core here")
    ansatz = manufactured.two_modes()
    assembly, a = Assembly(ansatz, GRID, perforated()), manufactured.random_unknowns(ansatz, 1)
    f, g = images()
    spline, found = SplineImage.of(g), []
    for count in (1, 2, threads):
        numba.set_num_threads(count)
        found.append(assembly.images(a, f, spline))
    for other in found[1:]:
        np.testing.assert_array_equal(other.matrix, found[0].matrix)
        np.testing.assert_array_equal(other.gradient, found[0].gradient)
        assert other.cost == found[0].cost


@pytest.mark.parametrize("name", ANSATZES)
def test_without_the_matrix_the_rest_is_the_same(name: str) -> None:
    ansatz = ANSATZES[name]()
    assembly, a = Assembly(ansatz, GRID, perforated()), manufactured.random_unknowns(ansatz, 1)
    f, g = images()
    whole, part = (assembly.images(a, f, SplineImage.of(g), with_matrix=w) for w in (True, False))
    np.testing.assert_array_equal(part.gradient, whole.gradient)
    assert part.cost == whole.cost
    assert not part.matrix.any()


def test_two_halves_add_up_to_the_whole() -> None:
    ansatz, mask = manufactured.one_mode(), perforated()
    a = manufactured.random_unknowns(ansatz, 6, 0.03)
    f, g = images()
    spline = SplineImage.of(g)
    left = mask & (GRID.x < 0.13)
    whole, part, rest = (
        Assembly(ansatz, GRID, m).images(a, f, spline) for m in (mask, left, mask & ~left)
    )
    total = part + rest
    assert (total.pixels, total.outside_image) == (whole.pixels, whole.outside_image)
    assert total.cost == pytest.approx(whole.cost, rel=1e-12)
    size = np.sqrt(np.diag(whole.matrix))
    np.testing.assert_allclose(
        total.matrix / size / size[:, None], whole.matrix / size / size[:, None], atol=1e-12
    )


def test_no_pixel_is_an_infinite_mean_and_no_fault() -> None:
    ansatz = manufactured.one_mode()
    f, g = images()
    empty = Assembly(ansatz, GRID, np.zeros(GRID.shape, dtype=np.bool_))
    got = empty.images(ansatz.initial_guess(), f, SplineImage.of(g))
    assert got.pixels == 0
    assert got.mean_square == np.inf
    assert not got.matrix.any()


def test_mask_of_another_size_is_named() -> None:
    with pytest.raises(InputError, match=r"\(61, 290\).*\(3, 3\)"):
        Assembly(manufactured.one_mode(), GRID, np.ones((3, 3), dtype=np.bool_))
