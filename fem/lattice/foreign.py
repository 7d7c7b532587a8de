"""Meshes of other programs: unit of length, node numbering, and validity of elements.

A mesh is brought into standard form. The number of each node in the file, and texts on all changes,
are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh, in_plane, with_mid_sides
from modeharvest.fem.meshing import REVERSED_T6
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError

MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "in": 25.4}
"""Possible units of length of a file, in mm."""
_USUAL = 1e-2, 1e3  # usual range of a cell's width [mm]: outside it the unit is probably wrong
_SIDES = ((0, 1), (1, 2), (2, 0))

NUMBERINGS = {
    "corners, then the mid-sides opposite to them (basix, FEniCS)": (0, 1, 2, 5, 3, 4),
    "corners, then mid-sides 1-2, 1-3, 2-3 (COMSOL)": (0, 1, 2, 3, 5, 4),
    "corners, then mid-sides 3-1, 1-2, 2-3": (0, 1, 2, 4, 5, 3),
    "corners, then mid-sides 2-3, 1-2, 3-1": (0, 1, 2, 4, 3, 5),
    "corners, then mid-sides 3-1, 2-3, 1-2": (0, 1, 2, 5, 4, 3),
    "corners and mid-sides in turn around the element": (0, 2, 4, 1, 3, 5),
    "row by row: corner, mid-side, corner, two mid-sides, corner": (0, 2, 5, 1, 4, 3),
    "mid-sides 1-2, 2-3, 3-1, then corners": (3, 4, 5, 0, 1, 2),
}
"""Orders of a T6 element's nodes other than that of gmsh, VTK and Abaqus (CPE6): indices of the
corners and of the mid-sides 1-2, 2-3, 3-1 among its nodes."""
_FAR, _CLOSE = 0.3, 0.12  # distance from a side's middle, over its length: wrong, correct order


def millimetres(unit: str | None) -> float:
    """Length of a file's unit in mm; InputError for unknown units."""
    if unit is not None and unit not in MILLIMETRES:
        raise InputError(f"unit: expected one of {', '.join(MILLIMETRES)}, got {unit!r}")
    return MILLIMETRES[unit or "mm"]


def require_unit(points: FloatArray, lattice: FloatArray | None) -> None:
    """Raise InputError asking for the unit if the nodes' or the cell's width is unusual in mm.

    ``points`` (n, 2): as in the file; ``lattice`` (2, 2): the given vectors [mm], if any.
    """
    width, low, high = float(np.ptp(points, axis=0).max()), *_USUAL
    ratio = 1.0 if lattice is None else width / float(np.linalg.norm(lattice, axis=1).max())
    if low <= width <= high and 0.05 < ratio < 20:
        return
    is_small = width < low or ratio < 1
    beside = "" if low <= width <= high else "; 'mm' if it is meant so"
    at = "" if lattice is None else f" beside lattice vectors of {width / ratio:.3g} mm"
    raise InputError(
        f"expected a cell in mm, got one {width:.3g} wide{at}, which looks like "
        f"{'metres' if is_small else 'micrometres'}; state the unit of the file's nodes, such as "
        f"unit = '{'m' if is_small else 'um'}'{beside} (all else stays in mm)"
    )


@dataclass(frozen=True, eq=False)
class ForeignMesh:
    """A mesh of another program in standard form."""

    mesh: Mesh
    """Plane T6 mesh, counter-clockwise, without unused nodes."""
    origin: IntArray
    """(n,) index of each node among the given nodes; -1 for added mid-side nodes."""
    notes: tuple[str, ...] = ()
    """Texts on what was changed."""


