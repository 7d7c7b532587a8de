"""Table of a mesh's elements in pixel coordinates, for the compiled kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import (
    bezier_matrix,
    lattice_points,
    sub_elements,
    to_bernstein,
)
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.elements import ReferenceElement, monomial_gradients, reference_element

BEYOND = (0.25, 0.1, 0.03)
"""Distances beyond an element's edges, in (xi, eta), for which to prove its map one to one."""
CLEAR_OF_EDGES = 1e-6
"""Distance from the edges, in xi and eta, above which a pixel counts as inside an element."""
UNASSIGNED, EDGE, INSIDE, OVERLAPPING, EXCLUDED = 0, 1, 2, 3, 4
"""States of a pixel: not assigned yet, on an element's edge, inside one, inside two, excluded."""
_AFFINE_PX = 1e-13  # higher terms whose absolute sum is smaller are rounding errors


class ElementTable(NamedTuple):
    """A mesh of m elements with k sides each; positions are (row, col)."""

    polynomials: FloatArray
    """(m, 2, 9) monomial coefficients of the position relative to the centre [px]."""
    absolute: FloatArray
    """(m, 2, 9) those of (x, y) [mm]; used for the residual only, which makes it a check."""
    sides: FloatArray
    """(m, k, 2, 3) coefficients of 1, u, u^2 of the position along each side, 0 <= u <= 1, relative
    to the centre [px]."""
    centres: FloatArray
    """(m, 2) elements' centres, rounded to whole pixels."""
    affine: BoolArray
    """(m,) whether the polynomials are of first degree."""
    row_from: IntArray
    row_to: IntArray
    """(m,) the element's pixels lie in the image rows row_from ... row_to - 1."""
    corners: FloatArray
    """(k, 2) local coordinates of the corners; corner i begins side i and ends side i - 1."""
    bezier: FloatArray
    """(p, 9) matrix from monomial coefficients to Bézier control points."""
    slopes: FloatArray
    """(len(BEYOND), 9, 2 q) matrices from monomial coefficients to the Bernstein coefficients of
    the two derivatives over the enlarged reference domain."""
    quarters: FloatArray
    """(4, 3) sub-elements, see :func:`~modeharvest.imaging.mapping.bernstein.sub_elements`."""
    middle: float
    """Centre of the reference domain: the value of both local coordinates."""
    triangular: bool
    """True for triangles, False for quadrilaterals."""


class Pixels(NamedTuple):
    """Result of the mapping for a band of image rows; n pixels in row-major order."""

    element: NDArray[np.int32]
    """(n,) int32 element number, -1 outside the mesh."""
    values: FloatArray
    """(c, n) fields at the pixels, NaN outside the mesh."""
    residual: NDArray[np.float32]
    """(n,) float32 residual of the mapping [px], NaN outside the mesh. Shape (0,): not computed;
    ``values`` outside the mesh are then not overwritten."""
    first_row: int
    """Image row of the first pixel."""
    cols: int
    """Pixels per row."""
    x0: float
    y0: float
    pixel_size: float
    """Of the image's :class:`~modeharvest.imaging.grid.PixelGrid` [mm]."""


def tabulate_elements(
    nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid
) -> ElementTable:
    """Tabulate the elements of a mesh (nodes (n, 2) [mm], cells (m, k)) on a pixel grid."""
    reference = reference_element(element)
    triangular = reference.triangular
    count, sides = len(cells), 3 if triangular else 4
    slopes = np.stack([_enlarged_slopes(reference, beyond) for beyond in BEYOND])
    elements = ElementTable(
        np.empty((count, 2, 9)), np.empty((count, 2, 9)), np.empty((count, sides, 2, 3)),
        np.empty((count, 2)), np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.int64),
        np.empty(count, dtype=np.int64), np.ascontiguousarray(reference.nodes[:sides]),
        bezier_matrix(triangular), slopes, sub_elements(triangular),
        reference.middle, triangular,
    )  # fmt: skip
    position_px = np.stack(grid.to_px(nodes[:, 0], nodes[:, 1]), axis=1)
    nodes_yx = np.ascontiguousarray(nodes, dtype=np.float64)
    in_parallel(_tabulate, elements, nodes_yx, position_px,
                np.ascontiguousarray(cells, dtype=np.int64), reference.coefficients,
                grid.rows)  # fmt: skip
    return elements


def _enlarged_slopes(reference: ReferenceElement, beyond: float) -> FloatArray:
    """(9, 2 q) Bernstein coefficients of the monomials' derivatives by xi, then by eta."""
    centre, triangular = reference.middle, reference.triangular
    factor = 1.0 + beyond * (3.0 if triangular else 1.0)
    points = centre + factor * (lattice_points(triangular, 2) - centre)
    control = np.einsum("qp,pmi->miq", to_bernstein(triangular, 2), monomial_gradients(points))
    return np.asarray(control.reshape(9, -1))


