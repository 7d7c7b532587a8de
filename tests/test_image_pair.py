"""Guards a pair of images: what is refused, and the error against the truth."""

from dataclasses import dataclass
from typing import get_type_hints

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.pair import ImagePair, KnownPair, Truth
from modeharvest.util.arrays import BoolArray
from modeharvest.util.errors import InputError

GRID = PixelGrid.centred(12, 10, 0.1)
F = np.random.default_rng(0).integers(0, 255, GRID.shape, dtype=np.uint8)
LEFT = np.broadcast_to(np.arange(GRID.cols) < 5, GRID.shape)


@dataclass
class Shift:
    """A measurement: one vector everywhere [mm]."""

    u: ArrayLike

    def displacement(self, grid: PixelGrid) -> NDArray[np.float64]:
        return np.broadcast_to(np.asarray(self.u, np.float64), (*grid.shape, 2))


def test_images_are_kept_as_read_only_float32() -> None:
    pair = ImagePair(F, F[::-1], GRID, LEFT)
    assert pair.deformed.dtype == np.float32
    np.testing.assert_array_equal(pair.deformed, F[::-1])
    np.testing.assert_array_equal(pair.grey[0], F[LEFT])
    assert not pair.reference.flags.writeable
    other = pair.with_images(F, F + 0.5)
    np.testing.assert_array_equal(other.deformed, F + np.float32(0.5))
    assert other.mask is not None
    assert other.grid == GRID


def test_type_checkers_know_that_rendered_pairs_have_masks_and_a_truth() -> None:
    assert get_type_hints(ImageSet.pair)["return"] is KnownPair
    known = get_type_hints(KnownPair)
    assert known["truth"] is Truth
    assert known["mask"] == known["deformed_mask"] == BoolArray


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"deformed": F[:-1]}, "expected a deformed image of 12 x 10 px like the grid"),
        ({"reference": np.where(F[3, 4] == F, np.nan, F)}, "finite grey levels in the reference"),
        ({"deformed": 0 * F}, "contrast in the deformed image, got the constant grey level 0"),
        ({"reference": np.where(LEFT, 7, F)}, "contrast in the reference image"),
        ({"mask": LEFT[:, 1:]}, "expected a mask of 12 x 10 px like the images"),
        ({"deformed_mask": LEFT & False}, "expected material in the deformed mask"),
    ],
)
def test_what_cannot_be_correlated_is_refused(
    change: dict[str, NDArray[np.generic]], message: str
) -> None:
    whole = {"reference": F, "deformed": F[::-1], "mask": LEFT}
    with pytest.raises(InputError, match=message):
        ImagePair(grid=GRID, **(whole | change))


def test_a_plain_material_may_have_one_grey_level() -> None:
    thresholded = np.where(LEFT, 7, 0)
    pair = ImagePair(thresholded, thresholded, GRID, LEFT, is_plain=True)
    np.testing.assert_array_equal(pair.reference, thresholded)
    with pytest.raises(InputError, match="contrast in the deformed image"):
        ImagePair(thresholded, 0 * F, GRID, LEFT, is_plain=True)


def test_rms_is_per_component_and_of_the_material_alone() -> None:
    u = np.where(LEFT[..., None], [0.3, -0.1], np.nan)
    pair = ImagePair(F, F[::-1], GRID, LEFT, truth=Truth.of(displacement=u))
    assert pair.rms(Shift([0.3, -0.1])) == 0.0
    assert pair.rms(Shift([0.0, 0.3])) == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 2))
    with pytest.raises(InputError, match="displacement is known"):
        ImagePair(F, F[::-1], GRID).rms(Shift([0.0, 0.0]))


def test_grey_levels_far_beyond_the_material_s_are_replaced_by_its_median() -> None:
    grid = PixelGrid.centred(200, 200, 0.1)
    f, g = np.random.default_rng(1).standard_normal((2, *grid.shape)).astype(np.float32)
    pair = ImagePair(f, g, grid)
    same = pair.without_extremes()
    np.testing.assert_array_equal([same.reference, same.deformed], [f, g])
    glare, defect = g.copy(), f.copy()
    glare[40:65, 100:125], defect[7, 9] = 20.0, -1e6  # 1.6 % of the image, and one pixel
    shown = pair.with_images(defect, glare).without_extremes()
    changed = np.stack([shown.reference != defect, shown.deformed != glare])
    assert changed[0].sum() == 1
    assert changed[1].sum() == 25 * 25
    np.testing.assert_allclose(shown.deformed[40:65, 100:125], np.median(g), atol=0.05)
    brighter = pair.with_images(300.0 * defect + 1e3, 300.0 * glare + 1e3).without_extremes()
    np.testing.assert_allclose(brighter.deformed, 300.0 * shown.deformed + 1e3, rtol=1e-5)


def test_material_that_has_moved_away_is_not_extreme() -> None:
    """Where it was, the deformed image shows nothing but the background, of one grey level."""
    grid = PixelGrid.centred(100, 200, 0.1)
    f, g = np.zeros((2, *grid.shape), np.float32)
    f[:, 20:60] = g[:, 80:120] = 5.0 + np.random.default_rng(0).standard_normal((100, 40))
    found = ImagePair(f, g, grid, mask=f > 0.0).without_extremes()
    np.testing.assert_array_equal(found.deformed, g)
