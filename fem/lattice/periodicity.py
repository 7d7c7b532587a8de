"""Periodicity of a cell's mesh: nodes that lattice translations map onto each other.

The copies of a cell, translated by all integer combinations of two lattice vectors, must fit
together: nodes must coincide wherever material meets material. The cell may have any boundary (a
parallelogram, a hexagon, one that cuts through holes), as long as its copies tile the lattice.
Contact isn't modelled; :func:`overlaps` detects whether a deformed cell overlaps itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.lattice.options import lattice_vectors
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError

SAME_PLACE = 1e-6
"""Distance, over the shorter lattice vector, below which translated nodes count as coincident."""
# Neighbours that can touch a cell whose boundary extends over at most two cells.
_NEIGHBOURS = [r for r in product(range(-2, 3), repeat=2) if r != (0, 0)]


@dataclass(frozen=True, eq=False)
class Periodicity:
    """The nodes of a cell as translates of independent ones ("masters").

    Node i is at the position of the master ``master[i]``, 0 ... count - 1, plus R1 a1 + R2 a2 with
    the integers R = ``shift[i]``.
    """

    lattice: FloatArray
    """(2, 2) lattice vectors a1 and a2 as rows [mm]."""
    master: IntArray
    shift: IntArray

    @property
    def count(self) -> int:
        """Number of masters."""
        return int(self.master.max()) + 1


def find_periodicity(mesh: Mesh, lattice: FloatArray) -> Periodicity:
    """Pair the nodes of a T6 mesh that lattice translations map onto each other.

    ``lattice``: lattice vectors a1 and a2 as rows (2, 2) [mm].

    InputError for parallel vectors, and for copies of the cell that overlap, touch without
    common nodes, or aren't connected along both vectors; the message names the nodes.
    """
    if mesh.element != "T6":
        raise InputError(f"periodic cell: expected a T6 mesh, got {mesh.element}")
    lattice = lattice_vectors(lattice, "periodic cell")
    distance = SAME_PLACE * float(np.linalg.norm(lattice, axis=1).min())
    pairs = _pairs(mesh.nodes, lattice, distance)
    sides = boundary_sides(mesh)
    _refuse_overlap(mesh, lattice, np.unique(sides))
    _refuse_hanging(mesh, lattice, sides, pairs)
    n = len(mesh.nodes)
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(n, n))
    _, master = connected_components(links, directed=False)
    _, first = np.unique(master, return_index=True)
    shift = np.rint((mesh.nodes - mesh.nodes[first[master]]) @ np.linalg.inv(lattice))
    found = Periodicity(lattice, master.astype(np.int64), shift.astype(np.int64))
    _refuse_loose(mesh, found, sides)
    return found


def _pairs(nodes: FloatArray, lattice: FloatArray, distance: float) -> IntArray:
    """(p, 2) pairs of nodes that a nonzero lattice translation maps onto each other."""
    tree, found = cKDTree(nodes), []
    for r in _NEIGHBOURS:
        near, partner = tree.query(nodes + np.array(r) @ lattice, distance_upper_bound=distance)
        mine = np.flatnonzero(np.isfinite(near))
        found.append(np.stack([mine, partner[mine]], axis=1))
    return np.vstack(found).astype(np.int64)


def _refuse_overlap(mesh: Mesh, lattice: FloatArray, boundary: IntArray) -> None:
    interior = np.setdiff1d(mesh.cells[:, :3], boundary)
    covered = _covered(mesh, lattice, mesh.nodes[interior])
    if covered.any():
        raise InputError(
            "periodic cell: expected copies of the cell to meet at its boundary only, but they "
            f"overlap at {_named(interior[covered], mesh.nodes)}; check the lattice vectors"
        )


def _refuse_hanging(mesh: Mesh, lattice: FloatArray, sides: IntArray, pairs: IntArray) -> None:
    """Raise InputError where copies touch along sides whose three nodes don't coincide."""
    matched = np.isin(sides, pairs).all(axis=1)
    a, middle, b = mesh.nodes[sides[~matched]].transpose(1, 0, 2)
    along = b - a
    # Points slightly outside the side lie in the void if the surface is free.
    outside = middle + 0.02 * np.stack([along[:, 1], -along[:, 0]], axis=1)
    covered = _covered(mesh, lattice, outside)
    if covered.any():
        mine = np.unique(sides[~matched][covered])
        alone = np.setdiff1d(mine, pairs)
        lost = alone if len(alone) else mine
        raise InputError(
            "periodic cell: expected a partner, one lattice translation away, for every node on "
            f"the cell's boundary, got none for {_named(lost, mesh.nodes)}; divide opposite sides "
            "alike or check the lattice vectors"
        )


