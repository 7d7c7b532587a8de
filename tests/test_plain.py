"""Specimens without speckle: their contours, and the displacement that these alone determine."""

from __future__ import annotations

from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contours import dots, painted
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import brentq
from scipy.spatial import KDTree
from summary_schemas import faults

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import stress_and_tangent
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.contours.measure import (
    ELASTOMER,
    STEPS_PX3,
    displacement_from_contours,
)
from modeharvest.idic.finite_element.contours.penalised_body import PenalisedBody, straight_sides
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import read_result
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.photograph.plain.matching import matched_contours
from modeharvest.idic.photograph.plain.measure import displacement_of_plain
from modeharvest.idic.photograph.plain.surface import away_from_cuts, coat_of_paint, plain_surface
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.contour import Contour, Contours, HoleShape, SeenContours
from modeharvest.imaging.photographs.files import read_image, read_mask, write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.report.figures import style
from modeharvest.runs.measure import measure
from modeharvest.runs.photographs.pipeline import harvest
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.validation.whole_field import v_percent, waves_percent

pytestmark = pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")

SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
PIXEL = 0.05
PLAIN = ImagingSpec(
    pixel_size=PIXEL,
    margin_px=12,
    background=0.15,
    speckle=SpeckleSpec(dark=0.7, bright=0.7),
    sensor=Sensor(fill_factor=1.0, psf_px=0.6, read_noise=0.01),
)
FINE = 8


def disks(
    shape: tuple[int, int], frame: float, centres: FloatArray, axes: FloatArray, angle: float
) -> FloatImage:
    """A grey plate with elliptical holes on black, as pixels average it."""
    rows, cols = (np.arange(FINE * n) / FINE - 0.5 + 0.5 / FINE for n in shape)
    y, x = rows[:, None], cols[None]
    plate = (np.abs(y - (shape[0] - 1) / 2) < shape[0] / 2 - frame) & (
        np.abs(x - (shape[1] - 1) / 2) < shape[1] / 2 - frame
    )
    c, s = np.cos(angle), np.sin(angle)
    for row, col in centres:
        right, up = x - col, row - y
        along, across = c * right + s * up, c * up - s * right
        plate &= (along / axes[0]) ** 2 + (across / axes[1]) ** 2 > 1.0
    fine = plate.reshape(shape[0], FINE, shape[1], FINE).mean(axis=(1, 3))
    return np.asarray(0.1 + 0.6 * fine, dtype=np.float32)


CENTRES = np.array([[40.3, 40.2], [40.3, 90.9], [90.6, 41.1], [91.2, 91.4]])


@settings(max_examples=6, deadline=None)
@given(a=st.floats(8.0, 18.0), ratio=st.floats(0.6, 0.95), angle=st.floats(-1.5, 1.5))
def test_holes_are_found_to_a_hundredth_of_a_pixel(a: float, ratio: float, angle: float) -> None:
    image = disks((132, 132), 15.25, CENTRES, np.array([a, ratio * a]), angle)
    grid = PixelGrid.centred(132, 132, 1.0)
    seen = plain_surface(image)
    assert seen is not None
    assert len(seen.contours) == 5
    same = matched_contours(seen, seen, grid)
    found = [HoleShape.of(hole) for hole, _ in same.holes]
    found.sort(key=lambda h: (-round(h.y, -1), h.x))
    x, y = grid.to_mm(*CENTRES.T)
    assert np.allclose([h.x for h in found], x, atol=0.02)
    assert np.allclose([h.y for h in found], y, atol=0.02)
    # A blur of variance s^2 takes pi s^2 from a hole's area, 1.8 px^2 here: half is put back at
    # least.
    assert np.allclose([h.area for h in found], np.pi * ratio * a**2, atol=0.9)
    assert np.allclose([h.ellipticity for h in found], 1.0 - ratio, atol=0.01)
    off = np.array([h.orientation_deg for h in found]) - np.degrees(angle)
    assert np.abs((off + 90.0) % 180.0 - 90.0).max() < 1.5


