"""What users get wrong: one line, exit code 2, and what was there before is still there."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from synthetic_photographs import NOISE, Photographed, lattice_points, of

from modeharvest.cli.root import main
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import square_family
from modeharvest.idic.photograph.geometry import SpecimenTable, find_geometry
from modeharvest.idic.solver.noise import measured_noise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs import prepare
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.util.errors import InputError, WriteError

PITCH, PIXEL = 1.9, 0.035
CELLULAR, DOMAIN = Box.centred(3 * PITCH, 4 * PITCH), Box.centred(3 * PITCH + 1.6, 4 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (0.0, PITCH / 2))
ANSATZ = Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], PITCH)
EXPERIMENT = f"""
[images]
reference = "reference.tif"
deformed = ["frame_*.tif"]
[scale]
pixel_size = {PIXEL}
[specimen]
cell_size = {PITCH}
[correlation]
v0_degree = 2
v_degree = 1
"""


def photographed(seed: int = 2) -> Photographed:
    return Photographed(PixelGrid.centred(310, 250, PIXEL), DOMAIN, HOLES, 1.4, seed)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing wrong in it."""
    folder = tmp_path_factory.mktemp("sound")
    states = {f"frame_{n}": of(ANSATZ, ANSATZ.initial_guess(0.02 * n, 0.0)) for n in (1, 2, 3)}
    photographed().save(folder, states)
    (folder / "experiment.toml").write_text(EXPERIMENT)
    return folder


@pytest.fixture
def folder(sound: Path, tmp_path: Path) -> Path:
    """A copy of it, to be spoilt."""
    return Path(shutil.copytree(sound, tmp_path / "test"))


Spoil = Callable[[Path], None]


def text(old: str, new: str) -> Spoil:
    def spoil(folder: Path) -> None:
        assert old in EXPERIMENT
        (folder / "experiment.toml").write_text(EXPERIMENT.replace(old, new))

    return spoil


def and_a_file(spoil: Spoil, name: str, image: np.ndarray | bytes) -> Spoil:
    def both(folder: Path) -> None:
        spoil(folder)
        if isinstance(image, bytes):
            (folder / name).write_bytes(image)
        else:
            tifffile.imwrite(folder / name, image)

    return both


def no_file(folder: Path) -> None:
    (folder / "experiment.toml").unlink()


def nothing(folder: Path) -> None:
    pass


def mask(key: str, name: str) -> Spoil:
    return text(f"cell_size = {PITCH}", f'cell_size = {PITCH}\n{key} = "{name}"')


def tables(more: str) -> Spoil:
    return text("[correlation]", f"{more}\n[correlation]")


def table_of(field: str) -> Spoil:
    return tables(f'[local]\ncode = "file"\nfiles = ["{field}", "{field}", "{field}"]')


