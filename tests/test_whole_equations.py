"""Parts of finite-element DIC: smoothness, normal equations, factorisation, continued images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from perforated import OBLIQUE, holed_cell
from plate_with_hole import GRID, is_material, plate_pair, quadratic_field
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.sparse import csr_array, diags_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.sparse_factor import LIBRARIES, factorise
from modeharvest.idic.finite_element.equations.continued import (
    NONE_CONTINUED,
    continued,
    continued_pixels,
    images_on,
)
from modeharvest.idic.finite_element.equations.normal_equations import normal_equations
from modeharvest.idic.finite_element.equations.system import Body, SmoothnessRoots, interior_sides
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.solver.pyramid import FULL, Level
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return holed_cell(OBLIQUE, 6)


def straight(mesh: Mesh) -> Mesh:
    nodes = mesh.nodes.copy()
    for k in range(3):
        ends = mesh.cells[:, [k, (k + 1) % 3]]
        nodes[mesh.cells[:, 3 + k]] = nodes[ends].mean(axis=1)
    return Mesh(nodes, mesh.cells, "T6")


def smoothness(mesh: Mesh) -> csr_array:
    """R of one component, which both have alike and not in common."""
    both = Body(mesh).smoothness
    assert (both[::2, ::2] != both[1::2, 1::2]).nnz == 0 == abs(both[::2, 1::2]).max()
    return both[::2, ::2]


def test_smoothness_vanishes_for_quadratic_fields_alone(mesh: Mesh) -> None:
    mesh = straight(mesh)
    x, y = mesh.nodes.T
    values, vectors = np.linalg.eigh(smoothness(mesh).toarray())
    assert (values[:6] < 1e-9 * values[-1]).all()
    assert values[6] > 1e3 * abs(values[:6]).max()
    quadratic = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    inside = np.linalg.lstsq(vectors[:, :6], quadratic, rcond=None)[0]
    np.testing.assert_allclose(vectors[:, :6] @ inside, quadratic, atol=1e-6)


def test_curved_elements_leave_affine_fields_smooth(mesh: Mesh) -> None:
    R, affine = (smoothness(mesh), np.column_stack([np.ones(len(mesh.nodes)), mesh.nodes]))
    assert abs(R @ affine).max() < 1e-12 * abs(R).max()


def test_waves_cost_the_sixth_power_of_their_wave_number() -> None:
    """So does a cut-off wavelength mean a wavelength, whatever the elements."""
    cost = {}
    for size in (16, 32):
        mesh = square(size)
        R = smoothness(mesh)
        for waves in (1, 2):
            u = np.cos(2.0 * np.pi * waves * mesh.nodes[:, 0])
            cost[size, waves] = float(u @ R @ u)
    assert cost[32, 2] / cost[32, 1] == pytest.approx(64.0, rel=0.05)
    assert cost[32, 1] / cost[16, 1] == pytest.approx(1.0, rel=0.05)


def square(count: int) -> Mesh:
    """A unit square of 2 count^2 triangles."""
    at = np.arange(2 * count + 1) / (2 * count)
    nodes = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    number = np.arange(len(nodes)).reshape(len(at), len(at))
    i, j = (2 * k.ravel() for k in np.meshgrid(np.arange(count), np.arange(count)))

    def cells(*offsets: tuple[int, int]) -> NDArray[np.int64]:
        return np.stack([number[j + b, i + a] for a, b in offsets], axis=1)

    lower = cells((0, 0), (2, 0), (0, 2), (1, 0), (1, 1), (0, 1))
    upper = cells((2, 2), (0, 2), (2, 0), (1, 2), (1, 1), (2, 1))
    return Mesh(nodes, np.vstack([lower, upper]), "T6")


def test_samples_have_the_covariance_of_smoothness(mesh: Mesh) -> None:
    roots, count = SmoothnessRoots.of(mesh), 2000
    R, found = smoothness(mesh), roots.samples(count).reshape(len(mesh.nodes), 2, count)
    x, y = mesh.nodes.T
    for field in (np.sin(5 * x), x * y, np.cos(9 * y)):
        along = np.tensordot(field, found, 1)
        covariance = along @ along.T / count
        # Of so many samples: 1/sqrt(1000) = 3 % is one standard deviation.
        expected = field @ R @ field * np.eye(2)
        np.testing.assert_allclose(covariance, expected, atol=0.15 * expected[0, 0])


def test_every_side_inside_has_two_cells(mesh: Mesh) -> None:
    sides = interior_sides(mesh.cells)
    for cell, k, other, m in sides:
        ends = mesh.cells[cell, [k, (k + 1) % 3]], mesh.cells[other, [m, (m + 1) % 3]]
        assert set(ends[0]) == set(ends[1])
    corners = len(np.unique(mesh.cells[:, :3]))
    # Euler: corners - sides + cells = 0 for a plate with one hole.
    assert corners - (3 * len(mesh.cells) - len(sides)) + len(mesh.cells) == 0


def test_background_in_the_outermost_pixels_does_not_tell_blurred_images_apart() -> None:
    """Masks of photographs are too large by a pixel: corners then moved in blurred images."""
    pair = plate_pair(lambda points: 0.0 * points)
    mask, other = binary_dilation(pair.masks[0]), binary_erosion(pair.masks[0])
    level = images_on(ImagePair(*[pair.reference] * 2, GRID, mask, other), Level(2, 3.0), 1, 5)
    row, col = np.nonzero(level.mask)
    difference = level.deformed.sample(row, col)[0] - level.reference[level.mask]
    assert abs(difference).max() < 0.5 * level.reference[level.mask].std()


@pytest.mark.parametrize("by_reference", [False, True])
def test_gradient_against_finite_differences(by_reference: bool) -> None:
    pair = plate_pair(quadratic_field)
    body = Body(plate_mesh())
    level = images_on(pair, FULL, 4, 5)
    covered = locate(body.mesh.nodes, body.mesh.cells, "T6", level.grid).mask
    pixels = body.pixels.on(level.grid, level.mask & covered, level.reference)
    if by_reference:
        _, d_row, d_col = images_on(
            type(pair)(pair.deformed, pair.reference, GRID, pair.deformed_mask, pair.mask),
            FULL, 0, 5,
        ).deformed.sample(pixels.row, pixels.col)  # fmt: skip
        slope = np.stack([d_col, -d_row]).astype(np.float32) / GRID.pixel_size
        pixels = pixels._replace(slope=slope)
    random = np.random.default_rng(1)
    u = quadratic_field(body.mesh.nodes)
    there = normal_equations(pixels, body.mesh, level, u)
    M, gradient = body.matrix(there.blocks), body.vector(there.gradient)
    assert there.outside == 0
    if by_reference:
        # At the truth both gradients are the same, but for what splines make of the images.
        bare = pixels._replace(slope=pixels.slope[:, :0])
        other = body.matrix(normal_equations(bare, body.mesh, level, u).blocks)
        assert abs(M - other).max() < 2e-3 * abs(other).max()
        return
    step = 1e-6 * random.standard_normal(u.shape)
    squares = [normal_equations(pixels, body.mesh, level, u + s * step).square_sum for s in (1, -1)]
    slope = -(squares[0] - squares[1]) / 4.0
    expected = gradient @ step.ravel()
    scale = np.sqrt(there.square_sum * (step.ravel() @ (M @ step.ravel())))
    assert slope == pytest.approx(expected, abs=1e-4 * scale)
    assert abs(M - M.T).max() <= 1e-12 * abs(M).max()


def plate_mesh() -> Mesh:
    from modeharvest.fem.meshing import rectangle

    block = rectangle(2.2, 0.5, 10, 3)
    return Mesh(block.nodes + np.array([-1.1, 0.38]), block.cells, "T6")


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("library", LIBRARIES)
def test_factor_solves_and_takes_new_values(library: str, block: int) -> None:
    pytest.importorskip({"mumps": "petsc4py", "superlu": "scipy"}[library])
    n = 40
    matrix = csr_array(diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(n, n)))
    matrix.sort_indices()
    factor = factorise(matrix, library, block=block)
    right = np.random.default_rng(0).standard_normal((n, 3))
    np.testing.assert_allclose(matrix @ factor.solve(right), right, atol=1e-12)
    factor.update(2.0 * matrix)
    np.testing.assert_allclose(2.0 * matrix @ factor.solve(right[:, 0]), right[:, 0], atol=1e-12)


@pytest.mark.parametrize("library", [*LIBRARIES])
def test_a_singular_matrix_is_the_data_s_fault(library: str) -> None:
    if library == "mumps":
        pytest.importorskip("petsc4py")
    whole = np.diag([1.0, 2.0, 3.0])
    factor = factorise(csr_array(whole), library)
    singular = csr_array(whole)
    singular.data[1] = 0.0
    with pytest.raises(InputError, match="determine every unknown, got a singular matrix"):
        factor.update(singular)


def test_libraries_agree() -> None:
    n = 30
    matrix = csr_array(diags_array([-1.0, 2.1, -1.0], offsets=[-1, 0, 1], shape=(n, n)))
    right = np.arange(float(n))
    np.testing.assert_allclose(
        factorise(matrix).solve(right), factorise(matrix, "superlu").solve(right), rtol=1e-10
    )


def test_continued_image_follows_a_smooth_pattern() -> None:
    at = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
    mask = is_material(at)
    smooth = (np.sin(4.0 * at[..., 0]) + np.cos(3.0 * at[..., 1])).astype(np.float32)
    found = continued(np.where(mask, smooth, 0.0).astype(np.float32), mask)
    np.testing.assert_array_equal(found[mask], smooth[mask])
    near = images_border(mask)
    # 0.04/px is the slope: a constant continuation would be off by that.
    assert abs(found - smooth)[near].max() < 0.004


def images_border(mask: np.ndarray) -> np.ndarray:
    """Pixels beside the mask."""
    beside = np.zeros_like(mask)
    beside[1:] |= mask[:-1]
    beside[:-1] |= mask[1:]
    return beside & ~mask


def test_continued_pixels_weigh_by_how_wrong_they_are() -> None:
    """Exact images leave them out; noise makes all pixels alike."""
    ratios = []
    for noise in (0.0, 0.002, 0.1):
        pair = plate_pair(quadratic_field, noise)
        assert pair.deformed_mask is not None
        found = continued_pixels(pair, noise**2, noise**2)
        np.testing.assert_array_equal(found.outside == 0.0, pair.deformed_mask)
        ratios.append(found.variance)
    assert ratios[0] > 100.0 * ratios[1] > 100.0 * ratios[2]
    assert ratios[2] < 1.0
    whole = ImagePair(pair.reference, pair.deformed, pair.grid)
    assert continued_pixels(whole, 0.0, 0.0) is NONE_CONTINUED


@pytest.mark.parametrize("edge_px", [0, 3])
def test_blocks_inside_the_material_need_no_look_at_single_pixels(edge_px: int) -> None:
    """Where none around a block is continued or not valid, sums are the same without asking."""
    pair = plate_pair(quadratic_field, 0.002)
    body = FiniteElementOptions().body(pair.masks[0], pair.grid)
    level = images_on(pair, FULL, edge_px, 5)
    pixels = body.pixels.on(level.grid, level.mask & body.mask, level.reference)
    found = continued_pixels(pair, 4e-6, 4e-6, level.valid)
    each = found._replace(summed=NONE_CONTINUED.summed)
    for off in (0.0, 5.3):  # px, by which pixels of edges leave the deformed image's material
        u = quadratic_field(body.mesh.nodes) + off * GRID.pixel_size
        a, b = (normal_equations(pixels, body.mesh, level, u, by) for by in (found, each))
        assert (a.outside > 0) == (off > 0.0)
        for name in ("blocks", "gradient", "squares", "counts", "weights"):
            one, other = getattr(a, name), getattr(b, name)
            np.testing.assert_allclose(one, other, atol=1e-10 * abs(other).max())


def test_residuals_alike_over_elements_inflate_the_variance(mesh: Mesh) -> None:
    """Noise doesn't, unless it is larger than is said."""
    random, m, k = np.random.default_rng(0), len(mesh.cells), 60
    xi = random.dirichlet((1.0, 1.0, 1.0), (m, k))[..., :2]
    N = shape_functions("T6", xi)
    h = random.standard_normal((m, 1, 2)) + 0.3 * random.standard_normal((m, k, 2))
    products = h[..., [0, 0, 1]] * h[..., [0, 1, 1]]
    blocks, body = np.einsum("mkc,mka,mkb->mcab", products, N, N), Body(mesh)

    def found(residual: NDArray[np.float64], noise: float = 1.0) -> float:
        """Variance that is counted, over that of noise."""
        pull = np.einsum("mka,mki,mk->mai", N, h, residual)
        M, free = noise**2 * blocks, np.full(m, 12.0)
        drawn, alone = (body.samples(M, part, free)[0] for part in (pull, 0.0 * pull))
        return float(np.sum(drawn**2) / np.sum(alone**2))

    white = random.standard_normal((m, k))
    assert found(white) == pytest.approx(1.1, abs=0.1)
    assert found(white, 0.5) == pytest.approx(found(2.0 * white), rel=1e-9)
    assert found(2.0 * white) == pytest.approx(4.0, abs=0.4)
    assert found(np.repeat(random.choice([-1.0, 1.0], (m, 1)), k, axis=1)) > 3.0
