"""From files of a camera to modes: the whole path, and what is wrong with files."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from modeharvest.cli.root import app
from modeharvest.fem.field import Solution
from modeharvest.idic.result import Result
from modeharvest.idic.solver.noise import estimated_noise, measured_noise
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.report.figures import style
from modeharvest.runs.case import shipped_solution
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun, harvest
from modeharvest.runs.photographs.sequence import named_files
from modeharvest.util.errors import InputError

pytestmark = pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")

PIXEL, NOISE = 0.05, 0.01
EXPERIMENT = f"""
title = "A test"
[images]
reference = "reference.tif"
deformed = ["frame_*.tif"]
[scale]
pixel_size = {PIXEL}
[specimen]
cell_size = 1.9
"""


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageSet:
    """The paper's specimen before and after buckling, by a noisy camera."""
    path = shipped_solution("paper-virtual")
    spec = ImagingSpec(pixel_size=PIXEL, background=0.1, sensor=Sensor(read_noise=NOISE))
    folder = tmp_path_factory.mktemp("images")
    return make_images(Solution.read(path), spec, folder, (0.078, 0.128))


@pytest.fixture(scope="module")
def photographs(images: ImageSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that a user would have."""
    folder = tmp_path_factory.mktemp("photographs")
    shutil.copy(images.folder / "reference_8bit.tif", folder / "reference.tif")
    shutil.copy(images.folder / "deformed_0780_8bit.tif", folder / "frame_1.tif")
    shutil.copy(images.folder / "deformed_1280_8bit.tif", folder / "frame_2.tif")
    (folder / "experiment.toml").write_text(EXPERIMENT)
    return folder


@pytest.fixture(scope="module")
def harvested(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished harvest."""
    out = tmp_path_factory.mktemp("harvest")
    with pytest.MonkeyPatch.context() as patch:  # no test here is about pictures
        patch.setattr(style, "to_svg", lambda *_, **__: "<svg></svg>")
        harvest(photographs / "experiment.toml", out)
    return out


def summary(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "summary.json").read_text()))


def experiment(photographs: Path, folder: Path, **changes: str) -> Path:
    """Another experiment with the same photographs, some of its text replaced."""
    text = EXPERIMENT
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    for path in photographs.glob("*.tif"):
        shutil.copy(path, folder)
    (folder / "experiment.toml").write_text(text)
    return folder / "experiment.toml"


def test_the_pattern_is_found_with_no_number_typed(harvested: Path, images: ImageSet) -> None:
    before, after = summary(harvested)["frames"]
    assert (before["has_pattern"], after["has_pattern"]) == (False, True)
    assert before["modes"][0]["fixed"]
    (mode,) = after["modes"]
    # Asked of the identified wave vectors: within 1 %.
    for wave, ideal in zip(mode["waves"], ((0.5, 0.5), (-0.5, 0.5)), strict=True):
        assert wave["xi"] == pytest.approx(ideal, rel=0.01)
    found = Result.read(harvested / "results" / "frame_2.json")
    mask = images.mask()
    w = (images.truth(0.128).displacement - found.displacement())[mask] / PIXEL
    # The best fit of the paper's ansatz leaves 2.0 px per component at 0.01 mm/px, so 0.40 here;
    # the IDIC is 0.12 times that away from it.
    assert np.sqrt(np.nanmean(w**2)) < 0.45


def test_a_result_has_the_error_bars_of_the_summary(harvested: Path) -> None:
    found = Result.read(harvested / "results" / "frame_2.json")
    assert found.errors is not None
    both = {"sd_noise": found.errors.by_noise, "sd_model_error": found.errors.by_model_error}
    (mode,) = summary(harvested)["frames"][1]["modes"]
    for name, C in both.items():
        assert C is not None
        sd = np.sqrt(np.diag(C))[found.ansatz.phi_slice(0)]
        assert [p[name] for p in mode["parameters"]] == pytest.approx(sd.tolist(), rel=1e-6)


def test_the_noise_is_measured(harvested: Path) -> None:
    found = summary(harvested)["noise"]
    # Read noise and rounding; the estimate from one image is good to some per cent.
    assert found["sd"] == pytest.approx(np.hypot(255 * NOISE, 1 / np.sqrt(12)), rel=0.06)


@pytest.mark.usefixtures("undrawn_pictures")
def test_again_repeats_nothing(harvested: Path, photographs: Path) -> None:
    files = [*harvested.glob("results/*"), *harvested.glob("prepared/*")]
    before = {path: path.stat().st_mtime_ns for path in files}
    experiment = PhotographCase.read(photographs / "experiment.toml")
    results = HarvestRun(experiment, harvested).results()
    assert list(results) == ["frame_1", "frame_2"]
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in before.items())


