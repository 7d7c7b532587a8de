"""Scores of displacement fields: known errors come out, lost points and wrong units are told."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError
from modeharvest.validation.scoring.score import REGIONS, ranked, regions, score

FloatArray = NDArray[np.float64]

SPECIMEN = Specimen(holes_x=2, holes_y=3, bulk_x=0.9, bulk_y=0.5)
PIXEL = 0.02
GRID = PixelGrid.centred(350, 300, PIXEL)


def material() -> NDArray[np.bool_]:
    (w, h), r = SPECIMEN.half_size, 0.5 * SPECIMEN.diameter
    x, y = GRID.x[None, :], GRID.y[:, None]
    w, h, r = (size - 1e-9 for size in (w, h, r))  # no pixel on the edge, whatever its rounding
    mask = (np.abs(x) <= w) & (np.abs(y) <= h)
    for cx, cy in SPECIMEN.hole_centres:
        mask &= np.hypot(x - cx, y - cy) > r
    return mask


MASK = material()
LABELS = regions(MASK, GRID, SPECIMEN)


def points(step: int = 6) -> tuple[FloatArray, FloatArray]:
    row, col = np.mgrid[3 : GRID.rows : step, 2 : GRID.cols : step]
    x, y = GRID.to_mm(row.ravel(), col.ravel())
    return x, y


def truth_at(x: FloatArray, y: FloatArray) -> FloatArray:
    row, col = (np.rint(v).astype(int) for v in GRID.to_px(x, y))
    u = np.column_stack([-0.1 * x + 0.02 * np.sin(y), 0.03 * y])
    u[~MASK[row, col]] = np.nan
    return u


def test_regions_are_a_partition_of_the_material() -> None:
    assert np.array_equal(LABELS >= 0, MASK)
    assert set(np.unique(LABELS[MASK])) == set(range(len(REGIONS)))


def test_regions_lie_where_their_names_say() -> None:
    def at(x: float, y: float) -> str:
        row, col = (int(np.rint(v)) for v in GRID.to_px(x, y))
        return REGIONS[LABELS[row, col]]

    pitch, d = SPECIMEN.pitch, SPECIMEN.diameter
    hole = SPECIMEN.hole_centres[0]
    assert at(0.0, 0.5 * pitch) == "junctions"
    # The ligament is 0.4 mm = 20 px wide: with edges of 10 px nothing else is left of it.
    assert at(0.0, 0.0) == "edges"
    assert at(hole[0] + 0.5 * d + 3 * PIXEL, hole[1]) == "edges"
    assert at(SPECIMEN.half_size[0] - 0.4, 0.0) == "bulk"
    thin = regions(MASK, GRID, SPECIMEN, edge_px=4)
    assert REGIONS[thin[GRID.rows // 2, GRID.cols // 2]] == "ligaments"


def test_mirrored_specimens_have_mirrored_regions() -> None:
    assert np.array_equal(LABELS, LABELS[::-1])
    assert np.array_equal(LABELS, LABELS[:, ::-1])


def test_a_known_error_comes_out() -> None:
    x, y = points()
    truth = truth_at(x, y)
    rng = np.random.default_rng(0)
    noise = PIXEL * (0.3 * rng.normal(size=truth.shape) + [0.2, -0.1])
    graded = score(LocalField(x, y, np.nan_to_num(truth) + noise), truth, LABELS, GRID)
    n = graded.everywhere.points
    assert n == np.isfinite(truth).all(axis=1).sum()
    assert graded.off_material == len(x) - n
    assert graded.everywhere.bias_px == pytest.approx([0.2, -0.1], abs=4 * 0.3 / np.sqrt(n))
    rms = np.sqrt(0.3**2 + (0.2**2 + 0.1**2) / 2)
    assert graded.everywhere.rms_px == pytest.approx(rms, rel=4 / np.sqrt(2 * n))
    assert graded.everywhere.returned == 1.0
    assert sum(part.points for part in graded.by_region.values()) == n


def test_lost_points_are_counted_and_not_hidden() -> None:
    x, y = points()
    truth = truth_at(x, y)
    u = truth.copy()
    lost = np.flatnonzero(np.isfinite(truth).all(axis=1))[::4]
    u[lost] = np.nan
    graded = score(LocalField(x, y, u), truth, LABELS, GRID)
    n = graded.everywhere.points
    assert graded.everywhere.returned == pytest.approx(1 - len(lost) / n)
    assert graded.everywhere.rms_px == 0.0


def test_a_field_of_half_the_specimen_covers_half_of_it() -> None:
    x, y = points()
    half = x < 0
    graded = score(
        LocalField(x[half], y[half], truth_at(x, y)[half]), truth_at(x[half], y[half]), LABELS, GRID
    )
    assert graded.covered == pytest.approx(0.5, abs=0.03)


def test_points_that_are_few_stand_for_little() -> None:
    """Four points, as far from each other as can be, and one."""
    x, y = (np.array([-1.6, 1.6, -1.6, 1.6]), np.array([-2.9, -2.9, 2.9, 2.9]))
    reach_px = 0.25 * SPECIMEN.pitch / PIXEL
    for n in (4, 1):
        field = LocalField(x[:n], y[:n], truth_at(x, y)[:n], source="few")
        few = score(field, truth_at(x, y)[:n], LABELS, GRID, reach_px)
        assert few.everywhere.rms_px == 0.0
        assert few.covered <= n * np.pi * (reach_px + 1) ** 2 / MASK.sum()
        x2, y2 = points()
        noisy = LocalField(x2, y2, np.nan_to_num(truth_at(x2, y2)) + PIXEL, source="noisy")
        many = score(noisy, truth_at(x2, y2), LABELS, GRID, reach_px)
        assert ranked([few, many]) == [many, few]


@pytest.mark.parametrize("times", [2, 3])
def test_points_given_twice_are_as_far_apart_as_once(times: int) -> None:
    x, y = points()
    once = LocalField(x, y, truth_at(x, y))
    truth = np.tile(truth_at(x, y), (times, 1))
    more = LocalField(np.tile(x, times), np.tile(y, times), truth)
    graded = score(more, truth, LABELS, GRID)
    assert graded.spacing_px == pytest.approx(6.0, rel=1e-9)
    assert graded.covered == score(once, truth_at(x, y), LABELS, GRID).covered


def test_a_field_beside_the_specimen_is_refused() -> None:
    x, y = points()
    far = LocalField(x + 100.0, y, np.zeros((len(x), 2)))
    with pytest.raises(InputError, match="got none of"):
        score(far, np.full((len(x), 2), np.nan), LABELS, GRID)
