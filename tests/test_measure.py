"""``modeharvest measure``: a plate with a hole, from image files to files of its displacement."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import tifffile
from explored import content_of, quantity, samples
from manufactured import inverted, speckle
from plate_with_hole import GRID, plate_pair, quadratic_field
from scipy.ndimage import gaussian_filter
from summary_schemas import faults
from test_cli import called, error_line

from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import (
    Given,
    field_at,
    field_names,
    read_result,
    write_csv,
    write_result,
)
from modeharvest.idic.finite_element.light import LOCAL, UNEVEN, brightness, light_for, uneven_light
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.mesh import mesh_of_mask
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.local.field import read_field
from modeharvest.idic.photograph.displacement import block_motion, deformed_mask, displacement_from
from modeharvest.idic.photograph.material import mixed_edge_px
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.measure import measure
from modeharvest.util.errors import InputError

pytest.importorskip("gmsh")
pytestmark = pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")

GAIN, OFFSET = 0.8, 20.0
"""Of the second deformed image's brightness, in 8-bit levels."""


def field(points: np.ndarray, load: float) -> np.ndarray:
    """A motion of some 10 px, a strain of 3 %, a wave of 120 px; no pattern in sight."""
    x, y = np.moveaxis(points, -1, 0)
    wave = 0.01 * np.stack([np.sin(2 * np.pi * y / 1.2), np.sin(2 * np.pi * x / 1.2)], axis=-1)
    smooth = np.stack([0.08 - 0.03 * x + 0.01 * y, -0.06 + 0.02 * y - 0.02 * x**2], axis=-1)
    return load * (smooth + wave)


@dataclasses.dataclass(frozen=True)
class Plate:
    """Files of a plate with a hole: reference, deformed images, mask; the truth of each."""

    folder: Path
    truth: dict[str, np.ndarray]
    mask: np.ndarray

    @property
    def files(self) -> list[Path]:
        return [self.folder / f"{name}.tif" for name in self.truth]


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Plate:
    folder, truth = tmp_path_factory.mktemp("plate"), {}
    for name, load, (gain, offset) in (("a", 0.5, (1.0, 0.0)), ("b", 1.0, (GAIN, OFFSET))):
        pair = plate_pair(lambda points, load=load: field(points, load), 0.005, seed=len(truth))
        levels = [np.clip(np.rint(255 * image), 0, 255).astype(np.uint8)
                  for image in (pair.reference, gain * pair.deformed + offset / 255)]  # fmt: skip
        write_image(folder / f"{name}.tif", levels[1])
        assert pair.truth is not None
        truth[name] = pair.truth.displacement
        if name == "a":
            write_image(folder / "ref.tif", levels[0])
            write_image(folder / "mask.tif", pair.masks[0])
    return Plate(folder, truth, pair.masks[0])


