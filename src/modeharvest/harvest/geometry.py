"""Where the holes are, what lattice they lie on, and which part of the specimen is cellular."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.harvest.experiment import SpecimenTable
from modeharvest.harvest.prepare import Prepared
from modeharvest.idic.hole_lattice import HoleLattice, find_hole_lattice
from modeharvest.idic.hole_motion import HoleMotion, match
from modeharvest.idic.region import Region, region_of_lattice, region_of_mask, region_of_polygon
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.io import read_mask

FloatArray = NDArray[np.float64]


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
    """

    grid: PixelGrid
    mask: NDArray[np.bool_]
    lattice: HoleLattice | None
    region: Region

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

    def motion_in(self, mask: NDArray[np.bool_]) -> tuple[HoleMotion | None, str]:
        """How the holes have moved in a deformed image, and a sentence about it.

        None where they can't be followed; the sentence says why.

        Parameters
        ----------
        mask
            (rows, cols) True on material of the deformed image.
        """
        if self.lattice is None:
            return None, "The reference shows no lattice of holes to follow."
        try:
            motion = match(self.lattice, find_hole_lattice(mask))
        except InputError as error:
            return None, f"The holes could not be followed: {error}."
        return motion, " ".join(motion.sentences)


_UPRIGHT_DEG = 1.0


def find_geometry(prepared: Prepared, table: SpecimenTable, base: Path) -> Geometry:
    """Find holes, lattice and cellular part in the reference.

    Raises
    ------
    InputError
        If the holes contradict the cell size, or there is no lattice and no region is given.
    """
    grid, mask = prepared.grid, prepared.mask()
    lattice: HoleLattice | None = None
    try:
        lattice = find_hole_lattice(mask, table.cell_size / grid.pixel_size)
    except InputError:
        if not (table.polygon or table.cells):
            raise
    if table.polygon:
        region = region_of_polygon([(row, col) for col, row in table.polygon], mask, grid)
    elif table.cells:
        region = region_of_mask(read_mask(base / table.cells), mask, grid)
    else:
        assert lattice is not None  # it was raised otherwise
        region = region_of_lattice(lattice, mask, grid)
    return Geometry(grid, mask, lattice, region)