SMALL = np.full((100, 100), 255, dtype=np.uint8)
LENS = '[distortion]\ncalibration = ["frame_1.tif", "frame_2.tif"]'
OUTSIDE = f"cell_size = {PITCH}\npolygon = [[10, 10], [900, 10], [900, 200]]"
CASES: dict[str, tuple[Spoil, str]] = {
    "cell size": (text(f"= {PITCH}", "= 2.3"), "correct the cell size"),
    "no TOML": (no_file, "experiment.toml"),
    "not TOML": (text("[images]", "[images"), "not valid TOML"),
    "unknown key": (text("v_degree", "v_degre"), "did you mean 'v_degree'?"),
    "unknown table": (tables("[corelation]"), "did you mean 'correlation'?"),
    "no scale": (text(f"pixel_size = {PIXEL}", ""), "pixel_size"),
    "missing frame": (text('"frame_*.tif"', '"frame_1.tif", "no.tif"'), "no.tif"),
    "other specimen": (
        and_a_file(nothing, "reference.tif", photographed(seed=7).image()), "not the reference"),
    "material of other size": (and_a_file(mask("material", "m.tif"), "m.tif", SMALL), "m.tif"),
    "cells of other size": (and_a_file(mask("cells", "m.tif"), "m.tif", SMALL), "m.tif"),
    "no such mask": (mask("material", "m.tif"), "m.tif"),
    "too few masks": (
        text(f"= {PITCH}", f'= {PITCH}\ndeformed_material = ["frame_1.tif"]'), "each of 3"),
    "polygon outside": (text(f"cell_size = {PITCH}", OUTSIDE), "polygon inside the image"),
    "two calibration images": (tables(LENS), "at least 3 photographs"),
    "repeats of another state": (
        text('"reference.tif"', '"reference.tif"\nrepeats = ["frame_3.tif"]'), "images.repeats"),
    "pyvale": (tables('[local]\ncode = "pyvale"'), "MODEHARVEST_PYVALE"),
    "field's columns": (
        and_a_file(table_of("f.csv"), "f.csv", b"a,b,c\n1,2,3\n"), "f.csv"),
    "too few fields": (
        tables('[local]\ncode = "file"\nfiles = ["frame_1.tif"]'), "local.files: expected one"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_it_is_one_line_and_nothing_is_lost(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    spoil, message = CASES[case]
    spoil(folder)
    out = folder / "out"
    out.mkdir()
    (out / "report.html").write_text("of an earlier harvest")
    monkeypatch.setenv("MODEHARVEST_PYVALE", str(folder / "no-such-python"))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    arguments = ["modeharvest", "harvest", str(folder / "experiment.toml"), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as end:
        main()
    printed = capsys.readouterr().err
    assert end.value.code == 2
    assert "Traceback" not in printed
    (line,) = [row for row in printed.splitlines() if row.startswith("error:")]
    assert message in line
    assert all(path.read_bytes() == content for path, content in before.items())
    assert not (out / "summary.json").exists()


@pytest.mark.parametrize("command", ["measure", "harvest"])
@pytest.mark.parametrize("content", [b"", b"<!DOCTYPE html>", b"half", b"small"])
def test_damaged_images_alone_leave_no_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    content: bytes, command: str,
) -> None:  # fmt: skip
    frames = sorted(folder.glob("frame_*.tif"))
    for path in frames:
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2] if content == b"half" else content)
        if content == b"small":
            tifffile.imwrite(path, SMALL)
    photographs = map(str, (folder / "reference.tif", *frames))
    inputs = photographs if command == "measure" else [str(folder / "experiment.toml")]
    argv = ["modeharvest", command, *inputs, "--out", str(folder / "new/out")]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit) as end:
        main()
    (line,) = [row for row in capsys.readouterr().err.splitlines() if row.startswith("error:")]
    assert end.value.code == 2
    assert "none of 3 deformed images can be used; the first: " in line
    assert str(frames[0]) in line
    assert not (folder / "new").exists()


def test_spoilt_frames_are_skipped_each_with_its_reason(folder: Path) -> None:
    """A constant one, one of 16 bits, and one whose mask is of another size."""
    shape = photographed().grid.shape
    tifffile.imwrite(folder / "frame_1a.tif", np.full(shape, 90, dtype=np.uint8))
    deep = tifffile.imread(folder / "frame_2.tif").astype(np.uint16) * 257
    tifffile.imwrite(folder / "frame_1b.tif", deep)
    shutil.copy(folder / "frame_2.tif", folder / "frame_2a.tif")
    for path in sorted(folder.glob("frame_*.tif")):
        whole = SMALL if path.stem == "frame_2a" else np.full(shape, 255, dtype=np.uint8)
        tifffile.imwrite(folder / f"mask_{path.name}", whole)
    text(f"= {PITCH}", f'= {PITCH}\ndeformed_material = ["mask_*.tif"]')(folder)
    run = HarvestRun(PhotographCase.read(folder / "experiment.toml"), folder / "out")
    prepared = run.prepared
    assert prepared.names == ("frame_1", "frame_2", "frame_3")
    reasons = dict(prepared.skipped)
    assert "the constant grey level 90" in reasons["frame_1a.tif"]
    assert "16 bits" in reasons["frame_1b.tif"]
    assert "100 x 100" in reasons["frame_2a.tif"]
    assert not any("\n" in reason for reason in reasons.values())


