"""Slender specimens: strips that stand obliquely in the picture, with noise of 3 %."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
from test_cli import called

from modeharvest.idic.finite_element.files import read_result
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.measure import measure
from modeharvest.util.errors import InputError

STRETCH = np.array([[0.02, 0.0], [0.0, -0.008]])
SHIFT = np.array([2.3, -1.15])


def axes_of(turn: float) -> np.ndarray:
    a = np.radians(turn)
    return np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])


def strip(
    folder: Path, turn: float, stretch: np.ndarray, length: float = 360.0, width: float = 40.0,
    finer: float = 2.0,
) -> None:  # fmt: skip
    """Photographs of a strip turned counter-clockwise [degrees], before and after its motion."""
    a = np.radians(turn)
    rows, cols = 140 + int(length * np.sin(a)), 60 + int(length * np.cos(a))
    y, x = np.mgrid[:rows, :cols].astype(float) - np.array([rows - 1, cols - 1])[:, None, None] / 2
    axes = axes_of(turn)
    speckle = Speckle(SpeckleSpec(seed=1), (rows, cols))
    for n, name in enumerate(("ref", "def")):
        now = np.stack([x, -y], axis=-1)
        X = (now - n * SHIFT) @ np.linalg.inv(np.eye(2) + n * stretch).T
        along, across = np.moveaxis(X @ axes.T, -1, 0)
        shown = (abs(along) < length / 2) & (abs(across) < width / 2)
        levels = 50.0 + 160.0 * speckle(-finer * X[..., 1] + rows / 2, finer * X[..., 0] + cols / 2)
        noise = 0.03 * 255 * np.random.default_rng(n).normal(size=levels.shape)
        levels = np.clip(np.rint(np.where(shown, levels, 20.0) + noise), 0, 255)
        tifffile.imwrite(folder / f"{name}.tif", levels.astype(np.uint8))


@pytest.mark.parametrize("turn", [0.0, 12.0, 40.0])
def test_a_strip_is_measured_wherever_it_points(tmp_path: Path, turn: float) -> None:
    strip(tmp_path, turn, STRETCH)
    summary = measure(tmp_path / "ref.tif", [str(tmp_path / "def.tif")], tmp_path / "out")
    result = read_result(tmp_path / "out/results/def.h5")
    off = result.displacement - (result.mesh.nodes @ STRETCH.T + SHIFT)
    assert np.sqrt(np.mean(off**2)) < 0.05  # standard deviations are about 0.02 px
    assert summary["images"][0]["warnings"] == []


@pytest.mark.parametrize("strain", [0.05, 0.15])
def test_two_coarse_speckles_across_a_strip_suffice(tmp_path: Path, strain: float) -> None:
    """Of 33 px; it was refused, because blocks of a single speckle were found anywhere."""
    stretch = np.diag([strain, -0.45 * strain])
    strip(tmp_path, 0.0, stretch, 600.0, 60.0, finer=0.4)
    measure(tmp_path / "ref.tif", [str(tmp_path / "def.tif")], tmp_path / "out")
    result = read_result(tmp_path / "out/results/def.h5")
    off = result.displacement - (result.mesh.nodes @ stretch.T + SHIFT)
    assert np.median(np.linalg.norm(off, axis=1)) < 1.5


def test_strains_are_along_the_specimens_own_axes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    axes = axes_of(12.0)
    strip(tmp_path, 12.0, axes.T @ STRETCH @ axes, width=90.0)
    (tmp_path / "gauges.toml").write_text(
        '[[gauges]]\nname = "A"\npolygon = [[-40, -30], [40, -30], [40, 30], [-40, 30]]\n'
        '[[gauges]]\nname = "L"\nline = [[-40, 0], [40, 0]]\n'
        '[[gauges]]\nname = "P"\npoint = [0, 0]\nangle = 0\n'
    )
    files = tmp_path / "ref.tif", [str(tmp_path / "def.tif")], tmp_path / "out"
    (note,) = measure(*files)["notes"]
    found = re.search(r"turned by (\S+)° .* --angle", note)
    assert found
    assert float(found[1]) == pytest.approx(12.0, abs=0.5)
    summary = measure(*files, angle=12.0, gauges=tmp_path / "gauges.toml")
    assert summary["notes"] == []
    assert "--angle 12" in summary["command"]
    (image,) = summary["images"]
    assert (image["strain_x"], image["strain_y"]) == pytest.approx((0.02, -0.008), abs=5e-4)
    read = {(row["gauge"], row["reads"]): row["value"] for row in summary["gauges"]}
    assert read["A", "strain_11"] == pytest.approx(np.log(1.02), abs=1e-3)
    assert read["A", "strain_22"] == pytest.approx(np.log(0.992), abs=1e-3)
    assert read["A", "strain_12"] == pytest.approx(0.0, abs=1e-3)
    assert ("L", "engineering_strain") in read
    before = (tmp_path / "out/gauges.csv").read_text()
    assert called(monkeypatch, "gauges", tmp_path / "out", tmp_path / "gauges.toml") == 0
    assert (tmp_path / "out/gauges.csv").read_text() == before
    assert read["P", "strain_11"] < 0.0195  # its own angle counts
    assert "the specimen’s axis, 12° to x" in (tmp_path / "out/report.html").read_text("utf-8")
    with pytest.raises(InputError, match=r"--angle: expected .* got 192; the same axis is at 12$"):
        measure(*files, angle=192.0)