@pytest.fixture(scope="module")
def measured(plate: Plate, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    measure(plate.folder / "ref.tif", plate.files, out, mask=plate.folder / "mask.tif",
            pixel_size=GRID.pixel_size)  # fmt: skip
    return out


@pytest.fixture(scope="module")
def result(measured: Path) -> NodalResult:
    return read_result(measured / "results/b.h5")


def test_both_images_up_to_the_edges(plate: Plate, measured: Path) -> None:
    for name, truth in plate.truth.items():
        u = read_result(measured / f"results/{name}.h5").displacement_on()
        error = (u - truth)[plate.mask] / GRID.pixel_size
        assert np.isfinite(error).all()  # every pixel of the material
        assert np.sqrt(np.mean(error**2)) < 0.03
        near = np.hypot(*np.meshgrid(GRID.x, GRID.y)) < 0.35 + 10 * GRID.pixel_size
        at_hole = (u - truth)[plate.mask & near] / GRID.pixel_size
        assert np.sqrt(np.mean(at_hole**2)) < 0.06


def test_summary(plate: Plate, measured: Path) -> None:
    summary = json.loads((measured / "summary.json").read_text())
    assert faults(summary, "measure") == []
    first, second = summary["images"]
    truth = plate.truth["b"][plate.mask] / GRID.pixel_size
    assert second["rms_px"] == pytest.approx(np.sqrt(np.mean(truth**2)), rel=0.01)
    assert second["max_px"] == pytest.approx(np.linalg.norm(truth, axis=-1).max(), rel=0.01)
    assert second["coverage"] == 1.0
    assert first["gain"] == pytest.approx(1.0, abs=0.01)
    assert second["gain"] == pytest.approx(1.0 / GAIN, rel=0.01)
    seconds = json.loads((measured / "timings.json").read_text())
    assert seconds["image b"] > 0
    assert "seconds" not in second
    assert summary["unit"] == "mm"
    page = (measured / "report.html").read_text()
    assert page.count("<svg") == 2 * 8
    content = content_of(page)
    for k, name in enumerate("ab"):
        u = samples(content, plate.truth[name])
        assert np.nanmax(np.abs(quantity(content, k, "u") - u[..., 0])) < GRID.pixel_size
        strain = quantity(content, k, "exx")
        assert np.nanmedian(np.abs(strain - np.gradient(u[..., 0], axis=1) / GRID.pixel_size
                                   / content["factor"])) < 0.01  # fmt: skip


@pytest.mark.usefixtures("undrawn_pictures")
def test_finished_images_are_not_measured_again(plate: Plate, measured: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (measured / "results").iterdir()}
    measure(plate.folder / "ref.tif", plate.files, measured, mask=plate.folder / "mask.tif",
            pixel_size=GRID.pixel_size)  # fmt: skip
    assert {path: path.stat().st_mtime_ns for path in (measured / "results").iterdir()} == before


def test_gauges_are_read_and_shown(plate: Plate, measured: Path, tmp_path: Path) -> None:
    gauges = tmp_path / "gauges.toml"
    gauges.write_text(
        '[[gauges]]\nname = "across"\nline = [[-0.6, 0.6], [0.6, 0.6]]\n'
        '[[gauges]]\nname = "corner"\npolygon = [[0.5, 0.5], [0.7, 0.5], [0.6, 0.7]]\n'
    )
    found = measure(plate.folder / "ref.tif", plate.files, measured, gauges=gauges,
                    mask=plate.folder / "mask.tif", pixel_size=GRID.pixel_size)  # fmt: skip
    assert faults(found, "measure") == []
    read = {(r["image"], r["gauge"], r["reads"]): r for r in found["gauges"]}
    ends = np.array([[-0.6, 0.6], [0.6, 0.6]])
    for name, load in (("a", 0.5), ("b", 1.0)):
        length = read[name, "across", "length"]
        true = float(np.linalg.norm(np.diff(ends + field(ends, load), axis=0)))
        assert length["unit"] == "mm"
        assert 0.0 < length["sd"] < 0.1 * GRID.pixel_size
        assert length["value"] == pytest.approx(true, abs=4.0 * length["sd"])
    assert (measured / "gauges.csv").is_file()
    page = (measured / "report.html").read_text("utf-8")
    assert "What gauges read in b" in page
    assert "--gauges" in page


def test_hdf5_comes_back_as_it_was(result: NodalResult, tmp_path: Path) -> None:
    path = tmp_path / "again.h5"
    write_result(path, result, Given("px"))
    again = read_result(path)
    for f in dataclasses.fields(result):
        if f.name != "mesh":
            one, other = getattr(result, f.name), getattr(again, f.name)
            assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other
    assert np.array_equal(result.mesh.cells, again.mesh.cells)
    with h5py.File(path) as file:
        assert file["displacement"].attrs["unit"] == file.attrs["unit"] == "px"


def test_damaged_files_are_refused_in_one_line(result: NodalResult, tmp_path: Path) -> None:
    path = tmp_path / "damaged.h5"
    write_result(path, result)
    with h5py.File(path, "a") as file:
        file["displacement"][3] = np.nan
    with pytest.raises(InputError, match="expected finite numbers") as refused:
        read_result(path)
    assert "\n" not in str(refused.value)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="measure again"):
        read_result(path)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "other"
    with pytest.raises(InputError, match="got format 'other'"):
        read_result(path)


