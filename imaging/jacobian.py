"""Is the Jacobian of every element positive everywhere? A proof, not a sample.

The determinant is a polynomial; if its Bernstein coefficients are positive, so is it. Where
they aren't, the element is cut into four and each part is asked again, until a corner value
shows a violation or every part is proved. Only then is the element's map one to one.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.elements import (
    bernstein,
    lattice,
    monomial_gradients,
    reference_element,
    to_bernstein,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_DEEPEST = 12
_ROUNDING = 1e-12  # of the largest Bernstein coefficient


def sub_elements(triangular: bool) -> FloatArray:
    """(4, 3) the quarters of a reference domain: xi = (origin xi, origin eta) + scale xi'."""
    if triangular:
        return np.array([[0, 0, 0.5], [0.5, 0, 0.5], [0, 0.5, 0.5], [0.5, 0.5, -0.5]])
    return np.array([[s, t, 0.5] for s in (-0.5, 0.5) for t in (-0.5, 0.5)])


def non_positive_jacobians(positions: FloatArray, cells: IntArray, element: str) -> IntArray:
    """Numbers of the cells whose Jacobian isn't positive everywhere, ascending.

    Parameters
    ----------
    positions
        (n, 2) node positions in a right-handed frame (x right, y up).
    cells, element
        As in :class:`modeharvest.fem.field.Mesh`.
    """
    triangular = reference_element(element).triangular
    degree = 2 if triangular else 3
    points = lattice(triangular, degree)
    slopes = np.ascontiguousarray(monomial_gradients(points).transpose(2, 0, 1))
    convert = to_bernstein(triangular, degree)
    shape_slopes = slopes @ reference_element(element).coefficients
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    all_coefficients = np.empty((len(cells), len(points)))
    proved = np.empty(len(cells), dtype=np.bool_)
    _prove(positions, np.ascontiguousarray(cells), shape_slopes, convert, all_coefficients, proved)
    if proved.all():
        return np.empty(0, dtype=np.int64)
    unproved = np.flatnonzero(~proved)
    coefficients = all_coefficients[unproved]
    corners = _corners(triangular, degree)
    split = np.stack(
        [convert @ bernstein(triangular, degree, s[:2] + s[2] * points)
         for s in sub_elements(triangular)]
    )  # fmt: skip
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
        bad[owner] = True  # zero to within what can be told
    return unproved[bad]


@compiled(parallel=True)
def _prove(
    positions: FloatArray,
    cells: IntArray,
    slopes: FloatArray,
    convert: FloatArray,
    coefficients: FloatArray,
    proved: BoolArray,
) -> None:
    """Bernstein coefficients of every determinant, and whether all are positive.

    ``slopes`` (2, q, k): derivatives of the shape functions at the lattice's points.
    """
    for e in prange(len(cells)):
        proved[e] = _prove_one(positions, cells[e], slopes, convert, coefficients[e])


@compiled(relaxed=True)
def _prove_one(
    positions: FloatArray,
    cell: IntArray,
    slopes: FloatArray,
    convert: FloatArray,
    coefficients: FloatArray,
) -> bool:
    coefficients[:] = 0.0
    for q in range(slopes.shape[1]):
        x_s, x_t, y_s, y_t = 0.0, 0.0, 0.0, 0.0
        for a in range(cell.size):
            x, y = positions[cell[a], 0], positions[cell[a], 1]
            x_s += slopes[0, q, a] * x
            x_t += slopes[1, q, a] * x
            y_s += slopes[0, q, a] * y
            y_t += slopes[1, q, a] * y
        determinant = x_s * y_t - x_t * y_s
        for p in range(coefficients.size):
            coefficients[p] += convert[p, q] * determinant
    size = np.abs(coefficients).max()
    return bool(np.all(coefficients > _ROUNDING * size))  # False for NaN


def require_positive_jacobian(
    positions: FloatArray, cells: IntArray, element: str, where: str = "mesh"
) -> None:
    """Raise InputError, naming the first cell, unless all Jacobians are positive."""
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
            f"{bad[0]} near ({centre[0]:.4g}, {centre[1]:.4g}); repair the mesh or take a "
            "smaller displacement"
        )


def _corners(triangular: bool, degree: int) -> IntArray:
    """Lattice points where a Bernstein coefficient is the polynomial's value."""
    points = lattice(triangular, degree)
    if triangular:
        at_corner = np.isclose(np.column_stack([points, 1 - points.sum(axis=1)]).max(axis=1), 1.0)
    else:
        at_corner = np.isclose(np.abs(points), 1.0).all(axis=1)
    return np.flatnonzero(at_corner)
