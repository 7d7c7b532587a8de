"""What can be done with measured displacements later: gauges, exports, animations, PDF."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import PathPatch
from PIL import Image
from scipy.io import loadmat
from test_cli import called, error_line
from test_gauges import GRID, MESH, affine, result

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.finite_element.files import Given, write_csv, write_result
from modeharvest.idic.local.field import read_field
from modeharvest.idic.modes import square_family
from modeharvest.idic.photograph.finished import FinishedRun
from modeharvest.idic.result import Covariance, Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import write_image
from modeharvest.report.figures.maps import ColourScale
from modeharvest.report.figures.on_photographs import draw_on_photograph, write_pdf
from modeharvest.report.figures.style import SIZE, style
from modeharvest.util.errors import InputError
from modeharvest.util.files import write_json

STRETCH = np.array([[1.02, 0.01], [-0.02, 0.97]])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "results").mkdir()
    rng, images = np.random.default_rng(2), []
    for k, name in enumerate(("b", "a")):  # not in the order of the alphabet
        roots = 1e-4 * rng.normal(size=(len(MESH.nodes), 2, 4))
        write_result(folder / f"results/{name}.h5", result((k + 1) * affine(STRETCH), roots))
        write_image(folder / f"{name}.tif", rng.integers(0, 255, GRID.shape).astype(np.uint8))
        images.append({"name": name, "file": str(folder / f"{name}.tif")})
    write_json(folder / "summary.json", {"images": images})
    (folder / "gauges.toml").write_text(
        '[[gauges]]\nname = "L"\nline = [[-3, 0], [3, 0]]\n[[gauges]]\nname = "P"\npoint = [0, 1]\n'
    )
    return folder


def test_a_run_is_opened_in_the_order_of_the_test(run: Path) -> None:
    finished = FinishedRun.read(run)
    assert [*finished.files] == ["b", "a"]
    assert finished.unit == "mm"
    assert [*finished.pictures] == ["b", "a"]
    picture = finished.picture("a")
    assert picture is not None
    assert (picture.shape, bool(picture.max() <= 1.0)) == (GRID.shape, True)
    only = FinishedRun.read(run / "results/a.h5")
    assert ([*only.files], only.picture("a")) == (["a"], None)
    with pytest.raises(InputError, match="a photograph for each of 2, got 1"):
        FinishedRun.read(run, [run / "a.tif"])
    with pytest.raises(InputError, match="expected a folder of 'measure'"):
        FinishedRun.read(run / "a.tif")


@pytest.mark.parametrize(
    "form", ["ncorr", "vic2d", "davis", "dice", "matchid", "gom", "aramis", "pyvale"]
)
def test_a_run_written_for_another_code_is_read_as_it_was(
    run: Path, tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert called(monkeypatch, "export", run, "--as", form, "--out", tmp_path, "--step", "4") == 0
    (path,) = tmp_path.glob("a.*")
    field = read_field(path, GRID)
    assert field.convention
    x, y, u = field.valid_points()
    true = 2.0 * np.column_stack([x, y]) @ (STRETCH - np.eye(2)).T
    np.testing.assert_allclose(u, true, atol=1e-9)
    assert len(x) > 400
    if form == "vic2d":
        F = np.eye(2) + 2.0 * (STRETCH - np.eye(2))
        E = 0.5 * (F.T @ F - np.eye(2))
        exx, eyy, exy = np.loadtxt(path, delimiter=",", skiprows=1).T[-3:]
        for found, expected in ((exx, E[0, 0]), (eyy, E[1, 1]), (exy, -E[0, 1])):
            np.testing.assert_allclose(found, expected, atol=1e-9)


def test_all_fields_go_into_every_format(run: Path, tmp_path: Path) -> None:
    finished = FinishedRun.read(run)
    for form, count in (("csv", 2), ("hdf5", 2), ("vtu", 2), ("mat", 2), ("tiff", 72)):
        assert len(finished.export(form, tmp_path / form, 2)) == count
    maps = loadmat(tmp_path / "mat/b.mat")
    assert maps["logarithmic_xx"].shape == tuple(-(-n // 2) for n in GRID.shape)
    assert np.nanmedian(maps["rotation"]) == pytest.approx(np.degrees(np.arctan2(-0.03, 1.99)))
    field = read_field(tmp_path / "vtu/b.vtu")
    np.testing.assert_allclose(field.u, affine(STRETCH), atol=1e-9)
    own = read_field(tmp_path / "hdf5/b.h5")
    np.testing.assert_allclose(own.u, affine(STRETCH), atol=1e-9)
    assert own.convention == "modeharvest: in mm, y up"


def test_lengths_in_pixels_stay_so(tmp_path: Path) -> None:
    grid = replace(GRID, pixel_size=1.0, x0=-60.0, y0=40.0)
    in_px = replace(result(affine(STRETCH)), grid=grid)
    write_result(tmp_path / "a.h5", in_px, Given("px"))
    write_csv(tmp_path / "a.csv", in_px, given=Given("px"))
    for name in ("a.h5", "a.csv"):
        field = read_field(tmp_path / name, grid)
        np.testing.assert_allclose(np.column_stack([field.x, field.y]), MESH.nodes, atol=1e-6)
        np.testing.assert_allclose(field.u, affine(STRETCH), atol=1e-8)
        assert field.convention == "modeharvest: in px, y down, first pixel 0"
    finished = FinishedRun.read(tmp_path / "a.h5")
    with pytest.raises(InputError, match=r"expected the size of a pixel for gom.*--pixel-size"):
        finished.export("gom", tmp_path / "out", 3)
    for form, axis in (("matchid", "down"), ("npz", ""), ("mat", "down"), ("ncorr", "down")):
        (path,) = finished.export(form, tmp_path / form, 4)
        field = read_field(path, grid)
        x, y, u = field.valid_points()
        true = np.column_stack([x, y]) @ (STRETCH - np.eye(2)).T
        inside = np.hypot(x, y) < 2.5  # maps hold edge pixels whose centres are beside the mesh
        np.testing.assert_allclose(u[inside], true[inside], atol=1e-9)
        assert axis in field.convention
    with pytest.raises(InputError, match="expected lengths in mm, got a measurement in px"):
        read_field(*finished.export("vtu", tmp_path / "vtu", 4), grid)


@pytest.mark.parametrize("form", ["gom", "aramis", "matchid", "npz", "mat", "csv", "vic2d"])
def test_the_size_of_a_pixel_may_come_later(tmp_path: Path, form: str) -> None:
    grid = replace(GRID, pixel_size=1.0, x0=-60.0, y0=40.0)
    write_result(tmp_path / "a.h5", replace(result(affine(STRETCH)), grid=grid), Given("px"))
    finished = FinishedRun.read(tmp_path / "a.h5")
    (path,) = finished.export(form, tmp_path, 4, 0.02)
    field = read_field(path, PixelGrid.centred(*grid.shape, 0.02))
    x, y, u = field.valid_points()
    np.testing.assert_allclose(u, np.column_stack([x, y]) @ (STRETCH - np.eye(2)).T, atol=1e-9)
    assert abs(x).max() == pytest.approx(0.02 * np.abs(MESH.nodes[:, 0]).max(), abs=0.08)
    write_result(tmp_path / "b.h5", result(affine(STRETCH)))
    with pytest.raises(InputError, match="got a run measured in mm"):
        FinishedRun.read(tmp_path / "b.h5").export(form, tmp_path, 4, 0.02)


def test_maps_for_matlab_are_read_back(run: Path, tmp_path: Path) -> None:
    FinishedRun.read(run).export("mat", tmp_path, 3)
    field = read_field(tmp_path / "b.mat", GRID)
    x, y, u = field.valid_points()
    np.testing.assert_allclose(u, np.column_stack([x, y]) @ (STRETCH - np.eye(2)).T, atol=1e-9)
    assert field.sd is not None


def test_photographs_of_a_harvest_are_in_the_order_of_the_test(run: Path, tmp_path: Path) -> None:
    (tmp_path / "whole_field").mkdir()
    for new, old in (("frame_10", "a"), ("frame_2", "b")):
        (tmp_path / f"whole_field/{new}.h5").write_bytes((run / f"results/{old}.h5").read_bytes())
    names = ["frame_2", "frame_10"]
    write_json(tmp_path / "summary.json", {"frames": [{"name": name} for name in names]})
    assert [*FinishedRun.read(tmp_path).files] == names


def test_a_harvest_without_whole_displacements_is_exported_by_its_modes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = PixelGrid.centred(60, 80, 0.05)
    ansatz = Ansatz.on(Box.centred(3.6, 2.8), [(square_family(), Box.centred(3.0, 2.0))], 1.0)
    a = ansatz.initial_guess(0.05, 2.0)
    covariance = np.diag(np.full(ansatz.size, 1e-8))
    known = Result(ansatz, grid, a, covariance, 1.0, 9, 0, Outcome.CONVERGED, 1.0)
    known = replace(known, errors=Covariance(0.01 * covariance, covariance))
    mask = np.zeros(grid.shape, dtype=bool)
    mask[8:50, 10:70] = True
    for name in ("results", "prepared"):
        (tmp_path / name).mkdir()
    known.write(tmp_path / "results/f.json")
    write_json(tmp_path / "results/f_start.json", {"text": []})
    write_image(tmp_path / "prepared/reference_mask.tif", mask)
    for form in ("vic2d", "ncorr", "gom", "csv"):
        out = tmp_path / form
        assert called(monkeypatch, "export", tmp_path, "--as", form, "--out", out) == 0
        (path,) = out.iterdir()
        field = read_field(path, grid)
        x, y, u = field.valid_points()
        np.testing.assert_allclose(u, ansatz.displacement_at(a, np.column_stack([x, y])), atol=1e-9)
        assert len(x) == mask[::5, ::5].sum()
        if form == "vic2d":
            exx = np.loadtxt(path, delimiter=",", skiprows=1)[:, 5]
            points, step = np.column_stack([x, y]), np.array([1e-5, 0.0])
            ahead, behind = (points + s * step + ansatz.displacement_at(a, points + s * step)
                             for s in (1, -1))  # fmt: skip
            stretch = np.linalg.norm(ahead - behind, axis=1) / 2e-5
            np.testing.assert_allclose(exx, 0.5 * (stretch**2 - 1.0), atol=1e-6)
        if form == "csv":
            assert field.sd is not None
            assert field.sd.min() > 1e-5  # by model error
    assert called(monkeypatch, "export", tmp_path, "--as", "vtu", "--out", tmp_path) == 2
    assert "harvest with --whole-field" in error_line(capsys)


def test_gauges_of_a_run(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch, "gauges", run, run / "gauges.toml") == 0
    assert re.search(r"^L +engineering strain +0\.", capsys.readouterr().out, re.MULTILINE)
    head, *rows = (run / "gauges.csv").read_text().splitlines()
    read = dict(zip(head.split(","), rows[1].split(","), strict=True))
    strain = np.linalg.norm(np.eye(2)[0] + 2.0 * (STRETCH - np.eye(2))[:, 0]) - 1.0
    assert float(read["L engineering_strain [-]"]) == pytest.approx(strain)
    assert float(read["L sd engineering_strain [-]"]) > 0.0
    assert (run / "gauges.pdf").read_bytes()[:5] == b"%PDF-"
    assert len((run / "gauges_along.csv").read_text().splitlines()) == 1 + 2 * 31


def test_a_field_is_animated_on_the_photographs(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert called(monkeypatch, "animate", run, "--field", "rotation") == 0
    with Image.open(run / "rotation.gif") as picture:
        assert picture.n_frames == 2
        first = np.asarray(picture.convert("RGB")).astype(int)
    assert (abs(first - first.mean(axis=2, keepdims=True)).max(axis=2) > 30).mean() > 0.2  # colours
    pytest.importorskip("imageio_ffmpeg")
    assert called(monkeypatch, "animate", run, "--as", "mp4") == 0
    assert (run / "u.mp4").stat().st_size > 1000


def test_a_specimen_that_leaves_the_picture_is_cut_at_its_border() -> None:
    """Its edge, too, would be drawn over the colour bar."""
    away = result(affine(STRETCH) + np.array([4.0, 0.0]))  # the picture is 12 mm wide
    scale = ColourScale(SIZE, 0.0, 1.0, "mm")
    drawn = draw_on_photograph(away, np.zeros(len(MESH.nodes)), scale, None)
    (axes,) = drawn.axes
    with style():
        drawn.draw_without_rendering()
        (edge,) = (patch for patch in axes.patches if isinstance(patch, PathPatch))
        right = edge.get_tightbbox().x1
    assert right <= axes.get_window_extent().x1 + 1.0


def test_fields_are_printed(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = "--field", "u", "--field", "stretch_1"
    assert called(monkeypatch, "animate", run, "--as", "pdf", *wanted) == 0
    content = (run / "fields.pdf").read_bytes()
    assert content.count(b"/Type /Page ") + content.count(b"/Type /Page\n") == 1 + 2 * 2


@pytest.mark.parametrize(("rows", "pages"), [(0, 1), (60, 1), (61, 2)])
def test_a_long_table_goes_on_on_the_next_page(rows: int, pages: int, tmp_path: Path) -> None:
    write_pdf(tmp_path / "table.pdf", "Numbers", [["unit"], *[["px"]] * rows], [])
    content = (tmp_path / "table.pdf").read_bytes()
    assert content.count(b"/Type /Page ") + content.count(b"/Type /Page\n") == pages


def test_what_cannot_be_done_is_one_line(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, words in (
        (("animate", run, "--field", "strain"), "expected a field's component, got 'strain'"),
        (("animate", run, "--as", "avi"), "expected --as gif, mp4 or pdf, got 'avi'"),
        (("animate", run, *2 * ("--photograph", "none.tif")), "at none.tif, found no such file"),
        (("export", run, "--as", "xls", "--out", tmp_path), "expected a format among ncorr"),
        (("gauges", tmp_path, run / "gauges.toml"), "expected a folder of 'measure'"),
    ):
        assert called(monkeypatch, *arguments) == 2
        assert words in error_line(capsys)
