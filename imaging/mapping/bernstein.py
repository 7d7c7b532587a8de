"""Bernstein polynomials over reference elements, and positive Jacobians.

That a Jacobian is positive everywhere in an element is proved, not sampled. The determinant is a
polynomial; it is positive if its Bernstein coefficients are. Where they aren't, the element is
divided into four and each part is tested, until a corner value shows a violation or every part is
proved positive. Only with a positive Jacobian is the element's map one to one.
"""

from __future__ import annotations

from math import comb

import numpy as np

from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.elements import monomial_gradients, monomials, reference_element
from modeharvest.util.errors import InputError


def lattice_points(triangular: bool, degree: int) -> FloatArray:
    """(p, 2) equidistant points that determine a polynomial of ``degree`` on the domain.

    The degree is the total degree on the triangle, the degree in each coordinate on the square.
    """
    steps = [(i, j) for i in range(degree + 1) for j in range(degree + 1)]
    if triangular:
        return np.array([s for s in steps if sum(s) <= degree], dtype=np.float64) / degree
    return 2.0 * np.array(steps, dtype=np.float64) / degree - 1.0


def bernstein(triangular: bool, degree: int, xi: FloatArray) -> FloatArray:
    """(..., p) Bernstein polynomials at local coordinates (..., 2), ordered like lattice_points.

    A polynomial lies between the least and the greatest of its Bernstein coefficients. Those
    of a mapping are its Bézier control points, whose convex hull contains the element.
    """
    x, y = xi[..., 0], xi[..., 1]
    columns = []
    for u, v in lattice_points(triangular, degree):
        if triangular:
            i, j = round(u * degree), round(v * degree)
            k, count = degree - i - j, comb(degree, i) * comb(degree - i, j)
            columns.append(count * x**i * y**j * (1.0 - x - y) ** k)
        else:
            i, j = round((u + 1) * degree / 2), round((v + 1) * degree / 2)
            p, q, count = degree - i, degree - j, comb(degree, i) * comb(degree, j)
            s, t = 0.5 * (1.0 + x), 0.5 * (1.0 + y)
            columns.append(count * s**i * (1.0 - s) ** p * t**j * (1.0 - t) ** q)
    return np.stack(columns, axis=-1)


def to_bernstein(triangular: bool, degree: int) -> FloatArray:
    """(p, p) matrix from values at the lattice points to Bernstein coefficients."""
    values = bernstein(triangular, degree, lattice_points(triangular, degree))
    return np.asarray(np.linalg.inv(values), dtype=np.float64)


def bezier_matrix(triangular: bool) -> FloatArray:
    """(p, 9) matrix from the nine monomial coefficients to quadratic Bézier control points."""
    points = lattice_points(triangular, 2)
    return np.asarray(to_bernstein(triangular, 2) @ monomials(points))


_DEEPEST = 12
_ROUNDING = 1e-12  # of the largest Bernstein coefficient


def sub_elements(triangular: bool) -> FloatArray:
    """(4, 3) origin xi, origin eta, scale of a domain's quarters: xi = origin + scale xi'."""
    if triangular:
        return np.array([[0, 0, 0.5], [0.5, 0, 0.5], [0, 0.5, 0.5], [0.5, 0.5, -0.5]])
    return np.array([[s, t, 0.5] for s in (-0.5, 0.5) for t in (-0.5, 0.5)])


def non_positive_jacobians(positions: FloatArray, cells: IntArray, element: str) -> IntArray:
    """Cells whose Jacobian isn't positive everywhere, for node ``positions`` (n, 2) (y up)."""
    triangular = reference_element(element).triangular
    degree = 2 if triangular else 3
    points = lattice_points(triangular, degree)
    slopes = np.ascontiguousarray(monomial_gradients(points).transpose(2, 0, 1))
    convert = to_bernstein(triangular, degree)
    shape_slopes = slopes @ reference_element(element).coefficients
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    all_coefficients = np.empty((len(cells), len(points)))
    proved = np.empty(len(cells), dtype=np.bool_)
    in_parallel(_prove, positions, np.ascontiguousarray(cells), shape_slopes, convert,
                all_coefficients, proved)  # fmt: skip
    if proved.all():
        return np.empty(0, dtype=np.int64)
    unproved = np.flatnonzero(~proved)
    coefficients = all_coefficients[unproved]
    # At the corners a Bernstein coefficient is the polynomial's value.
    ends = np.column_stack([points, 1 - points.sum(axis=1)]) if triangular else np.abs(points)
    is_one = np.isclose(ends, 1.0)
    corners = np.flatnonzero(is_one.any(axis=1) if triangular else is_one.all(axis=1))
    parts = [s[:2] + s[2] * points for s in sub_elements(triangular)]
    split = np.stack([convert @ bernstein(triangular, degree, part) for part in parts])
    owner = np.arange(len(unproved))
    threshold = _ROUNDING * np.abs(coefficients).max(axis=1)
    bad = np.zeros(len(unproved), dtype=np.bool_)
    for _ in range(_DEEPEST):
        positive = coefficients > threshold[owner, None]  # False for NaN
        bad[owner[~positive[:, corners].all(axis=1)]] = True
        open_ = ~positive.all(axis=1) & ~bad[owner]
        if not open_.any():
            break
        coefficients = np.einsum("spq,eq->esp", split, coefficients[open_])
        coefficients = coefficients.reshape(-1, len(points))
        owner = np.repeat(owner[open_], 4)
    else:
        bad[owner] = True  # zero to rounding
    return unproved[bad]


@compiled(relaxed=True)
def _prove(
    positions: FloatArray, cells: IntArray, slopes: FloatArray, convert: FloatArray,
    coefficients: FloatArray, proved: BoolArray, thread: int, threads: int,
) -> None:  # fmt: skip
    """Compute the Bernstein coefficients of every determinant, and whether all are positive.

    ``slopes`` (2, q, k): derivatives of the shape functions at the lattice points.
    """
    for e in range(thread, len(cells), threads):
        found = coefficients[e]
        found[:] = 0.0
        for q in range(slopes.shape[1]):
            x_s, x_t, y_s, y_t = 0.0, 0.0, 0.0, 0.0
            for a in range(cells.shape[1]):
                x, y = positions[cells[e, a], 0], positions[cells[e, a], 1]
                x_s += slopes[0, q, a] * x
                x_t += slopes[1, q, a] * x
                y_s += slopes[0, q, a] * y
                y_t += slopes[1, q, a] * y
            determinant = x_s * y_t - x_t * y_s
            for p in range(found.size):
                found[p] += convert[p, q] * determinant
        proved[e] = np.all(found > _ROUNDING * np.abs(found).max())  # False for NaN


def require_positive_jacobian(
    positions: FloatArray, cells: IntArray, element: str, where: str = "mesh"
) -> None:
    """Raise InputError, naming the first such cell, unless all Jacobians are positive."""
    lost = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if lost.size:
        raise InputError(
            f"{where}: expected finite node positions, got NaN or infinity at {lost.size} nodes, "
            f"the first is node {lost[0]}; check the displacement's file"
        )
    bad = non_positive_jacobians(positions, cells, element)
    if bad.size:
        centre = positions[cells[bad[0]]].mean(axis=0)
        raise InputError(
            f"{where}: expected {element} elements with positive Jacobians (nodes "
            f"counter-clockwise, not folded), got {bad.size} without, the first is element "
            f"{bad[0]} near ({centre[0]:.4g}, {centre[1]:.4g}); repair the mesh (or, "
            "of a deformed one, take a smaller displacement)"
        )