def test_contours_do_not_depend_on_which_is_bright_nor_on_the_light() -> None:
    image = disks((132, 132), 15.25, CENTRES, np.array([15.0, 11.0]), 0.3)
    light = np.linspace(0.9, 1.1, 132, dtype=np.float32)
    plain, dark, lit = (plain_surface(one) for one in (image, 0.9 - image, light * image))
    assert plain
    assert dark
    assert lit
    assert np.array_equal(plain.mask, dark.mask)
    every = [Contours((Contour(points),)) for points in lit.contours]
    for points in plain.contours:
        alike = np.zeros(len(points), dtype=np.int64)
        off = min(np.abs(contour.distance(points, alike)[0]).max() for contour in every)
        assert off < 0.05


def test_distance_from_a_circle_and_its_gradient() -> None:
    t = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    circle = Contour(np.stack([3.0 * np.cos(t), 3.0 * np.sin(t)], axis=1))
    x = np.random.default_rng(0).uniform(-5.0, 5.0, (100, 2))
    x = x[np.abs(np.linalg.norm(x, axis=1) - 3.0) < 1.5]
    whole, number = Contours((circle,)), np.zeros(len(x), dtype=np.int64)
    d, normal, _ = whole.distance(x, number)
    assert np.allclose(d, np.linalg.norm(x, axis=1) - 3.0, atol=1e-6)
    step = 1e-5 * np.eye(2)
    ahead, behind = ([whole.distance(x + k * s, number)[0] for s in step] for k in (1.0, -1.0))
    slope = (np.array(ahead) - behind) / 2e-5
    assert np.allclose(slope.T, normal, atol=1e-5)


def test_a_curve_that_is_cut_has_no_distance_beyond_its_ends() -> None:
    t = np.linspace(0.0, np.pi, 100)
    half = Contour(np.stack([3.0 * np.cos(t), 3.0 * np.sin(t)], axis=1), closed=False)
    x = np.array([[0.5, 2.0], [-2.0, 2.9], [2.0, -1.5], [-3.2, -0.5]])
    d, _, beyond = Contours((half,)).distance(x, np.zeros(4, dtype=np.int64))
    assert np.allclose(d[:2], np.linalg.norm(x[:2], axis=1) - 3.0, atol=1e-6)
    assert beyond.tolist() == [False, False, True, True]
    points, step = half.evenly(0.5)
    assert np.allclose(points[[0, -1]], [[3.0, 0.0], [-3.0, 0.0]])
    assert np.allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), step, rtol=1e-2)


def test_moments_of_an_ellipse() -> None:
    t = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    area, centre, second = Contour(
        np.stack([1.0 + 3.0 * np.cos(t), 2.0 + np.sin(t)], axis=1)
    ).moments
    assert area == pytest.approx(3.0 * np.pi, rel=1e-5)
    assert np.allclose(centre, [1.0, 2.0])
    assert np.allclose(second, np.diag([9.0, 1.0]) / 4.0, rtol=1e-5)


def plate(half: FloatArray, centre: FloatArray) -> FloatImage:
    """A plate in 140 x 200 px, as pixels average it; (x, y) half its size and its centre [px]."""
    covered = []
    for n, h, c in zip((200, 140), half, centre, strict=True):
        edges = np.arange(n + 1) - n / 2
        covered.append(np.diff(np.clip(edges - c, -h, h)))
    return np.asarray(0.1 + 0.6 * covered[1][::-1, None] * covered[0], dtype=np.float32)


def test_a_bar_that_is_pressed_between_frictionless_plates_shortens_evenly() -> None:
    # A homogeneous deformation whose sides are free of traction by the assumed law.
    def traction(across: float) -> float:
        return float(stress_and_tangent(ELASTOMER, np.diag([0.9, across])[None])[0][0, 1, 1])

    half, stretches = np.array([80.3, 50.4]), np.array([0.9, brentq(traction, 0.8, 1.3)])
    shift, grid = np.array([3.2, -1.7]), PixelGrid.centred(140, 200, 0.1)
    images = plate(half, np.zeros(2)), plate(half * stretches, shift)
    seen = [plain_surface(image) for image in images]
    assert seen[0]
    assert seen[1]
    contours = matched_contours(seen[0], seen[1], grid).seen
    body = FiniteElementOptions().body(seen[0].mask, grid)
    start = np.zeros((len(body.mesh.nodes), 2))
    assert len(straight_sides(body.mesh)) == 4
    u = body.mesh.nodes * (stretches - 1.0) + 0.1 * shift
    free = displacement_from_contours(contours, body, grid, start, slides=True)
    off = np.abs(free.displacement - u) / grid.pixel_size
    # The springs give way by the traction over their stiffness, a few hundredths of a pixel.
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert off.max() < 0.3
    stuck = displacement_from_contours(contours, body, grid, start)
    x = np.abs(body.mesh.nodes[:, 0])
    at_plates = x > x.max() - 0.01
    assert np.ptp(stuck.displacement[at_plates, 1]) < 0.02 * grid.pixel_size
    # Which of the two it is can't be seen, and is part of the standard deviation.
    within = np.abs(stuck.displacement - u) < 3.0 * stuck.standard_deviation + 1e-3
    assert within.mean() > 0.95