def test_other_files_say_the_same(result: NodalResult, measured: Path, tmp_path: Path) -> None:
    u = result.displacement
    found = meshio.read(measured / "results/b.vtu")
    labels = {"displacement": "displacement_mm", "standard_deviation": "standard_deviation_mm"}
    assert found.point_data.keys() == {labels.get(name, name) for name in field_names()}
    for name in field_names():
        exact = field_at(result, name).astype(np.float32)
        spatial = found.point_data[labels.get(name, name)].reshape(len(u), *[3] * (exact.ndim - 1))
        np.testing.assert_array_equal(spatial[(..., *[slice(2)] * (exact.ndim - 1))], exact)
    F = result.field("F")
    np.testing.assert_allclose(result.field("J"), np.linalg.det(F))
    stretches = result.field("stretch_1"), result.field("stretch_2")
    np.testing.assert_allclose(np.stack(stretches, -1), np.linalg.svd(F)[1], rtol=1e-9)
    # A table of the nodes that every reader of a local DIC's field understands.
    np.testing.assert_allclose(read_field(measured / "results/b.csv", GRID).u, u, rtol=1e-8)
    maps = [tifffile.imread(measured / f"results/b_{name}_mm.tif") for name in ("u", "v")]
    assert maps[0].dtype == np.float32
    np.testing.assert_allclose(np.stack(maps, -1), result.displacement_on(), rtol=1e-6)
    points = np.array([[0.8, 0.5], [0.0, 0.0]])
    write_csv(tmp_path / "points.csv", result, points)
    table = np.genfromtxt(tmp_path / "points.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(table[0, 4:6], result.at(points[:1])[0], rtol=1e-8)
    assert np.isnan(table[1, 4:]).all()  # in the hole


@pytest.fixture(scope="module")
def no_numbers(
    plate: Plate, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    """Of a folder with an empty file, without a mask and a pixel size: summary and output."""
    shots, out = tmp_path_factory.mktemp("Prüfung (3)"), tmp_path_factory.mktemp("no numbers")
    (shots / "a.tif").write_bytes((plate.folder / "a.tif").read_bytes())
    (shots / "b.tif").touch()
    return measure(plate.folder / "ref.tif", [shots], out), out


def test_an_empty_file_in_a_folder_is_skipped_and_the_rest_goes_on(
    no_numbers: tuple[dict[str, Any], Path],
) -> None:
    summary, out = no_numbers
    (image,), (skipped,) = summary["images"], summary["skipped"]
    assert (image["name"], skipped["name"]) == ("a", "b")
    command = shlex.split(summary["command"])
    assert command[-3:] == [str(Path(image["file"]).parent), "--out", str(out)]
    assert "an empty file, cut short at 0 bytes" in skipped["reason"]


def test_light_may_slope_by_default(plate: Plate, tmp_path: Path, undrawn_pictures: None) -> None:
    """A lamp that has moved made errors of 0.1 px, a change of 2 % some without a warning."""
    slope = 1.0 + 0.05 * np.linspace(-1.0, 1.0, GRID.cols)
    image = np.clip(tifffile.imread(plate.files[0]) * slope, 0, 255).astype(np.uint8)
    write_image(tmp_path / "a.tif", image)
    summary = measure(plate.folder / "ref.tif", [tmp_path / "a.tif"], tmp_path / "out",
                      mask=plate.folder / "mask.tif")  # fmt: skip
    assert summary["images"][0]["warnings"] == []
    u = read_result(tmp_path / "out/results/a.h5").displacement_on()
    error = (u - plate.truth["a"] / GRID.pixel_size)[plate.mask]
    assert np.sqrt(np.nanmean(error**2)) < 0.03


def test_material_is_found_and_lengths_are_pixels(
    plate: Plate, no_numbers: tuple[dict[str, Any], Path]
) -> None:
    summary, out = no_numbers
    (image,) = summary["images"]
    u = read_result(out / "results/a.h5").displacement_on()
    error = u - plate.truth["a"] / GRID.pixel_size
    both = plate.mask & np.isfinite(error).all(axis=-1)
    assert both.sum() > 0.9 * plate.mask.sum()
    assert np.sqrt(np.mean(error[both] ** 2)) < 0.1
    assert (summary["unit"], summary["mask"]) == ("px", "found by its speckle")
    assert image["coverage"] > 0.99


@pytest.mark.usefixtures("undrawn_pictures")
def test_two_specimens_that_move_apart_are_not_strained(tmp_path: Path) -> None:
    """The gap between them was taken for a strain: 3.3 % here."""
    pattern = speckle(3, PixelGrid.centred(200, 200, 0.01))
    y, x = 0.01 * np.mgrid[:130, :200]
    for name, shift in (("ref", 0.0), ("a", 0.02)):
        image = np.full(x.shape, 0.0)
        for left, moved in ((0.15, -shift), (1.1, shift)):
            at = x - moved
            mask = (at > left) & (at < left + 0.75) & (y > 0.15) & (y < 1.15)
            image = np.where(mask, pattern(at - 1.0, y - 0.65), image)
            if name == "ref":
                write_image(tmp_path / "mask.tif", image > 0.0)
        write_image(tmp_path / f"{name}.tif", image.astype(np.float32))
    summary = measure(tmp_path / "ref.tif", [tmp_path / "a.tif"], tmp_path / "out",
                      mask=tmp_path / "mask.tif")  # fmt: skip
    assert abs(summary["images"][0]["strain_x"]) < 2e-4


@pytest.mark.usefixtures("undrawn_pictures")
def test_a_photograph_without_background_says_so(plate: Plate, tmp_path: Path) -> None:
    """One with a background as rough as speckle does, too, and is measured as a whole."""
    field = gaussian_filter(np.random.default_rng(0).standard_normal((150, 160)), 2.5)
    image = (128 + 60 * np.tanh(field / field.std())).astype(np.uint8)
    for name in ("ref", "a"):
        write_image(tmp_path / f"{name}.tif", image)
    summary = measure(tmp_path / "ref.tif", [tmp_path / "a.tif"], tmp_path / "out")
    assert summary["mask"] == "the whole image, as no background was found"
    assert summary["material_px"] == image.size
    assert summary["images"][0]["max_px"] < 0.01


@pytest.mark.usefixtures("undrawn_pictures")
def test_what_of_a_mask_is_not_measured_is_reported(plate: Plate, tmp_path: Path) -> None:
    mask = plate.mask.copy()
    assert not mask[:16].any()
    mask[4:12, 50:150] = True  # background
    mask[100:104, 70:74] = False  # dirt
    write_image(tmp_path / "mask.tif", mask)
    summary = measure(plate.folder / "ref.tif", [plate.folder / "a.tif"], tmp_path / "out",
                      mask=tmp_path / "mask.tif")  # fmt: skip
    island, hole = summary["warnings"]
    assert island.startswith("1 island(s) of the mask without speckle, 800 px")
    assert hole.startswith("Holes in the mask smaller than 36 px were filled, 16 px")
    mask[4:12, 50:150], mask[100:104, 70:74] = False, True
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out/mask.tif") > 0, mask)
    # They are said again when nothing is measured again.
    again = measure(plate.folder / "ref.tif", [plate.folder / "a.tif"], tmp_path / "out",
                    mask=tmp_path / "mask.tif")  # fmt: skip
    assert again["warnings"] == summary["warnings"]
    assert "of the mask without speckle" in (tmp_path / "out/report.html").read_text()


@pytest.mark.usefixtures("undrawn_pictures")
def test_elements_beside_the_mask_are_left_out(plate: Plate, tmp_path: Path) -> None:
    mask = plate.mask.copy()
    mask[:, 130:] = False
    write_image(tmp_path / "mask.tif", mask)
    mesh = mesh_of_mask(plate.mask, GRID, 24.0, 24.0).mesh
    points = np.pad(mesh.nodes, ((0, 0), (0, 1)))
    meshio.Mesh(points, [("triangle6", mesh.cells)]).write(tmp_path / "mesh.vtu")
    summary = measure(plate.folder / "ref.tif", [plate.folder / "a.tif"], tmp_path / "out",
                      mask=tmp_path / "mask.tif", mesh=tmp_path / "mesh.vtu",
                      pixel_size=GRID.pixel_size)  # fmt: skip
    assert "elements lie beside the image or the mask" in summary["warnings"][0]
    result = read_result(tmp_path / "out/results/a.h5")
    assert 0.4 * len(mesh.cells) < len(result.mesh.cells) < 0.7 * len(mesh.cells)
    error = (result.displacement_on() - plate.truth["a"])[mask] / GRID.pixel_size
    assert np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.usefixtures("undrawn_pictures")
def test_what_does_not_match_is_reported(plate: Plate, tmp_path: Path) -> None:
    image, other = (tifffile.imread(path) for path in (plate.files[0], plate.folder / "ref.tif"))
    image[120:150, 180:220] = other[60:90, 180:220]
    write_image(tmp_path / "patched.tif", image)
    summary = measure(plate.folder / "ref.tif", [tmp_path / "patched.tif"], tmp_path / "out",
                      mask=plate.folder / "mask.tif")  # fmt: skip
    warning = summary["images"][0]["warnings"][-1]
    assert "the surface has changed" in warning
    row, col = map(int, re.findall(r"row (\d+), column (\d+)", warning)[0])
    assert 120 <= row < 150
    assert 180 <= col < 220


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize(("share", "count"), [(0.005, 0), (0.03, 1)])
def test_light_that_changes_along_the_material_is_reported(
    share: float, count: int, degree: int
) -> None:
    """A slope where gain and offset are constants, a spot where they are linear."""
    pair, _ = plate_and_body()
    across = np.linspace(-1.0, 1.0, GRID.cols)  # beside the material, too
    light = 1.0 + share * (across if degree == 0 else 3.0 * across**2)
    assert pair.truth is not None
    lit = pair.with_images(pair.reference, light * pair.deformed)
    u = pair.truth.displacement
    assert (uneven_light(lit, u, degree) > UNEVEN) == bool(count)
    assert light_for(lit, u, degree) == (LOCAL if count else degree)
    assert light_for(lit, u, None) is None
    slope = pair.with_images(pair.reference, (1.0 + 0.05 * across) * pair.deformed)
    assert light_for(slope, u, 1) == 1


def test_speckle_and_noise_are_no_light() -> None:
    """Windows of fine speckle had few of the compared pixels in large images: 3.5 % of light."""
    rng, shape = np.random.default_rng(0), (1000, 2000)
    speckle = gaussian_filter(rng.standard_normal(shape), 1.5)
    f = 128.0 + 60.0 * speckle / speckle.std()
    images = (f + 5.0 * rng.standard_normal(shape) for _ in "fg")
    pair, at_rest = ImagePair(*images, PixelGrid.centred(*shape, 1.0)), np.zeros((*shape, 2))
    assert light_for(pair, at_rest, 1) == 1
    spot = 1.2 - 0.4 * abs(pair.grid.x) / pair.grid.x.max()
    assert light_for(pair.with_images(pair.reference, spot * pair.deformed), at_rest, 1) == LOCAL


def test_gain_and_offset_around_each_pixel_are_those_of_a_spot() -> None:
    """Also where the displacement is off by 2 px, and something hides the surface."""
    pair, _ = plate_and_body()
    assert pair.truth is not None
    x, y = np.meshgrid(GRID.x, GRID.y)
    spot = 1.0 + 0.2 * np.exp(-((x - 0.5) ** 2 + y**2) / (2.0 * 0.6**2))
    dark = 0.05 * pair.reference.std()
    levels = spot * pair.deformed + dark
    levels[100:120, 40:60] = levels.max()
    for off_px, most in ((0.0, 0.015), (2.0, 0.04)):
        u = pair.truth.displacement + off_px * GRID.pixel_size
        gain, offset = brightness(pair.with_images(pair.reference, levels), u, LOCAL)
        at = pair.truth.displacement[..., 0] + x, pair.truth.displacement[..., 1] + y
        lit = 1.0 + 0.2 * np.exp(-((at[0] - 0.5) ** 2 + at[1] ** 2) / (2.0 * 0.6**2))
        level = pair.reference[pair.masks[0]].mean()
        found = ((level - offset) / gain)[pair.masks[0]]
        error = found / (lit[pair.masks[0]] * level + dark) - 1.0
        assert np.sqrt(np.mean(error**2)) < most


@pytest.mark.parametrize(("size", "most"), [(0.5, 0.2), (0.8, 0.12)])
def test_a_spot_of_light_is_not_taken_for_displacement(size: float, most: float) -> None:
    """Of 20 % in the middle of the deformed image; linear gain and offset left 1.2 and 0.36 px."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    spot = 0.2 * np.exp(-((x - 0.6) ** 2 + (y + 0.2) ** 2) / (2.0 * size**2))
    error = error_from(0.0, brightness=1, light=spot)
    assert np.sqrt(np.mean(error**2)) < most


@pytest.mark.usefixtures("undrawn_pictures")
def test_noise_in_one_image_is_no_mismatch(plate: Plate, tmp_path: Path) -> None:
    images = [tifffile.imread(path) for path in (plate.folder / "ref.tif", plate.files[0])]
    for k, name in enumerate(("ref", "a")):
        noisy = [*images]
        noisy[k] = noisy[k] + 0.1 * np.ptp(noisy[k]) * np.random.default_rng(0).standard_normal(
            noisy[k].shape
        )
        for what, image in zip(("ref", "a"), noisy, strict=True):
            write_image(tmp_path / f"{what}.tif", image.astype(np.float32))
        summary = measure(tmp_path / "ref.tif", [tmp_path / "a.tif"], tmp_path / name,
                          mask=plate.folder / "mask.tif")  # fmt: skip
        assert summary["images"][0]["warnings"] == []
        assert summary["images"][0]["image_noise"] == pytest.approx(
            summary["images"][0]["residual_rms"], rel=0.1
        )


def test_start_follows_what_no_polynomial_does() -> None:
    def wave(points: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(points, -1, 0)
        return 0.08 * np.stack([np.sin(2 * np.pi * y / 1.6), np.cos(2 * np.pi * x / 1.6)], axis=-1)

    grid = PixelGrid.centred(240, 240, 0.01)
    pattern, at = speckle(1, grid), np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    before = inverted(wave, at, 1e-9)
    pair = ImagePair(*(pattern(x[..., 0], x[..., 1]) for x in (at, before)), grid)
    mesh = mesh_of_mask(pair.masks[0], grid, 24.0, 24.0).mesh
    start = block_motion(pair, Body(mesh), 0.0 * mesh.nodes)
    off = np.linalg.norm(start - wave(mesh.nodes), axis=1) / grid.pixel_size
    inner = (abs(mesh.nodes) < 0.8).all(axis=1)  # where there are blocks on all sides
    # Whole pixels, and a block of 41 px is blind to a tenth of such a wave's 8 px.
    assert np.median(off[inner]) < 1.5
    assert np.quantile(off[inner], 0.99) < 4.0


@cache
def body_of_all(grid: PixelGrid) -> Body:
    """A mesh of all pixels."""
    return FiniteElementOptions().body(np.ones(grid.shape, bool), grid)


@cache
def plate_and_body() -> tuple[ImagePair, Body]:
    """The plate under a quadratic field, and its mesh."""
    exact = plate_pair(quadratic_field, 0.004)
    return exact, FiniteElementOptions().body(exact.masks[0], GRID)


def test_light_is_not_estimated_from_a_start_that_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the deformed mask is given it was, and even light was taken from around each pixel."""
    pair, body = plate_and_body()
    found: list[int | str | None] = []

    def recorded(*given: Any) -> int | str | None:
        found.append(light_for(*given))
        return found[-1]

    monkeypatch.setattr("modeharvest.idic.photograph.displacement.light_for", recorded)
    x, y = body.mesh.nodes.T
    off = (
        4.0 * GRID.pixel_size * np.stack([np.sin(2 * np.pi * y / 1.2), np.cos(2 * np.pi * x / 1.2)])
    )
    result = displacement_from(quadratic_field(body.mesh.nodes) + off.T, pair, body, light_degree=1)
    assert set(found) == {1}
    assert pair.truth is not None
    error = (result.displacement_on() - pair.truth.displacement)[pair.masks[0]] / GRID.pixel_size
    assert np.abs(error).max() < 0.3


@pytest.mark.parametrize(("size_px", "amplitude_px"), [(5.0, 0.0), (12.0, 0.0), (5.0, 0.2)])
def test_error_bars_of_a_smooth_displacement_count_the_start_s_noise(
    size_px: float, amplitude_px: float
) -> None:
    """It comes from the same images: what is left of their noise in it was counted by nothing.

    Errors were seven times the standard deviation, and as many times larger than they need be.
    """
    pixel, shape = 0.01, (240, 320)
    grid = PixelGrid.centred(*shape, pixel)

    def u(points: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(points, -1, 0)
        wave = amplitude_px * pixel * np.sin(2.0 * np.pi * x / (200.0 * pixel))
        return np.stack([0.013 + 0.02 * x + wave, 0.004 - 0.01 * y + wave], axis=-1)

    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    speckles, rng = SpeckleSpec(0.5 / size_px, blur_px=0.3 * size_px), np.random.default_rng(1)
    pattern = Speckle(speckles, shape)
    images = [
        pattern(*grid.to_px(x[..., 0], x[..., 1])) + 0.01 * rng.standard_normal(shape)
        for x in (at, inverted(u, at, 1e-9))
    ]
    pair, body = ImagePair(*images, grid), body_of_all(grid)
    nodes = body.mesh.nodes
    found = displacement_from(block_motion(pair, body, 0.0 * nodes), pair, body)
    seen = (np.abs(nodes + u(nodes)) < [grid.x[-3], grid.y[2]]).all(axis=1)
    off, sd = np.abs(found.displacement - u(nodes))[seen], found.standard_deviation[seen]
    assert np.mean(off < 1.96 * sd) > 0.8
    assert np.sqrt(np.mean(off**2)) < 1.3 * np.sqrt(np.mean(sd**2))


@pytest.mark.parametrize(("size_px", "noise"), [(24.0, 0.05), (36.0, 0.02)])
def test_coarse_speckle_is_measured_up_to_corners(size_px: float, noise: float) -> None:
    """First measurements followed its noise at corners, by 5 and 22 px, into the background."""
    grid, rng = PixelGrid.centred(320, 400, 1.0), np.random.default_rng(0)
    R, shift = np.array([[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]]), [5.3, -8.6]
    pattern = Speckle(SpeckleSpec(0.5 / size_px, blur_px=0.3 * size_px), grid.shape)
    points = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)

    def inside(at: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(at) < [160.0, 120.0]).all(axis=-1))

    f, g = (
        np.where(inside(at), 0.2 + 0.6 * pattern(*grid.to_px(at[..., 0], at[..., 1])), 0.06)
        + noise * rng.standard_normal(grid.shape)
        for at in (points, (points - shift) @ R)
    )
    mask = inside(points)
    pair, body = ImagePair(255 * f, 255 * g, grid, mask), FiniteElementOptions().body(mask, grid)
    nodes = body.mesh.nodes
    found = displacement_from(block_motion(pair, body, 0.0 * nodes), pair, body)
    off = found.displacement - (nodes @ (R - np.eye(2)).T + shift)
    assert np.abs(off).max() < 0.2


@pytest.mark.parametrize("wave_px", [0.0, 1.0])
def test_error_bars_at_edges_count_the_start_s_noise(wave_px: float) -> None:
    """Around a hole it made the cut-off short, and what remained of it was counted by nothing.

    Errors were 2 to 2.5 times the standard deviation.
    """

    def u(points: np.ndarray) -> np.ndarray:
        x, y = np.pi * np.moveaxis(points, -1, 0)
        waves = np.stack([np.sin(x) * np.cos(y), np.cos(x)], axis=-1)
        affine = points @ np.array([[0.05, 0.07], [-0.07, -0.02]]) + [0.06, 0.03]
        return affine + wave_px * GRID.pixel_size * waves

    pair, body = plate_pair(u, 0.003), plate_and_body()[1]
    pair, nodes = ImagePair(pair.reference, pair.deformed, GRID, pair.masks[0]), body.mesh.nodes
    found = displacement_from(block_motion(pair, body, 0.0 * nodes), pair, body)
    off, sd = np.abs(found.displacement - u(nodes)), found.standard_deviation
    assert np.mean(off < 1.96 * sd) > 0.85
    assert np.sqrt(np.mean(off**2)) < 1.2 * np.sqrt(np.mean(sd**2))


def error_from(
    off_px: float,
    wave_px: float = 60.0,
    brightness: int | None = 0,
    light: float | np.ndarray = 0.0,
) -> np.ndarray:
    """(p, 2) errors on the plate [px], where nothing is known of the deformed image.

    The start is off by a wave; the light in the deformed image grows by a share.
    """
    exact, body = plate_and_body()
    mask, lit = exact.masks[0], (1.0 + light) * exact.deformed
    pair = ImagePair(255 * exact.reference, 255 * lit, GRID, mask)
    phase = 2.0 * np.pi / (wave_px * GRID.pixel_size) * body.mesh.nodes[:, ::-1]
    wave = off_px * GRID.pixel_size * np.column_stack([np.cos(phase[:, 0]), np.sin(phase[:, 1])])
    start = quadratic_field(body.mesh.nodes) + wave
    found = displacement_from(start, pair, body, light_degree=brightness).displacement_on()
    assert exact.truth is not None
    return (found - exact.truth.displacement)[mask] / GRID.pixel_size


@pytest.mark.parametrize(("off_px", "wave_px"), [(4.0, 60.0), (4.0, 40.0), (8.0, 80.0)])
def test_all_is_found_from_a_start_that_is_far_off(off_px: float, wave_px: float) -> None:
    """Background taken for material made nodes run away, by 7 px; local minima were kept.

    From 10 px over 100 px on it is luck: a change of the start by 1e-9 px decides.
    """
    error = error_from(off_px, wave_px)
    assert np.isfinite(error).all()
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert np.linalg.norm(error, axis=1).max() < 1.0


@pytest.mark.parametrize(("half", "px"), [((0.45, 0.3), 0.1), ((0.3, 0.25), 0.2)])
def test_a_small_specimen_in_a_large_picture_is_found(half: tuple[float, float], px: float) -> None:
    """Blocks were as far apart as those of a whole picture, and compared with their own places."""
    grid = PixelGrid.centred(360, 420, 0.01)

    def u(points: np.ndarray) -> np.ndarray:
        return points @ np.diag([0.02, -0.03]) + [0.013, 0.02]

    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    before, pattern = inverted(u, at, 1e-12), speckle(3, grid)
    noise = 0.01 * np.random.default_rng(1).standard_normal((2, *grid.shape))
    masks = [(abs(where - [-1.2, 1.0]) <= half).all(axis=-1) for where in (at, before)]
    images = [
        np.where(mask, pattern(where[..., 0], where[..., 1]), 0.0) + grain
        for mask, where, grain in zip(masks, (at, before), noise, strict=True)
    ]
    body = FiniteElementOptions().body(masks[0], grid)
    pair, nodes = ImagePair(*images, grid, masks[0]), body.mesh.nodes
    start = block_motion(pair, body, 0.0 * nodes)
    assert np.abs(start - u(nodes)).max() < 3.0 * grid.pixel_size
    error = (displacement_from(start, pair, body).displacement - u(nodes)) / grid.pixel_size
    assert np.sqrt(np.mean(error**2)) < px


def test_a_lens_does_not_mix_background_into_the_displacement() -> None:
    """A blur of 0.7 px made edges of a turned plate drift: 0.23 px rms, 1.9 px at most."""
    grid, turn = PixelGrid.centred(300, 360, 1.0), np.deg2rad(8.0)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    x, pattern = np.stack(np.meshgrid(grid.x, grid.y), axis=-1), Speckle(SpeckleSpec(), grid.shape)

    def photograph(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mask = (abs(at) < [130.2, 90.6]).all(axis=-1)
        shown = np.where(mask, pattern(*grid.to_px(at[..., 0], at[..., 1])), 0.05)
        return np.rint(255 * gaussian_filter(shown, 0.7)).astype(np.float32), mask

    (f, mask), (g, _) = photograph(x), photograph((x - [4.3, -2.6]) @ R)
    options = FiniteElementOptions(edge_px=mixed_edge_px(f, mask))
    body, pair = options.body(mask, grid), ImagePair(f, g, grid, mask)
    start = block_motion(pair, body, 0.0 * body.mesh.nodes)
    found = displacement_from(start, pair, body, options).displacement
    error = found - body.mesh.nodes @ (R - np.eye(2)).T - [4.3, -2.6]
    assert np.sqrt(np.mean(error**2)) < 0.01


def test_light_that_changes_along_the_image_does_not_enter_the_displacement() -> None:
    slope = 0.05 * GRID.x / GRID.x.max()
    without, ignored, found, around = (
        np.sqrt(np.mean(error_from(2.0, 60.0, degree, light) ** 2))
        for degree, light in ((0, 0.0), (None, slope), (2, slope), (0, slope))
    )
    assert ignored > 3.0 * without
    assert found < 1.4 * without
    assert around < 0.1 * ignored


@pytest.mark.usefixtures("undrawn_pictures")
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("size", "expected images of one size"),
        ("mask size", "expected images of one size"),
        ("black mask", "expected a mask with material"),
        ("mask of NaN", "expected a mask of finite numbers"),
        ("pixel size", "expected a pixel size [mm] of 1e-09 to 1e+06, got 1e-300"),
        ("brightness", "expected a degree of gain and offset, 0 (even) to 6, or 'none', got '0.5'"),
        ("mesh", "expected a mesh that covers the mask"),
        ("mesh beside", "expected a mesh on the image"),
        ("mesh twice", "expected elements that don't overlap"),
        ("mesh tilted", "expected a plane mesh, z = const in"),
        ("mesh of NaN", "mesh.vtu, got NaN or infinity"),
        ("blank mask", "expected speckle on the material"),
        ("no contrast", "expected an image with contrast"),
        ("noise", "expected a speckle pattern"),
        ("other surface", "expected two images of one surface"),
        ("missing", "no such file"),
    ],
)
def test_bad_input_is_one_line(
    plate: Plate,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    what: str,
    message: str,
) -> None:
    rng, bad = np.random.default_rng(0), tmp_path / "bad.tif"
    images = {
        "size": rng.integers(0, 255, (50, 60)).astype(np.uint8),
        "mask size": np.full((50, 60), 7, np.uint8),
        "black mask": np.zeros(GRID.shape, np.uint8),
        "mask of NaN": np.full(GRID.shape, np.nan, np.float32),
        "blank mask": np.uint8(255) * (np.hypot(*np.meshgrid(GRID.x, GRID.y)) < 0.3),
        "no contrast": np.full(GRID.shape, 7, np.uint8),
        "noise": rng.integers(0, 255, GRID.shape).astype(np.uint8),
        "other surface": tifffile.imread(plate.folder / "a.tif")[::-1, ::-1],
    }
    if what in images:
        write_image(bad, np.ascontiguousarray(images[what]))
    options = ["--mask", bad if "mask" in what else plate.folder / "mask.tif"]
    options += ["--pixel-size", "1e-300"] if what == "pixel size" else []
    options += ["--brightness", "0.5"] if what == "brightness" else []
    if what.startswith("mesh"):
        times = 2 if what == "mesh twice" else 1
        corners = np.array([[-0.9, 0.5, 0.0], [0.0, 0.5, 0.0], [-0.9, 0.8, 0.0]])
        corners[:, 0] += 90.0 * (what == "mesh beside")
        corners[2, 2] = {"mesh tilted": 0.2, "mesh of NaN": np.nan}.get(what, 0.0)
        nodes = np.tile(corners, (times, 1))
        cells = [("triangle", np.arange(3 * times).reshape(-1, 3))]
        meshio.Mesh(nodes, cells).write(tmp_path / "mesh.vtu")
        options += ["--mesh", tmp_path / "mesh.vtu", "--pixel-size", "0.01"]
    deformed = bad if what in images and "mask" not in what else plate.folder / "a.tif"
    if what == "missing":
        deformed = tmp_path / "nothing.tif"
    command = ["measure", plate.folder / "ref.tif", deformed, *options, "--out", tmp_path / "out"]
    assert called(monkeypatch, *command) == 2
    assert message in error_line(capsys)
    assert what != "missing" or not (tmp_path / "out").exists()


def test_a_folded_element_takes_no_other_s_material_from_the_deformed_image() -> None:
    """One in a place that a reflection hid cost the whole mask, and edges drifted off by 34 px."""
    grid = PixelGrid.centred(160, 200, 1.0)
    mask = np.zeros(grid.shape, np.bool_)
    mask[20:-20, 20:-20] = True
    mesh = FiniteElementOptions(12.0, 12.0).body(mask, grid).mesh
    u = np.zeros_like(mesh.nodes)
    u[np.argmin(np.linalg.norm(mesh.nodes, axis=1))] = [30.0, 0.0]
    found, at_rest = (deformed_mask(grid, mesh, motion, 2.0) for motion in (u, 0.0 * u))
    assert found is not None
    assert at_rest is not None
    far = np.hypot(*np.meshgrid(grid.x, grid.y)) > 30.0
    np.testing.assert_array_equal(found[far], at_rest[far])
    assert deformed_mask(grid, mesh, -2.0 * mesh.nodes[:, ::-1], 2.0) is None
