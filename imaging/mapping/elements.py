"""Reference elements T3, T6, Q4, Q8 and Q9, polynomials over them, and positive Jacobians.

An element is its nodes and the monomials it spans; everything else follows. Over an element
every field (position, displacement) is one polynomial in the local coordinates (xi, eta), kept
as nine coefficients in the order

    1, xi, eta, xi^2, xi eta, eta^2, xi^2 eta, xi eta^2, xi^2 eta^2,

so that all element types share the same kernels. Triangles live on xi, eta >= 0,
xi + eta <= 1; quadrilaterals on -1 <= xi, eta <= 1. Node order: see modeharvest.fem.field.

That a Jacobian is positive everywhere in an element is proved, not sampled. The determinant is a
polynomial; if its Bernstein coefficients are positive, so is it. Where they aren't, the element is
cut into four and each part is asked again, until a corner value shows a violation or every part is
proved. Only then is the element's map one to one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.errors import InputError

EXPONENTS = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2], [2, 1], [1, 2], [2, 2]])

_TRIANGLE = [[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]]
_SQUARE = [[-1, -1], [1, -1], [1, 1], [-1, 1], [0, -1], [1, 0], [0, 1], [-1, 0], [0, 0]]


@dataclass(frozen=True, eq=False)
class ReferenceElement:
    """One element type."""

    triangular: bool
    """Whether the reference domain is the triangle (else the square)."""
    nodes: FloatArray
    """(k, 2) local coordinates (xi, eta) of the nodes [-]."""
    monomials: tuple[int, ...]
    """Which k of the nine monomials the element spans."""
    coefficients: FloatArray = field(init=False)
    """(9, k); column a holds the coefficients of node a's shape function."""

    def __post_init__(self) -> None:
        full = np.zeros((9, len(self.nodes)))
        full[list(self.monomials)] = np.linalg.inv(monomials(self.nodes)[:, self.monomials])
        # The exact values are multiples of 1/4; the inversion may leave rounding behind.
        object.__setattr__(self, "coefficients", np.round(full * 4.0) / 4.0)

    @property
    def middle(self) -> float:
        """Both local coordinates of the reference domain's middle."""
        return 1.0 / 3.0 if self.triangular else 0.0


def monomials(xi: ArrayLike) -> FloatArray:
    """(..., 9) values of the nine monomials at local coordinates (..., 2)."""
    xi = np.asarray(xi, dtype=np.float64)
    return np.asarray(xi[..., :1] ** EXPONENTS[:, 0] * xi[..., 1:] ** EXPONENTS[:, 1])


def monomial_gradients(xi: ArrayLike) -> FloatArray:
    """(..., 9, 2) derivatives of the nine monomials along xi and eta at (..., 2)."""
    xi = np.asarray(xi, dtype=np.float64)
    i, j = EXPONENTS.T
    along_xi = i * xi[..., :1] ** np.maximum(i - 1, 0) * xi[..., 1:] ** j
    along_eta = j * xi[..., :1] ** i * xi[..., 1:] ** np.maximum(j - 1, 0)
    return np.stack([along_xi, along_eta], axis=-1)


def _make(triangular: bool, spanned: tuple[int, ...]) -> ReferenceElement:
    nodes = np.array(_TRIANGLE if triangular else _SQUARE, dtype=np.float64)[: len(spanned)]
    return ReferenceElement(triangular, nodes, spanned)


_ELEMENTS = {
    "T3": _make(True, (0, 1, 2)),
    "T6": _make(True, (0, 1, 2, 3, 4, 5)),
    "Q4": _make(False, (0, 1, 2, 4)),
    "Q8": _make(False, (0, 1, 2, 3, 4, 5, 6, 7)),
    "Q9": _make(False, (0, 1, 2, 3, 4, 5, 6, 7, 8)),
}


def reference_element(name: str) -> ReferenceElement:
    """Look up a reference element by its name; InputError if there is none."""
    try:
        return _ELEMENTS[name]
    except KeyError:
        raise InputError(f"expected an element among {list(_ELEMENTS)}, got {name!r}") from None


def shape_functions(name: str, xi: ArrayLike) -> FloatArray:
    """(..., k) shape functions of element ``name`` at local coordinates (..., 2)."""
    return np.asarray(monomials(xi) @ reference_element(name).coefficients)


def shape_gradients(name: str, xi: ArrayLike) -> FloatArray:
    """(..., k, 2) derivatives of the shape functions along xi and eta at (..., 2)."""
    coefficients = reference_element(name).coefficients
    return np.asarray(np.einsum("...mi,mk->...ki", monomial_gradients(xi), coefficients))


def polynomials(name: str, cells: IntArray, nodal: FloatArray) -> FloatArray:
    """(m, c, 9) coefficients, over each cell (m, k), of a nodal field (n, c)."""
    per_cell = np.ascontiguousarray(nodal[cells].transpose(0, 2, 1), dtype=np.float64)
    flat = per_cell.reshape(-1, cells.shape[1]) @ reference_element(name).coefficients.T
    return flat.reshape(len(cells), nodal.shape[1], 9)


def lattice_points(triangular: bool, degree: int) -> FloatArray:
    """(p, 2) equidistant points that determine a polynomial of ``degree`` on the domain.

    Total degree on the triangle, degree in each coordinate on the square.
    """
    steps = [(i, j) for i in range(degree + 1) for j in range(degree + 1)]
    if triangular:
        return np.array([s for s in steps if sum(s) <= degree], dtype=np.float64) / degree
    return 2.0 * np.array(steps, dtype=np.float64) / degree - 1.0


def bernstein(triangular: bool, degree: int, xi: FloatArray) -> FloatArray:
    """(..., p) Bernstein polynomials at local coordinates (..., 2), ordered like the lattice.

    A polynomial lies between the least and the greatest of its Bernstein coefficients; those
    of a mapping are its Bézier control points, whose convex hull holds the element.
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
    """(p, p) matrix from values at the lattice to Bernstein coefficients."""
    values = bernstein(triangular, degree, lattice_points(triangular, degree))
    return np.asarray(np.linalg.inv(values), dtype=np.float64)


def bezier_matrix(triangular: bool) -> FloatArray:
    """(p, 9) matrix from the nine monomial coefficients to quadratic Bézier control points."""
    points = lattice_points(triangular, 2)
    return np.asarray(to_bernstein(triangular, 2) @ monomials(points))


_DEEPEST = 12
_ROUNDING = 1e-12  # of the largest Bernstein coefficient


def sub_elements(triangular: bool) -> FloatArray:
    """(4, 3) the quarters of a reference domain: xi = (origin xi, origin eta) + scale xi'."""
    if triangular:
        return np.array([[0, 0, 0.5], [0.5, 0, 0.5], [0, 0.5, 0.5], [0.5, 0.5, -0.5]])
    return np.array([[s, t, 0.5] for s in (-0.5, 0.5) for t in (-0.5, 0.5)])


def non_positive_jacobians(positions: FloatArray, cells: IntArray, element: str) -> IntArray:
    """Cells whose Jacobian isn't positive everywhere at ``positions`` (n, 2) (x right, y up)."""
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
    # Where a Bernstein coefficient is the polynomial's value.
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
    positions: FloatArray,
    cells: IntArray,
    slopes: FloatArray,
    convert: FloatArray,
    coefficients: FloatArray,
    proved: BoolArray,
    thread: int,
    threads: int,
) -> None:
    """Bernstein coefficients of every determinant, and whether all are positive.

    ``slopes`` (2, q, k): derivatives of the shape functions at the lattice's points.
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
