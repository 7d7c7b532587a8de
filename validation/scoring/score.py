"""How good a displacement field from any DIC code is, against the truth of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from modeharvest.errors import InputError
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.scoring.regions import REGIONS

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ENOUGH_POINTS = 20_000
"""For a median or a share."""
_SAME_PX = 1e-3
"""Points no farther from each other are one [px]."""
PERCENTILES = (50, 90, 95, 99)
ENOUGH_COVERED = 0.5
"""Share of the material that a field has to cover to be ranked by its error alone [-]."""


@dataclass(frozen=True)
class RegionScore:
    """The error over one region.

    Parameters
    ----------
    points
        Points of the field that lie there.
    returned
        Share of them with a displacement [-].
    bias_px
        (x, y) mean error [px].
    rms_px
        Rms error per component [px].
    percentiles_px
        Of the error's length, at :data:`PERCENTILES` [px].
    max_px
        The largest length [px].
    """

    points: int
    returned: float
    bias_px: tuple[float, float]
    rms_px: float
    percentiles_px: tuple[float, ...]
    max_px: float

    @classmethod
    def of(cls, error_px: FloatArray, valid: BoolArray) -> RegionScore:
        """From (n, 2) errors of n points, of which those that are not valid count as lost."""
        found = error_px[valid]
        nan = float("nan")
        if not len(found):
            share = 0.0 if len(valid) else nan
            return cls(len(valid), share, (nan, nan), nan, (nan,) * len(PERCENTILES), nan)
        length = np.hypot(found[:, 0], found[:, 1])
        mean = found.mean(axis=0)
        return cls(
            points=len(valid),
            returned=float(valid.mean()),
            bias_px=(float(mean[0]), float(mean[1])),
            rms_px=float(np.sqrt(np.mean(found**2))),
            percentiles_px=tuple(float(p) for p in np.percentile(length, PERCENTILES)),
            max_px=float(length.max()),
        )


@dataclass(frozen=True, eq=False)
class Score:
    """A graded field.

    Parameters
    ----------
    source
        Of the field.
    everywhere
        Over all its points on material.
    by_region
        For each of :data:`modeharvest.validation.scoring.regions.REGIONS`.
    off_material
        Points that lie in holes or outside the specimen: not graded.
    spacing_px
        Of its points on material; of those at the same place, one counts [px].
    reach_px
        How far from a point its displacement stands for others: one spacing, if that is within
        the reach given [px].
    near
        (rows, cols) True on material within reach of a valid point.
    covered
        Share of the material that is near [-].
    x, y, error_px
        (m,), (m,) [mm] and (m, 2) [px] of the valid points on material.
    """

    source: str
    everywhere: RegionScore
    by_region: Mapping[str, RegionScore]
    off_material: int
    spacing_px: float
    reach_px: float
    near: BoolArray
    covered: float
    x: FloatArray
    y: FloatArray
    error_px: FloatArray

    def over(self, where: BoolArray, grid: PixelGrid) -> RegionScore:
        """The error of the measured points in a part of the image (rows, cols)."""
        row, col = (np.rint(i).astype(int) for i in grid.to_px(self.x, self.y))
        inside = where[row, col]
        return RegionScore.of(self.error_px[inside], np.ones(inside.sum(), dtype=np.bool_))


def ranked(scores: Sequence[Score]) -> list[Score]:
    """The best first: by rms; after all others those that cover too little of the material."""
    return sorted(
        scores,
        key=lambda s: (s.covered < ENOUGH_COVERED, np.nan_to_num(s.everywhere.rms_px, nan=np.inf)),
    )


def score(
    field: LocalField,
    truth: FloatArray,
    labels: NDArray[np.int8],
    grid: PixelGrid,
    reach_px: float = float("inf"),
) -> Score:
    """Grade a field.

    Parameters
    ----------
    field
        Displacements at points of the reference [mm].
    truth
        (n, 2) true displacements at the field's points [mm]; NaN off the material.
    labels
        (rows, cols) of :func:`modeharvest.validation.scoring.regions.regions`.
    grid
        The reference image's pixels.
    reach_px
        Farthest from a point that its displacement can stand for [px].

    Raises
    ------
    InputError
        If no point lies on the material.
    """
    here = _labels_at(field.x, field.y, labels, grid)
    _require_on_specimen(field, labels, grid)
    on_material = (here >= 0) & np.isfinite(truth).all(axis=1)
    used = on_material & field.good
    error = np.asarray((field.u - truth) / grid.pixel_size, dtype=np.float64)
    spacing_px = max(1.0, _spacing_px(field.x[on_material], field.y[on_material], grid))
    reach_px = min(spacing_px, reach_px)
    near = _near(field, used, reach_px, grid) & (labels >= 0)
    return Score(
        source=field.source,
        everywhere=RegionScore.of(error[on_material], field.good[on_material]),
        by_region={
            name: RegionScore.of(
                error[on_material & (here == k)], field.good[on_material & (here == k)]
            )
            for k, name in enumerate(REGIONS)
        },
        off_material=int((~on_material).sum()),
        spacing_px=spacing_px,
        reach_px=reach_px,
        near=near,
        covered=float(near.sum() / (labels >= 0).sum()),
        x=field.x[used],
        y=field.y[used],
        error_px=error[used],
    )


def _labels_at(
    x: FloatArray, y: FloatArray, labels: NDArray[np.int8], grid: PixelGrid
) -> NDArray[np.int8]:
    """(n,) labels of the pixels nearest to positions [mm]; -1 off the image."""
    row, col = grid.to_px(x, y)
    inside = (np.abs(row - 0.5 * (grid.rows - 1)) <= 0.5 * grid.rows - 0.5) & (
        np.abs(col - 0.5 * (grid.cols - 1)) <= 0.5 * grid.cols - 0.5
    )
    found = np.full(x.size, -1, dtype=np.int8)
    found[inside] = labels[np.rint(row[inside]).astype(int), np.rint(col[inside]).astype(int)]
    return found


def _require_on_specimen(field: LocalField, labels: NDArray[np.int8], grid: PixelGrid) -> None:
    """Recognise positions in another unit, or beside the specimen."""
    some = slice(None, None, -(-field.x.size // _ENOUGH_POINTS))
    own_x, own_y = field.x[some], field.y[some]
    there = float((_labels_at(own_x, own_y, labels, grid) >= 0).mean())
    row, col = grid.to_px(own_x, own_y)
    last, px, mm = grid.rows - 1, "pixels declared as mm", "mm declared as pixels"
    for (x, y), words in (
        (grid.to_mm(-own_y, own_x), px),  # rows down
        (grid.to_mm(last - own_y, own_x), px),
        ((col, -row), mm),
        ((col, last - row), mm),
    ):
        share = float((_labels_at(x, y, labels, grid) >= 0).mean())
        if share > 0.1 and there < 0.2 * share:
            raise InputError(
                f"{field.source}: expected positions in the declared unit, got {100 * there:.0f} % "
                f"of them on the specimen, but {100 * share:.0f} % if they are {words} (a pixel is "
                f"{grid.pixel_size} mm); declare the unit that the file is in"
            )
    if there == 0.0:
        raise InputError(
            f"{field.source}: expected points on the specimen, got none of {field.x.size} there; "
            "check the field's units, its origin and the direction of its y axis"
        )


def _spacing_px(x: FloatArray, y: FloatArray, grid: PixelGrid) -> float:
    """Median distance of a point from the nearest elsewhere [px]; infinite if there is none."""
    points = np.column_stack(grid.to_px(x, y))
    distance = _to_nearest(points)
    if (distance < _SAME_PX).any():  # some are there twice
        distance = _to_nearest(np.unique(np.rint(points / _SAME_PX), axis=0) * _SAME_PX)
    return float(np.median(distance))


def _to_nearest(points: FloatArray) -> FloatArray:
    """(m,) distances of some of n points (n, 2) from their nearest neighbours."""
    if len(points) < 2:
        return np.array([np.inf])
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    some = points[:: -(-len(points) // _ENOUGH_POINTS)]
    return np.asarray(tree.query(some, k=2)[0][:, 1])


def _near(field: LocalField, used: BoolArray, reach_px: float, grid: PixelGrid) -> BoolArray:
    """(rows, cols) True where a used point is no farther."""
    row, col = grid.to_px(field.x[used], field.y[used])
    missed = np.ones(grid.shape, dtype=np.bool_)
    missed[np.rint(row).astype(int), np.rint(col).astype(int)] = False
    if missed.all():
        return ~missed
    return np.asarray(ndimage.distance_transform_edt(missed) <= reach_px)