@compiled(relaxed=True)
def _tabulate(
    elements: ElementTable, nodes: FloatArray, position_px: FloatArray, cells: IntArray,
    coefficients: FloatArray, rows: int, thread: int, threads: int,
) -> None:  # fmt: skip
    """Fill in the elements' centres, polynomials, sides, and range of image rows."""
    for e in range(thread, len(cells), threads):
        cell, centre = cells[e], elements.centres[e]
        for i in range(2):
            mean = 0.0
            for a in cell:
                mean += position_px[a, i]
            centre[i] = np.rint(mean / cell.size)
        elements.polynomials[e] = 0.0
        elements.absolute[e] = 0.0
        for a in range(cell.size):
            x, y = nodes[cell[a]]
            row, col = position_px[cell[a], 0] - centre[0], position_px[cell[a], 1] - centre[1]
            for m in range(9):
                part = coefficients[m, a]
                elements.polynomials[e, 0, m] += part * row
                elements.polynomials[e, 1, m] += part * col
                elements.absolute[e, 0, m] += part * x
                elements.absolute[e, 1, m] += part * y
        low, high = np.inf, -np.inf
        for side in range(elements.sides.shape[1]):
            _side(elements, e, side, position_px, cell)
            c = elements.sides[e, side, 0]
            low = min(low, c[0], c[0] + 0.5 * c[1], c[0] + c[1] + c[2])
            high = max(high, c[0], c[0] + 0.5 * c[1], c[0] + c[1] + c[2])
        bent = 0.0
        for m in range(3, 9):
            bent += abs(elements.polynomials[e, 0, m]) + abs(elements.polynomials[e, 1, m])
        elements.affine[e] = bent <= _AFFINE_PX
        elements.row_from[e] = min(max(int(np.ceil(low - 1e-9 + centre[0])), 0), rows)
        elements.row_to[e] = min(max(int(np.floor(high + 1e-9 + centre[0])) + 1, 0), rows)


@compiled(inner=True, relaxed=True)
def _side(
    elements: ElementTable, e: int, side: int, position_px: FloatArray, cell: IntArray
) -> None:
    """Fill in the position along a side, from its corner to the next via any mid-side node."""
    sides = elements.sides.shape[1]
    for i in range(2):
        a = position_px[cell[side], i] - elements.centres[e, i]
        b = position_px[cell[(side + 1) % sides], i] - elements.centres[e, i]
        bulge = 0.0
        if cell.size > sides:
            between = position_px[cell[sides + side], i] - elements.centres[e, i]
            bulge = 2.0 * a - 4.0 * between + 2.0 * b
        elements.sides[e, side, i, 0] = a
        elements.sides[e, side, i, 1] = b - a - bulge
        elements.sides[e, side, i, 2] = bulge


@compiled(inner=True, relaxed=True)
def proved_reach(polynomial: FloatArray, slopes: FloatArray, centre: float) -> float:
    """Distance beyond its edges, in (xi, eta), to which an element's map is proved one to one.

    0 if not proved. Sufficient on a convex domain: ||A^-1 J - 1|| < 1, A the Jacobian at the
    centre; the norm is convex, so the Bernstein coefficients of J bound it.
    """
    a = np.empty((2, 2))
    for i in range(2):
        c = polynomial[i]
        a[i, 0] = c[1] + centre * (2.0 * c[3] + c[4])
        a[i, 1] = c[2] + centre * (c[4] + 2.0 * c[5])
    inverse = 1.0 / (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
    count = slopes.shape[2] // 2
    for k in range(slopes.shape[0]):
        largest = 0.0
        for q in range(count):
            far = 0.0
            for along in range(2):
                p, r = 0.0, 0.0
                for m in range(9):
                    p += polynomial[0, m] * slopes[k, m, along * count + q]
                    r += polynomial[1, m] * slopes[k, m, along * count + q]
                first = inverse * (a[1, 1] * p - a[0, 1] * r) - (1.0 if along == 0 else 0.0)
                second = inverse * (a[0, 0] * r - a[1, 0] * p) - (1.0 if along == 1 else 0.0)
                far += first * first + second * second
            largest = max(largest, far)
        if largest < 1.0:
            return BEYOND[k]
    return 0.0


def bands(elements: ElementTable, rows: int, height: int) -> tuple[IntArray, IntArray]:
    """(start, visits): the elements that reach into each band of ``height`` image rows.

    The elements of band b are ``visits[start[b]:start[b + 1]]``, ascending.
    """
    first, past = elements.row_from // height, (elements.row_to - 1) // height + 1
    past = np.where(elements.row_to > elements.row_from, past, first)
    ranges = np.stack([first, np.zeros_like(first), past, np.ones_like(first)], axis=1)
    return fill_buckets(ranges, (rows + height - 1) // height, 1)


@compiled()
def fill_buckets(ranges: IntArray, rows: int, cols: int) -> tuple[IntArray, IntArray]:
    """(start, members): the elements that reach into each bucket of a grid (rows, cols).

    ``ranges`` (m, 4): an element's first bucket row and column, and one past its last ones. The
    elements of bucket b, row-major, are ``members[start[b]:start[b + 1]]``, ascending.
    """
    start = np.zeros(rows * cols + 1, dtype=np.int64)
    for top, left, bottom, right in ranges:
        for i in range(top, bottom):
            for j in range(left, right):
                start[i * cols + j + 1] += 1
    for b in range(rows * cols):
        start[b + 1] += start[b]
    members = np.empty(start[-1], dtype=np.int64)
    cursor = start[:-1].copy()
    for e in range(len(ranges)):
        for i in range(ranges[e, 0], ranges[e, 2]):
            for j in range(ranges[e, 1], ranges[e, 3]):
                members[cursor[i * cols + j]] = e
                cursor[i * cols + j] += 1
    return start, members
