"""Meshing of gmsh's current model with equal divisions on opposite sides of a cell."""

from __future__ import annotations

import gmsh
import numpy as np
from numpy.typing import NDArray

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError


def mesh_periodically(lattice: FloatArray | None) -> None:
    """T6 mesh of the current model with equal divisions on sides related by a lattice translation.

    ``lattice`` (2, 2): its vectors as rows, in the model's unit; None: those of the bounding
    rectangle. InputError for curves that cross.
    """
    mesh = gmsh.model.mesh
    mesh.clear()
    mesh.generate(1)
    surfaces = gmsh.model.getEntities(2)
    _refuse_crossing({tag for _, tag in gmsh.model.getBoundary(surfaces, False, False)})
    curves = [tag for _, tag in gmsh.model.getBoundary(surfaces, combined=True, oriented=False)]
    if curves:
        width = np.ptp(mesh.getNodes()[1].reshape(-1, 3)[:, :2], axis=0)
        vectors = np.diag(width) if lattice is None else lattice
        for a, b, shift in _translates([_ends_and_middle(tag) for tag in curves], vectors):
            if mesh.getPeriodicNodes(1, curves[b])[0] == curves[b]:  # not set periodic by the user
                affine = np.eye(4)
                affine[:2, 3] = shift
                mesh.setPeriodic(1, [curves[b]], [curves[a]], affine.ravel())
    mesh.clear()
    mesh.generate(2)
    mesh.setOrder(2)


def _refuse_crossing(curves: set[int]) -> None:
    """Raise InputError for crossing curves, with which gmsh's mesher would never end."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    points = coordinates.reshape(-1, 3)[order, :2]
    ends = [nodes for curve in curves for nodes in gmsh.model.mesh.getElements(1, curve)[2]]
    lines = np.searchsorted(tags[order], np.concatenate([[], *ends])).reshape(-1, 2)
    start, along = points[lines[:, 0]], points[lines[:, 1]] - points[lines[:, 0]]
    for p, d in zip(start, along, strict=True):
        near = 1e-6 * (d @ d)  # closer points count as touching

        def apart(a: FloatArray, b: FloatArray, near: float = near) -> NDArray[np.bool_]:
            return np.asarray((np.minimum(a, b) < -near) & (np.maximum(a, b) > near))

        crossed = apart(_cross(d, start - p), _cross(d, start + along - p))
        crossed &= apart(_cross(along, p - start), _cross(along, p + d - start))
        if crossed.any():
            raise InputError(
                f"expected curves that don't cross, got some that do near ({p[0]:.5g}, {p[1]:.5g}) "
                "mm; holes must neither overlap each other nor leave their surface"
            )


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n,) cross products of vectors (n, 2) or (2,)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _ends_and_middle(curve: int) -> FloatArray:
    """(3, 2) ends, sorted by x, then y, and middle of a curve of the current model."""
    low, high = (float(bound[0]) for bound in gmsh.model.getParametrizationBounds(1, curve))
    at = [low, high, 0.5 * (low + high)]
    points = np.array(gmsh.model.getValue(1, curve, at)).reshape(3, 3)[:, :2]
    if tuple(points[1]) < tuple(points[0]):
        points = points[[1, 0, 2]]
    return points


def _translates(
    boundary: list[FloatArray], lattice: FloatArray
) -> list[tuple[int, int, FloatArray]]:
    """(first, second, vector): pairs of curves related by a translation; each in one pair only."""
    near = 1e-6 * float(np.linalg.norm(lattice, axis=1).min())
    found: list[tuple[int, int, FloatArray]] = []
    paired: set[int] = set()
    for shift in np.array([[1, 0], [0, 1], [1, 1], [-1, 1]]) @ lattice:
        for a, start in enumerate(boundary):
            for b, end in enumerate(boundary):
                if not {a, b} & paired and np.abs(start + shift - end).max() < near:
                    found.append((a, b, shift))
                    paired |= {a, b}
    return found
