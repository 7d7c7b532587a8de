"""Integrals over the material of a mesh, and nodal fields at the points they are summed over.

Every element is integrated by a product of Gauss rules; on triangles one side of the square is
collapsed into a corner, with the Gauss-Jacobi rule whose weight is the Jacobian of doing so
(A. H. Stroud, Approximate Calculation of Multiple Integrals, 1971).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import roots_jacobi

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.imaging.elements import reference_element, shape_functions, shape_gradients

FloatArray = NDArray[np.float64]


class Quadrature:
    """Points and weights over the material of a mesh.

    Parameters
    ----------
    mesh
        Any isoparametric mesh [mm].
    points
        Per direction and element. A wave whose phase turns by p rad across the largest element
        is integrated to 1e-10 by 4 + p of them, see :func:`points_for`.

    Attributes
    ----------
    positions : (q, 2) points in the material [mm].
    weights : (q,) area that each stands for [mm^2], positive.

    Raises
    ------
    InputError
        If an element is turned inside out.
    """

    def __init__(self, mesh: Mesh, points: int = 8) -> None:
        self.mesh = mesh
        local, weights = gauss_rule(reference_element(mesh.element).triangular, points)
        self._shapes = shape_functions(mesh.element, local)
        gradients = shape_gradients(mesh.element, local)
        J = np.einsum("pki,mkj->mpij", gradients, mesh.nodes[mesh.cells], optimize=True)
        jacobian = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        if not jacobian.size or jacobian.min() <= 0:
            raise InputError(
                "quadrature: expected elements that are not inside out, got "
                f"{int(np.sum(np.any(jacobian <= 0, axis=1)))} bad ones of {len(mesh.cells)}; "
                "number the corners of each counter-clockwise"
            )
        self.positions = self.values(mesh.nodes)
        self.weights = np.asarray((jacobian * weights).ravel())

    def values(self, nodal: ArrayLike) -> FloatArray:
        """(q, c) values, at the points, of a field (n, c) given at the mesh's nodes."""
        field = np.asarray(nodal, dtype=np.float64)
        at_points = np.einsum("pk,mkc->mpc", self._shapes, field[self.mesh.cells], optimize=True)
        return np.ascontiguousarray(at_points.reshape(-1, field.shape[1]))

    @cached_property
    def area(self) -> float:
        """Area of the material [mm^2]."""
        return float(self.weights.sum())

    def without_mean(self, values: FloatArray) -> FloatArray:
        """Values (q, c) less their mean over the material: rigid translations taken out."""
        return np.asarray(values - self.weights @ values / self.area)

    def product(self, first: FloatArray, second: FloatArray) -> float:
        """Integral of first . second over the material, both (q, c)."""
        return float(np.einsum("q,qc,qc", self.weights, first, second, optimize=True))


def points_for(mesh: Mesh, wave_number: float) -> int:
    """Points per direction for waves up to a wave number [rad/mm], to about 1e-10."""
    corners = mesh.nodes[mesh.cells[:, : 3 if mesh.element.startswith("T") else 4]]
    size = float(np.ptp(corners, axis=1).max())
    return 4 + int(np.ceil(wave_number * size))


def gauss_rule(triangular: bool, points: int) -> tuple[FloatArray, FloatArray]:
    """Local points (p, 2) and weights (p,) on the reference triangle or square.

    Parameters
    ----------
    triangular
        Triangle xi, eta >= 0, xi + eta <= 1; else the square from -1 to 1.
    points
        Per direction: p is its square, and polynomials up to the degree 2 ``points`` - 1 (on the
        square in each coordinate) are integrated exactly.
    """
    s, ws = np.polynomial.legendre.leggauss(points)
    if not triangular:
        first, second = np.meshgrid(s, s, indexing="ij")
        local, weights = np.stack([first.ravel(), second.ravel()], axis=1), np.outer(ws, ws)
        return local, np.asarray(weights.ravel(), dtype=np.float64)
    t, wt = roots_jacobi(points, 1.0, 0.0)
    across, up = np.meshgrid(0.5 * (1.0 + s), 0.5 * (1.0 + t), indexing="ij")
    local = np.stack([(across * (1.0 - up)).ravel(), up.ravel()], axis=1)
    return local, np.asarray(np.outer(ws / 2.0, wt / 4.0).ravel(), dtype=np.float64)
