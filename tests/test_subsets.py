"""Subset DIC by pyvale: what is asked of it, what it answers, and how sure that is.

pyvale is optional; the tests that run it are skipped where it is missing.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.subsets import (
    WHERE,
    SubsetOptions,
    predicted_sd,
    pyvale_python,
    speckle_area,
    subset_field,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.errors import InputError, MissingDependencyError

GRID = PixelGrid.centred(160, 200, 0.05)
MASK = np.hypot(GRID.x[None, :] - 1.0, GRID.y[:, None]) > 1.2


def speckle(seed: int = 0, blur: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(GRID.shape)
    image = ndimage.gaussian_filter(noise, blur)
    return np.asarray(0.5 + 0.15 * image / image.std(), dtype=np.float32)


def pair() -> tuple[np.ndarray, np.ndarray]:
    """f, and g with f(x) = g(x + u), u = 0.11 mm + 2 % x along x: f is sampled from g."""
    g = speckle()
    row, col = np.indices(GRID.shape).astype(float)
    x, _ = GRID.to_mm(row, col)
    value, _, _ = SplineImage.of(g, 5).sample(row, col + (0.11 + 0.02 * x) / GRID.pixel_size)
    return np.where(np.isfinite(value), value, 0.5).astype(np.float32), g


def stand_in(folder: Path, answer: str, code: int = 0) -> Path:
    """A "Python" that does what pyvale would: leaves a file, or fails."""
    script = folder / "python"
    script.write_text(
        f"#!{sys.executable}\nimport sys\nfrom pathlib import Path\n"
        f"answer = {answer!r}\n"
        "if answer: (Path(sys.argv[2]) / 'subsets_0.csv').write_text(answer)\n"
        f"else: print('RuntimeError: Seed subset failed', file=sys.stderr)\nsys.exit({code})\n"
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return script


def test_what_pyvale_writes_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pixels with y down become mm with y up; what it gave up stays, as not valid."""
    rows = ["20,40,1.5,-0.5,1.58,1,0.999,0,0,4", "25,40,nan,nan,nan,0,nan,nan,nan,40"]
    header = '"subset_x","subset_y","disp_u","disp_v","disp_mag","converged","cost_zncc","ftol",'
    answer = "\n".join([header + '"xtol","num_iter",', *rows])
    monkeypatch.setenv(WHERE, str(stand_in(tmp_path, answer)))
    field = subset_field(ImagePair(*pair(), GRID, MASK))
    assert field.lost == 1
    np.testing.assert_allclose(field.u[0], [1.5 * 0.05, 0.5 * 0.05], atol=1e-12)
    np.testing.assert_allclose([field.x[0], field.y[0]], GRID.to_mm(40, 20))
    assert field.sd is not None
    assert np.all(field.sd[0] > 0)
    assert field.source == "pyvale, subsets of 21 px"


def test_a_failure_of_pyvale_is_reported_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(WHERE, str(stand_in(tmp_path, "", code=1)))
    with pytest.raises(InputError, match="got none: RuntimeError: Seed subset failed"):
        subset_field(ImagePair(*pair(), GRID, MASK))


def test_without_pyvale_the_way_to_it_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WHERE, "/nowhere/python")
    with pytest.raises(MissingDependencyError, match="found no file /nowhere/python"):
        pyvale_python()
    monkeypatch.delenv(WHERE)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"docs/how-to/fields\.md"):
        pyvale_python()


def test_predicted_errors_are_those_of_white_noise_in_ideal_subsets() -> None:
    """Least squares by hand on subsets that were not moved: its scatter is what is predicted."""
    f = speckle(blur=1.0).astype(float)
    sigma, n, half = 0.02, 21, 10
    rng = np.random.default_rng(5)
    centres = [(r, c) for r in range(20, 140, 22) for c in range(20, 90, 22)]
    down, right = np.gradient(f)
    found, correlations = [], []
    for _ in range(40):
        g = f + sigma * rng.standard_normal(f.shape)
        for r, c in centres:
            part = np.s_[r - half : r + half + 1, c - half : c + half + 1]
            columns = np.column_stack([right[part].ravel(), down[part].ravel()])
            found.append(-np.linalg.lstsq(columns, (g - f)[part].ravel(), rcond=None)[0])
            correlations.append(np.corrcoef(f[part].ravel(), g[part].ravel())[0, 1])
    scatter = np.std(found, axis=0) * GRID.pixel_size
    x, y = GRID.to_mm(*np.array(centres * 40).T.astype(float))
    field = LocalField(x, y, np.zeros((len(x), 2)))
    mask = np.ones(GRID.shape, dtype=bool)
    sd = predicted_sd(f, mask, GRID, field, np.array(correlations), n)
    # White noise has one value a pixel, not one a speckle: that factor apart, 3 % of 960 values.
    white = np.sqrt(np.mean(sd**2, axis=0) / speckle_area(f - f.mean(), mask))
    np.testing.assert_allclose(white, scatter, rtol=0.08)


def test_speckles_are_as_large_as_their_autocorrelation() -> None:
    """Of noise blurred by s it is a Gaussian of s √2, at half height after 1.665 s."""
    mask = np.ones(GRID.shape, dtype=bool)
    for blur in (2.0, 4.0):
        image = speckle(blur=blur).astype(float)
        radius = np.sqrt(speckle_area(image - image.mean(), mask) / np.pi)
        assert 1.665 * blur - 1.0 <= radius <= 1.665 * blur + 1.5  # whole pixels, and chance


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"subset_px": 20}, "an odd subset"),
        ({"step_px": 30}, "a step of 1 px up to it"),
        ({"shape": "cubic"}, "'affine', 'quad' or 'rigid'"),
        ({"filling": 0.0}, "a filling in"),
    ],
)
def test_bad_options_are_named(values: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        SubsetOptions(**values)  # type: ignore[arg-type]


def test_material_too_narrow_for_a_subset_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(WHERE, str(stand_in(tmp_path, "")))
    narrow = np.zeros(GRID.shape, dtype=bool)
    narrow[:, 50:60] = True
    with pytest.raises(InputError, match="take smaller subsets"):
        subset_field(ImagePair(*pair(), GRID, narrow))


@pytest.mark.skipif(not os.environ.get(WHERE), reason=f"needs pyvale; {WHERE} says where")
def test_pyvale_measures_a_known_field() -> None:
    f, g = pair()
    inner = MASK.copy()
    inner[:, -12:] = False  # leaves the image there
    field = subset_field(ImagePair(f, g, GRID, inner), SubsetOptions(step_px=8, threads=1))
    assert field.valid_share > 0.95
    expected = np.column_stack([0.11 + 0.02 * field.x, np.zeros_like(field.x)])
    error = (field.u - expected)[field.good] / GRID.pixel_size
    # An affine subset can follow it; what is left is interpolation, 1e-2 px at the most.
    assert np.sqrt(np.mean(error**2)) < 0.01
