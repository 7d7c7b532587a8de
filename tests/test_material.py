"""The material found in an image against the mask it was made with, on any background."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from modeharvest.idic.photograph.material import find_material, mixed_edge_px
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown

BoolArray = NDArray[np.bool_]

SHAPE, PITCH, RADIUS = (420, 460), 100.0, 38.0


def specimen() -> BoolArray:
    """A rectangle with 3 x 3 round holes, off the pixels' raster."""
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    mask = (abs(row - 209.3) < 185.0) & (abs(col - 230.7) < 200.0)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            mask &= np.hypot(row - 209.3 - i * PITCH, col - 230.7 - j * PITCH) > RADIUS
    return mask


def image(background: float, noise: float, mask: BoolArray, seed: int = 0) -> NDArray[np.float64]:
    speckle = Speckle(SpeckleSpec(standard_deviation=0.06, blur_px=2.0, seed=seed), SHAPE).image()
    random = np.random.default_rng(seed + 1)
    return np.where(mask, speckle, background) + noise * random.normal(size=SHAPE)


@pytest.mark.parametrize(
    ("lens_px", "noise", "low", "high"),
    [(0.0, 0.002, 1, 1), (0.0, 0.01, 1, 1), (0.7, 0.002, 2, 3), (0.7, 0.01, 2, 2),
     (1.2, 0.002, 3, 4), (1.2, 0.01, 2, 3)],
)  # fmt: skip
def test_rows_with_background_in_them(lens_px: float, noise: float, low: int, high: int) -> None:
    mask, random = specimen(), np.random.default_rng(1)
    for background in (0.0, 0.9):
        grey = image(background, 0.0, mask)
        grey = gaussian_filter(grey, lens_px) if lens_px else grey
        grey = grey + noise * random.normal(size=SHAPE)
        assert low <= mixed_edge_px(grey.astype(np.float32), mask) <= high
    too_large = mixed_edge_px(grey.astype(np.float32), grown(mask, 1.0))
    assert too_large == min(4, mixed_edge_px(grey.astype(np.float32), mask) + 1)
    everywhere = image(0.0, noise, np.ones(SHAPE, np.bool_)).astype(np.float32)
    assert mixed_edge_px(everywhere, mask) == 1  # a part of a surface is no edge of material
    assert mixed_edge_px(everywhere, np.ones(SHAPE, np.bool_)) == 1


def edge_distance(found: BoolArray, truth: BoolArray) -> NDArray[np.float64]:
    """Distances of wrong pixels from the true edge [px]; 0.5 next to it."""
    inside, outside = distance_transform_edt(truth), distance_transform_edt(~truth)
    return np.where(truth, inside, outside)[found != truth] - 0.5


# Share of wrong pixels: the edges are 3 900 px long, that is 2 % of the image for each px.
@pytest.mark.parametrize(
    ("background", "wrong", "far"),
    [
        (0.0, 0.002, 1.5),  # darker than every speckle: to the pixel
        (0.2, 0.006, 8.0),  # as dark as the dark speckles: lost where one of them is at an edge
        (0.5, 0.006, 8.0),
        (1.0, 0.006, 8.0),
    ],
)
def test_material_is_found_on_any_background(background: float, wrong: float, far: float) -> None:
    truth = specimen()
    found = find_material(image(background, 0.02, truth)).mask
    assert (found != truth).mean() < wrong
    assert edge_distance(found, truth).max(initial=0.0) < far


@pytest.mark.parametrize("scale", [1e-3, 255.0, 65535.0])
def test_units_of_the_grey_levels_do_not_matter(scale: float) -> None:
    grey = image(0.3, 0.01, specimen())
    one, other = find_material(grey).mask, find_material(scale * grey).mask
    assert (one != other).mean() < 1e-4  # float32 rounds differently


def test_turning_the_image_turns_the_mask() -> None:
    grey = image(0.1, 0.01, specimen())
    one, other = find_material(grey).mask, find_material(grey[::-1, ::-1].T).mask
    assert (one != other.T[::-1, ::-1]).mean() < 1e-3  # an even window has no middle


def test_uneven_lighting_does_not_matter() -> None:
    truth = specimen()
    light = np.linspace(0.6, 1.0, SHAPE[1]) * np.linspace(1.0, 0.8, SHAPE[0])[:, None]
    found = find_material(light * image(0.3, 0.01, truth)).mask
    assert (found != truth).mean() < 0.008


def test_noise_free_images_will_do() -> None:
    truth = specimen()
    for background in (0.0, 0.2, 1.0):
        assert (find_material(image(background, 0.0, truth)).mask != truth).mean() < 0.008


