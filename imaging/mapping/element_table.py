"""The elements of a mesh over the pixels of an image, tabulated for the compiled kernels."""

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
"""How far beyond an element's edges, in (xi, eta), its map is tried to be proved one to one."""
CLEAR_OF_EDGES = 1e-6
"""In xi, eta; pixels on an edge come out within some 1e-9."""
UNASSIGNED, EDGE, INSIDE, OVERLAPPING, EXCLUDED = 0, 1, 2, 3, 4
"""States of a pixel: not assigned yet, on an element's edge, inside it, inside two; left out."""
_AFFINE_PX = 1e-13  # terms of higher degree that add up to less are rounding


class ElementTable(NamedTuple):
    """A mesh of m elements with k sides each; positions are (row, col)."""

    polynomials: FloatArray
    """(m, 2, 9) position relative to the centre [px]."""
    absolute: FloatArray
    """(m, 2, 9) (x, y) [mm]; only the residual is from them, which makes it a check."""
    sides: FloatArray
    """(m, k, 2, 3) coefficients of 1, u, u^2 of the position along each side, 0 <= u <= 1, relative
    to the centre [px]."""
    centres: FloatArray
    """(m, 2) whole pixels."""
    affine: BoolArray
    """(m,) whether the polynomials have no terms of higher than the first degree."""
    row_from: IntArray
    row_to: IntArray
    """(m,) the image rows row_from ... row_to - 1 may hold pixels of it."""
    corners: FloatArray
    """(k, 2) local coordinates of the corners, where side i begins and side i - 1 ends."""
    bezier: FloatArray
    """(p, 9) from polynomials to control points."""
    slopes: FloatArray
    """(len(BEYOND), 9, 2 q) from polynomials to the Bernstein coefficients of the two derivatives
    over the reference domain enlarged."""
    quarters: FloatArray
    """(4, 3) sub-elements."""
    middle: float
    """Both local coordinates of the reference domain's middle."""
    triangular: bool
    """True for triangles, False for quadrilaterals."""


class Pixels(NamedTuple):
    """What is found, over some rows of an image, pixels in the order of memory."""

    element: NDArray[np.int32]
    """(n,) int32 element, -1 where none is."""
    values: FloatArray
    """(c, n) fields at the pixels, NaN where no element is."""
    residual: NDArray[np.float32]
    """(n,) float32 [px], NaN where no element is; (0,) if it isn't computed, and then ``values``
    are left as they were where no element is."""
    first_row: int
    """The first of these rows in the image."""
    cols: int
    """Pixels a row."""
    x0: float
    y0: float
    pixel_size: float
    """Of the image's grid [mm]."""


def tabulate_elements(
    nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid
) -> ElementTable:
    """Lay a mesh (nodes (n, 2) [mm], cells (m, k)) over the pixels of a grid."""
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
    """(9, 2 q) derivatives along xi, then along eta, as Bernstein coefficients."""
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
    """Fill in the elements: centres, polynomials, sides, and the image rows they reach into."""
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
    """Position along a side: from its corner to the next, through the node between, if any."""
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
    """How far beyond its edges, in (xi, eta), an element's map is one to one, proved; else 0.

    Sufficient on a convex domain: ||A^-1 J - 1|| < 1 there, with A the Jacobian in the middle;
    the norm is convex, so the Bernstein coefficients of J bound it.
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
    """(start, visits): the elements that reach into each band of ``height`` rows.

    Those of band b are ``visits[start[b]:start[b + 1]]``, ascending.
    """
    first, past = elements.row_from // height, (elements.row_to - 1) // height + 1
    past = np.where(elements.row_to > elements.row_from, past, first)
    ranges = np.stack([first, np.zeros_like(first), past, np.ones_like(first)], axis=1)
    return fill_buckets(ranges, (rows + height - 1) // height, 1)


@compiled()
def fill_buckets(ranges: IntArray, rows: int, cols: int) -> tuple[IntArray, IntArray]:
    """(start, members): the elements that reach into each bucket of a grid of them.

    ``ranges`` (m, 4) are each element's first row and column of buckets, and those past its last.
    Of bucket b, by rows, they are ``members[start[b]:start[b + 1]]``, ascending.
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
