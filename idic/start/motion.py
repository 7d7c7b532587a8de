"""What is known of the motion before any correlation: from hole centres, or from outlines."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from modeharvest.errors import InputError
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.fields.coarse_field import Slow
from modeharvest.idic.start.fits import degree_for, fit_unknowns
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SLOW_DEGREE = 3
"""Total degree of v0 at the start, at most: what bends and barrels, but doesn't follow cells."""
WRONG_CELL = 0.07
"""Relative difference of a cell size given from one found, beyond which they contradict each
other: over the paper's six cells the phase of its mode drifts by 1.3 rad, and a correlation may
settle in a local minimum. A measured field's peaks are known to a few hundredths."""
_FEWEST_HOLES = 4
_SMALLEST_HOLE = 0.01
"""Area of a hole [cells] below which it is a speck in the mask."""


def first_motion(
    domain: Box,
    grid: PixelGrid,
    mask: BoolArray | None,
    deformed_mask: BoolArray | None,
    holes: tuple[ArrayLike, ArrayLike] | None,
) -> tuple[Slow, str]:
    """Find the slow motion from what the images' geometry shows.

    Parameters
    ----------
    domain
        Of the polynomial [mm].
    grid
        The pixels.
    mask, deformed_mask
        (rows, cols) True on material.
    holes
        (n, 2) hole centres in the reference and (n, 2) their displacements [mm]; NaN where lost.

    Returns
    -------
    From (..., 2) points to (..., 2) displacements [mm], and a sentence.
    """
    if holes is not None:
        found = _through_holes(domain, *holes)
        if found is not None:
            return found
    affine = None
    if mask is not None and deformed_mask is not None:
        affine = outline_motion(mask, deformed_mask, grid)
    if affine is None:
        return (
            np.zeros_like,
            "v0 starts from no motion: neither holes nor whole outlines are known.",
        )
    plane = affine
    return lambda points: plane[:, 0] + points @ plane[:, 1:].T, (
        f"v0 starts from the outlines: {100 * affine[0, 1]:+.1f} % along x and "
        f"{100 * affine[1, 2]:+.1f} % along y."
    )


def _through_holes(domain: Box, centres: ArrayLike, motion: ArrayLike) -> tuple[Slow, str] | None:
    """A polynomial through the holes' displacements; None if there are too few for a plane."""
    points, u = (np.asarray(h, dtype=np.float64) for h in (centres, motion))
    if points.ndim != 2 or points.shape[1:] != (2,) or u.shape != points.shape:
        raise InputError(
            "automatic start: expected hole centres (n, 2) and their displacements (n, 2), got "
            f"{points.shape} and {u.shape}"
        )
    good = np.isfinite(np.hstack([points, u])).all(axis=1)
    degree = degree_for(int(good.sum()), SLOW_DEGREE)
    if degree == 0:
        return None
    slow = Ansatz(domain, (), degree, 0)
    fit = fit_unknowns(slow, np.zeros(slow.size), points[good], u[good], degree, -1)
    return partial(slow.displacement_at, fit.coefficients), (
        f"v0 starts from the motion of {good.sum()} hole centres: a polynomial of degree {degree} "
        f"leaves {1e3 * fit.sd:.0f} µm, {fit.outliers} of {2 * good.sum()} components set aside."
    )


def outline_motion(mask: BoolArray, deformed_mask: BoolArray, grid: PixelGrid) -> FloatArray | None:
    """Affine motion that takes one outline to the other, by centre and second moments.

    The holes are filled, so that it doesn't matter how they close. A rotation or a shear can't be
    seen in these moments and is taken to be none.

    Returns
    -------
    (2, 3) u_i = affine[i] · (1, x, y) [mm], [-], [-]; None if material reaches the image's border,
    where an outline says nothing.
    """
    moments = []
    for inside in (mask, deformed_mask):
        if inside[[0, -1]].any() or inside[:, [0, -1]].any():
            return None
        row, col = np.nonzero(ndimage.binary_fill_holes(inside))
        points = np.column_stack(grid.to_mm(row, col))
        moments.append((points.mean(axis=0), points.std(axis=0)))
    (centre, size), (centre_now, size_now) = moments
    stretch = size_now / size
    affine = np.zeros((2, 3))
    affine[:, 0] = centre_now - stretch * centre
    affine[0, 1], affine[1, 2] = stretch - 1.0
    return affine


def hole_centres(mask: BoolArray, grid: PixelGrid, cellular: Box, cell_size: float) -> FloatArray:
    """(n, 2) centres of the holes that lie in the cellular part [mm]; specks are left out."""
    labels, count = ndimage.label(~mask)
    numbers = np.arange(1, count + 1)
    centres = np.array(ndimage.center_of_mass(labels > 0, labels, numbers)).reshape(-1, 2)
    area = ndimage.sum_labels(labels > 0, labels, numbers) * (grid.pixel_size / cell_size) ** 2
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    x, y = grid.to_mm(*centres.T)
    keep = (area > _SMALLEST_HOLE) & ~np.isin(numbers, border)
    keep &= (x > cellular.x_min) & (x < cellular.x_max)
    keep &= (y > cellular.y_min) & (y < cellular.y_max)
    return np.asarray(np.column_stack([x, y])[keep])


def require_hole_distance(centres: FloatArray, cell_size: float) -> None:
    """Raise InputError if neighbouring holes are not a cell size apart; few holes say nothing."""
    if len(centres) < _FEWEST_HOLES:
        return
    apart = float(np.median(cKDTree(centres).query(centres, k=2)[0][:, 1]))
    if abs(apart - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"automatic start: expected holes {cell_size:g} mm apart, the cell size given, got "
            f"{apart:.3g} mm between neighbours of {len(centres)} holes; give cell size "
            f"{apart:.3g} mm, or check the pixel size"
        )
