"""The cellular region of a specimen, the lattice of its holes in mm, and boxes for an ansatz.

The cellular part comes from the lattice of the holes, from a polygon drawn by hand, or from a
mask image; modes live there. The domain of v0 is the whole specimen as far as the image shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import find_objects, label
from scipy.spatial import KDTree
from skimage.draw import polygon2mask

from modeharvest.fem.lattice.options import lattice_vectors
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.photograph.holes import HoleLattice, find_holes
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

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
    """Where the region comes from, and what is odd about it."""


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
    return _region(_box(low, high, grid), mask, grid, [text])


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
    text = [f"The cellular part is a polygon of {len(corners)} corners, as given."]
    text += _unlike_box(inside, low, high)
    return _region(_box(low, high, grid), mask, grid, text)


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
    text = ["The cellular part is a mask image, as given.", *_unlike_box(inside, low, high)]
    return _region(_box(low, high, grid), mask, grid, text)


def junction(lattice: HoleLattice, grid: PixelGrid) -> tuple[float, float]:
    """(x, y) [mm] of a solid junction between holes, where the paper puts a mode's origin."""
    x, y = grid.to_mm(*lattice.position((0.5, 0.5)))
    return float(x), float(y)


def _region(box: Box, mask: ArrayLike, grid: PixelGrid, text: list[str]) -> Region:
    low, high = _bounds(_largest_part(np.asarray(mask, dtype=np.bool_)))
    domain = _box(low, high, grid)
    cut = (low[1] < 0.5, high[1] > grid.cols - 1.5, high[0] > grid.rows - 1.5, low[0] < 0.5)
    if any(cut):
        sides = ", ".join(side for side, outside in zip(SIDES, cut, strict=True) if outside)
        text = [*text, f"The specimen leaves the image at the {sides}."]
    # Half a cell of rounding or of a crooked edge must not make the domain the smaller one.
    domain = Box(
        min(box.x_min, domain.x_min),
        max(box.x_max, domain.x_max),
        min(box.y_min, domain.y_min),
        max(box.y_max, domain.y_max),
    )
    return Region(box, domain, tuple(text))


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


NEARLY_SQUARE = 0.05
"""Relative difference of lengths, and cosine between directions, of a square lattice's vectors."""
WRONG_CELL = 0.07
"""Relative difference of a cell size given from one found, beyond which they contradict each
other: over the paper's six cells the phase of its mode drifts by 1.3 rad, and a correlation may
settle in a local minimum. A measured field's peaks are known to a few hundredths."""
_FEWEST_HOLES = 4
_SMALLEST_HOLE = 0.01
"""Area of a hole [cells] below which it is a speck in the mask."""


@dataclass(frozen=True, eq=False)
class Cells:
    """The lattice of holes."""

    cell_size: float
    """l, the distance of neighbouring holes [mm]."""
    vectors: FloatArray
    """(2, 2) lattice vectors as rows [mm]."""
    given: bool
    """Whether they were given, or are square for want of better knowledge."""
    hole: FloatArray
    """(2,) centre of one hole [mm]."""

    @classmethod
    def found(
        cls,
        cell_size: float,
        lattice: ArrayLike | None,
        pair: ImagePair,
        boxes: Sequence[Box],
        holes: LocalField | None,
    ) -> Cells:
        """Take what is given, and the rest from the mask; raises InputError if they differ."""
        if not cell_size > 0:
            raise InputError(f"initial guess: expected a positive cell size, got {cell_size} mm")
        vectors = _matching_vectors(cell_size, lattice)
        centres = np.zeros((0, 2)) if holes is None else np.column_stack([holes.x, holes.y])
        if holes is None and pair.mask is not None and not pair.mask.all():
            centres = hole_centres(pair, boxes, cell_size)
        centres = centres[np.isfinite(centres).all(axis=1)]
        require_hole_distance(centres, cell_size)
        corner = np.array([boxes[0].x_min, boxes[0].y_min])
        hole = _middle_hole(centres, vectors) if len(centres) else corner + vectors.sum(axis=0) / 2
        return cls(cell_size, vectors, lattice is not None, hole)

    @property
    def square(self) -> bool:
        """Whether the lattice vectors are as long as each other, and at right angles."""
        a, b = np.linalg.norm(self.vectors, axis=1)
        cosine = abs(self.vectors[0] @ self.vectors[1]) / (a * b)
        return bool(abs(a - b) <= NEARLY_SQUARE * a and cosine <= NEARLY_SQUARE)

    @property
    def junction(self) -> FloatArray:
        """(2,) the middle of the solid between four holes [mm]."""
        return np.asarray(self.hole - 0.5 * self.vectors.sum(axis=0))


def hole_centres(pair: ImagePair, boxes: Sequence[Box], cell_size: float) -> FloatArray:
    """(n, 2) centres of the holes of the reference that lie in boxes [mm]; specks are left out."""
    holes = find_holes(pair.masks[0], _SMALLEST_HOLE * (cell_size / pair.grid.pixel_size) ** 2)
    x, y = pair.grid.to_mm(*holes.centres.T)
    inside = [
        (x > box.x_min) & (x < box.x_max) & (y > box.y_min) & (y < box.y_max) for box in boxes
    ]
    return np.vstack([np.column_stack([x, y])[within] for within in inside])


def require_hole_distance(centres: FloatArray, cell_size: float) -> None:
    """Raise InputError if neighbouring holes are not a cell size apart; not of too few holes."""
    if len(centres) < _FEWEST_HOLES:
        return
    apart = float(np.median(KDTree(centres).query(centres, k=2)[0][:, 1]))
    if abs(apart - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"initial guess: expected holes {cell_size:g} mm apart, the cell size given, got "
            f"{apart:.3g} mm between neighbours of {len(centres)} holes; give cell size "
            f"{apart:.3g} mm, or check the pixel size"
        )


def _middle_hole(centres: FloatArray, vectors: FloatArray) -> FloatArray:
    """(2,) where the hole in the middle should be, by itself and its neighbours [mm]."""
    middle = centres[np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1))]
    steps = np.linalg.solve(vectors.T, (centres - middle).T).T
    near = np.abs(steps).max(axis=1) < 1.5
    return np.asarray((centres - np.round(steps) @ vectors)[near].mean(axis=0))


def _matching_vectors(cell_size: float, lattice: ArrayLike | None) -> FloatArray:
    """(2, 2) vectors of the lattice of holes as rows [mm], the first one nearest to the x axis.

    Raises InputError if it isn't one, or its shortest distance isn't the cell size within 7 %.
    """
    if lattice is None:
        return cell_size * np.eye(2)
    vectors = lattice_vectors(lattice, "initial guess")
    i = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)
    lengths = np.linalg.norm(i[np.any(i != 0, axis=1)] @ vectors, axis=1)
    shortest = float(lengths.min())
    if abs(shortest - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"initial guess: expected holes {cell_size:g} mm apart, the cell size given, got a "
            f"lattice of holes {shortest:.3g} mm apart; give cell size {shortest:.3g} mm, or check "
            "the pixel size"
        )
    if np.prod(np.abs(np.diag(vectors[::-1]))) > np.prod(np.abs(np.diag(vectors))):
        vectors = vectors[::-1]
    signs = np.where(np.diag(vectors) < 0, -1.0, 1.0)
    return np.asarray(vectors * signs[:, None])
