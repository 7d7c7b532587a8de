"""Reference elements T3, T6, Q4, Q8 and Q9: nodes, shape functions, polynomials; sums over nodes.

An element is defined by its nodes and the monomials that it spans. Over an element every field
(position, displacement) is one polynomial in the local coordinates (xi, eta), stored as nine
coefficients in the order

    1, xi, eta, xi^2, xi eta, eta^2, xi^2 eta, xi eta^2, xi^2 eta^2,

so that all element types share the same kernels. Triangles occupy xi, eta >= 0,
xi + eta <= 1; quadrilaterals -1 <= xi, eta <= 1. Node order: see modeharvest.fem.field.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError

_TRIANGLE = [[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]]
_SQUARE = [[-1, -1], [1, -1], [1, 1], [-1, 1], [0, -1], [1, 0], [0, 1], [-1, 0], [0, 0]]


@dataclass(frozen=True, eq=False)
class ReferenceElement:
    """An element type: its reference domain, nodes and shape functions."""

    triangular: bool
    """Whether the reference domain is the triangle; otherwise it is the square."""
    nodes: FloatArray
    """(k, 2) local coordinates (xi, eta) of the nodes [-]."""
    monomials: tuple[int, ...]
    """Which k of the nine monomials the element spans."""
    coefficients: FloatArray = field(init=False)
    """(9, k); column a holds the coefficients of node a's shape function."""

    def __post_init__(self) -> None:
        full = np.zeros((9, len(self.nodes)))
        full[list(self.monomials)] = np.linalg.inv(monomials(self.nodes)[:, self.monomials])
        # The exact values are multiples of 1/4; rounding errors of the inversion are removed.
        object.__setattr__(self, "coefficients", np.round(full * 4.0) / 4.0)

    @property
    def middle(self) -> float:
        """Value of both local coordinates, xi and eta, at the reference domain's centre."""
        return 1.0 / 3.0 if self.triangular else 0.0


def monomials(xi: ArrayLike) -> FloatArray:
    """(..., 9) values of the nine monomials at local coordinates (..., 2)."""
    x, y = np.moveaxis(np.asarray(xi, dtype=np.float64), -1, 0)
    xx, xy, yy, one = x * x, x * y, y * y, np.ones_like(x)
    return np.stack([one, x, y, xx, xy, yy, xx * y, x * yy, xx * yy], axis=-1)


def monomial_gradients(xi: ArrayLike) -> FloatArray:
    """(..., 9, 2) derivatives of the nine monomials along xi and eta at (..., 2)."""
    x, y = np.moveaxis(np.asarray(xi, dtype=np.float64), -1, 0)
    xx, xy, yy, one, zero = x * x, 2.0 * x * y, y * y, np.ones_like(x), np.zeros_like(x)
    along_xi = [zero, one, zero, 2.0 * x, y, zero, xy, yy, xy * y]
    along_eta = [zero, zero, one, zero, x, 2.0 * y, xx, xy, x * xy]
    return np.stack([np.stack(along, axis=-1) for along in (along_xi, along_eta)], axis=-1)


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
    return np.asarray(reference_element(name).coefficients.T @ monomial_gradients(xi))


def polynomials(name: str, cells: IntArray, nodal: FloatArray) -> FloatArray:
    """(m, c, 9) coefficients, over each cell (m, k), of a field (n, c) given at nodes."""
    per_cell = np.ascontiguousarray(nodal[cells].transpose(0, 2, 1), dtype=np.float64)
    flat = per_cell.reshape(-1, cells.shape[1]) @ reference_element(name).coefficients.T
    return flat.reshape(len(cells), nodal.shape[1], 9)


def nodal_sums(count: int, nodes: IntArray, values: FloatArray) -> FloatArray:
    """(count, s) sum at each node of the elements' values (m, k, s) at their nodes (m, k)."""
    flat = nodes.ravel()
    ones = csr_array((np.ones(flat.size), (flat, np.arange(flat.size))), (count, flat.size))
    return np.asarray(ones @ values.reshape(flat.size, values.shape[2]))
