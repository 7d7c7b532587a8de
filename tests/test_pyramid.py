"""Coarser pairs: nothing of a hole leaks into the material, positions stay where they are."""

from __future__ import annotations

import manufactured
import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.idic.solver.pyramid import COARSE_TO_FINE, Level, LevelPair, eroded, level_pair
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError

GRID = PixelGrid(203, 165, 0.013, -0.9, 1.4)  # divisible by none of the binnings
ROW, COL = np.indices(GRID.shape)
EACH_LEVEL = pytest.mark.parametrize("level", COARSE_TO_FINE, ids=lambda level: str(level.factor))
FLOAT32 = 1e-6


def perforated(shift: int = 0) -> NDArray[np.bool_]:
    mask = (ROW > 8) & (COL < 158)
    for row in (50, 100, 150):
        for col in (40, 90, 135):
            mask &= np.hypot(ROW - row, COL - col - shift) > 17
    return mask


def coarse(
    f: NDArray[np.float64],
    g: NDArray[np.float64],
    level: Level,
    mask: NDArray[np.bool_] | None = None,
    g_mask: NDArray[np.bool_] | None = None,
) -> LevelPair:
    return level_pair(ImagePair(f, g, GRID, mask, g_mask), level, edge_px=3, order=5)


def seen(pair: LevelPair) -> NDArray[np.float64]:
    """G at its own pixels."""
    row, col = np.indices(pair.grid.shape)
    return pair.deformed.sample(row, col)[0]


@EACH_LEVEL
@pytest.mark.parametrize("outside", [0.0, 1e3, -50.0])
def test_a_constant_material_stays_constant_whatever_is_outside(
    level: Level, outside: float
) -> None:
    mask, g_mask = perforated(), perforated(4)
    material = 0.7 * (1.0 + 1e-7 * (np.indices(GRID.shape).sum(axis=0) % 2))  # no pair is blank
    f, g = (np.where(m, material, outside) for m in (mask, g_mask))
    pair = coarse(f, g, level, mask, g_mask)
    np.testing.assert_allclose(pair.reference[pair.mask], 0.7, rtol=FLOAT32)
    # In g the holes are filled, so it is constant everywhere.
    np.testing.assert_allclose(seen(pair), 0.7, rtol=60 * FLOAT32)  # quintic coefficients


@EACH_LEVEL
def test_nothing_depends_on_grey_levels_outside_the_material(level: Level) -> None:
    mask, g_mask = perforated(), perforated(4)
    rng = np.random.default_rng(0)
    f, g = rng.uniform(size=(2, *GRID.shape))
    first = coarse(f, g, level, mask, g_mask)
    again = coarse(np.where(mask, f, 9.0), np.where(g_mask, g, -9.0), level, mask, g_mask)
    inside = first.mask
    np.testing.assert_array_equal(first.reference[inside], again.reference[inside])
    np.testing.assert_array_equal(first.deformed.coefficients, again.deformed.coefficients)


@EACH_LEVEL
def test_a_linear_image_stays_linear(level: Level) -> None:
    grid = PixelGrid(403, 365, 0.006, -0.9, 1.4)
    f = 0.3 + 0.2 * grid.x + 0.5 * grid.y[:, None]
    pair = level_pair(ImagePair(f, 2 * f, grid), level, edge_px=3, order=5)
    expected = 0.3 + 0.2 * pair.grid.x + 0.5 * pair.grid.y[:, None]
    margin = int(np.ceil(4 * level.blur)) + 1  # scipy's Gaussian ends at 4 standard deviations
    inner = (slice(margin, -margin),) * 2 if level.blur else (slice(None),) * 2
    assert pair.reference[inner].size > 400
    np.testing.assert_allclose(pair.reference[inner], expected[inner], atol=3 * FLOAT32)
    # The spline is global, but what the borders do to it fades by 0.43 a pixel.
    np.testing.assert_allclose(seen(pair)[inner], 2 * expected[inner], atol=60 * FLOAT32)


def test_binning_without_blur_is_the_mean_of_blocks() -> None:
    f = np.random.default_rng(1).uniform(size=GRID.shape)
    pair = coarse(f, f, Level(4, 0.0))
    assert pair.grid == GRID.binned(4)
    assert pair.reference.shape == pair.mask.shape == pair.grid.shape == (50, 41)
    assert pair.reference[3, 2] == pytest.approx(f[12:16, 8:12].mean(), rel=FLOAT32)