def test_edges_beside_the_border_of_the_picture_are_contours_all_the_same() -> None:
    half, images = np.array([80.3, 50.4]), []
    for size in (half, half * [0.98, 1.016]):  # about what free sides do
        whole = plate(size, np.zeros(2))
        images.append((whole, whole[16:-16, 16:-16]))  # 3.6 px are left beside it
    found = []
    for f, g in zip(*images, strict=True):
        grid, seen = PixelGrid.centred(*f.shape, 0.1), [plain_surface(f), plain_surface(g)]
        assert seen[0]
        assert seen[1]
        body = FiniteElementOptions().body(seen[0].mask, grid)
        contours = matched_contours(seen[0], seen[1], grid)
        start = contours.start(body.mesh.nodes)
        result = displacement_from_contours(contours.seen, body, grid, start)
        assert result.outside == 0
        found.append(result.at(np.array([[7.8, 0.0], [-7.8, 0.0], [3.0, 4.8]])))
    np.testing.assert_allclose(found[0], found[1], atol=0.01)


def test_a_start_inside_out_ends_in_one_line(photographed: Path) -> None:
    g, grid, surface, body, anew, _ = measured_part(photographed, "middle")
    other = plain_surface(g)
    assert other
    seen, start = matched_contours(surface, other, grid).seen, body.mesh.nodes * [-2.0, 0.0]
    with pytest.raises(InputError, match="contours that hold the body"):
        displacement_from_contours(seen, body, grid, start)
    # A picture before that went astray doesn't lead the next one astray.
    x, y = body.mesh.nodes.T
    folded = np.column_stack([3.0 * np.sin(4.0 * y), 3.0 * np.sin(4.0 * x)])
    found, _ = displacement_of_plain(surface, g, grid, body, before=folded)
    assert not found.warnings
    assert np.abs(found.displacement - anew.displacement).max() < 0.02 * grid.pixel_size


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plain")
    make_images(Solution.read(SHIPPED), PLAIN, folder, (0.128,))
    return folder


