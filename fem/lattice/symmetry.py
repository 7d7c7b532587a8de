"""Symmetries of a cell's geometry, from its holes' edges: primitive cell, rotations, reflections.

The mesh need not have these symmetries: a gmsh mesh of four equal holes is as good as a copied one.
In the lattice of a connected body, all edges are closed loops around holes. A symmetry maps every
loop onto a loop. Candidates follow from the loops' centroids; they must map all corners of the
edges onto edges, within the error of approximating a smooth curve by elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.lattice.periodicity import Periodicity
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray

_SAMPLES = np.linspace(0.0, 1.0, 17)  # along a side
_SHARE = 5e-4  # of a side's length: least tolerance of edges
_ALIKE = 1e-2  # relative tolerance of the areas of equal holes
_SAME_LENGTH = 1e-5  # relative


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The map x -> turn x + move of the lattice onto itself."""

    turn: FloatArray
    """(2, 2) rotation or reflection."""
    move: FloatArray
    """(2,) translation [mm]."""

    def keeps(self, gradient: FloatArray) -> bool:
        """Whether the lattice keeps this symmetry under a macroscopic F̄ (2, 2)."""
        off = self.turn @ gradient @ self.turn.T - gradient
        return bool(np.abs(off).max() <= 1e-2 * np.abs(gradient - np.eye(2)).max() + 1e-12)


@dataclass(frozen=True, eq=False)
class CellSymmetry:
    """The symmetries of a lattice that is given by one cell."""

    primitive: FloatArray
    """(2, 2) shortest vectors a1, a2 as rows [mm]; those of the cell if it is primitive."""
    translations: FloatArray
    """(N, 2) distinct translations within the cell, including 0 [mm]; N: its primitive cells."""
    operations: tuple[Symmetry, ...] = ()
    """Rotations and reflections, each once, without the identity."""


def find_symmetry(mesh: Mesh, periodicity: Periodicity) -> CellSymmetry:
    """The symmetries of the lattice made of copies of a cell."""
    lattice, nowhere = periodicity.lattice, np.zeros((1, 2))
    edges = HoleEdges(mesh, periodicity)
    if not len(edges.areas):
        return CellSymmetry(lattice, nowhere)
    moves = [move for move in edges.candidates(np.eye(2)) if edges.has(np.eye(2), move)]
    count = max(len(moves), 1)
    turns = np.rint(count * np.array(moves or nowhere) @ np.linalg.inv(lattice)) / count
    translations = np.unique(np.mod(turns, 1.0), axis=0) @ lattice
    if len(translations) != count or len(edges.areas) % count:  # no group: accidental matches
        count, translations = 1, nowhere
    reduced = _reduced(translations, lattice, count)
    operations = []
    for turn in _turns(reduced):
        move = next((m for m in edges.candidates(turn) if edges.has(turn, m)), None)
        if move is not None and not np.allclose(turn, np.eye(2)):
            operations.append(Symmetry(turn, move))
    return CellSymmetry(lattice if count == 1 else reduced, translations, tuple(operations))


