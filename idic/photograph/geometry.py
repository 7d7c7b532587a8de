"""Geometry of a photographed specimen: its cellular part, its boundary, the lattice of its holes.

The cellular part comes from the lattice of the holes, from a polygon drawn by hand, or from a
mask image; modes live there. The domain of v0 is the whole specimen as far as the image shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import find_objects, label
from skimage.draw import polygon2mask

from modeharvest.idic.ansatz import FEWEST_CELLS, cells_across
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.photograph.axes import require_angle
from modeharvest.idic.photograph.holes import HoleLattice, find_hole_lattice
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import read_mask, require_same_shape
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

Corners = tuple[tuple[float, float], ...]


def _require_area(corners: Corners, where: str) -> None:
    """Raise InputError unless at least three corners [px] are a pixel or more off one line."""
    if len(corners) < 3:
        raise InputError(
            f"{where}: expected a polygon of at least three corners [column, row], got "
            f"{len(corners)}; add the others, or leave it out"
        )
    (x, y), *others = corners
    sides = [(other_x - x, other_y - y) for other_x, other_y in others]
    along_x, along_y = max(sides, key=lambda side: math.hypot(*side))
    length = math.hypot(along_x, along_y)
    width = max(abs(along_x * v - along_y * u) for u, v in sides) / length if length else 0.0
    if not width >= 1.0:  # NaN neither
        raise InputError(
            f"{where}: expected a polygon with an area, got {len(corners)} corners on one line, "
            f"from {list(min(corners))} to {list(max(corners))} [column, row]; correct them"
        )


@dataclass(frozen=True)
class RegionTable:
    """A part of the specimen with a pattern, and modes, of its own."""

    name: str = ""
    polygon: Corners = ()
    """Corners (column, row) in the reference image [px]; the modes live in the box around them."""

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("specimen.regions: expected a name for each, got one without")
        _require_area(self.polygon, f"specimen.regions {self.name!r}")


@dataclass(frozen=True)
class SpecimenTable:
    """Prior knowledge of the specimen: cell size, cellular part, material, regions."""

    cell_size: float = math.nan
    """l [mm], the distance of neighbouring holes."""
    polygon: Corners = ()
    """Corners (column, row) of the cellular part in the reference [px]; else found from holes."""
    cells: str = ""
    """Mask image of the cellular part, white inside; instead of a polygon."""
    material: str = ""
    """Mask image of the reference's material, white on it; found from the image otherwise."""
    deformed_material: tuple[str, ...] = ()
    """Mask images of the material in the deformed images, in order; names may hold wildcards."""
    regions: tuple[RegionTable, ...] = ()
    """Parts of the cellular part whose patterns differ; by default it has one pattern."""
    angle: float = 0.0
    """From x to the specimen's axis, counter-clockwise [degrees]: mean strains, and those of gauges
    without an angle, are along it."""

    def __post_init__(self) -> None:
        if not self.cell_size > 0:
            raise InputError(
                f"specimen: expected a cell_size above 0 mm, got {self.cell_size}; it is the "
                "distance of neighbouring holes"
            )
        if self.polygon:
            _require_area(self.polygon, "specimen.polygon")
        if self.polygon and self.cells:
            raise InputError(
                f"specimen: expected a polygon or a mask image 'cells', got both, cells = "
                f"{self.cells!r}"
            )
        require_angle("specimen.angle", self.angle)
        names = [region.name for region in self.regions]
        if len(set(names)) < len(names):
            raise InputError(f"specimen.regions: expected different names, got {', '.join(names)}")


SIDES = ("left", "right", "bottom", "top")
_FILLED = 0.9
"""Share of its bounding box below which a region is not nearly a rectangle."""
_SOME = 0.01
"""A region with less material than this share of itself is a mistake."""


@dataclass(frozen=True, eq=False)
class Region:
    """The cellular part of a specimen."""

    cellular: Box
    """Smallest axis-parallel box around the cellular part [mm]."""
    domain: Box
    """Box around all material in the image [mm]."""
    text: tuple[str, ...]
    """How the region was found, and what is unusual about it."""


