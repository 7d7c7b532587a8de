"""The inverse isoparametric mapping: element and local coordinates at a pixel or point.

For each position x, find the element e and the local coordinates xi with sum_a N_a(xi) x_a = x,
where x_a are the element's node positions in the state the image shows. The paper inverts the same
mapping to make its virtual images (section "Virtual Experiments").

:func:`locate` fills a regular grid of pixels element by element. :func:`locate_points` finds the
elements of scattered points, such as those that pixels show through a lens: the plane is divided
into buckets that list the elements reaching into them. For an element whose bounding box of Bézier
control points contains the point, the mapping is inverted by Newton's method. An exhaustive search
follows only if no element is found this way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping import rasterise
from modeharvest.imaging.mapping.bernstein import require_positive_jacobian
from modeharvest.imaging.mapping.element_table import (
    ElementTable,
    Pixels,
    bands,
    fill_buckets,
    tabulate_elements,
)
from modeharvest.imaging.mapping.inversion import (
    ON_EDGE,
    coefficients,
    distance_px,
    newton,
    outside,
    search,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.elements import polynomials, reference_element
from modeharvest.util.errors import InputError


@dataclass(frozen=True, eq=False)
class Located:
    """Element and local coordinates, or nodal fields, at every pixel of an image."""

    element: NDArray[np.int32]
    """(rows, cols) int32 number of the element that covers the pixel centre, -1 where none does. A
    pixel on a shared edge or node belongs to the element with the lowest number."""
    values: FloatArray
    """(c, rows, cols) nodal fields at the pixel centres, or the two local coordinates (xi, eta)
    there [-]; NaN outside the mesh."""
    residual_px: NDArray[np.float32]
    """(rows, cols) float32 distance of the mapped (xi, eta) from the pixel [px], or NaN."""
    doubly_covered: int = 0
    """Number of pixels inside more than one element, where the mesh overlaps itself."""

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True where there is material."""
        return np.asarray(self.element >= 0)

    @property
    def xi(self) -> FloatArray:
        """(rows, cols, 2) local coordinates; valid only if located without ``nodal`` fields."""
        return np.moveaxis(self.values, 0, -1)

    @property
    def max_residual_px(self) -> float:
        """The largest residual of the inverse mapping [px]; 0 if no pixel is covered."""
        mask = self.mask
        return float(self.residual_px[mask].max()) if mask.any() else 0.0


def locate(
    nodes: FloatArray,
    cells: IntArray,
    element: str,
    grid: PixelGrid,
    where: str = "mesh",
    nodal: FloatArray | None = None,
) -> Located:
    """Find element and local coordinates, or fields, at every pixel centre of a grid.

    InputError if a Jacobian isn't positive everywhere in some element.

    nodes : (n, 2) node positions in the state to look at: undeformed X or deformed X + u [mm].
    cells, element : (m, k) node numbers of each element; T3, T6, Q4, Q8 or Q9.
    grid : the pixels.
    where : what to call the mesh in an error.
    nodal : (n, c) nodal fields to evaluate instead of the local coordinates: faster than
        :func:`interpolate` afterwards, and needs no memory for the local coordinates.
    """
    require_positive_jacobian(nodes, cells, element, where)
    elements = tabulate_elements(nodes, cells, element, grid)
    start, visits = bands(elements, grid.rows, rasterise.BAND)
    fields = polynomials(element, cells, np.empty((len(nodes), 0)) if nodal is None else nodal)
    size = grid.rows * grid.cols
    pixels = Pixels(
        np.empty(size, dtype=np.int32), np.empty((fields.shape[1] or 2, size)),
        np.empty(size, dtype=np.float32), 0, grid.cols, float(grid.x0), float(grid.y0),
        float(grid.pixel_size),
    )  # fmt: skip
    overlapping = np.zeros(start.size - 1, dtype=np.int64)
    in_parallel(rasterise.rasterise, elements, fields, pixels, start, visits, overlapping)
    return Located(
        pixels.element.reshape(grid.shape), pixels.values.reshape(-1, *grid.shape),
        pixels.residual.reshape(grid.shape), int(overlapping.sum()),
    )  # fmt: skip


def interpolate(located: Located, cells: IntArray, element: str, nodal: FloatArray) -> FloatArray:
    """(c, rows, cols) values of a nodal field (n, c) at located pixels, NaN outside the mesh.

    ``located`` is from :func:`locate` with the same cells. InputError unless the field is (n, c).
    """
    if nodal.ndim != 2:
        raise InputError(f"expected a nodal field of shape (n, c), got {nodal.shape}")
    fields = polynomials(element, cells, np.asarray(nodal, dtype=np.float64))
    out = np.empty((fields.shape[1], *located.element.shape))
    curved = not reference_element(element).triangular
    in_parallel(rasterise.evaluate, fields, curved, located.element, located.xi, out)
    return out


_BUCKET_PX = 16
_BLOCK = 1024  # number of points that a thread processes at a time
_SLACK_PX = 1e-7