def test_a_full_disk_skips_no_photograph(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case, write = PhotographCase.read(folder / "experiment.toml"), prepare.write_image

    def refused(path: Path, image: np.ndarray) -> None:
        if path.stem == "frame_2":
            raise WriteError(f"could not write {path}: No space left on device")
        write(path, image)

    monkeypatch.setattr(prepare, "write_image", refused)
    with pytest.raises(WriteError, match="No space left"):
        _ = HarvestRun(case, folder / "out").prepared
    monkeypatch.undo()
    prepared = HarvestRun(case, folder / "out").prepared
    assert (prepared.names, prepared.skipped) == (("frame_1", "frame_2", "frame_3"), ())


def test_fields_stay_with_their_photographs_when_one_is_skipped(folder: Path) -> None:
    """The files are counted by the photographs that were given, not by those that were left."""
    tifffile.imwrite(folder / "frame_2.tif", np.full(photographed().grid.shape, 90, dtype=np.uint8))
    grid = np.stack(np.meshgrid(np.arange(40, 210, 8), np.arange(40, 270, 8)), -1).reshape(-1, 2)
    for n in (1, 2, 3):
        points = np.column_stack(photographed().grid.to_mm(grid[:, 1], grid[:, 0]))
        u = of(ANSATZ, ANSATZ.initial_guess(0.02 * n, 0.0))(points) / PIXEL
        rows = np.column_stack([grid, u[:, 0], -u[:, 1]])
        header = "x [px],y [px],u [px],v [px]"
        np.savetxt(folder / f"f{n}.csv", rows, delimiter=",", header=header, comments="")
    tables('[local]\ncode = "file"\nfiles = ["f*.csv"]\ny_axis = "down"')(folder)
    run = HarvestRun(PhotographCase.read(folder / "experiment.toml"), folder / "out")
    results = run.results()
    assert list(results) == ["frame_1", "frame_3"]
    for n in (1, 3):
        local = results[f"frame_{n}"].local
        truth = of(ANSATZ, ANSATZ.initial_guess(0.02 * n, 0.0))(np.column_stack([local.x, local.y]))
        assert np.abs(local.u - truth).max() < 1e-6 * PITCH


def test_repeats_between_which_something_moved_are_reported() -> None:
    """Half a pixel looks like noise, but not like that of a single photograph."""
    shown = photographed()
    still, moved = (
        measured_noise([shown.image(), shown.image(state, exposure=1)], shown.mask)
        for state in (None, lambda points: np.full_like(points, 0.5 * PIXEL))
    )
    # The camera's noise and rounding to whole grey levels.
    assert still.sd == pytest.approx(np.hypot(NOISE, 12**-0.5), rel=0.05)
    assert "if anything moved" not in still.source
    assert moved.sd > 2 * still.sd
    assert "if anything moved" in moved.source


@pytest.mark.parametrize(
    ("radii", "words"),
    [((), "with no holes where 2 x 2 are needed"), ((20,), "with 1 hole where 2 x 2 are needed"),
     (None, "with no holes;")],
)  # fmt: skip
def test_a_plain_body_is_named_with_what_measures_it(
    radii: tuple[int, ...] | None, words: str
) -> None:
    row, col = np.mgrid[:200, :300]
    mask = np.ones((200, 300), dtype=bool)
    if radii is not None:
        mask = (abs(row - 100) < 80) & (abs(col - 150) < 120)
        for radius in radii:
            mask &= np.hypot(row - 100, col - 150) > radius
    with pytest.raises(InputError) as caught:
        find_geometry(mask, PixelGrid.centred(200, 300, 0.02), SpecimenTable(1.0), Path())
    size = "6 x 4 mm" if radii is None else "4.78 x 3.18 mm"
    assert f"got a body of {size} {words}" in str(caught.value)
    assert "'modeharvest measure REFERENCE DEFORMED... --pixel-size 0.02'" in str(caught.value)
