"""Guards what the images show: exact intensities of moved material, and a truth that agrees."""

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.render import ImagedState, Rendering, render_deformed, render_reference
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

BACKGROUND = 0.1
H = 0.125  # mm/px, a binary fraction
FLOAT32 = 1e-7  # rounding of an intensity up to 1


def square(n: int, edge: float) -> Mesh:
    """Cut a square of n x n cells and that edge, centred on the origin, into T6 triangles."""
    number = np.arange((2 * n + 1) ** 2).reshape(2 * n + 1, 2 * n + 1)
    y, x = np.divmod(number.ravel(), 2 * n + 1)
    cells = []
    for j in range(0, 2 * n, 2):
        for i in range(0, 2 * n, 2):
            a = number[j : j + 3, i : i + 3]
            cells.append([a[0, 0], a[0, 2], a[2, 2], a[0, 1], a[1, 2], a[1, 1]])
            cells.append([a[0, 0], a[2, 2], a[2, 0], a[1, 1], a[2, 1], a[1, 0]])
    return Mesh((np.column_stack([x, y]) / (2 * n) - 0.5) * edge, np.array(cells), "T6")


MESH = square(4, 5.0)
GRID = PixelGrid.centred(61, 61, H)  # pixel centres at whole multiples of H
SPECKLE = Speckle(SpeckleSpec(seed=9), GRID.shape)


def state(displacement: FloatArray | None) -> ImagedState:
    return ImagedState(MESH, displacement, GRID, SPECKLE, BACKGROUND, "deformed mesh")


def reference() -> Rendering:
    located = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    return render_reference(state(None), located)


def deformed(displacement: FloatArray) -> tuple[Rendering, Truth]:
    located = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    return render_deformed(state(displacement), located)


def test_reference_shows_speckle_on_material_and_background_elsewhere() -> None:
    rendering = reference()
    x, y = np.meshgrid(GRID.x, GRID.y)
    inside = (np.abs(x) <= 2.5) & (np.abs(y) <= 2.5)  # edges on pixel centres belong to it
    np.testing.assert_array_equal(rendering.mask, inside)
    assert rendering.image.dtype == np.float32
    np.testing.assert_allclose(rendering.image[inside], SPECKLE.image()[inside], atol=FLOAT32)
    assert (rendering.image[~inside] == np.float32(BACKGROUND)).all()


def test_no_displacement_changes_nothing() -> None:
    before, (after, truth) = reference(), deformed(np.zeros_like(MESH.nodes))
    np.testing.assert_array_equal(after.mask, before.mask)
    np.testing.assert_allclose(after.image, before.image, atol=2 * FLOAT32)
    assert np.abs(truth.displacement[before.mask]).max() == 0.0


def test_shift_by_whole_pixels_shifts_the_image_up_and_right() -> None:
    before, (after, _) = reference(), deformed(np.full_like(MESH.nodes, 1.0) * [3 * H, 2 * H])
    np.testing.assert_array_equal(after.mask[:-2, 3:], before.mask[2:, :-3])
    np.testing.assert_allclose(after.image[:-2, 3:], before.image[2:, :-3], atol=2 * FLOAT32)


def test_quarter_turn_counter_clockwise_turns_the_image_so() -> None:
    x, y = MESH.nodes.T
    before, (after, _) = reference(), deformed(np.column_stack([-y - x, x - y]))
    np.testing.assert_array_equal(after.mask, np.rot90(before.mask))
    np.testing.assert_allclose(after.image, np.rot90(before.image), atol=2 * FLOAT32)


def test_mirror_symmetric_displacement_of_a_symmetric_mesh_mirrors_the_mask() -> None:
    x, y = MESH.nodes.T
    u = np.column_stack([-0.05 * x * (1 + 0.05 * y), 0.1 * y])
    mask = deformed(u)[0].mask
    np.testing.assert_array_equal(mask, mask[:, ::-1])


def test_affine_motion_against_its_closed_inverse() -> None:
    F, shift = np.array([[0.9, 0.08], [-0.05, 1.07]]), np.array([0.21, -0.13])
    rendering, truth = deformed(MESH.nodes @ (F - np.eye(2)).T + shift)
    x = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
    X = (x - shift) @ np.linalg.inv(F).T
    mask = np.abs(X).max(axis=-1) <= 2.5
    np.testing.assert_array_equal(rendering.mask, mask)
    np.testing.assert_allclose(truth.reference_point[mask], X[mask], atol=1e-13)
    exact = SPECKLE(*GRID.to_px(*X[mask].T))
    np.testing.assert_allclose(rendering.image[mask], exact, atol=FLOAT32)
    u = x @ (F - np.eye(2)).T + shift
    at_reference = reference().mask
    np.testing.assert_allclose(truth.displacement[at_reference], u[at_reference], atol=1e-13)


def wavy(X: FloatArray) -> FloatArray:
    return 0.2 * np.column_stack([np.sin(X[:, 1]) - 0.3 * X[:, 0], np.cos(1.3 * X[:, 0])])


def test_truth_agrees_with_itself_on_a_nonlinear_motion() -> None:
    """X + u = x in the deformed frame, NaN and -1 exactly outside, units as promised."""
    rendering, truth = deformed(wavy(MESH.nodes))
    mask = rendering.mask
    x = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
    closure = truth.reference_point + truth.deformed_displacement - x
    assert np.abs(closure[mask]).max() < 1e-7  # u in the deformed frame is float32
    assert truth.residual_px[mask].max() <= 1e-10
    for field in (truth.reference_point, truth.deformed_displacement, truth.residual_px[..., None]):
        for component in np.moveaxis(field, -1, 0):
            np.testing.assert_array_equal(np.isnan(component), ~mask)
    np.testing.assert_array_equal(truth.element < 0, ~mask)
    np.testing.assert_array_equal(np.isnan(truth.displacement[..., 0]), ~reference().mask)


def test_truth_in_both_frames_is_one_motion() -> None:
    """What a reference pixel shows is found again at X + u(X), at the same xi."""
    u = wavy(MESH.nodes)
    _, truth = deformed(u)
    reference_pixels = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    rows, cols = np.nonzero(reference_pixels.mask)
    for k in np.random.default_rng(0).choice(rows.size, 25, replace=False):
        row, col = rows[k], cols[k]
        dx, dy = truth.displacement[row, col]
        there = PixelGrid(1, 1, H, GRID.x[col] + dx, GRID.y[row] + dy)
        found = locate(MESH.nodes + u, MESH.cells, MESH.element, there)
        assert found.element.item() == reference_pixels.element[row, col]
        np.testing.assert_allclose(found.xi[0, 0], reference_pixels.xi[row, col], atol=1e-12)


def test_folding_displacement_is_refused_by_name() -> None:
    located = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    with pytest.raises(InputError, match="deformed mesh: expected T6 elements with positive"):
        render_deformed(state(-1.5 * MESH.nodes * [1, 0]), located)