def test_the_finest_level_leaves_the_material_untouched_and_fills_the_holes() -> None:
    mask, g_mask = perforated(), perforated(4)
    rng = np.random.default_rng(2)
    f, g = rng.uniform(0.2, 1.0, size=(2, *GRID.shape))
    pair = coarse(f, np.where(g_mask, g, 50.0), COARSE_TO_FINE[-1], mask, g_mask)
    np.testing.assert_array_equal(pair.reference[mask], f.astype(np.float32)[mask])
    np.testing.assert_allclose(seen(pair)[g_mask], g[g_mask], atol=60 * FLOAT32)
    # The filling continues the material, so it lies between its grey levels.
    filled = seen(pair)[~g_mask]
    assert filled.min() > 0.2 - 60 * FLOAT32
    assert filled.max() < 1.0 + 60 * FLOAT32


def test_pixels_of_the_finest_level_keep_their_distance_from_the_edges() -> None:
    mask, g_mask = perforated(), perforated(4)
    f = np.random.default_rng(3).uniform(size=GRID.shape)
    pair = coarse(f, f, COARSE_TO_FINE[-1], mask, g_mask)
    np.testing.assert_array_equal(pair.mask, eroded(mask, 3))
    assert pair.valid is not None
    inner = (slice(8, -8),) * 2
    np.testing.assert_array_equal(pair.valid[inner], eroded(g_mask, 2)[inner])


@pytest.mark.parametrize(("order", "shape", "border"), [(5, (150, 140), 8), (3, (90, 140), 5),
                                                        (5, (150, 80), 5)])  # fmt: skip
def test_pixels_of_the_finest_level_keep_their_distance_from_the_border(
    order: int, shape: tuple[int, int], border: int
) -> None:
    """Where what lies beyond is felt by more than 0.2 %: 0.43^8 and 0.27^5 are 0.12 and 0.14 %."""
    f = np.random.default_rng(3).uniform(size=shape)
    grid = PixelGrid.centred(*shape, 1.0)
    pair = level_pair(ImagePair(f, f, grid), COARSE_TO_FINE[-1], edge_px=3, order=order)
    expected = np.zeros(shape, dtype=np.bool_)
    expected[border:-border, border:-border] = True
    np.testing.assert_array_equal(pair.valid, expected)
    assert pair.mask.all()


def test_without_the_deformed_mask_the_reference_is_not_normalised_either() -> None:
    """Else the holes would look different in the two images."""
    mask = perforated()
    f = np.where(mask, np.random.default_rng(4).uniform(size=GRID.shape), 0.0)
    level = COARSE_TO_FINE[1]
    pair, plain = coarse(f, f, level, mask), coarse(f, f, level)
    np.testing.assert_array_equal(pair.reference, plain.reference)
    assert pair.valid is None
    assert pair.mask.sum() < plain.mask.sum()


def test_erosion_by_a_square_not_by_the_image_border() -> None:
    mask = np.ones((9, 11), dtype=np.bool_)
    mask[4, 5] = False
    expected = np.ones_like(mask)
    expected[2:7, 3:8] = False
    np.testing.assert_array_equal(eroded(mask, 2), expected)
    np.testing.assert_array_equal(eroded(mask, 0), mask)
    assert eroded(np.ones((4, 4), dtype=np.bool_), 3).all()
    assert not eroded(np.zeros((4, 4), dtype=np.bool_), 1).any()


def test_the_same_blur_acts_on_both_images() -> None:
    """A pattern that only moved by whole binned pixels still matches itself, level by level."""
    pattern = manufactured.CosinePattern.random(3)
    x, y = np.meshgrid(GRID.x, GRID.y)
    f, g = pattern(x, y), pattern(x - 8 * GRID.pixel_size, y)
    for level in COARSE_TO_FINE[1:]:
        pair = coarse(f, g, level)
        shift = 8 // level.factor
        inner = (slice(13, -13), slice(13, -13 - shift))
        moved = np.roll(seen(pair), -shift, axis=1)
        np.testing.assert_allclose(pair.reference[inner], moved[inner], atol=1e-5)


def test_bad_level() -> None:
    for factor, blur in ((0, 1.0), (2, -1.0)):
        with pytest.raises(InputError, match="binning of at least 1 px"):
            Level(factor, blur)