@pytest.mark.usefixtures("undrawn_pictures")
def test_an_interrupted_harvest_goes_on(harvested: Path, photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(harvested, out)
    (out / "results" / "frame_2_start.json").unlink()  # written last
    kept = (out / "results" / "frame_1.json").stat().st_mtime_ns
    experiment = PhotographCase.read(photographs / "experiment.toml")
    HarvestRun(experiment, out).results()
    assert (out / "results" / "frame_1.json").stat().st_mtime_ns == kept
    again, first = (Result.read(f / "results" / "frame_2.json") for f in (out, harvested))
    assert np.array_equal(again.unknowns, first.unknowns)


def test_damaged_and_foreign_frames_are_skipped_and_reported(
    photographs: Path, images: ImageSet, tmp_path: Path
) -> None:
    path = experiment(photographs, tmp_path)
    whole = (tmp_path / "frame_1.tif").read_bytes()
    (tmp_path / "frame_1a.tif").write_bytes(whole[: len(whole) // 2])
    mask = images.deformed_mask(0.078)
    other = Speckle(SpeckleSpec(seed=99), mask.shape).image()
    for name, shown in (("frame_1b.tif", other * mask), ("frame_1c.tif", other)):
        tifffile.imwrite(tmp_path / name, np.rint(255 * shown).astype(np.uint8))
    harvesting = HarvestRun(PhotographCase.read(path), tmp_path / "out")
    assert list(harvesting.results()) == ["frame_1", "frame_2"]
    ((damaged, why),) = harvesting.prepared.skipped
    assert damaged == "frame_1a.tif"
    assert "frame_1a.tif" in why
    failures = dict(harvesting.failures())
    assert set(failures) == {"frame_1b", "frame_1c"}
    for reason in failures.values():
        assert "reference is not the reference" in reason
        assert "\n" not in reason


@pytest.mark.usefixtures("undrawn_pictures")
def test_the_updated_formulation_agrees_with_the_total_one(
    photographs: Path, harvested: Path, tmp_path: Path
) -> None:
    experiment = PhotographCase.read(photographs / "experiment.toml")
    updated = experiment.model_copy(
        update={"correlation": replace(experiment.correlation, formulation="updated")}
    )
    results = HarvestRun(updated, tmp_path).results()
    first = Result.read(harvested / "results" / "frame_2.json")
    apart = (results["frame_2"].result.displacement() - first.displacement()) / PIXEL
    # It inherits what the frame before couldn't describe: w of 0.21 px rms there.
    assert 0 < np.sqrt(np.mean(apart[120:-120, 90:-90] ** 2)) < 0.21


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cell_size = 1.9", "cell_size = 2.3", "cell"),
        ("cell_size = 1.9", "cel_size = 1.9", "did you mean 'cell_size'"),
        ("frame_\\*.tif", "nothing_*.tif", "expected files that match"),
        ("reference.tif", "no.tif", "found no such file"),
        (f"pixel_size = {PIXEL}", "line = [[0, 0], [0, 0]]\nlength = 1.0", "two different ends"),
    ],
)
def test_bad_experiments_are_one_line(
    photographs: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = experiment(photographs, tmp_path, **{old.replace("\\", ""): new})
    ran = CliRunner().invoke(app, ["harvest", str(path), "--out", str(tmp_path / "out")])
    assert isinstance(ran.exception, InputError)
    assert message in str(ran.exception)
    assert "\n" not in str(ran.exception)


def test_a_blank_reference_is_refused(photographs: Path, tmp_path: Path) -> None:
    path = experiment(photographs, tmp_path)
    shape = tifffile.imread(tmp_path / "reference.tif").shape
    tifffile.imwrite(tmp_path / "reference.tif", np.full(shape, 17, dtype=np.uint8))
    with pytest.raises(InputError, match=r"reference\.tif"):
        harvest(path, tmp_path / "out")


def test_names_that_would_collide_are_refused(tmp_path: Path) -> None:
    for name in ("a.tif", "a.png"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="names differ"):
        named_files(tmp_path, ["a.*"])


def test_noise_from_repeats_and_from_one_image() -> None:
    rng = np.random.default_rng(0)
    speckle = 255 * Speckle(SpeckleSpec(), (300, 300)).image()
    mask = np.ones((300, 300), dtype=np.bool_)
    images = [speckle + k + 2.0 * rng.normal(size=speckle.shape) for k in range(3)]
    # Two variances of 9e4 pixels; the one image's share of speckle in its finest details is 1 %.
    assert measured_noise(images, mask).sd == pytest.approx(2.0, rel=0.01)
    assert estimated_noise(images[0], mask).sd == pytest.approx(2.0, rel=0.02)