def sound_t6(points: FloatArray, cells: IntArray) -> ForeignMesh:
    """Make a plane T6 mesh, counter-clockwise, without unused nodes; node order is kept.

    From points (n, 2), or (n, 3) with z = const [mm], and cells (m, 3) or (m, 6) in gmsh's order or
    any of ``NUMBERINGS``; mid-side nodes are added to three-node triangles, after all other nodes.
    InputError for a mesh that isn't plane, has elements on top of each other, or flat or folded
    elements.
    """
    used, numbers = np.unique(cells, return_inverse=True)
    nodes, cells = in_plane(points[used]), numbers.reshape(cells.shape).astype(np.int64)
    notes: list[str] = []
    if cells.shape[1] == 3:
        nodes, cells = with_mid_sides(nodes, cells)
        notes.append(
            f"{len(cells)} three-node triangles became six-node ones with straight sides: a curved "
            "edge stays the polygon that the file has"
        )
    elif name := _numbering(nodes, cells):
        cells = cells[:, NUMBERINGS[name]]
        notes.append(
            f"the file's six-node triangles are numbered {name}, recognised by where their nodes "
            "are, and were renumbered like gmsh's, VTK's and Abaqus': corners, mid-sides 1-2, 2-3, "
            "3-1"
        )
    a, b, c = (nodes[cells[:, k]] for k in range(3))
    clockwise = np.linalg.det(np.stack([b - a, c - a], axis=1)) < 0
    if clockwise.any():
        cells = np.where(clockwise[:, None], cells[:, REVERSED_T6], cells)
        notes.append(f"{clockwise.sum()} of {len(cells)} elements are clockwise and were turned")
    mesh = Mesh(nodes, cells, "T6")
    _refuse_unsound(mesh)
    near = 1e-9 * float(np.ptp(nodes, axis=0).max())
    if len(pairs := cKDTree(nodes).query_pairs(near, output_type="ndarray")):
        x, y = nodes[pairs[0, 0]]
        notes.append(
            f"{len(pairs)} pairs of nodes lie upon each other, the first at ({x:.5g}, {y:.5g}) mm: "
            "the mesh is cut open there; merge them where that is no crack"
        )
    origin = np.append(used, np.full(len(nodes) - len(used), -1)).astype(np.int64)
    return ForeignMesh(mesh, origin, tuple(notes))


def _numbering(nodes: FloatArray, cells: IntArray) -> str:
    """The name of the node order of T6 elements (m, 6); "" for gmsh's order."""
    if _off_middle(nodes, cells) < _FAR:
        return ""
    off = {name: _off_middle(nodes, cells[:, order]) for name, order in NUMBERINGS.items()}
    best = min(off, key=lambda name: off[name])
    if off[best] > _CLOSE:
        raise InputError(
            "expected six-node triangles numbered like gmsh's, VTK's and Abaqus' (corners, then "
            "mid-sides 1-2, 2-3, 3-1), got an order that isn't recognised: in the nearest one, "
            f"{best}, mid-sides are {off[best]:.0%} of their side off its middle"
        )
    return best


def _off_middle(nodes: FloatArray, cells: IntArray) -> float:
    """Distance of mid-side nodes from their side's middle, over its length; median of elements."""
    off = []
    for k, (p, q) in enumerate(_SIDES):
        a, b, middle = (nodes[cells[:, j]] for j in (p, q, 3 + k))
        length = np.maximum(np.linalg.norm(b - a, axis=1), 1e-300)
        off.append(np.linalg.norm(middle - 0.5 * (a + b), axis=1) / length)
    return float(np.median(np.max(off, axis=0)))


def _refuse_unsound(mesh: Mesh) -> None:
    nodes, cells = mesh.nodes, mesh.cells
    middle, count = np.unique(cells[:, 3:], return_counts=True)
    if count.max() > 2:
        x, y = nodes[middle[np.argmax(count)]]
        raise InputError(
            f"expected sides of one or two elements, got one of {count.max()} at ({x:.5g}, "
            f"{y:.5g}) mm; elements must not lie upon each other"
        )
    bad = np.flatnonzero(_smallest_jacobians(mesh) <= 0)
    if len(bad):
        x, y = nodes[cells[bad[0], :3]].mean(axis=0)
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
    """(6, 2) derivatives of the T6 shape functions by xi and eta."""
    z = 1.0 - xi - eta
    by_xi = [1 - 4 * z, 4 * xi - 1, 0.0, 4 * (z - xi), 4 * eta, -4 * eta]
    by_eta = [1 - 4 * z, 0.0, 4 * eta - 1, -4 * xi, 4 * xi, 4 * (z - eta)]
    return np.stack([by_xi, by_eta], axis=1)


NODES = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5))
"""Nodes of a T6 element in local coordinates; values there determine its quadratic Jacobian."""
_GRADIENTS = np.array([_gradients(xi, eta) for xi, eta in NODES])
