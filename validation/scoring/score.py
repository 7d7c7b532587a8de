"""Scores of displacement fields: errors by region and by wavelength, ranking, comparison.

Errors of a displacement measurement differ between regions: subsets extend beyond edges,
ligaments bend, junctions rotate almost rigidly, the bulk hardly moves. Scores of several
fields of one image are compared in a :class:`Grading`, for ``scores.json`` and ``scores.csv``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.spectra.spectrum import gridded, spectral_density
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown, shrunk
from modeharvest.util.typed import to_plain
from modeharvest.validation.scoring.benchmark import BenchmarkTruth

EDGES, LIGAMENTS, JUNCTIONS, BULK = REGIONS = ("edges", "ligaments", "junctions", "bulk")
Labels = NDArray[np.int8]
EDGE_PX = 10
"""Material closer than this to a hole or to the outer boundary counts as edge [px]."""


def regions(mask: BoolArray, grid: PixelGrid, specimen: Specimen, edge_px: int = EDGE_PX) -> Labels:
    """(rows, cols) index of every pixel into :data:`REGIONS`, -1 where there is no material.

    Edges come first, then material outside the cellular part (bulk); the rest belongs to the
    ligament or junction whose centre is nearest. ``mask``: (rows, cols) True on material of the
    undeformed ``specimen``, with little scatter of holes; ``edge_px``: width of the edges [px].
    """
    labels = np.full(grid.shape, -1, dtype=np.int8)
    # A pixel on the boundary belongs to the cellular part, whatever the rounding of its position.
    a, b = (size + 1e-9 * specimen.pitch for size in specimen.cellular_half_size)
    cellular = (np.abs(grid.y)[:, None] <= b) & (np.abs(grid.x)[None, :] <= a)
    labels[mask & ~cellular] = REGIONS.index(BULK)
    row, col = np.nonzero(mask & cellular)
    labels[row, col] = _nearest(specimen, np.stack([grid.x[col], grid.y[row]], axis=1))
    labels[mask & ~shrunk(mask, edge_px, at_border=True)] = REGIONS.index(EDGES)
    return labels


def _nearest(specimen: Specimen, points: FloatArray) -> Labels:
    """Region index of points (n, 2) [mm]: the ligament or junction whose centre is nearest."""
    # Relative to the nearest hole's centre, mirrored to the quarter of its cell with x, y > 0.
    quarter = np.abs(points - specimen.hole_centres[specimen.nearest_hole(points)])
    ligament, junction = (
        np.min([np.hypot(*(quarter - place).T) for place in places], axis=0)
        for places in specimen.quarter_places
    )
    is_junction = junction < ligament - 1e-9 * specimen.pitch
    return np.where(is_junction, REGIONS.index(JUNCTIONS), REGIONS.index(LIGAMENTS)).astype(np.int8)


_ENOUGH_POINTS = 20_000
"""Sample size for a median or a share."""
_SAME_PX = 1e-3
"""Points that are closer than this count as one [px]."""
PERCENTILES = (50, 90, 95, 99)
ENOUGH_COVERED = 0.5
"""Share of the material that a field must cover to be ranked by its error alone [-]."""


@dataclass(frozen=True)
class RegionScore:
    """The error over one region."""

    points: int
    returned: float
    """Share of the points with a displacement [-]."""
    bias_px: tuple[float, float]
    """Mean error (x, y) [px]."""
    rms_px: float
    """Rms error per component [px]."""
    percentiles_px: tuple[float, ...]
    """Percentiles :data:`PERCENTILES` of the error's length [px]."""
    max_px: float
    """Largest length of the error [px]."""

    @classmethod
    def of(cls, error_px: FloatArray, valid: BoolArray) -> RegionScore:
        """From errors (n, 2) of n points; points that are not ``valid`` (n,) count as lost."""
        found = error_px[valid]
        nan = float("nan")
        if not len(found):
            share = 0.0 if len(valid) else nan
            return cls(len(valid), share, (nan, nan), nan, (nan,) * len(PERCENTILES), nan)
        length = np.hypot(found[:, 0], found[:, 1])
        bias_x, bias_y = map(float, found.mean(axis=0))
        return cls(
            len(valid), float(valid.mean()), (bias_x, bias_y), float(np.sqrt(np.mean(found**2))),
            tuple(map(float, np.percentile(length, PERCENTILES))), float(length.max()),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of a graded field."""

    source: str
    everywhere: RegionScore
    """Over all points on material."""
    by_region: Mapping[str, RegionScore]
    """For each of :data:`REGIONS`."""
    off_material: int
    """Number of points outside the material, not graded."""
    spacing_px: float
    """Spacing of the points on material; coinciding points count once [px]."""
    reach_px: float
    """Distance up to which a point represents its neighbourhood: one spacing, at most the given
    reach [px]."""
    near: BoolArray
    """(rows, cols) True on material within reach of a valid point."""
    covered: float
    """Share of the material that is near [-]."""
    x: FloatArray
    y: FloatArray
    """(m,) positions of the valid points on material [mm]."""
    error_px: FloatArray
    """(m, 2) errors at these points [px]."""

    def over(self, where: BoolArray, grid: PixelGrid) -> RegionScore:
        """The error of the valid points where ``where`` (rows, cols) is True."""
        row, col = (np.rint(i).astype(int) for i in grid.to_px(self.x, self.y))
        inside = where[row, col]
        return RegionScore.of(self.error_px[inside], np.ones(inside.sum(), dtype=np.bool_))


def ranked(scores: Sequence[Score]) -> list[Score]:
    """The scores by ascending rms; fields that cover too little of the material come last."""
    return sorted(
        scores,
        key=lambda s: (s.covered < ENOUGH_COVERED, np.nan_to_num(s.everywhere.rms_px, nan=np.inf)),
    )


def score(
    field: LocalField,
    truth: FloatArray,
    labels: Labels,
    grid: PixelGrid,
    reach_px: float = float("inf"),
) -> Score:
    """Grade a field of displacements at points of the reference [mm].

    ``truth``: (n, 2) true displacements at these points [mm], NaN outside the material; ``labels``:
    (rows, cols) of :func:`regions`; ``grid``: the reference image's pixels; ``reach_px``: largest
    distance that a point represents [px]. InputError if no point is on the material.
    """
    here = _labels_at(field.x, field.y, labels, grid)
    _require_on_specimen(field, labels, grid)
    on_material = (here >= 0) & np.isfinite(truth).all(axis=1)
    used = on_material & field.good
    error = np.asarray((field.u - truth) / grid.pixel_size, dtype=np.float64)
    spacing_px = max(1.0, _spacing_px(field.x[on_material], field.y[on_material], grid))
    reach_px = min(spacing_px, reach_px)
    row, col = grid.to_px(field.x[used], field.y[used])
    met = np.zeros(grid.shape, dtype=np.bool_)
    met[np.rint(row).astype(int), np.rint(col).astype(int)] = True
    near = grown(met, reach_px) & (labels >= 0)

    def over(part: BoolArray) -> RegionScore:
        return RegionScore.of(error[part], field.good[part])

    by_region = {name: over(on_material & (here == k)) for k, name in enumerate(REGIONS)}
    covered, off_material = float(near.sum() / (labels >= 0).sum()), int((~on_material).sum())
    return Score(
        field.source, over(on_material), by_region, off_material, spacing_px, reach_px, near,
        covered, field.x[used], field.y[used], error[used],
    )  # fmt: skip


def _labels_at(x: FloatArray, y: FloatArray, labels: Labels, grid: PixelGrid) -> Labels:
    """(n,) labels of the pixels nearest to positions [mm]; -1 outside the image."""
    row, col = grid.to_px(x, y)
    inside = np.ones(x.shape, dtype=np.bool_)
    for at, count in ((row, grid.rows), (col, grid.cols)):
        inside &= np.abs(at - 0.5 * (count - 1)) <= 0.5 * count - 0.5
    found = np.full(x.size, -1, dtype=np.int8)
    found[inside] = labels[np.rint(row[inside]).astype(int), np.rint(col[inside]).astype(int)]
    return found


def _require_on_specimen(field: LocalField, labels: Labels, grid: PixelGrid) -> None:
    """Raise InputError for positions in another unit or frame, or outside the specimen."""
    some = slice(None, None, -(-field.x.size // _ENOUGH_POINTS))
    own_x, own_y = field.x[some], field.y[some]

    def share_of(x: FloatArray, y: FloatArray) -> float:
        return float((_labels_at(x, y, labels, grid) >= 0).mean())

    there, (row, col) = share_of(own_x, own_y), grid.to_px(own_x, own_y)
    last, px, mm = grid.rows - 1, "pixels declared as mm", "mm declared as pixels"
    for (x, y), text in (
        (grid.to_mm(-own_y, own_x), px),  # rows down
        (grid.to_mm(last - own_y, own_x), px),
        ((col, -row), mm),
        ((col, last - row), mm),
    ):
        share = share_of(x, y)
        if share > 0.1 and there < 0.2 * share:
            raise InputError(
                f"{field.source}: expected positions in the declared unit, got {100 * there:.0f} % "
                f"of them on the specimen, but {100 * share:.0f} % if they are {text} (a pixel is "
                f"{grid.pixel_size} mm); declare the unit that the file is in"
            )
    if there == 0.0:
        raise InputError(
            f"{field.source}: expected points on the specimen, got none of {field.x.size} there; "
            "check the field's units, its origin and the direction of its y axis"
        )


def _spacing_px(x: FloatArray, y: FloatArray, grid: PixelGrid) -> float:
    """Median distance of a point from its nearest distinct point [px]; infinite if none."""
    points = np.column_stack(grid.to_px(x, y))
    distance = _to_nearest(points)
    if (distance < _SAME_PX).any():  # some points coincide
        distance = _to_nearest(np.unique(np.rint(points / _SAME_PX), axis=0) * _SAME_PX)
    return float(np.median(distance))


def _to_nearest(points: FloatArray) -> FloatArray:
    """(m,) distances of a sample of points (n, 2) from their nearest neighbours."""
    if len(points) < 2:
        return np.array([np.inf])
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    some = points[:: -(-len(points) // _ENOUGH_POINTS)]
    return np.asarray(tree.query(some, k=2)[0][:, 1])


BANDS_AN_OCTAVE = 3
_MOST = 1000  # points along the longer side; finer fields are averaged


@dataclass(frozen=True, eq=False)
class ErrorSpectrum:
    """Spectrum of the error over the wavelength, in thirds of an octave."""

    wavelength_px: FloatArray
    """(m,) centre of each band, ascending [px]."""
    rms_px: FloatArray
    """(m,) rms error per component in each band [px]. The squares of all bands and of ``affine_px``
    add up to the square of the whole error, except for what averaging a fine field removes."""
    affine_px: float
    """Rms of the error's affine part [px]."""


def error_spectrum(graded: Score, grid: PixelGrid) -> ErrorSpectrum | None:
    """Decompose a field's error by wavelength; None if its points don't fill a box.

    Gaps, at holes and where points were lost, count as zero error. The pattern of gaps spreads the
    error of a wavelength over neighbouring wavelengths.
    """
    if not len(graded.x):
        return None
    try:
        u, regular, mask = gridded(_averaged(graded, grid))
        unit = 10.0 * regular.pixel_size  # arbitrary: wavelengths are in px
        spectrum = spectral_density(u, regular, mask, unit, bins_per_cell=10, padding=1)
    except InputError:
        return None
    density = spectrum.density.sum(axis=-1).ravel()
    cell = (spectrum.xi1[1] - spectrum.xi1[0]) * (spectrum.xi2[1] - spectrum.xi2[0]) / unit**2
    area = mask.sum() * regular.pixel_size**2
    frequency = np.hypot(spectrum.xi1[None, :], spectrum.xi2[:, None]).ravel() / unit
    waves = frequency > 0
    wavelength = 1.0 / (frequency[waves] * grid.pixel_size)
    band = np.rint(BANDS_AN_OCTAVE * np.log2(wavelength)).astype(int)
    low = int(band.min())
    square_mm = np.bincount(band - low, density[waves] * cell) / (2.0 * area)
    middle = 2.0 ** ((low + np.arange(square_mm.size)) / BANDS_AN_OCTAVE)
    there = np.bincount(band - low) > 0
    points = np.stack([np.ones_like(graded.x), graded.x, graded.y])
    affine_rms = float(np.sqrt(np.mean((spectrum.affine @ points) ** 2)))
    rms = np.sqrt(square_mm) / grid.pixel_size
    return ErrorSpectrum(middle[there], rms[there], affine_rms / grid.pixel_size)


def _averaged(graded: Score, grid: PixelGrid) -> LocalField:
    """The error as a field [mm], averaged over squares if it has too many points."""
    x, y, error = graded.x, graded.y, graded.error_px * grid.pixel_size
    step = graded.spacing_px * grid.pixel_size
    many = int(np.ceil(max(np.ptp(x), np.ptp(y)) / (step * _MOST)))
    if many > 1:
        side = many * step
        left, low = (at.min() - 0.5 * step for at in (x, y))  # no grid point on a square's border
        col, row = (((at - begin) / side).astype(int) for at, begin in ((x, left), (y, low)))
        cols = int(col.max()) + 1
        square = row * cols + col
        count = np.bincount(square)
        there = np.flatnonzero(count)
        error = np.column_stack([np.bincount(square, e)[there] / count[there] for e in error.T])
        x = left + side * (there % cols + 0.5)
        y = low + side * (there // cols + 0.5)
    return LocalField(x, y, error, source=graded.source)


SCORES_FORMAT = "modeharvest-scores-1"

EVERYWHERE, COMMON = "everywhere", "where all measure"


@dataclass(frozen=True, eq=False)
class Grading:
    """Graded fields of one deformed image."""

    truth: BenchmarkTruth
    strain: float
    """Nominal strain of the image [-]."""
    edge_px: int
    """Width of the edge region [px]."""
    labels: Labels
    """(rows, cols) labels from :func:`regions`."""
    scores: tuple[Score, ...]
    """Scores, the best first."""
    spectra: Mapping[str, ErrorSpectrum | None]
    """Spectrum of each field's error, by the field's name."""
    remarks: tuple[str, ...] = ()
    """Texts about probable errors in the declared conventions."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Reasons why fields were not graded, by file name."""

    @cached_property
    def _covered(self) -> BoolArray:
        """(rows, cols) True where all fields cover the material."""
        return np.asarray(np.logical_and.reduce([graded.near for graded in self.scores]))

    @cached_property
    def common(self) -> dict[str, RegionScore]:
        """The error of each field, by name, over the material that all fields cover."""
        grid = self.truth.grid
        return {graded.source: graded.over(self._covered, grid) for graded in self.scores}

    @property
    def common_share(self) -> float:
        """Share of the material that all fields cover [-]."""
        return float(self._covered.sum() / (self.labels >= 0).sum())

    def parts(self, graded: Score) -> dict[str, RegionScore]:
        """A field's table rows: everywhere, where all fields cover the material, by region."""
        common = {COMMON: self.common[graded.source]} if len(self.scores) > 1 else {}
        return {EVERYWHERE: graded.everywhere, **common, **graded.by_region}

    @property
    def notes(self) -> list[str]:
        """Notes for the reader: refused fields, remarks, empty regions, poor coverage."""
        return [
            *(f"not graded: {why}" for why in self.refused.values()),
            *self.remarks,
            *(f"no material is in {name}, {self.edge_px} px or more from any edge"
              for k, name in enumerate(REGIONS) if k not in self.labels),
            *(f"{graded.source} covers {100 * graded.covered:.0f} % of the material, less than "
              f"{100 * ENOUGH_COVERED:.0f} %, and is ranked after those that cover more"
              for graded in self.scores if graded.covered < ENOUGH_COVERED),
        ]  # fmt: skip


def grading_summary(grading: Grading) -> dict[str, Any]:
    """The grades as plain values: all numbers of each field, the best first."""
    fields = [
        {"name": graded.source, "points_off_material": graded.off_material,
         "spacing_px": graded.spacing_px, "covered": graded.covered, **grading.parts(graded),
         "spectrum": grading.spectra.get(graded.source)}
        for graded in grading.scores
    ]  # fmt: skip
    content = {
        "format": SCORES_FORMAT, "benchmark": grading.truth.id,
        "nominal_strain": grading.strain, "edge_px": grading.edge_px, "percentiles": PERCENTILES,
        "covered_by_all": grading.common_share,
        "fields": fields,
        "refused": grading.refused,
        "remarks": grading.notes,
    }  # fmt: skip
    return dict(to_plain(content))


def csv_lines(grading: Grading) -> Iterator[str]:
    """The table as CSV: a line for each field and region."""
    percentiles = ",".join(f"p{p} [px]" for p in PERCENTILES)
    yield ("field,region,points,returned [-],covered [-],bias x [px],bias y up [px],rms [px],"
           f"{percentiles},max [px]")  # fmt: skip
    for graded in grading.scores:
        for name, part in grading.parts(graded).items():
            covered = f"{graded.covered:.6g}" if name == EVERYWHERE else ""
            values = [*part.bias_px, part.rms_px, *part.percentiles_px, part.max_px]
            numbers = ",".join(f"{v:.6g}" for v in values)
            yield f'"{graded.source}",{name},{part.points},{part.returned:.6g},{covered},{numbers}'
