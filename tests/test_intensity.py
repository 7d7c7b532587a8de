"""Guards the grey levels: the analytic pattern at every pixel, by two routes of their own.

The routes are those of ``benchmarks/intensity.py``, which shows the same on the paper's specimen.
"""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from modeharvest.fem.field import Mesh
from modeharvest.imaging.camera import TOLERANCE
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.render import ImagedState
from modeharvest.imaging.sensor import Aperture
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "intensity.py"
GRID = PixelGrid.centred(71, 81, 0.125)
FLOAT32 = 6e-8  # rounding of an intensity up to 1


@pytest.fixture(scope="module")
def intensity() -> ModuleType:
    spec = importlib.util.spec_from_file_location("intensity", BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def quads() -> Mesh:
    """Nine Q9 elements over 7.5 mm x 7.5 mm, 20 px a side."""
    number = np.arange(49).reshape(7, 7)
    y, x = np.divmod(number.ravel(), 7)
    cells = []
    for j in (0, 2, 4):
        for i in (0, 2, 4):
            a = number[j : j + 3, i : i + 3]
            cells.append([*a[[0, 0, 2, 2], [0, 2, 2, 0]], *a[[0, 1, 2, 1, 1], [1, 2, 1, 0, 1]]])
    return Mesh((np.column_stack([x, y]) / 6 - 0.5) * 7.5, np.array(cells), "Q9")


def bent(mesh: Mesh) -> np.ndarray:
    x, y = mesh.nodes.T
    return 0.2 * np.column_stack([np.sin(y) - 0.3 * x, np.cos(1.3 * x)])


@pytest.mark.parametrize("unit", ["cycles/px", "rad/px"])
def test_deformed_images_show_the_analytic_pattern(intensity: ModuleType, unit: str) -> None:
    mesh = quads()
    speckle = Speckle(SpeckleSpec(seed=4, unit=unit), GRID.shape)  # type: ignore[arg-type]
    errors = intensity.point_errors(mesh, bent(mesh), GRID, speckle, 200)
    allowed = {"image (float32)": FLOAT32, "image before": speckle.spline.bound, "spectral": 1e-11}
    for what, error in errors.items():
        assert error < next(a for start, a in allowed.items() if what.startswith(start)), what


def test_averages_over_pixels_within_an_element_keep_their_promise(intensity: ModuleType) -> None:
    """And pixels that a kink of the deformation cuts are off by what a kink costs."""
    mesh = quads()
    imaged = ImagedState(mesh, bent(mesh), GRID, Speckle(SpeckleSpec(seed=4), GRID.shape), 0.0)
    points, errors = intensity.aperture_errors(imaged, Aperture(1.0), 7, 987)
    assert points == 9
    within, cut, hole = (
        errors[k] for k in ("within one element", "cut by an element's edge", "at a hole's edge")
    )
    assert min(within.size, cut.size, hole.size) > 150
    assert np.sqrt((within**2).mean()) <= TOLERANCE
    assert np.abs(within).max() <= 1e-6
    # A kink of some percent within a pixel, with slopes up to 0.15 of full scale a pixel.
    assert np.abs(cut).max() < 1e-3
    # Shares of a pixel good to 0.0047 rms, of a contrast up to 1.
    assert np.sqrt((hole**2).mean()) < 0.007