def test_walls_of_holes_out_of_focus_are_background() -> None:
    truth = specimen()
    grey = image(0.0, 0.01, truth)
    inward = distance_transform_edt(~truth)
    seen = ~truth & (inward < 24.0)  # at one side only, as of a hole in a thick specimen
    seen[:, 230:] = False
    blurred = gaussian_filter(Speckle(SpeckleSpec(seed=5), SHAPE).image(), 8.0)
    grey += np.where(seen, 0.6 * blurred * (1.0 - inward / 24.0), 0.0)
    material = find_material(grey)
    assert "out of focus" in material.text[-1]
    assert (seen & material.mask).sum() < 0.25 * seen.sum()
    # Paid for by some px at the edges there, which hide in the same window.
    assert (truth & ~material.mask).mean() < 0.01


def test_holes_that_a_window_hardly_fits_into_are_found() -> None:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    truth = (abs(row - 209.3) < 185.0) & (abs(col - 230.7) < 200.0)
    truth &= np.hypot((row + 20.0) % 60.0 - 30.0, (col + 10.0) % 60.0 - 30.0) > 16.0
    found = find_material(image(0.0, 0.02, truth)).mask
    assert (found != truth).mean() < 0.004  # one px along all edges would be 0.03


def test_flat_patches_of_coarse_speckles_are_material() -> None:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    truth = (abs(row - 209.3) < 185.0) & (abs(col - 230.7) < 200.0)
    truth &= np.hypot((row + 20.0) % 45.0 - 22.5, (col + 10.0) % 45.0 - 22.5) > 16.5
    for seed in (0, 4, 9):  # speckles of 12 px in windows of 9 px; the last has a wide bright one
        speckle = 0.25 + 0.7 * Speckle(SpeckleSpec(seed=seed), SHAPE).image()
        grey = np.where(truth, speckle, 0.08)
        grey += 0.008 * np.random.default_rng(seed).normal(size=SHAPE)
        assert (find_material(grey, 9).mask == truth).all()


@pytest.mark.parametrize("size_px", [4.0, 6.0])
def test_flat_speckles_at_edges_are_material(size_px: float) -> None:
    """Paint is black or white, flat within a speckle, and no wall of a hole out of focus."""
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    truth = (abs(row - 209.3) < 185.0) & (abs(col - 230.7) < 200.0)
    truth &= np.hypot((row + 20.0) % 48.0 - 24.0, (col + 10.0) % 48.0 - 24.0) > 17.5
    random = np.random.default_rng(7)
    waves = gaussian_filter(random.normal(size=SHAPE), size_px / 2.35)
    paint = 140.0 + 80.0 * np.tanh(4.0 * waves / waves.std())
    grey = np.where(truth, paint, 25.0) + 2.0 * random.normal(size=SHAPE)
    assert (find_material(grey, 9).mask != truth).mean() < 2e-3  # 1 and 4 % were lost


def test_without_a_background_all_is_material_and_that_is_reported() -> None:
    material = find_material(image(0.0, 0.01, np.ones(SHAPE, dtype=bool)))
    assert material.mask.all()
    assert "whole image" in material.text[0]


def test_background_like_the_speckle_is_reported() -> None:
    warnings = find_material(image(0.5, 0.03, specimen())).text
    assert any("grey levels of the background" in message for message in warnings)


def test_bad_images_are_refused() -> None:
    with pytest.raises(InputError, match="constant grey level"):
        find_material(np.full((100, 100), 3.0))
    with pytest.raises(InputError, match="at least 50 px"):
        find_material(np.zeros((30, 100)))
    with pytest.raises(InputError, match="NaN"):
        find_material(np.full((100, 100), np.nan))
    with pytest.raises(InputError, match="window of 5 px or more"):
        find_material(image(0.3, 0.01, specimen()), 4)


@settings(max_examples=50, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 25), st.integers(1, 25)),
    share=st.sampled_from([0.0, 0.02, 0.3, 1.0]),
    px=st.sampled_from([0.0, 0.7, 1.0, 2.0**0.5, 2.0, 5.0**0.5, 4.3, 30.0]),
    seed=st.integers(0, 2**16),
)
def test_masks_grow_by_a_distance(
    shape: tuple[int, int], share: float, px: float, seed: int
) -> None:
    mask = np.random.default_rng(seed).random(shape) < share
    near = distance_transform_edt(~mask) <= px if mask.any() else mask
    np.testing.assert_array_equal(grown(mask, px), near)
    np.testing.assert_array_equal(grown(mask.T, px), near.T)
