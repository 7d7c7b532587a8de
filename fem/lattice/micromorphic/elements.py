"""Isoparametric plane elements of a homogenized body: shape functions, quadrature, meshes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

_QUAD = [(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)]
_TRIANGLE = [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)]
_POWERS = {
    "T3": [(0, 0), (1, 0), (0, 1)],
    "T6": [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)],
    "Q4": [(0, 0), (1, 0), (0, 1), (1, 1)],
    "Q8": [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2)],
    "Q9": [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (2, 2)],
}
# Of Gauss points on a triangle, for degrees 2 and 4: barycentric coordinate a of (a, a, 1 - 2 a).
_TRIANGLE_RULES = {
    2: [(1 / 6, 1 / 6)],
    3: [(0.445948490915965, 0.111690794839005), (0.091576213509771, 0.054975871827661)],
}


class Quadrature(NamedTuple):
    """The points of some elements (c), p in each, with k nodes."""

    weights: FloatArray
    """(c, p) areas [mm^2]."""
    shapes: FloatArray
    """(p, k) shape functions."""
    gradients: FloatArray
    """(c, p, k, 2) their gradients [1/mm]."""
    places: FloatArray
    """(c, p, 2) [mm]."""


def quadrature(mesh: Mesh, points: int) -> Quadrature:
    """Gauss points of all elements: ``points`` 2 or 3 a direction (3 or 6 in a triangle).

    An InputError refuses other numbers, and elements whose Jacobian isn't positive.
    """
    if points not in (2, 3):
        raise InputError(f"quadrature: expected 2 or 3 points a direction, got {points}")
    weights: FloatArray
    if mesh.element[0] == "Q":
        at, weight = np.polynomial.legendre.leggauss(points)
        xi: FloatArray = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
        weights = np.asarray(np.outer(weight, weight).ravel())
    else:
        rule = _TRIANGLE_RULES[points]
        xi = np.array([p for a, _ in rule for p in ((a, a), (a, 1 - 2 * a), (1 - 2 * a, a))])
        weights = np.repeat([w for _, w in rule], 3)
    shapes, slopes = _shape_functions(mesh.element, xi)
    nodes = mesh.nodes[mesh.cells]
    J = np.einsum("pkb,cka->cpab", slopes, nodes)
    area = np.linalg.det(J)
    if not (area > 0).all():
        worst = int(np.argmin(area.min(axis=1)))
        raise InputError(
            "macroscopic mesh: expected elements with positive Jacobians (nodes counter-clockwise, "
            f"corners first), got {area.min():.3g} in element {worst}"
        )
    gradients = np.einsum("pkb,cpba->cpka", slopes, np.linalg.inv(J))
    return Quadrature(weights * area, shapes, gradients, np.einsum("pk,cka->cpa", shapes, nodes))


def _shape_functions(element: str, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(p, k) shape functions and (p, k, 2) their derivatives at reference points (p, 2)."""
    m, n = np.array(_POWERS[element]).T
    nodes = np.array((_QUAD if element[0] == "Q" else _TRIANGLE)[: len(m)], dtype=np.float64)
    coefficients = np.linalg.inv(nodes[:, :1] ** m * nodes[:, 1:] ** n)
    x, y = xi[:, :1], xi[:, 1:]
    of_x = m * x ** np.maximum(m - 1, 0) * y**n
    of_y = n * x**m * y ** np.maximum(n - 1, 0)
    slopes = np.stack([of_x @ coefficients, of_y @ coefficients], axis=-1)
    return x**m * y**n @ coefficients, slopes


def rectangle_mesh(x: Sequence[float], y: Sequence[float]) -> Mesh:
    """Q8 elements between ascending places along x and along y [mm]."""
    at = []
    for places in (x, y):
        ends = np.asarray(places, dtype=np.float64)
        if ends.ndim != 1 or len(ends) < 2 or not (np.diff(ends) > 0).all():
            raise InputError(f"macroscopic mesh: expected ascending places [mm], got {places}")
        at.append(np.sort(np.concatenate([ends, 0.5 * (ends[1:] + ends[:-1])])))
    columns, rows = len(at[0]), len(at[1])
    i, j = np.meshgrid(np.arange(0, columns - 1, 2), np.arange(0, rows - 1, 2), indexing="ij")
    numbers = [((i + a + 1) * rows + j + b + 1).ravel() for a, b in _QUAD[:8]]
    grid = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1).reshape(-1, 2)
    used, cells = np.unique(np.stack(numbers, axis=1), return_inverse=True)
    return Mesh(grid[used], cells.reshape(-1, 8), "Q8")


def specimen_mesh(
    specimen: Specimen, divisions: tuple[int, int] | None = None, quarter: bool = False
) -> tuple[Mesh, BoolArray]:
    """Q8 elements of a specimen, and which of them (m,) are lattice; the others are solid bulk.

    divisions : of the cellular part along x and y; by default one for two holes, at least two.
    quarter : only that with x, y >= 0, of half the divisions (rounded up).
    """
    half, whole = specimen.cellular_half_size, specimen.half_size
    counts = divisions or [max(2, round(0.5 * n)) for n in (specimen.holes_x, specimen.holes_y)]
    if min(counts) < 1:
        raise InputError(f"macroscopic mesh: expected divisions of 1 or more, got {divisions}")
    places = []
    for inner, outer, count in zip(half, whole, counts, strict=True):
        if quarter:
            places.append(np.unique([*np.linspace(0.0, inner, (count + 1) // 2 + 1), outer]))
        else:
            places.append(np.unique([-outer, *np.linspace(-inner, inner, count + 1), outer]))
    mesh = rectangle_mesh(*places)
    middles = mesh.nodes[mesh.cells[:, :4]].mean(axis=1)
    return mesh, np.all(np.abs(middles) < half, axis=1)