class HoleEdges:
    """The edges of a lattice's holes: area (negative) [mm^2] and centroid [mm] of each.

    The corners on the edges are the nodes ``masters`` (s,), each on the hole ``hole`` (s,) in the
    cell ``copy`` (s, 2). ``sharpest``: the largest kink of a notch [rad].
    """

    def __init__(self, mesh: Mesh, periodicity: Periodicity) -> None:
        self.lattice, self._inverse = periodicity.lattice, np.linalg.inv(periodicity.lattice)
        sides = boundary_sides(mesh)
        _, number, count = np.unique(
            periodicity.master[sides[:, 1]], return_inverse=True, return_counts=True
        )
        sides = sides[count[number.ravel()] == 1]  # without material of another copy next to it
        a, middle, b = mesh.nodes[sides].transpose(1, 0, 2)
        self.corners, bow = a, 2.0 * (a + b) - 4.0 * middle
        s = _SAMPLES[:, None, None]
        slope = b - a + (2.0 * s - 1.0) * bow
        points = a + s * (b - a) + s * (s - 1.0) * bow
        self.masters = periodicity.master[sides[:, 0]]
        self._find_loops(periodicity, sides, points)
        length = np.linalg.norm(b - a, axis=1)
        self.near = self.sharpest = 0.0
        if not len(sides):
            return
        self.near = _SHARE * float(np.median(length)) + self._roughness(slope, length)
        self._spacing = float(length.max()) / (len(_SAMPLES) - 1)
        tangent = (slope / np.linalg.norm(slope, axis=2, keepdims=True)).reshape(-1, 2)
        inside = np.mod(points.reshape(-1, 2) @ self._inverse, 1.0)
        tiles = [(inside + r) @ self.lattice for r in product((-1, 0, 1), repeat=2)]
        self._tree, self._tangent = cKDTree(np.vstack(tiles)), np.tile(tangent, (9, 1))

    def _find_loops(self, periodicity: Periodicity, sides: IntArray, points: FloatArray) -> None:
        """Follow the sides around each hole, and integrate over it."""
        ends, left = periodicity.master[sides[:, 2]], set(range(len(sides)))
        after = {int(master): side for side, master in enumerate(self.masters)}
        areas: list[float] = []
        centroids: list[FloatArray] = []
        self._following: IntArray = np.full(len(sides), -1)
        self.hole, self.copy = np.full(len(sides), -1), -periodicity.shift[sides[:, 0]]
        while left:
            side, here, loop = min(left), points[0, min(left)], []
            while side in left:
                left.remove(side)
                loop.append(points[:-1, side] - points[0, side] + here)
                away = np.rint((here - points[0, side]) @ self._inverse)
                self.hole[side], self.copy[side] = len(areas), self.copy[side] - away
                here = here + points[-1, side] - points[0, side]
                self._following[side] = side = after.get(int(ends[side]), -1)
            x = np.vstack(loop)
            y = np.roll(x, -1, axis=0)
            parts = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
            areas.append(float(0.5 * parts.sum()))
            centroids.append(parts @ (x + y) / (3.0 * (parts.sum() or 1.0)))  # a crack has no area
        self.areas, self.centroids = np.array(areas), np.array(centroids).reshape(-1, 2)

    def _roughness(self, slope: FloatArray, length: FloatArray) -> float:
        """Deviation of sides from a smooth edge [mm], from the median kink between them."""
        out, into = slope[-1], slope[0][self._following]
        turn = out[:, 0] * into[:, 1] - out[:, 1] * into[:, 0]
        kink = np.arctan2(turn, np.sum(out * into, axis=1))
        self.sharpest = -float(kink.min())
        return float(1.5 / 8.0 * np.median(np.abs(kink)) * np.median(length))

    def candidates(self, turn: FloatArray) -> FloatArray:
        """(c, 2) translations after ``turn`` that map the rarest hole onto an equal one [mm]."""
        alike = np.abs(self.areas[:, None] - self.areas) <= _ALIKE * np.abs(self.areas)
        rarest = int(np.argmin(alike.sum(axis=1)))
        moves = self.centroids[alike[rarest]] - turn @ self.centroids[rarest]
        return np.asarray(np.mod(np.round(moves @ self._inverse, 9), 1.0) @ self.lattice)

    def has(self, turn: FloatArray, move: FloatArray) -> bool:
        """Whether a rotation or reflection, and a translation, map all edges onto edges."""
        every = np.mod((self.corners @ turn.T + move) @ self._inverse, 1.0) @ self.lattice
        return all(self._are_on(part).all() for part in (every[::17], every))

    def _are_on(self, points: FloatArray) -> BoolArray:
        _, nearest = self._tree.query(points, 3)
        away, along = points[:, None] - self._tree.data[nearest], self._tangent[nearest]
        ahead = np.abs(np.sum(away * along, axis=2)) - 0.6 * self._spacing
        aside = away[..., 0] * along[..., 1] - away[..., 1] * along[..., 0]
        return np.asarray(np.hypot(np.maximum(ahead, 0.0), aside).min(axis=1) < self.near)


def _reduced(translations: FloatArray, lattice: FloatArray, count: int) -> FloatArray:
    """(2, 2) shortest two vectors of a lattice with ``count`` translations in its cell [mm].

    Counter-clockwise, the first as close to x as possible; at 60 degrees rather than 120.
    """
    steps = np.array(list(product(range(-4, 5), repeat=2))) @ lattice
    every = (translations[:, None] + steps).reshape(-1, 2)
    length = np.linalg.norm(every, axis=1)
    size = float(length[length > _SAME_LENGTH * length.max()].min())
    order = np.lexsort((-every[:, 1], -np.round(every[:, 0] / size, 4), np.round(length / size, 4)))
    every = every[order][length[order] > 0.5 * size]
    first, area = every[0], abs(np.linalg.det(lattice)) / count
    across = first[0] * every[:, 1] - first[1] * every[:, 0]
    return np.stack([first, every[np.flatnonzero(np.abs(across - area) < 1e-3 * area)[0]]])


def _turns(vectors: FloatArray) -> list[FloatArray]:
    """The rotations and reflections of a lattice, given by its shortest vectors."""
    gram, found = vectors @ vectors.T, []
    for entries in product((-1, 0, 1), repeat=4):
        B = np.array(entries).reshape(2, 2)
        if np.abs(B @ gram @ B.T - gram).max() < _SAME_LENGTH * gram.max():
            found.append(np.asarray((np.linalg.inv(vectors) @ B @ vectors).T))
    return found