@pytest.fixture(scope="module")
def measured(
    photographed: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    """What ``measure`` returns for the whole specimen, and its output folder."""
    out = tmp_path_factory.mktemp("measured")
    names = [photographed / f"{name}_8bit.tif" for name in ("reference", "deformed_1280")]
    with pytest.MonkeyPatch.context() as patch:  # no test here is about pictures
        patch.setattr(style, "to_svg", lambda *_, **__: "<svg></svg>")
        return measure(names[0], names[1:], out, pixel_size=PIXEL), out


def test_a_buckled_specimen_without_speckle(
    photographed: Path, measured: tuple[dict[str, Any], Path]
) -> None:
    (pair,) = make_images(Solution.read(SHIPPED), PLAIN, photographed, (0.128,))
    px, u = pair.grid.pixel_size, pair.truth.displacement
    f, g = (
        read_image(photographed / f"{name}_8bit.tif") for name in ("reference", "deformed_1280")
    )
    surface = plain_surface(f)
    assert surface is not None
    result = read_result(measured[1] / "results/deformed_1280_8bit.h5")
    found = result.displacement_on()
    there = np.isfinite(u[..., 0]) & surface.mask & np.isfinite(found[..., 0])
    off = (found - u)[there] / px
    # The assumed law is another one than the specimen's.
    assert np.sqrt(np.mean(off**2)) < 0.06
    sd = result.standard_deviation_on()[there] / px
    assert 0.9 < np.mean(np.abs(off) < 1.96 * sd) <= 1.0
    assert result.shown == "contours"
    # It doesn't matter where the iteration begins: from a picture before, turned a little.
    turned = result.displacement + 0.03 * result.mesh.nodes[:, ::-1] * [-1.0, 1.0]
    body = Body(result.mesh)
    again, matched = displacement_of_plain(surface, g, pair.grid, body, before=turned)
    assert matched.lost == 0
    assert len(matched.holes) == 60
    assert np.abs(again.displacement - result.displacement).max() < 0.02 * px
    # Holes are flattened along x and y in turn, as the pattern has it.
    flat = [abs(HoleShape.of(hole).orientation_deg) for _, hole in matched.holes]
    assert 25 <= np.sum(np.array(flat) < 30.0) <= 35


def test_a_thresholded_disk_is_as_uncertain_as_is_assumed() -> None:
    # The area of pixels whose centres are in a disk, over its circumference: how far its edge is
    # off on average, whose variance falls with the circumference.
    rng, y, x = np.random.default_rng(0), *np.mgrid[-40:41, -40:41]
    for radius in (12.3, 30.7):
        r = radius + rng.random(1000)
        seen = [
            np.sum(np.hypot(x - a, y - b) < c)
            for c, (a, b) in zip(r, rng.random((1000, 2)), strict=True)
        ]
        noise = np.mean((np.array(seen) - np.pi * r**2) ** 2 / (2.0 * np.pi * r))
        assert noise == pytest.approx(0.5 * STEPS_PX3, rel=0.15)


def test_thresholded_pictures_are_measured_with_wider_intervals(photographed: Path) -> None:
    (pair,) = make_images(Solution.read(SHIPPED), PLAIN, photographed, (0.128,))
    names = "reference", "deformed_1280"
    grey = [read_image(photographed / f"{name}_8bit.tif") for name in names]
    f, g = (np.where(image > 0.43, 200, 20).astype(np.float32) for image in grey)
    surface = plain_surface(f)
    assert surface is not None
    body = FiniteElementOptions().body(surface.mask, pair.grid)
    result, matched = displacement_of_plain(surface, g, pair.grid, body)
    assert len(matched.holes) == 60
    (text,) = result.warnings
    assert text.startswith("Contours are met within 0.")
    assert "thresholded pictures" in text
    found = result.displacement_on()
    off = np.abs(found - pair.truth.displacement)
    there = surface.mask & np.isfinite(off).all(axis=-1)
    off = off[there]
    assert np.sqrt(np.mean(off**2)) < 0.4 * pair.grid.pixel_size
    assert 0.85 < np.mean(off < 1.96 * result.standard_deviation_on()[there]) <= 1.0


def test_a_plate_that_fills_the_picture_is_not_taken_for_its_holes() -> None:
    centres = np.stack(np.meshgrid([25.3, 60.1, 95.4], [24.8, 60.4, 95.2]), axis=-1).reshape(-1, 2)
    image = disks((120, 120), -4.0, centres, np.array([13.0, 10.0]), 0.3)
    for picture in (image, 0.8 - image):
        surface = plain_surface(picture)
        assert surface is not None
        assert surface.is_part
        assert len(surface.contours) == len(centres)
        assert surface.mask[[0, -1]].all()
    few = plain_surface(disks((120, 120), -4.0, centres[:2], np.array([13.0, 10.0]), 0.3))
    assert few is not None  # few islands are specimens
    assert not few.mask[0].any()


def cropped(photographed: Path, part: str) -> tuple[FloatImage, FloatImage, FloatArray]:
    """Reference, deformed picture and true displacement (rows, cols, 2) [mm] of a part."""
    (pair,) = make_images(Solution.read(SHIPPED), PLAIN, photographed, (0.128,))
    rows, cols = pair.grid.shape
    across = slice(0, int(0.6 * cols)) if part == "plate" else slice(cols // 5, cols - cols // 5)
    along = slice(0, rows) if part == "plate" else slice(rows // 5, rows - rows // 5)
    f, g = (
        read_image(photographed / f"{name}_8bit.tif")[along, across]
        for name in ("reference", "deformed_1280")
    )
    return f, g, pair.truth.displacement[along, across]


@cache
def measured_part(folder: Path, part: str) -> tuple[Any, ...]:
    """The deformed picture, its grid, the surface, the mesh, its displacement, matched contours."""
    f, g, _ = cropped(folder, part)
    grid, surface = PixelGrid.centred(*f.shape, PLAIN.pixel_size), plain_surface(f)
    assert surface is not None
    body = FiniteElementOptions().body(surface.mask, grid)
    return g, grid, surface, body, *displacement_of_plain(surface, g, grid, body)


@pytest.mark.parametrize("part", ["plate", "middle"])
def test_a_part_of_a_specimen_is_measured_away_from_where_it_is_cut(
    photographed: Path, part: str
) -> None:
    u, px = cropped(photographed, part)[2], PLAIN.pixel_size
    _, _, surface, _, result, matched = measured_part(photographed, part)
    assert matched.lost == 0
    assert any(text.startswith("Not all of the specimen is in view") for text in surface.warnings)
    found, sd = result.displacement_on(), result.standard_deviation_on()
    there = np.isfinite(u[..., 0]) & np.isfinite(found[..., 0])
    cell = round(1.9 / px)
    assert not there[:, -cell // 2 :].any()
    assert there[surface.mask].mean() > (0.7 if part == "plate" else 0.3)
    off = np.abs(found - u)[there]
    assert np.sqrt(np.mean(off**2)) < 0.1 * px
    assert np.mean(off < 1.96 * sd[there]) > 0.9


def test_measure_finds_by_itself_that_there_is_no_speckle(
    measured: tuple[dict[str, Any], Path],
) -> None:
    summary, out = measured
    (image,) = summary["images"]
    assert summary["mask"] == "found by its grey level"
    assert image["shown"] == "contours"
    assert image["coverage"] > 0.99
    holes = (out / "results/deformed_1280_8bit_holes.csv").read_text().splitlines()
    assert len(holes) == 61
    assert holes[0].startswith("reference x [mm],reference y up [mm],")
    assert read_json(out / "summary.json")["images"] == [image]
    assert "held to the contours" in (out / "report.html").read_text()


def test_dots_belong_to_the_material_and_are_followed(photographed: Path, tmp_path: Path) -> None:
    (pair,) = make_images(Solution.read(SHIPPED), PLAIN, photographed, (0.128,))
    names = ["reference", "deformed_1280"]
    pictures = [read_image(photographed / f"{name}_8bit.tif") for name in names]
    grey = float(pictures[0][:3].mean())
    for name, picture, edges in zip(names, pictures, dots(pair, 11.0 * PIXEL), strict=True):
        shown = painted(picture, edges, grey)
        write_image(tmp_path / f"{name}.tif", np.rint(255.0 * shown).astype(np.uint8))
    found = measure(tmp_path / "reference.tif", [tmp_path / "deformed_1280.tif"], tmp_path / "out",
                    pixel_size=PIXEL)  # fmt: skip
    assert any(text.startswith("45 dots are on the material") for text in found["warnings"])
    results = tmp_path / "out/results"
    assert len((results / "deformed_1280_holes.csv").read_text().splitlines()) == 1 + 60
    x, y, _, _, _, x_g, y_g, *_ = np.loadtxt(
        results / "deformed_1280_dots.csv", delimiter=",", skiprows=1, unpack=True
    )
    assert len(x) == 45
    # The area around a dot and the finite elements say the same.
    u, px = np.nan_to_num(pair.truth.displacement), PLAIN.pixel_size
    at = np.stack(pair.grid.to_px(x, y))
    true = [map_coordinates(u[..., k], at, order=1) for k in (0, 1)]
    assert np.sqrt(np.mean((true - np.stack([x_g - x, y_g - y])) ** 2)) < 0.03 * px
    measured = read_result(results / "deformed_1280.h5").displacement_on()
    there = np.isfinite(pair.truth.displacement[..., 0]) & np.isfinite(measured[..., 0])
    off = (measured - pair.truth.displacement)[there] / px
    assert np.sqrt(np.mean(off**2)) < 0.06


def test_a_dot_holds_what_is_around_it() -> None:
    """Springs of contours of half its circumference, in both directions, and no edge of its own."""
    rows, cols, t = 90, 100, np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    around = np.stack([np.cos(t), np.sin(t)], axis=1)
    corners = np.array([[-20.0, -15.0], [20.0, -15.0], [20.0, 15.0], [-20.0, 15.0]])
    along = np.linspace(0.0, 1.0, 40, endpoint=False)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    edge = Contour(np.vstack([a + (b - a) * along for a, b in sides]))
    grid = PixelGrid.centred(rows, cols, 1.0)
    x, y = np.meshgrid(grid.x, grid.y)
    body = FiniteElementOptions(8.0, 8.0).body((np.abs(x) < 20.0) & (np.abs(y) < 15.0), grid)
    moved = []
    for shift in (0.0, 0.5):
        pair = Contour(3.0 * around), Contour(3.0 * around + [shift, 0.0])
        seen = SeenContours((edge,), (edge,), 1e-4, 1.0, (pair,))
        found = displacement_from_contours(seen, body, grid, 0.0 * body.mesh.nodes)
        moved.append(found.at(np.array([[0.0, 0.0], [15.0, 10.0]])))
    assert np.abs(moved[0]).max() < 0.05
    pulled = moved[1] - moved[0]
    assert 0.3 < pulled[0, 0] < 0.5  # softer than the dot is known
    assert np.abs(pulled[1]).max() < 0.2 * pulled[0, 0]


def test_holes_that_are_not_found_again_leave_a_warning() -> None:
    holes = CENTRES, np.array([15.0, 11.0]), 0.3
    surface = plain_surface(disks((132, 132), 15.25, *holes))
    fewer = disks((132, 132), 15.25, CENTRES[:3], *holes[1:])
    assert surface is not None
    grid = PixelGrid.centred(132, 132, 1.0)
    body = FiniteElementOptions().body(surface.mask, grid)
    result, matched = displacement_of_plain(surface, fewer, grid, body)
    assert matched.lost == 1
    assert any("1 holes weren't found again" in warning for warning in result.warnings)


@pytest.fixture
def experiment(photographed: Path, tmp_path: Path) -> Path:
    """Of a photograph without speckle, and one with."""
    names = [photographed / f"{name}_8bit.tif" for name in ("reference", "deformed_1280")]
    plain = read_image(names[0])
    speckle = gaussian_filter(np.random.default_rng(0).standard_normal(plain.shape), 2.0)
    painted = plain + 300.0 * speckle * (plain > 0.5 * plain.max())
    write_image(tmp_path / "painted.tif", np.clip(painted, 0, 255).astype(np.uint8))
    path = tmp_path / "test.toml"
    path.write_text(
        f'[images]\nreference = "{names[0]}"\ndeformed = ["{names[1]}", "painted.tif"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = 1.9\n"
    )
    return path


@pytest.mark.usefixtures("undrawn_pictures")
def test_contours_that_do_not_settle_are_no_converged_result(
    experiment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle = PenalisedBody.settle
    monkeypatch.setattr(PenalisedBody, "settle", lambda *how: settle(*how) and False)
    (frame,) = harvest(experiment, tmp_path / "out")["frames"]
    assert "didn't converge" in frame["warnings"][0]
    assert frame["outcome"] == "max_iterations"


def test_harvest_finds_modes_by_contours(
    photographed: Path, experiment: Path, tmp_path: Path
) -> None:
    summary = harvest(experiment, tmp_path / "out")
    (frame,), (skipped,) = summary["frames"], summary["skipped"]
    assert skipped["name"] == "painted.tif"
    assert skipped["reason"].startswith("expected a specimen without speckle in ")
    assert frame["shown"] == "contours"
    assert frame["has_pattern"]
    assert frame["outcome"] == "converged"
    assert frame["residual_rms"] is None
    assert frame["whole_field"]["cutoff_px"] is None
    assert frame["whole_field"]["residual_rms"] < 0.05  # px
    (mode,) = frame["modes"]
    for wave in mode["waves"]:  # of infinitely many cells (1/2, 1/2)
        assert np.allclose(np.abs(wave["xi"]), 0.5, rtol=0.005)
    specimen = Solution.read(SHIPPED).specimen
    assert specimen
    (pair,) = make_images(Solution.read(SHIPPED), PLAIN, photographed, (0.128,))
    result = Result.read(tmp_path / "out/results/deformed_1280_8bit.json")
    u, mask = pair.truth.displacement, read_mask(tmp_path / "out/prepared/reference_mask.tif")
    inside = mask & np.isfinite(u[..., 0])
    best = fit_displacement(u, pair.grid, result.ansatz, result.unknowns, inside)
    v, best_v = (fit.v(0)[mask] for fit in (result, best))
    assert np.abs(v - best_v).max() < 0.02 * np.abs(best_v).max()
    assert len((tmp_path / "out/results/deformed_1280_8bit_holes.csv").read_text().split()) > 60
    # Noise is the least of what this is uncertain by.
    errors = frame["errors_px"]
    assert 0.0 < errors["noise"]["fluctuation"] < errors["model_error"]["fluctuation"] < 0.1
    assert harvest(experiment, tmp_path / "out")["frames"] == [frame]  # as read from its files


def test_modes_of_a_part_in_view(photographed: Path, tmp_path: Path) -> None:
    """Fitted away from where it is cut, as the truth is there."""
    *images, u = cropped(photographed, "middle")
    for name, image in zip("fg", images, strict=True):
        write_image(tmp_path / f"{name}.tif", np.rint(255 * image).astype(np.uint8))
    path = tmp_path / "part.toml"
    path.write_text(
        '[images]\nreference = "f.tif"\ndeformed = ["g.tif"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = 1.9\n"
    )
    summary = harvest(path, tmp_path / "out")
    assert faults(summary, "harvest") == []
    assert any("Not all of the specimen is in view" in text for text in summary["warnings"])
    assert summary["frames"][0]["has_pattern"]  # as large over w as where the ansatz is fitted
    result = Result.read(tmp_path / "out/results/g.json")
    found = read_result(tmp_path / "out/whole_field/g.h5").displacement_on()
    mask = read_mask(tmp_path / "out/prepared/reference_mask.tif")
    inside = away_from_cuts(mask, result.grid, 1.9)
    assert np.isfinite(found[inside]).all(axis=1).mean() > 0.99
    inside &= np.isfinite(u[..., 0])
    best = fit_displacement(u, result.grid, result.ansatz, result.unknowns, inside)
    assert v_percent(result, best) < 2.0
    assert waves_percent(result, best) < 0.5


def test_a_local_dic_of_a_specimen_without_speckle_is_refused(
    experiment: Path, tmp_path: Path
) -> None:
    np.savetxt(tmp_path / "u.csv", np.zeros((4, 4)), delimiter=",", header="x,y,u,v", comments="")
    text = experiment.read_text().replace(', "painted.tif"', "")
    experiment.write_text(text + '[local]\ncode = "file"\nfiles = ["u.csv"]\n')
    with pytest.raises(InputError, match="measured by its contours; leave"):
        harvest(experiment, tmp_path / "out")


def test_pictures_that_are_not_plain_or_not_whole() -> None:
    image = disks((132, 132), 15.25, CENTRES, np.array([15.0, 11.0]), 0.3)
    rng = np.random.default_rng(0)
    assert plain_surface(rng.random((100, 100), dtype=np.float32)) is None
    assert plain_surface(np.full((100, 100), 0.3, dtype=np.float32)) is None
    faint = gaussian_filter(rng.standard_normal(image.shape), 2.0).astype(np.float32)
    assert plain_surface(image + np.float32(0.01) * rng.standard_normal(image.shape)) is not None
    assert plain_surface(image + np.float32(0.3) * faint * (image > 0.4)) is None
    part, grid = plain_surface(image[:, :100]), PixelGrid.centred(132, 100, 1.0)
    assert part is not None
    assert len(part.contours) == 2  # holes that are all in view
    assert len(part.cut) == 3
    with pytest.raises(InputError, match=r"2 holes in .* of which not all is in view, found 0"):
        matched_contours(part, part, grid)
    surface = plain_surface(image)
    assert surface is not None
    grid = PixelGrid.centred(*image.shape, 1.0)
    body = FiniteElementOptions().body(surface.mask, grid)
    with pytest.raises(
        InputError, match="expected two grey levels in the picture, like the reference's"
    ):
        displacement_of_plain(surface, rng.random(image.shape, dtype=np.float32), grid, body)
    fewer = disks((132, 132), 15.25, CENTRES[:1], np.array([15.0, 11.0]), 0.3)
    with pytest.raises(InputError, match="the reference's 4 holes in the deformed picture, found"):
        displacement_of_plain(surface, fewer, grid, body)


def test_of_two_specimens_one_is_followed_and_the_other_one_named() -> None:
    holes = np.array([15.0, 11.0]), 0.3
    one = disks((132, 132), 15.25, CENTRES, *holes)
    other = disks((132, 120), 15.25, CENTRES[[0, 2]], *holes)
    reference = plain_surface(np.hstack([other, one]))
    assert reference is not None
    assert not reference.mask[:, :120].any()
    (text,) = reference.warnings
    assert text.startswith("There are 2 specimens in the picture; the one of ")
    assert text.endswith("crop the pictures to measure another one.")
    grown = disks((132, 120), 8.25, CENTRES[[0, 2]], np.array([3.0, 3.0]), 0.0)  # the larger now
    both = np.hstack([grown, one])
    assert plain_surface(both).mask[:, :120].any()
    np.testing.assert_array_equal(plain_surface(both, like=reference.mask).mask, reference.mask)
    cut = np.hstack([other[:, 30:], one])  # the other one is not all in view
    np.testing.assert_array_equal(plain_surface(cut).mask[:, -132:], reference.mask[:, -132:])


def dots_of_paint(shift: tuple[float, float]) -> FloatImage:
    """A light plate on black, with dark dots of 9 px at random; moved by (rows, cols) [px]."""
    inner = np.random.default_rng(3).uniform(0.0, (200.0, 260.0), (130, 2))
    row, col = (np.indices((600, 780)) + 0.5) / 3.0 - 0.5 - np.reshape(shift, (2, 1, 1))
    dark = KDTree(inner).query(np.stack([row, col], axis=-1), workers=1)[0] < 4.5
    plate = (abs(row - 99.5) < 79.0) & (abs(col - 129.5) < 109.0)
    levels = np.where(plate, np.where(dark, 45.0, 205.0), 20.0).reshape(200, 3, 260, 3)
    noise = np.random.default_rng(round(10 * shift[0])).normal(scale=2.0, size=(200, 260))
    return np.asarray(np.rint(levels.mean(axis=(1, 3)) + noise), dtype=np.float32)


def test_dots_of_paint_are_speckle_and_not_holes(tmp_path: Path) -> None:
    """They were refused, as holes of which some weren't found in the deformed picture."""
    images, shift = (dots_of_paint((0.0, 0.0)), dots_of_paint((1.3, -2.6))), (-2.6, -1.3)
    for name, image in zip(("f", "g"), images, strict=True):
        write_image(tmp_path / f"{name}.tif", np.clip(image, 0, 255).astype(np.uint8))
    measure(tmp_path / "f.tif", [str(tmp_path / "g.tif")], tmp_path / "out")
    found = read_result(tmp_path / "out/results/g.h5")
    assert found.shown == "speckle"
    off = np.linalg.norm(found.displacement - shift, axis=1)
    assert np.median(off) < 0.03
    assert np.sqrt(np.mean(off**2)) < 0.1


def test_holes_of_a_lattice_are_not_dots_of_paint() -> None:
    """Close to each other, also buckled: in turn upright and lying."""
    image = np.full((290, 290), 0.7, dtype=np.float32)
    row, col = np.indices(image.shape)
    for k, place in enumerate(product(range(40, 260, 30), repeat=2)):
        high = 12.0 if k % 2 else 7.0
        near = ((row - place[0]) / high) ** 2 + ((col - place[1]) / (19.0 - high)) ** 2 < 1.0
        image[near] = 0.1
    image[[0, 1, -1, -2]] = image[:, [0, 1, -1, -2]] = 0.1
    image = gaussian_filter(image, 0.6)
    assert coat_of_paint(image) is None
    assert plain_surface(image) is not None
