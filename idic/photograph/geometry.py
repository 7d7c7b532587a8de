"""Geometry of a photographed specimen: hole lattice, cellular parts, and where they have moved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.photograph.holes import HoleLattice, find_hole_lattice
from modeharvest.idic.photograph.matching import (
    BlockMatch,
    Expected,
    HoleMotion,
    match_blocks,
    possible_motions,
    require_same_surface,
)
from modeharvest.idic.photograph.region import (
    Region,
    region_of_lattice,
    region_of_mask,
    region_of_polygon,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
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
    """What is known of the specimen beforehand."""

    cell_size: float = math.nan
    """l [mm], the distance of neighbouring holes."""
    polygon: Corners = ()
    """Corners (column, row) of the cellular part in the reference [px]; else found from holes."""
    cells: str = ""
    """Or a mask image of the cellular part, white inside."""
    material: str = ""
    """Mask image of the reference's material, white on it; found from the image otherwise."""
    deformed_material: tuple[str, ...] = ()
    """The same of each deformed image, in their order; names may hold wildcards."""
    regions: tuple[RegionTable, ...] = ()
    """Parts of the cellular part whose patterns differ; by default it has one pattern."""

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
        names = [region.name for region in self.regions]
        if len(set(names)) < len(names):
            raise InputError(
                f"specimen.regions: expected names that differ, got {', '.join(names)}"
            )


_UPRIGHT_DEG = 1.0
_OVERLAP = 0.5
"""Cells by which the boxes of two parts may overlap; so wide are the tapers of their modes."""


@dataclass(frozen=True)
class Part:
    """Where modes live."""

    name: str
    """Of a part with a pattern of its own; "" for the whole cellular part."""
    box: Box
    """Around it [mm]."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """The specimen as the reference shows it."""

    grid: PixelGrid
    mask: BoolArray
    """(rows, cols) True on material."""
    lattice: HoleLattice | None
    """Of the holes; None where there is none and the region was given."""
    region: Region
    parts: tuple[Part, ...]
    """Of the cellular part, each with modes of its own; one by default."""

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


def find_geometry(mask: BoolArray, grid: PixelGrid, table: SpecimenTable, base: Path) -> Geometry:
    """Find holes, lattice and cellular part in the reference's material (rows, cols).

    Raises InputError if the holes contradict the cell size, there is no lattice and no region is
    given, or given parts lie outside the image or on one another.
    """
    lattice: HoleLattice | None = None
    try:
        lattice = find_hole_lattice(mask, table.cell_size / grid.pixel_size)
    except InputError:
        if not (table.polygon or table.cells or table.regions):
            raise
    given = tuple(
        Part(r.name, _polygon(r.polygon, mask, grid, f"specimen.regions {r.name!r}").cellular)
        for r in table.regions
    )
    _require_apart(given, table.cell_size)
    region = _region(table, lattice, mask, grid, base)
    return Geometry(grid, mask, lattice, region, given or (Part("", region.cellular),))


def _region(
    table: SpecimenTable,
    lattice: HoleLattice | None,
    mask: BoolArray,
    grid: PixelGrid,
    base: Path,
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


def _require_apart(parts: tuple[Part, ...], cell_size: float) -> None:
    """Raise InputError if two parts share more than their modes' tapers do."""
    for one, other in combinations(parts, 2):
        a, b = one.box, other.box
        shared = min(
            min(a.x_max, b.x_max) - max(a.x_min, b.x_min),
            min(a.y_max, b.y_max) - max(a.y_min, b.y_min),
        )
        if shared > _OVERLAP * cell_size:
            raise InputError(
                f"specimen.regions: expected parts beside each other, got {one.name!r} and "
                f"{other.name!r}, whose boxes overlap by {shared:.3g} mm; draw them apart"
            )


def matched_holes(pair: ImagePair, geometry: Geometry) -> tuple[HoleMotion | None, str]:
    """How the holes have moved, and a text about it; None where they can't be followed.

    Where a column of holes has left the image, the holes alone allow several answers; the speckle
    between them decides. Raises InputError if the images don't show the same surface.
    """
    if geometry.lattice is None:
        return None, "The reference shows no lattice of holes to follow."
    try:
        motions = possible_motions(geometry.lattice, find_hole_lattice(pair.masks[1]))
    except InputError as error:
        return None, f"The holes could not be followed: {error}."
    tied = motions[0].rivals + 1
    motion, blocks = best = _best(pair, motions[:tied])
    if not blocks.is_same and len(motions) > tied:  # those that match fewer holes
        motion, blocks = max(best, _best(pair, motions[tied:]), key=_share)
    require_same_surface(blocks, "the reference", "the deformed one")
    text = [*motion.text, blocks.text]
    if motion is not motions[0] or motion.rivals:
        text.append("Which hole is which was decided by the speckle between them.")
    return motion, " ".join(text)


def confirmed_by_speckle(pair: ImagePair, expected: Expected) -> str:
    """A text about blocks of the reference that were found where they are expected.

    Raises InputError if the images don't show the same surface.
    """
    blocks = match_blocks(pair.reference, pair.deformed, pair.mask, expected)
    require_same_surface(blocks, "the reference", "the deformed one")
    return blocks.text


def _best(pair: ImagePair, motions: Sequence[HoleMotion]) -> tuple[HoleMotion, BlockMatch]:
    """The motion that the speckle agrees with best."""
    return max(
        ((m, match_blocks(pair.reference, pair.deformed, pair.mask, m.at)) for m in motions),
        key=_share,
    )


def _share(found: tuple[HoleMotion, BlockMatch]) -> float:
    return found[1].share
