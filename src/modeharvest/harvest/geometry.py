"""Where the holes are, what lattice they lie on, and which parts of the specimen are cellular."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.harvest.experiment import Corners, SpecimenTable
from modeharvest.harvest.prepare import Prepared
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.specimen.hole_lattice import HoleLattice, find_hole_lattice
from modeharvest.idic.specimen.hole_motion import HoleMotion, possible_motions
from modeharvest.idic.specimen.region import (
    Region,
    region_of_lattice,
    region_of_mask,
    region_of_polygon,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.io import read_mask, require_same_shape

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_UPRIGHT_DEG = 1.0
_OVERLAP = 0.5
"""Cells by which the boxes of two parts may overlap; so wide are the tapers of their modes."""


@dataclass(frozen=True)
class Part:
    """Where modes live.

    Parameters
    ----------
    name
        Of a part with a pattern of its own; "" for the whole cellular part.
    box
        Around it [mm].
    """

    name: str
    box: Box


@dataclass(frozen=True, eq=False)
class Geometry:
    """The specimen as the reference shows it.

    Parameters
    ----------
    grid
        The pixels.
    mask
        (rows, cols) True on material.
    lattice
        Of the holes; None where there is none and the region was given.
    region
        The cellular part.
    parts
        Of the cellular part, each with modes of its own; one by default.
    """

    grid: PixelGrid
    mask: BoolArray
    lattice: HoleLattice | None
    region: Region
    parts: tuple[Part, ...]

    @property
    def lattice_mm(self) -> FloatArray | None:
        """(2, 2) vectors of the lattice as rows, along x and y [mm]; None for a square one.

        A square lattice along the image's axes is what the paper's family is written for; a
        specimen turned by less than a degree is followed by the mode's own wave vectors.
        """
        if self.lattice is None or self._is_upright:
            return None
        row, col = self.lattice.vectors.T
        return np.asarray(np.column_stack([col, -row]) * self.grid.pixel_size)

    @property
    def _is_upright(self) -> bool:
        assert self.lattice is not None
        return self.lattice.kind == "square" and abs(self.lattice.rotation_deg) < _UPRIGHT_DEG

    def motions_in(self, mask: BoolArray) -> tuple[tuple[HoleMotion, ...], str]:
        """How the holes may have moved in a deformed image, the likeliest first.

        Nothing where they can't be followed; the sentence says why. See
        :func:`modeharvest.idic.specimen.hole_motion.possible_motions`.

        Parameters
        ----------
        mask
            (rows, cols) True on material of the deformed image.
        """
        if self.lattice is None:
            return (), "The reference shows no lattice of holes to follow."
        try:
            return possible_motions(self.lattice, find_hole_lattice(mask)), ""
        except InputError as error:
            return (), f"The holes could not be followed: {error}."


def find_geometry(prepared: Prepared, table: SpecimenTable, base: Path) -> Geometry:
    """Find holes, lattice and cellular part in the reference.

    Raises
    ------
    InputError
        If the holes contradict the cell size, there is no lattice and no region is given, or
        given parts lie outside the image or on one another.
    """
    grid, mask = prepared.grid, prepared.mask()
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
    """The region of corners (column, row), its faults told with the table that they come from."""
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
