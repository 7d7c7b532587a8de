"""Blocks of one image in another: found where the surface moved to, and not on another surface."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.idic.photograph.matching.blocks import (
    BlockMatch,
    Expected,
    _correlation,
    match_blocks,
    require_same_surface,
)
from modeharvest.idic.photograph.matching.holes import HoleMotion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.errors import InputError

SHAPE = (300, 340)
SPECKLE = Speckle(SpeckleSpec(standard_deviation=0.06, blur_px=2.0), SHAPE)


def matched(
    f: NDArray[np.float64],
    g: NDArray[np.float64],
    mask: NDArray[np.bool_] | None = None,
    expected: Expected = lambda points: points,
) -> BlockMatch:
    return match_blocks(ImagePair(f, g, PixelGrid.centred(*SHAPE, 0.5), mask), expected)


def moved(
    shift: tuple[float, float], stretch: float = 1.0, noise: float = 0.03
) -> NDArray[np.float64]:
    """The pattern after x -> stretch x + shift; exact, because the pattern is known anywhere."""
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    image = SPECKLE((row - shift[0]) / stretch, (col - shift[1]) / stretch)
    return image + noise * np.random.default_rng(0).normal(size=SHAPE)


def test_blocks_are_stretched_as_their_surroundings_are_expected_to_be() -> None:
    """To twice their size: where they are not, none is found."""
    twice = moved((0.0, 0.0), 2.0)
    match = matched(SPECKLE.image(), twice, expected=lambda points: 2.0 * points)
    off = np.abs(match.after - 2.0 * match.before).max(axis=1)
    assert match.share > 0.9
    assert (off[match.found] <= 1.0).mean() > 0.95


@pytest.mark.parametrize("shift", [(0, 0), (7, -3), (-20, 15)])
def test_a_shifted_surface_is_found_to_the_pixel(shift: tuple[int, int]) -> None:
    match = matched(SPECKLE.image(), moved(shift))
    assert match.is_same
    off = (match.after - match.before)[match.found]
    # Some blocks have left the image, and 5 % of those are found elsewhere, by chance.
    assert (off == np.array(shift)).all(axis=1).mean() > 0.95


def test_another_surface_is_not_the_same() -> None:
    other = Speckle(SpeckleSpec(standard_deviation=0.06, blur_px=2.0, seed=7), SHAPE).image()
    match = matched(SPECKLE.image(), other)
    assert match.share < 0.3  # 5 % by the definition of chance, of some 60 blocks
    assert not match.is_same
    with pytest.raises(InputError, match=r"r\.tif and d\.tif, of which only"):
        require_same_surface(match, "r.tif", "d.tif")


def test_large_motion_is_found_where_it_is_expected() -> None:
    image = moved((60.0, -10.0), stretch=0.95)
    f = SPECKLE.image()
    lost = matched(f, image)
    found = matched(f, image, expected=lambda p: 0.95 * p + (58.0, -7.0))
    assert not lost.is_same
    assert found.is_same
    aims = 0.95 * found.before + (60.0, -10.0)
    # Whole pixels, and where in the block the contrast is: 5 % of half a block is 1 px.
    assert np.median(np.abs(found.after - aims)[found.found], axis=0).max() < 1.5
    assert found.found.mean() > 0.9


def test_turned_blocks_are_found() -> None:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    c, s = np.cos(np.radians(18.0)), np.sin(np.radians(18.0))
    turn, middle = np.array([[c, s], [-s, c]]), np.array([150.0, 170.0])
    back = (np.stack([row, col], axis=-1) - middle) @ turn.T + middle
    image = SPECKLE(back[..., 0], back[..., 1])
    match = matched(SPECKLE.image(), image, expected=lambda p: (p - middle) @ turn + middle)
    assert match.share > 0.8
    assert np.median(np.abs(match.after - (match.before - middle) @ turn - middle)) < 1.0


def test_correlations_are_the_definitions() -> None:
    """Of a textbook's formula, place by place; none on a part of one grey."""
    rng = np.random.default_rng(0)
    window = rng.random((23, 19), dtype=np.float32)
    window[:12, :12] = 0.5
    blocks = rng.random((3, 7, 7), dtype=np.float32)
    blocks[2] = 0.25
    found = _correlation(window, blocks)
    assert found.shape == (3, 17, 13)
    for n, row, col in np.ndindex(found.shape):
        part, block = window[row : row + 7, col : col + 7].astype(float), blocks[n].astype(float)
        flat = np.ptp(part) == 0.0 or np.ptp(block) == 0.0
        expected = 0.0 if flat else np.corrcoef(part.ravel(), block.ravel())[0, 1]
        assert found[n, row, col] == pytest.approx(expected, abs=1e-5)  # single precision


def test_blocks_in_mm_have_y_upwards() -> None:
    match = matched(SPECKLE.image(), moved((5.0, -8.0)))
    moved_mm = match.in_mm(PixelGrid.centred(*SHAPE, 0.5))
    np.testing.assert_allclose(np.median(moved_mm.u, axis=0), [-4.0, -2.5])


def test_blocks_lie_on_material() -> None:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[40:260, 100:180] = True
    match = matched(SPECKLE.image(), moved((0.0, 0.0)), mask)
    half = match.block_px // 2
    for row, col in match.before.astype(int):
        assert mask[row - half : row + half + 1, col - half : col + half + 1].all()


def test_motion_between_holes_reproduces_affine_maps() -> None:
    random = np.random.default_rng(0)
    before = random.uniform(0, 300, size=(20, 2))
    matrix, shift = np.array([[0.9, 0.05], [-0.02, 1.03]]), (12.0, -30.0)
    motion = HoleMotion(before, before @ matrix + shift, np.zeros((20, 2), int), 0, ())
    np.testing.assert_allclose(motion.at(before), motion.after, atol=1e-9)
    points = random.uniform(-100, 400, size=(5, 2))
    np.testing.assert_allclose(motion.at(points), points @ matrix + shift, atol=1e-8)


def test_what_cannot_be_compared_is_refused() -> None:
    f = SPECKLE.image()
    with pytest.raises(InputError, match="one size"):
        matched(f, f[:-1])
    narrow = np.arange(SHAPE[0])[:, None] % 20 < np.full(SHAPE[1], 10)
    with pytest.raises(InputError, match="room for blocks"):
        matched(f, f, narrow)
    with pytest.raises(InputError, match="motion is too large"):
        matched(f, f, expected=lambda p: p + 1e4)
