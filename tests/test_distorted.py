"""Guards images through a lens: exact at phi_S^-1, whole, and undone by the correction."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.imaging.distortion.files import write_distortion
from modeharvest.imaging.distortion.lens import (
    CameraDistortion,
    PolynomialDistortion,
    ideal_points,
    undistorted,
    undistorted_mask,
    without_affine,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.render import ImagedState, render_observed, render_reference
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import Ink, Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

FLOAT32 = 1e-7  # rounding of an intensity up to 1
H = 0.125
GRID = PixelGrid.centred(151, 181, H)
SPECKLE = Speckle(SpeckleSpec(seed=4), GRID.shape)
LENS = CameraDistortion(220.0, 220.0, 84.0, 80.0, k1=-0.2, k2=0.05, p1=0.01, p2=-0.015)  # 8 px
BACKGROUND = 0.1


def plate(half_width: float = 9.0, half_height: float = 7.0, n: int = 6) -> Mesh:
    """A rectangle about the origin, cut into n x n Q9 elements."""
    number = np.arange((2 * n + 1) ** 2).reshape(2 * n + 1, 2 * n + 1)
    y, x = np.divmod(number.ravel(), 2 * n + 1)
    order = [(0, 0), (0, 2), (2, 2), (2, 0), (0, 1), (1, 2), (2, 1), (1, 0), (1, 1)]
    corners = [(j, i) for j in range(0, 2 * n, 2) for i in range(0, 2 * n, 2)]
    cells = np.array([[number[j + r, i + c] for r, c in order] for j, i in corners])
    return Mesh((np.stack([x, y], axis=1) / n - 1.0) * [half_width, half_height], cells, "Q9")


MESH = plate()


def state(u: FloatArray | None = None, mesh: Mesh = MESH) -> ImagedState:
    return ImagedState(mesh, u, GRID, SPECKLE, BACKGROUND)


def test_a_lens_without_distortion_changes_nothing() -> None:
    points = ideal_points(PolynomialDistortion(GRID.shape, np.zeros((2, 3))), GRID.shape)
    located = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    plain = render_reference(state(), located)
    shown = render_observed(state(), points)
    np.testing.assert_array_equal(shown.mask, plain.mask)
    np.testing.assert_allclose(shown.image, plain.image, rtol=0, atol=FLOAT32)


def test_affine_motion_through_a_lens_against_its_closed_inverse() -> None:
    """Pixel p shows the speckle at F^-1 (phi_S^-1(p) - shift), no pixel more and none less."""
    F, shift = np.array([[0.9, 0.08], [-0.05, 1.04]]), np.array([0.21, -0.13])
    u = MESH.nodes @ (F - np.eye(2)).T + shift
    points = ideal_points(LENS, GRID.shape)
    shown = render_observed(state(u), points)
    x = np.stack(GRID.to_mm(*points), axis=-1)
    X = (x - shift) @ np.linalg.inv(F).T
    inside = (np.abs(X) <= [9.0, 7.0]).all(axis=-1)
    np.testing.assert_array_equal(shown.mask, inside)
    exact = SPECKLE.exact(*GRID.to_px(*X[inside].T))
    np.testing.assert_allclose(shown.image[inside], exact, rtol=0, atol=FLOAT32)
    assert (shown.image[~inside] == np.float32(BACKGROUND)).all()
    # The pixels' ideal points are those that the lens shows there.
    row, col = LENS.observed(*points)
    np.testing.assert_allclose(row, np.arange(GRID.rows)[:, None] + 0.0 * col, atol=1e-9)
    np.testing.assert_allclose(col, np.arange(GRID.cols) + 0.0 * row, atol=1e-9)
    assert np.hypot(row - points[0], col - points[1]).max() > 5.0


def test_a_lens_may_show_what_lies_beside_the_ideal_image() -> None:
    """S = (-3, 5) px everywhere: an image shifted by whole pixels, from a larger one."""
    shift = PolynomialDistortion(GRID.shape, np.array([[-3.0], [5.0]]))
    shown = render_observed(state(), ideal_points(shift, GRID.shape))
    located = locate(MESH.nodes, MESH.cells, MESH.element, GRID)
    plain = render_reference(state(), located)
    np.testing.assert_array_equal(shown.mask[:-3, 5:], plain.mask[3:, :-5])
    np.testing.assert_allclose(shown.image[:-3, 5:], plain.image[3:, :-5], rtol=0, atol=2 * FLOAT32)


def test_material_beside_the_ideal_image_is_shown_too() -> None:
    wide = plate(half_width=12.0)  # its right edge lies at column 186 of 181
    col = 150.0 + np.arange(60.0)[None]
    points = np.full(col.shape, 75.0), col
    shown = render_observed(state(mesh=wide), points)
    np.testing.assert_array_equal(shown.mask, col <= 186.0)
    exact = SPECKLE.exact(*(s[shown.mask] for s in points))
    np.testing.assert_allclose(shown.image[shown.mask], exact, rtol=0, atol=FLOAT32)


def test_without_affine_takes_an_affine_part_away_and_nothing_else() -> None:
    free = without_affine(LENS, GRID.shape)
    row, col = np.mgrid[: GRID.rows, : GRID.cols].astype(np.float64)
    taken = np.stack(LENS.shift(row, col)) - np.stack(free.shift(row, col))
    planes = np.stack([np.ones(row.size), row.ravel(), col.ravel()], axis=1)
    fit, *_ = np.linalg.lstsq(planes, taken.reshape(2, -1).T, rcond=None)
    # This lens is a polynomial of degree 5, so the series is exact.
    np.testing.assert_allclose(planes @ fit, taken.reshape(2, -1).T, atol=1e-10)
    assert np.abs(fit[1:]).max() > 1e-3
    assert free.degree == 5
    assert np.abs(free.coefficients[:, :3]).max() == 0.0
    again = without_affine(free, GRID.shape)
    np.testing.assert_allclose(again.coefficients, free.coefficients, atol=1e-12)


def bent() -> Solution:
    x, y = MESH.nodes.T
    u = np.stack([-0.06 * x + 0.02 * y, 0.3 * np.cos(0.3 * x) + 0.02 * y], axis=1)
    return Solution(MESH, (Snapshot(0.1, u),), {})


SPEC = ImagingSpec(pixel_size=H, margin_px=20, background=BACKGROUND, bits=16)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> tuple[ImageSet, ImageSet]:
    """The same test through a perfect lens, and through one that distorts."""
    folder = tmp_path_factory.mktemp("sets")
    plain = make_images(bent(), SPEC, folder / "plain", [0.1])
    return plain, make_images(bent(), replace(SPEC, distortion=LENS), folder / "lens", [0.1])


def test_truth_stays_on_the_ideal_grid(sets: tuple[ImageSet, ImageSet]) -> None:
    plain, through = (s.truth(0.1) for s in sets)
    np.testing.assert_array_equal(plain.displacement, through.displacement)
    np.testing.assert_array_equal(plain.reference_point, through.reference_point)
    assert sets[0].grid == sets[1].grid
    assert np.abs(sets[0].deformed(0.1) - sets[1].deformed(0.1)).max() > 0.3


def test_correction_gives_the_images_of_a_perfect_lens(sets: tuple[ImageSet, ImageSet]) -> None:
    """Up to the quintic spline's error, which the jump at the plate's edge spoils 12 px wide."""
    plain, through = sets
    for name in ("reference", "deformed"):
        one, other = (
            s.reference() if name == "reference" else s.deformed(0.1) for s in (plain, through)
        )
        mask = through.mask() if name == "reference" else through.deformed_mask(0.1)
        clear = undistorted_mask(_eroded(mask, 12), LENS)
        assert clear.mean() > 0.3
        back = undistorted(other, LENS)
        np.testing.assert_allclose(back[clear], one[clear], rtol=0, atol=5e-5)


def _eroded(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    inside = mask.copy()
    for axis in (0, 1):
        for shift in range(-by, by + 1):
            inside &= np.roll(mask, shift, axis=axis)
    return inside


def test_sidecar_and_key_know_the_lens(sets: tuple[ImageSet, ImageSet], tmp_path: Path) -> None:
    through = sets[1]
    assert ImageSet.read(through.folder).spec == replace(SPEC, distortion=LENS)
    keys = {image_key(bent(), SPEC, [0.1]), through.info["key"]}
    file = tmp_path / "lens.json"
    spec = replace(SPEC, distortion=str(file))
    for lens in (LENS, replace(LENS, k1=-0.1)):
        write_distortion(file, lens)
        keys.add(image_key(bent(), spec, [0.1]))
        assert spec.lens(GRID.shape) == lens
    assert len(keys) == 4
    file.unlink()
    with pytest.raises(InputError, match=r"lens\.json"):
        image_key(bent(), spec, [0.1])


def test_two_layers_are_read_back(tmp_path: Path) -> None:
    painted = replace(SPEC, speckle=SpeckleSpec(ink=Ink(seed=3)))
    made = make_images(bent(), painted, tmp_path, [0.1])
    assert ImageSet.read(tmp_path).spec == painted
    content = json.loads((tmp_path / "images.json").read_text())
    del content["spec"]["speckle"]["ink"], content["spec"]["distortion"]  # as of an older version
    (tmp_path / "images.json").write_text(json.dumps(content))
    assert ImageSet.read(tmp_path).spec == SPEC
    assert made.reference().mean() < 0.9 * 0.6


@pytest.mark.parametrize(
    "changes", [{"distortion": LENS}, {"speckle": SpeckleSpec(ink=Ink())}], ids=["lens", "ink"]
)
def test_pixels_that_average_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(InputError, match="expected pixels that show points"):
        ImagingSpec(sensor=Sensor(fill_factor=0.5), **changes)  # type: ignore[arg-type]


def test_light_flickers_from_image_to_image_and_evenly_over_each(tmp_path: Path) -> None:
    spec = replace(SPEC, sensor=Sensor(flicker=0.05, flicker_seed=2))
    made = make_images(bent(), spec, tmp_path / "flickering", [0.1])
    steady = make_images(bent(), SPEC, tmp_path / "steady", [0.1])
    lights = [made.info["reference"]["light"], made.info["snapshots"][0]["light"]]
    assert lights[0] != lights[1]
    assert all(0.8 < light < 1.2 for light in lights)
    np.testing.assert_allclose(made.reference(), lights[0] * steady.reference(), rtol=1e-6)
    np.testing.assert_allclose(made.deformed(0.1), lights[1] * steady.deformed(0.1), rtol=1e-6)
    many = np.log([spec.sensor.illumination(f"image {k}") for k in range(400)])
    assert abs(many.std() / 0.05 - 1.0) < 4 / np.sqrt(2 * 400)
    assert abs(many.mean()) < 4 * 0.05 / np.sqrt(400)
    with pytest.raises(InputError, match="flicker"):
        Sensor(flicker=0.5)
