"""The cellular region of a specimen, and the boxes that an ansatz needs.

The cellular part comes from the lattice of the holes, from a polygon drawn by hand, or from a
mask image; modes live there. The domain of v0 is the whole specimen as far as the image shows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import find_objects, label
from scipy.spatial import ConvexHull
from skimage.draw import polygon2mask

from modeharvest.idic.photograph.holes import HoleLattice
from modeharvest.idic.slow_fields import Box
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

SIDES = ("left", "right", "bottom", "top")
_FILLED = 0.9
"""Share of its bounding box below which a region is not nearly a rectangle."""
_SOME = 0.01
"""A region with less material than this share of itself is a mistake."""


@dataclass(frozen=True, eq=False)
class Region:
    """The cellular part of a specimen.

    Parameters
    ----------
    cellular
        Smallest axis-parallel box around the cellular part [mm].
    domain
        Box around all material in the image [mm].
    polygon
        (n, 2) outline of the cellular part, (row, col) [px].
    margins
        Width of the bulk beside ``cellular`` [mm]: left, right, bottom, top; NaN where the
        specimen leaves the image, so that it is not known.
    sentences
        Where the region comes from, and what is odd about it.
    """

    cellular: Box
    domain: Box
    polygon: FloatArray
    margins: tuple[float, float, float, float]
    sentences: tuple[str, ...]

    def inside(self, grid: PixelGrid) -> BoolArray:
        """(rows, cols) True on the pixels within the polygon."""
        return _filled(self.polygon, grid.shape)


def region_of_lattice(lattice: HoleLattice, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from the holes: every hole's cell, half a lattice vector each way.

    Parameters
    ----------
    lattice
        In the reference image.
    mask
        (rows, cols) True on material of the reference.
    grid
        Its pixels.
    """
    reach = 0.5 * np.abs(lattice.vectors).max(axis=0)  # rows and columns of a cell
    low, high = lattice.centres.min(axis=0) - reach, lattice.centres.max(axis=0) + reach
    steps = 0.5 * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) @ lattice.vectors
    corners = (lattice.centres[:, None] + steps).reshape(-1, 2)
    polygon = corners[ConvexHull(corners).vertices]
    said = (
        f"The cellular part is the cells of {len(lattice)} holes on a {lattice.kind} lattice of "
        f"{lattice.pitch_px * grid.pixel_size:.4g} mm."
    )
    box = _box(low, high, grid)
    return _region(box, polygon, mask, grid, (said,))


def region_of_polygon(polygon: ArrayLike, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from a polygon drawn by hand.

    Parameters
    ----------
    polygon
        (n, 2) corners in order, (row, col) [px], at least three.
    mask
        (rows, cols) True on material of the reference.
    grid
        Its pixels.

    Raises
    ------
    InputError
        If it has no area, leaves the image, or holds hardly any material.
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
    inside = _filled(corners, grid.shape)
    _require_material(inside, np.asarray(mask, dtype=np.bool_), "polygon")
    box = _box(corners.min(axis=0), corners.max(axis=0), grid)
    said = [f"The cellular part is a polygon of {len(corners)} corners, as given."]
    said += _unlike_box(inside, corners.min(axis=0), corners.max(axis=0))
    return _region(box, corners, mask, grid, tuple(said))


def region_of_mask(region: ArrayLike, mask: ArrayLike, grid: PixelGrid) -> Region:
    """Make the region from a mask image: True where the specimen is cellular, holes or not.

    Parameters
    ----------
    region
        (rows, cols) True on the cellular part.
    mask
        (rows, cols) True on material of the reference.
    grid
        Its pixels.

    Raises
    ------
    InputError
        If it has another size, or holds hardly any material.
    """
    inside = np.asarray(region, dtype=np.bool_)
    if inside.shape != grid.shape:
        raise InputError(
            f"expected a mask of the cellular part of {grid.rows} x {grid.cols} px like the "
            f"images, got shape {inside.shape}"
        )
    _require_material(inside, np.asarray(mask, dtype=np.bool_), "mask of the cellular part")
    pixels = np.argwhere(inside).astype(np.float64)
    low, high = _bounds(inside)
    said = ["The cellular part is a mask image, as given.", *_unlike_box(inside, low, high)]
    return _region(_box(low, high, grid), _hull(pixels), mask, grid, tuple(said))


def junction(lattice: HoleLattice, grid: PixelGrid) -> tuple[float, float]:
    """(x, y) [mm] of a solid junction between holes, where the paper puts a mode's origin."""
    x, y = grid.to_mm(*lattice.position((0.5, 0.5)))
    return float(x), float(y)


def _region(
    box: Box, polygon: FloatArray, mask: ArrayLike, grid: PixelGrid, said: tuple[str, ...]
) -> Region:
    low, high = _bounds(_largest_part(np.asarray(mask, dtype=np.bool_)))
    domain = _box(low, high, grid)
    cut = (
        low[1] < 0.5,
        high[1] > grid.cols - 1.5,
        high[0] > grid.rows - 1.5,
        low[0] < 0.5,
    )
    widths = (
        box.x_min - domain.x_min,
        domain.x_max - box.x_max,
        box.y_min - domain.y_min,
        domain.y_max - box.y_max,
    )
    margins = tuple(
        float("nan") if outside else float(w) for outside, w in zip(cut, widths, strict=True)
    )
    unseen = [side for side, outside in zip(SIDES, cut, strict=True) if outside]
    if unseen:
        said = (*said, f"The specimen leaves the image at the {', '.join(unseen)}.")
    # Half a cell of rounding or of a crooked edge must not make the domain the smaller one.
    domain = Box(
        min(box.x_min, domain.x_min),
        max(box.x_max, domain.x_max),
        min(box.y_min, domain.y_min),
        max(box.y_max, domain.y_max),
    )
    return Region(box, domain, polygon, (margins[0], margins[1], margins[2], margins[3]), said)


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
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == int(np.argmax(sizes)))


def _box(low: FloatArray, high: FloatArray, grid: PixelGrid) -> Box:
    """The box [mm] between two (row, col) [px]."""
    (left, right), (top, bottom) = grid.to_mm([low[0], high[0]], [low[1], high[1]])
    return Box(float(left), float(right), float(bottom), float(top))


def _filled(polygon: FloatArray, shape: tuple[int, int]) -> BoolArray:
    inside = polygon2mask(shape, polygon)  # type: ignore[no-untyped-call]
    return np.asarray(inside, dtype=np.bool_)


def _hull(pixels: FloatArray) -> FloatArray:
    try:
        corners = ConvexHull(pixels)
    except Exception as error:  # Qhull: all pixels in one line
        raise InputError(
            "expected a cellular part with an area, got pixels that lie in one line"
        ) from error
    return np.asarray(pixels[corners.vertices])


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
