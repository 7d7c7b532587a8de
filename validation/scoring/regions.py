"""Where on a cellular specimen a point lies: at a hole's edge, in a ligament, a junction, the bulk.

Errors of a displacement measurement differ from one to the next: subsets stick out over edges,
ligaments bend, junctions turn almost rigidly, the bulk hardly moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from modeharvest.fem.specimen import Specimen
from modeharvest.imaging.grid import PixelGrid

BoolArray = NDArray[np.bool_]

EDGES, LIGAMENTS, JUNCTIONS, BULK = REGIONS = ("edges", "ligaments", "junctions", "bulk")
EDGE_PX = 10
"""Material closer than this to a hole or to the outside counts as edge [px]."""


def regions(
    mask: BoolArray, grid: PixelGrid, specimen: Specimen, edge_px: int = EDGE_PX
) -> NDArray[np.int8]:
    """Label every pixel of the undeformed specimen.

    Parameters
    ----------
    mask
        (rows, cols) True on material.
    grid
        Where the pixels are.
    specimen
        The geometry; its scatter, if any, is small against the ligaments.
    edge_px
        Width of the edges [px].

    Returns
    -------
    (rows, cols) index into :data:`REGIONS`, -1 where there is no material. Edges are told first,
    then what lies outside the cellular part (bulk); the rest belongs to the ligament or junction
    whose middle is nearest.
    """
    labels = np.full(grid.shape, -1, dtype=np.int8)
    # A pixel on the boundary belongs to the cellular part, however its position was rounded.
    a, b = (size + 1e-9 * specimen.pitch for size in specimen.cellular_half_size)
    cellular = (np.abs(grid.y)[:, None] <= b) & (np.abs(grid.x)[None, :] <= a)
    labels[mask & ~cellular] = REGIONS.index(BULK)
    row, col = np.nonzero(mask & cellular)
    labels[row, col] = _nearest(specimen, grid.x[col], grid.y[row])
    padded = np.pad(mask, 1)
    near = ndimage.distance_transform_edt(padded)[1:-1, 1:-1] <= edge_px
    labels[mask & near] = REGIONS.index(EDGES)
    return labels


def _nearest(specimen: Specimen, x: ArrayLike, y: ArrayLike) -> NDArray[np.int8]:
    """Whether the middle of a ligament or of a junction is nearest to positions [mm]."""
    pitch, half = specimen.pitch, 0.5 * specimen.pitch
    # From the nearest hole's centre, in the quarter of its cell where both are positive.
    dx, dy = (
        np.abs(np.mod(np.asarray(at) - centre + half, pitch) - half)
        for at, centre in zip((x, y), specimen.hole_centres[0], strict=True)
    )
    ligament = np.minimum(np.hypot(dx - half, dy), np.hypot(dx, dy - half))
    is_junction = np.hypot(dx - half, dy - half) < ligament - 1e-9 * pitch
    kinds = REGIONS.index(LIGAMENTS), REGIONS.index(JUNCTIONS)
    return np.where(is_junction, kinds[1], kinds[0]).astype(np.int8)
