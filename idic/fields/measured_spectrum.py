"""Spectral densities of a field measured at points, as those of a field known at pixels.

The points of a subset DIC lie on a regular grid with gaps, at holes and where subsets failed; in
``families.spectrum.spectral_density`` they take the place of pixels, and gaps that of holes.
Scattered points are interpolated to such a grid first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from modeharvest.errors import InputError
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.families.spectrum import Spectrum, spectral_density
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ON_GRID = 0.1
"""Distance [steps] from a regular grid's points up to which points are taken to lie on them; it
moves a wave of 10 steps by 6 % of its amplitude at most, at random."""
FEWEST_A_CELL = 6
"""Points along a unit cell: fewer, and waves of a cell's length can't be told from longer ones."""
MOST_POINTS = 4e7
"""Of the regular grid: more, and a stray point far away is the likelier reason."""


def measured_spectrum(field: LocalField, pitch: float, region: Box | None = None) -> Spectrum:
    """Transform a displacement field measured at points.

    Parameters
    ----------
    field
        What was measured; points that are not valid count as gaps.
    pitch
        Unit cell size l [mm].
    region
        Only the points in this box: for parts of a specimen with patterns of their own.

    Returns
    -------
    Spectrum
        The affine part of the field removed, over this region alone.

    Raises
    ------
    InputError
        If no valid point is in the region, or the points are too sparse for the unit cell.
    """
    if region is not None:
        field = field.within(region)
    if not pitch > 0:
        raise InputError(f"expected a positive unit cell size, got {pitch} mm")
    if not pitch >= FEWEST_A_CELL * field.spacing:
        raise InputError(
            f"local field {field.source}: expected points at most {pitch / FEWEST_A_CELL:.3g} mm "
            f"apart, 1/{FEWEST_A_CELL} of the cell, got {field.spacing:.3g} mm; measure with a "
            "smaller step"
        )
    displacement, grid, mask = gridded(field)
    return spectral_density(displacement, grid, mask, pitch)


def gridded(field: LocalField) -> tuple[FloatArray, PixelGrid, BoolArray]:
    """Put a field on a regular grid of its own spacing.

    Returns
    -------
    (rows, cols, 2) displacements [mm], 0 in gaps; the grid, whose "pixels" are the points; and
    (rows, cols) True where there is a point.

    Raises
    ------
    InputError
        If the points spread over far more than they fill.
    """
    x, y, u = field.valid_points()
    step = field.spacing
    if not 0 < step < np.inf:
        raise InputError(f"local field {field.source}: expected points at different positions")
    steps = np.rint(np.ptp(np.stack([x, y]), axis=1) / step)
    if np.prod(steps + 1) > MOST_POINTS:
        raise InputError(
            f"local field {field.source}: expected points that fill their box, got {len(x)} points "
            f"{step:.3g} mm apart over {np.ptp(x):.3g} x {np.ptp(y):.3g} mm; remove stray points"
        )
    # Over the whole field's length the step is known better than from two neighbours.
    step = float((np.ptp(x) + np.ptp(y)) / steps.sum())
    cols, rows = (int(n) + 1 for n in steps)
    grid = PixelGrid(rows, cols, step, float(x.min()), float(y.max()))
    points = np.column_stack(grid.to_px(x, y))
    nearest = np.rint(points).astype(int).clip(0, (rows - 1, cols - 1))
    if np.abs(points - nearest).max() > ON_GRID:
        return _interpolated(points, u, grid)
    row, col = nearest.T
    displacement, mask = np.zeros((rows, cols, 2)), np.zeros((rows, cols), dtype=np.bool_)
    displacement[row, col], mask[row, col] = u, True
    return displacement, grid, mask


def _interpolated(
    points: FloatArray, u: FloatArray, grid: PixelGrid
) -> tuple[FloatArray, PixelGrid, BoolArray]:
    """Between scattered points (row, col), linearly; a gap where none is within a step."""
    at = np.indices(grid.shape).reshape(2, -1).T
    value = LinearNDInterpolator(points, u, fill_value=0.0)(at).reshape(*grid.shape, 2)
    mask = (cKDTree(points).query(at)[0] <= 1.0).reshape(grid.shape)
    return np.asarray(value), grid, mask
