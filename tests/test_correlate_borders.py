"""Pixels that don't count must not count: masked ones, and those that leave the image."""

from __future__ import annotations

from functools import cache

import manufactured
import numpy as np
import pytest
from manufactured import PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Outcome
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GRID = PixelGrid.centred(150, 140, PIXEL)
ANSATZ = Ansatz(Box.centred(1.4, 1.5), v0_degree=2)
STRAIN, SHIFT_PX = 0.01, 12
TIGHT = CorrelationOptions(
    levels=(Level(1, 0.0),), gauss_newton=GaussNewtonOptions(tolerance_px=1e-8, max_iterations=99)
)
SEEDS = range(3)
FLOAT_PX = 2e-6
"""Float32 pixels are rounded by 6e-8, their slope is 0.05 per px."""


@cache
def truth() -> FloatArray:
    """A shift by 12 px to the right, and everything else disturbed."""
    a = ANSATZ.initial_guess(STRAIN)
    a += 0.003 * np.random.default_rng(0).normal(size=a.size)
    a[0] += SHIFT_PX * PIXEL
    return a


@cache
def images(seed: int) -> tuple[FloatArray, FloatArray]:
    speckle = manufactured.speckle(seed, GRID)
    return manufactured.image_pair(speckle, ANSATZ, truth(), GRID)


@cache
def landing() -> FloatArray:
    """(rows, cols) how far inside the image the pixels of f land in g [px]; < 0 is outside."""
    u = ANSATZ.displacement(truth(), GRID.x, GRID.y) / PIXEL
    row, col = np.indices(GRID.shape)
    row, col = row - u[..., 1], col + u[..., 0]
    return np.minimum.reduce([row, GRID.rows - 1 - row, col, GRID.cols - 1 - col])


def error_px(found: FloatArray, where: BoolArray) -> float:
    apart = (found - ANSATZ.displacement(truth(), GRID.x, GRID.y))[where]
    return float(np.sqrt((apart**2).sum(axis=-1).mean()) / PIXEL)


@pytest.mark.parametrize("seed", SEEDS)
def test_without_those_that_land_at_the_border_the_error_is_that_of_float_images(seed: int) -> None:
    """A spline feels the border by 0.43 a pixel: 1e-4 of it are left after 10 px."""
    mask = landing() > 10
    found = correlate(
        ImagePair(*images(seed), GRID, mask), ANSATZ, guess=ANSATZ.initial_guess(STRAIN)
    )
    assert found.outcome is Outcome.CONVERGED
    assert found.outside_image == 0
    assert error_px(found.displacement(), mask) < 1e-4  # GaussNewtonOptions.tolerance_px
    tight = correlate(
        ImagePair(*images(seed), GRID, mask), ANSATZ, guess=found.unknowns, options=TIGHT
    )
    assert error_px(tight.displacement(), mask) < FLOAT_PX


@pytest.mark.parametrize("seed", SEEDS)
def test_a_strip_that_leaves_the_image_does_not_pull(seed: int) -> None:
    """Without any mask: what leaves is counted, and what lands at the border takes no part.

    Pixels that land within 8 px of the border would be sampled from a spline that feels the
    mirror image beyond it: with them the displacement was off by 4e-3 to 5e-3 px.
    """
    found = correlate(
        ImagePair(*images(seed), GRID), ANSATZ, guess=ANSATZ.initial_guess(STRAIN), options=TIGHT
    )
    assert found.outcome is Outcome.CONVERGED
    left, at_border = landing() < 0, (landing() >= 0) & (landing() < 7.5)
    assert 0.05 * GRID.rows * GRID.cols < left.sum()
    assert found.outside_image == pytest.approx(left.sum(), abs=3)
    assert found.pixels == pytest.approx((~left & ~at_border).sum(), rel=1e-3)
    # By then the border's pull has fallen to 0.43^7.5 = 0.002 of those 5e-3 px.
    assert error_px(found.displacement(), ~left) < 1e-5


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_behind_a_mask_is_never_looked_at(seed: int) -> None:
    """Whatever the grey levels there, the result is the same to the last bit."""
    f, g = images(seed)
    f_mask, g_mask = holes(), moved_holes()
    found = []
    for filling in (0.0, 1e3, None):
        rng = np.random.default_rng(5)
        f_rest, g_rest = (np.full(GRID.shape, filling) if filling is not None
                          else rng.normal(size=GRID.shape) for _ in range(2))  # fmt: skip
        filled = np.where(f_mask, f, f_rest), np.where(g_mask, g, g_rest)
        start = ANSATZ.initial_guess(STRAIN)
        found.append(correlate(ImagePair(*filled, GRID, f_mask, g_mask), ANSATZ, guess=start))
    for other in found[1:]:
        np.testing.assert_array_equal(other.unknowns, found[0].unknowns)
        np.testing.assert_array_equal(other.inverse, found[0].inverse)
        assert other.residual_rms == found[0].residual_rms


@pytest.mark.parametrize("seed", SEEDS)
def test_holes_of_another_grey_level_do_not_pull(seed: int) -> None:
    """The farther from the holes' edges, the less: by 0.43 a pixel, as splines do."""
    f, g = images(seed)
    f_mask, g_mask = holes() & (landing() > 10), moved_holes()
    f, g = np.where(f_mask, f, 3.0), np.where(g_mask, g, 3.0)
    errors = {}
    for edge_px in (2, 6, 10):
        options = CorrelationOptions(TIGHT.levels, edge_px, 5, TIGHT.gauss_newton)
        found = correlate(
            ImagePair(f, g, GRID, f_mask, g_mask), ANSATZ, guess=truth(), options=options
        )
        errors[edge_px] = error_px(found.displacement(), f_mask)
    assert errors[2] < 0.02
    # From pixels at least edge_px - 1 from a hole in g to those 4 px farther: 0.43^4 = 0.034.
    assert errors[6] < 0.1 * errors[2]
    assert errors[10] < 2e-5


def holes() -> BoolArray:
    """(rows, cols) material around round holes, in the reference."""
    return _solid(*np.meshgrid(GRID.x, GRID.y))


def moved_holes() -> BoolArray:
    """(rows, cols) the same material in the deformed image."""
    point = manufactured.reference_points(ANSATZ, truth(), GRID)
    return _solid(point[..., 0], point[..., 1])


def _solid(x: FloatArray, y: FloatArray) -> BoolArray:
    return np.asarray(np.hypot(x % 0.7 - 0.35, y % 0.7 - 0.35) > 0.2)


@pytest.mark.parametrize("in_reference", [False, True])
def test_a_reflection_brighter_than_the_speckle_counts_no_more_than_a_grey_one(
    in_reference: bool,
) -> None:
    """Of 16-bit images: it is as bright as 10 standard deviations, on 1.3 % of the material."""
    f, g = (image.copy() for image in images(0))
    inner = landing() > 10
    errors = []
    for level in (0.0, 10.0):
        shown = [f.copy(), g.copy()]
        image = shown[0] if in_reference else shown[1]
        image[60:77, 50:66] = image.mean() + level * image.std()
        pair = ImagePair(*shown, GRID, inner)
        found = correlate(pair, ANSATZ, guess=ANSATZ.initial_guess(STRAIN))
        errors.append(error_px(found.displacement(), inner))
    assert errors[1] < 1.25 * errors[0] < 0.1  # 16 px if its level counted