def _covered(mesh: Mesh, lattice: FloatArray, points: FloatArray) -> BoolArray:
    """Whether each point (n, 2) lies in the material of another copy of the cell."""
    triangles = mesh.nodes[mesh.cells[:, :3]]
    images = np.vstack([points + np.array(r) @ lattice for r in _NEIGHBOURS])
    return np.asarray(_inside(images, triangles).reshape(len(_NEIGHBOURS), -1).any(axis=0))


def _inside(points: FloatArray, triangles: FloatArray, depth: float = 0.0) -> BoolArray:
    """Whether each point (n, 2) lies in one of the triangles (m, 3, 2), ``depth`` heights deep."""
    centres = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max()
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    near = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
    tree, inside = cKDTree(centres), np.zeros(len(points), dtype=bool)
    pairs = cKDTree(points[near]).sparse_distance_matrix(tree, reach, output_type="ndarray")
    place = near[pairs["i"]]
    corners = triangles[pairs["j"]] - points[place][:, None]
    following = np.roll(corners, -1, axis=1)
    areas = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    inside[place[areas.min(axis=1) > depth * areas.sum(axis=1)]] = True
    return inside


def _refuse_loose(mesh: Mesh, found: Periodicity, sides: IntArray) -> None:
    """Raise InputError unless the lattice is one body connected along both lattice vectors."""
    piece = _pieces(found.master[mesh.cells], found.count)[found.master]
    if piece.max() > 0:
        largest = np.argmax(np.bincount(piece))
        raise InputError(
            "periodic cell: expected one body, got parts that nothing holds: "
            f"{_named(np.flatnonzero(piece != largest), mesh.nodes)}; connect or remove them"
        )
    # Differences of shifts between nodes with the same master in the same piece.
    piece = _pieces(mesh.cells, len(mesh.nodes))
    order = np.lexsort((piece, found.master))
    is_same = (np.diff(found.master[order]) == 0) & (np.diff(piece[order]) == 0)
    shifts = np.unique(np.diff(found.shift[order], axis=0)[is_same], axis=0)
    rank = np.linalg.matrix_rank(shifts) if len(shifts) else 0
    if rank < 2:
        boundary = np.unique(sides)
        alone = boundary[np.bincount(found.master)[found.master[boundary]] == 1]
        raise InputError(
            "periodic cell: expected the lattice to hold together along both lattice vectors, but "
            f"{'no' if rank == 0 else 'only one'} direction has partners; without one are "
            f"{_named(alone, mesh.nodes)}; check the lattice vectors"
        )


def _pieces(cells: IntArray, count: int) -> IntArray:
    """(count,) number of the connected piece that each node belongs to."""
    start, end = np.repeat(cells[:, 0], cells.shape[1]), cells.ravel()
    links = coo_array((np.ones(len(start)), (start, end)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _named(numbers: IntArray, nodes: FloatArray) -> str:
    """Text for a message, such as '3 nodes: 5 at (0, 1.2) mm, ...'."""
    places = (f"{k} at ({nodes[k, 0]:.5g}, {nodes[k, 1]:.5g}) mm" for k in numbers[:4])
    more = ", ..." if len(numbers) > 4 else ""
    return f"{len(numbers)} nodes: {', '.join(places)}{more}"


# A T6 element divided into four triangles.
PARTS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
_DEPTH = 1e-3  # depth, relative to a triangle's height, that doesn't count as overlap yet


def overlaps(
    mesh: Mesh, lattice: FloatArray, gradient: FloatArray, displacement: FloatArray
) -> bool:
    """Whether the material of a deformed periodic cell overlaps itself or its copies.

    T6 mesh and lattice vectors (rows) are undeformed [mm]; ``gradient`` (2, 2) is F̄, which moves
    the copies; ``displacement`` (n, 2) is that of the nodes [mm].
    """
    nodes, vectors = mesh.nodes + displacement, lattice @ gradient.T
    triangles = nodes[mesh.cells[:, PARTS].reshape(-1, 3)]
    points = nodes[np.unique(boundary_sides(mesh))]
    images = [points + np.array(r) @ vectors for r in product((-1, 0, 1), repeat=2)]
    return bool(_inside(np.vstack(images), triangles, _DEPTH).any())