def region_of_lattice(lattice: HoleLattice, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from the holes: every hole's cell, half a lattice vector each way.

    Lattice and mask, (rows, cols) True on material, are of the reference.
    """
    reach = 0.5 * np.abs(lattice.vectors).max(axis=0)  # rows and columns of a cell
    low, high = lattice.centres.min(axis=0) - reach, lattice.centres.max(axis=0) + reach
    text = (
        f"The cellular part is the cells of {len(lattice)} holes on a {lattice.kind} lattice of "
        f"{lattice.pitch_px * grid.pixel_size:.4g} mm."
    )
    return _region(low, high, mask, grid, text)


def region_of_polygon(polygon: ArrayLike, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from a polygon drawn by hand, (n, 2) corners in order, (row, col) [px].

    Raises InputError if it has no area, leaves the image, or holds hardly any material.
    """
    corners = np.asarray(polygon, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise InputError(
            "expected a polygon of at least three corners (row, col) [px], got shape "
            f"{corners.shape}"
        )
    last = np.array(grid.shape) - 0.5
    if not np.isfinite(corners).all() or (corners < -0.5).any() or (corners > last).any():
        raise InputError(
            f"expected a polygon inside the image of {grid.rows} x {grid.cols} px, got corners "
            f"from {corners.min(axis=0).tolist()} to {corners.max(axis=0).tolist()} (row, col)"
        )
    inside = np.asarray(polygon2mask(grid.shape, corners))  # type: ignore[no-untyped-call]
    _require_material(inside, np.asarray(mask, dtype=np.bool_), "polygon")
    low, high = corners.min(axis=0), corners.max(axis=0)
    text = f"The cellular part is a polygon of {len(corners)} corners, as given."
    return _region(low, high, mask, grid, text, *_unlike_box(inside, low, high))


def region_of_mask(region: ArrayLike, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from a mask image (rows, cols): True where the specimen is cellular.

    Raises InputError if it has another size, or holds hardly any material.
    """
    inside = np.asarray(region, dtype=np.bool_)
    if inside.shape != grid.shape:
        raise InputError(
            f"expected a mask of the cellular part of {grid.rows} x {grid.cols} px like the "
            f"images, got shape {inside.shape}"
        )
    _require_material(inside, np.asarray(mask, dtype=np.bool_), "mask of the cellular part")
    low, high = _bounds(inside)
    if min(high - low) < 2.0:
        raise InputError("expected a cellular part with an area, got pixels that lie in one line")
    text = "The cellular part is a mask image, as given."
    return _region(low, high, mask, grid, text, *_unlike_box(inside, low, high))


def junction(lattice: HoleLattice, grid: PixelGrid) -> tuple[float, float]:
    """(x, y) [mm] of a solid junction between holes, where the paper puts a mode's origin."""
    x, y = grid.to_mm(*lattice.position((0.5, 0.5)))
    return float(x), float(y)


def _region(
    low: FloatArray, high: FloatArray, mask: ArrayLike, grid: PixelGrid, *text: str
) -> Region:
    """The region of a cellular part between two (row, col) [px], in the specimen of a mask."""
    least, most = _bounds(_largest_part(np.asarray(mask, dtype=np.bool_)))
    cut = (least[1] < 0.5, most[1] > grid.cols - 1.5, most[0] > grid.rows - 1.5, least[0] < 0.5)
    if any(cut):
        sides = ", ".join(side for side, outside in zip(SIDES, cut, strict=True) if outside)
        text = (*text, f"The specimen leaves the image at the {sides}.")
    # Half a cell of rounding, or a crooked edge, must not make the domain smaller than the part.
    domain = _box(np.minimum(low, least), np.maximum(high, most), grid)
    return Region(_box(low, high, grid), domain, text)


def box_of(mask: BoolArray, grid: PixelGrid) -> Box:
    """The box along the outer edges of the pixels of a mask [mm]."""
    return _box(*_bounds(mask), grid)


def _bounds(mask: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (row, col) of the outer edges of a mask's pixels [px]."""
    rows, cols = find_objects(mask.astype(np.uint8))[0]
    return (
        np.array([rows.start - 0.5, cols.start - 0.5]),
        np.array([rows.stop - 0.5, cols.stop - 0.5]),
    )


def _largest_part(mask: BoolArray) -> BoolArray:
    """The largest connected part of the material."""
    parts, count = label(mask)
    if count == 0:
        raise InputError("expected material in the mask, got a mask with nothing in it")
    return np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))


def _box(low: FloatArray, high: FloatArray, grid: PixelGrid) -> Box:
    """The box [mm] between two (row, col) [px]."""
    (left, right), (top, bottom) = grid.to_mm([low[0], high[0]], [low[1], high[1]])
    return Box(float(left), float(right), float(bottom), float(top))


def _require_material(inside: BoolArray, mask: BoolArray, what: str) -> None:
    share = float(mask[inside].mean()) if inside.any() else 0.0
    if share < _SOME:
        raise InputError(
            f"expected material inside the {what}, got {100 * share:.1f} % of it; is it given as "
            "(row, col) with rows downwards?"
        )


def _unlike_box(inside: BoolArray, low: FloatArray, high: FloatArray) -> list[str]:
    share = inside.sum() / float(np.prod(high - low))
    if share >= _FILLED:
        return []
    return [f"It fills {100 * share:.0f} % of its bounding box, on which the modes are set up."]


_UPRIGHT_DEG = 1.0
_OVERLAP = 0.5
"""Largest overlap of the boxes of two parts [cells]: the width of their modes' tapers."""


_FEW = (
    "The pattern is {:.1f} cells across in view: on fewer than {} its wave vectors, a1 and v1 are "
    "off by percents; take more of it into view."
)


@dataclass(frozen=True, eq=False)
class Geometry:
    """The specimen as the reference shows it."""

    grid: PixelGrid
    mask: BoolArray
    """(rows, cols) True on material."""
    lattice: HoleLattice | None
    """Lattice of the holes; None where there is none and the region was given."""
    region: Region
    parts: Mapping[str, Box]
    """Boxes around the parts with modes of their own, by name [mm]; by default the whole cellular
    part, whose name is ""."""

    @property
    def lattice_mm(self) -> FloatArray | None:
        """(2, 2) vectors of the lattice as rows, along x and y [mm]; None for a square one.

        A square lattice along the image's axes is what the paper's family is written for; a
        specimen turned by less than a degree is followed by the mode's own wave vectors.
        """
        lattice = self.lattice
        if lattice is None:
            return None
        if lattice.kind == "square" and abs(lattice.rotation_deg) < _UPRIGHT_DEG:
            return None
        row, col = lattice.vectors.T
        return np.asarray(np.column_stack([col, -row]) * self.grid.pixel_size)

    def few_cells(self, cell_size: float) -> tuple[str, ...]:
        """Warnings if a part has too few cells [mm] across for its wave vectors."""
        across = min(cells_across(box, cell_size) for box in self.parts.values())
        return (_FEW.format(across, FEWEST_CELLS),) * (round(across) < FEWEST_CELLS)


def find_geometry(mask: BoolArray, grid: PixelGrid, table: SpecimenTable, base: Path) -> Geometry:
    """Find holes, lattice and cellular part in the reference's material (rows, cols).

    Raises InputError if the holes contradict the cell size, there is no lattice and no region is
    given, or given parts lie outside the image or on one another.
    """
    lattice: HoleLattice | None = None
    try:
        lattice = find_hole_lattice(mask, table.cell_size / grid.pixel_size)
    except InputError as error:
        if not (table.polygon or table.cells or table.regions):
            raise _no_pattern(mask, grid, error) from error
    given = {
        r.name: _polygon(r.polygon, mask, grid, f"specimen.regions {r.name!r}").cellular
        for r in table.regions
    }
    _require_apart(given, table.cell_size)
    region = _cellular(table, lattice, mask, grid, base)
    return Geometry(grid, mask, lattice, region, given or {"": region.cellular})


def _no_pattern(mask: BoolArray, grid: PixelGrid, error: InputError) -> InputError:
    """Error that tells how to measure a body without a lattice of holes; or ``error`` itself."""
    if "no lattice" not in str(error) and not mask.all():
        return error
    height, width = (mask.any(axis=k).sum() * grid.pixel_size for k in (1, 0))
    why = "no holes" if mask.all() else str(error).rpartition("in it: ")[2].partition(";")[0]
    return InputError(
        f"expected a lattice of holes, got a body of {width:.3g} x {height:.3g} mm with {why}; its "
        "displacement is measured by 'modeharvest measure REFERENCE DEFORMED... --pixel-size "
        f"{grid.pixel_size:g}', or draw the cellular part (specimen.polygon)"
    )


def _cellular(
    table: SpecimenTable, lattice: HoleLattice | None, mask: BoolArray, grid: PixelGrid, base: Path
) -> Region:
    """The cellular part: drawn, given as an image, or where the holes or the parts are."""
    if table.polygon:
        return _polygon(table.polygon, mask, grid, "specimen.polygon")
    if table.cells:
        cells = read_mask(base / table.cells)
        require_same_shape(mask, cells, "the photographs", str(base / table.cells))
        return region_of_mask(cells, mask, grid)
    if lattice is not None:
        return region_of_lattice(lattice, mask, grid)
    corners = np.array([corner for region in table.regions for corner in region.polygon])
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    around = ((left, top), (right, top), (right, bottom), (left, bottom))
    return _polygon(around, mask, grid, "specimen.regions")


def _polygon(polygon: Corners, mask: BoolArray, grid: PixelGrid, where: str) -> Region:
    """The region of corners (column, row), its faults reported with their table."""
    try:
        return region_of_polygon([(row, col) for col, row in polygon], mask, grid)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _require_apart(parts: Mapping[str, Box], cell_size: float) -> None:
    """Raise InputError if two parts share more than their modes' tapers do."""
    for (one, a), (other, b) in combinations(parts.items(), 2):
        shared = min(
            min(a.x_max, b.x_max) - max(a.x_min, b.x_min),
            min(a.y_max, b.y_max) - max(a.y_min, b.y_min),
        )
        if shared > _OVERLAP * cell_size:
            raise InputError(
                f"specimen.regions: expected parts beside each other, got {one!r} and "
                f"{other!r}, whose boxes overlap by {shared:.3g} mm; draw them apart"
            )
