"""Whether a deformed lattice has run into itself: contact isn't modelled, but it is noticed."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh

FloatArray = NDArray[np.float64]

# A T6 as four triangles with straight sides, and its sides as corner, corner, middle.
_PARTS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
_SIDES = np.array([[0, 1, 3], [1, 2, 4], [2, 0, 5]])
_DEPTH = 1e-3  # of a triangle's height: what doesn't count as overlap


def overlaps(
    mesh: Mesh, lattice: FloatArray, gradient: FloatArray, displacement: FloatArray
) -> bool:
    """Whether material of a periodic cell lies upon itself or upon its copies.

    Parameters
    ----------
    mesh, lattice
        T6 mesh of the cell, and its lattice vectors as rows, undeformed [mm].
    gradient
        (2, 2) F̄, which carries the copies along.
    displacement
        (n, 2) of the nodes [mm].
    """
    nodes, vectors = mesh.nodes + displacement, lattice @ gradient.T
    triangles = nodes[mesh.cells[:, _PARTS].reshape(-1, 3)]
    points = nodes[_boundary(mesh)]
    images = [points + np.array(r) @ vectors for r in product((-1, 0, 1), repeat=2)]
    return _any_inside(np.vstack(images), triangles)


def _boundary(mesh: Mesh) -> NDArray[np.int64]:
    """Nodes of the sides that belong to one element only."""
    sides = mesh.cells[:, _SIDES].reshape(-1, 3)
    _, first, count = np.unique(sides[:, 2], return_index=True, return_counts=True)
    return np.asarray(np.unique(sides[first[count == 1]]))


def _any_inside(points: FloatArray, triangles: FloatArray) -> bool:
    """Whether any of the points (n, 2) lies within one of the triangles (m, 3, 2)."""
    centres = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max()
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    points = points[np.all((points > low) & (points < high), axis=1)]
    near = cKDTree(points).sparse_distance_matrix(cKDTree(centres), reach, output_type="ndarray")
    corners = triangles[near["j"]] - points[near["i"]][:, None]
    following = np.roll(corners, -1, axis=1)
    areas = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    return bool(np.any(areas.min(axis=1) > _DEPTH * areas.sum(axis=1)))