class _Buckets(NamedTuple):
    """A grid of square buckets over the image plane, and the elements that reach into each."""

    boxes: FloatArray
    """(m, 4) each element's smallest row and column, largest row and column [px]."""
    start: IntArray
    members: IntArray
    """members[start[b]:start[b + 1]] are the elements of bucket b, ascending."""
    top: float
    left: float
    """Upper left corner of the first bucket (row, col) [px]."""
    rows: int
    cols: int
    """Number of buckets along each axis."""


def locate_points(
    nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid, row: ArrayLike,
    col: ArrayLike, where: str = "mesh",
) -> Located:  # fmt: skip
    """Find element and local coordinates of points given by their image positions.

    Points outside the mesh, and NaN, belong to no element. Points inside more than one element are
    not counted. InputError if a Jacobian isn't positive everywhere in some element.

    nodes, cells, element, where : as for :func:`locate`.
    grid : defines the px coordinates of the points, which need not be pixel centres.
    row, col : positions of the points [px], of shapes that broadcast to two dimensions.
    """
    require_positive_jacobian(nodes, cells, element, where)
    row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
    elements = tabulate_elements(nodes, cells, element, grid)
    owner, residual = np.empty(row.size, dtype=np.int32), np.empty(row.size, dtype=np.float32)
    xi = np.empty((row.size, 2))
    frame = (float(grid.x0), float(grid.y0), float(grid.pixel_size))
    points = (np.ascontiguousarray(row).ravel(), np.ascontiguousarray(col).ravel())
    in_parallel(_locate, elements, _buckets(elements), *points, frame, owner, xi, residual)
    # Same memory layout as from locate, so that kernels are compiled only once.
    shape, values = row.shape, np.ascontiguousarray(xi.T).reshape(2, *row.shape)
    return Located(owner.reshape(shape), values, residual.reshape(shape))


def _buckets(elements: ElementTable) -> _Buckets:
    control = elements.polynomials @ elements.bezier.T
    low = elements.centres + control.min(axis=2) - _SLACK_PX
    high = elements.centres + control.max(axis=2) + _SLACK_PX
    top, left = low.min(axis=0)
    first, last = (((at - [top, left]) // _BUCKET_PX).astype(np.int64) for at in (low, high))
    rows, cols = (int(n) for n in last.max(axis=0) + 1)
    start, members = fill_buckets(np.hstack([first, last + 1]), rows, cols)
    boxes = np.hstack([low, high])
    return _Buckets(boxes, start, members, float(top), float(left), rows, cols)


@compiled()
def _locate(
    elements: ElementTable, buckets: _Buckets, row: FloatArray, col: FloatArray,
    frame: tuple[float, float, float], owner: NDArray[np.int32], xi: FloatArray,
    residual: NDArray[np.float32], thread: int, threads: int,
) -> None:  # fmt: skip
    """Fill owner, xi and residual; each thread writes only its own points."""
    x0, y0, h = frame
    for block in range(thread, (row.size + _BLOCK - 1) // _BLOCK, threads):
        for k in range(block * _BLOCK, min((block + 1) * _BLOCK, row.size)):
            e, s, t = _owner(elements, buckets, row[k], col[k])
            owner[k], xi[k, 0], xi[k, 1], residual[k] = e, s, t, np.nan
            if e >= 0:
                x, y = coefficients(elements.absolute[e, 0]), coefficients(elements.absolute[e, 1])
                at = x0 + h * col[k], y0 - h * row[k], h
                residual[k] = distance_px(x, y, not elements.triangular, s, t, at)


@compiled(inner=True)
def _owner(
    elements: ElementTable, buckets: _Buckets, row: float, col: float
) -> tuple[int, float, float]:
    """(element, xi, eta) of a point: first by Newton's method alone, then exhaustively."""
    i = np.floor((row - buckets.top) / _BUCKET_PX)
    j = np.floor((col - buckets.left) / _BUCKET_PX)
    if not (0 <= i < buckets.rows and 0 <= j < buckets.cols):
        return -1, np.nan, np.nan
    bucket = int(i) * buckets.cols + int(j)
    triangular, middle = elements.triangular, elements.middle
    for exhaustively in (False, True):
        for e in buckets.members[buckets.start[bucket] : buckets.start[bucket + 1]]:
            box = buckets.boxes[e]
            if not (box[0] <= row <= box[2] and box[1] <= col <= box[3]):
                continue
            polynomial = elements.polynomials[e]
            down, right = row - elements.centres[e, 0], col - elements.centres[e, 1]
            if exhaustively:
                found, s, t = search(
                    polynomial, elements.bezier, elements.quarters, triangular, down, right
                )
            else:
                a, b = coefficients(polynomial[0]), coefficients(polynomial[1])
                found, s, t = newton(a, b, not triangular, down, right, middle, middle)
            if found and outside(triangular, s, t) <= ON_EDGE:
                return e, s, t
    return -1, np.nan, np.nan
