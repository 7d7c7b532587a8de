"""From triangles as files hold them to a plane T6 mesh in good order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import REVERSED_T6

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SIDES = ((0, 1), (1, 2), (2, 0))


def sound_t6(points: FloatArray, cells: IntArray) -> Mesh:
    """A plane T6 mesh, counter-clockwise, without unused nodes.

    Parameters
    ----------
    points
        (n, 2) or (n, 3) with z = const [mm].
    cells
        (m, 3) or (m, 6) node numbers, corners first; sides of three-node triangles get a node in
        their middle.

    Raises
    ------
    InputError
        If the mesh isn't plane, elements lie upon each other, or one is flat or folded.
    """
    used, numbers = np.unique(cells, return_inverse=True)
    nodes, cells = _in_plane(points[used]), numbers.reshape(cells.shape).astype(np.int64)
    if cells.shape[1] == 3:
        nodes, cells = _with_mid_sides(nodes, cells)
    a, b, c = (nodes[cells[:, k]] for k in range(3))
    clockwise = np.linalg.det(np.stack([b - a, c - a], axis=1)) < 0
    cells = np.where(clockwise[:, None], cells[:, REVERSED_T6], cells)
    mesh = Mesh(nodes, cells, "T6")
    _refuse_stacked(mesh)
    _refuse_folded(mesh)
    return mesh


def _in_plane(points: FloatArray) -> FloatArray:
    if not np.isfinite(points).all():
        raise InputError("expected finite node positions, got NaN or infinity")
    if points.shape[1] == 3 and np.ptp(points[:, 2]) > 1e-9 * np.ptp(points[:, :2]):
        raise InputError(
            f"expected a plane mesh, z = const, got z from {points[:, 2].min():.5g} to "
            f"{points[:, 2].max():.5g} mm"
        )
    return points[:, :2]


def _with_mid_sides(nodes: FloatArray, cells: IntArray) -> tuple[FloatArray, IntArray]:
    ends = np.sort(np.stack([cells[:, side] for side in _SIDES], axis=1), axis=2)
    sides, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middles = nodes[sides].mean(axis=1)
    return np.vstack([nodes, middles]), np.hstack([cells, len(nodes) + number.reshape(-1, 3)])


def _refuse_stacked(mesh: Mesh) -> None:
    middle, count = np.unique(mesh.cells[:, 3:], return_counts=True)
    if count.max() > 2:
        x, y = mesh.nodes[middle[np.argmax(count)]]
        raise InputError(
            f"expected sides of one or two elements, got one of {count.max()} at ({x:.5g}, "
            f"{y:.5g}) mm; elements must not lie upon each other"
        )


def _refuse_folded(mesh: Mesh) -> None:
    bad = np.flatnonzero(_smallest_jacobians(mesh) <= 0)
    if len(bad):
        x, y = mesh.nodes[mesh.cells[bad[0], :3]].mean(axis=0)
        raise InputError(
            f"expected elements that are neither flat nor folded, got {len(bad)}, the first at "
            f"({x:.5g}, {y:.5g}) mm"
        )


def _smallest_jacobians(mesh: Mesh) -> FloatArray:
    """(m,) lower bounds of the Jacobians [mm^2]: their smallest Bernstein coefficients."""
    at = np.linalg.det(np.einsum("pna,mnb->mpab", _GRADIENTS, mesh.nodes[mesh.cells]))
    sides = [2 * at[:, 3 + k] - 0.5 * (at[:, p] + at[:, q]) for k, (p, q) in enumerate(_SIDES)]
    return np.asarray(np.minimum(at[:, :3].min(axis=1), np.min(sides, axis=0)))


def _gradients(xi: float, eta: float) -> FloatArray:
    """(6, 2) derivatives of the shape functions."""
    z = 1.0 - xi - eta
    by_xi = [1 - 4 * z, 4 * xi - 1, 0.0, 4 * (z - xi), 4 * eta, -4 * eta]
    by_eta = [1 - 4 * z, 0.0, 4 * eta - 1, -4 * xi, 4 * xi, 4 * (z - eta)]
    return np.stack([by_xi, by_eta], axis=1)


# At the element's own nodes, which determine a Jacobian that is quadratic.
_GRADIENTS = np.array(
    [_gradients(*p) for p in [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)]]
)
