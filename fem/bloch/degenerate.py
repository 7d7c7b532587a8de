"""Modes that are degenerate by the symmetry of a lattice, independent of its mesh.

A mesh without the geometry's symmetry splits degenerate modes slightly. Here modes are transformed
by the symmetries (``fem.lattice.symmetry``) and interpolated in the elements. So degenerate sets
are recognised by symmetry, not by a tolerance of eigenvalues. By the min-max principle, the
Rayleigh quotient of a mode's image is an upper bound of its partner's eigenvalue.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.eigen import BlochModes, BlochWaves
from modeharvest.fem.bloch.modes import ModeSet
from modeharvest.fem.lattice.cell import PeriodicCell
from modeharvest.fem.lattice.options import CENTRE, Wave
from modeharvest.fem.lattice.symmetry import Symmetry
from modeharvest.util.arrays import FloatArray, IntArray

Vectors = NDArray[Any]  # real or complex
_NEIGHBOURS = 16  # number of nearest elements in which a point is searched for
_CLOSED = 0.8  # least share of an image's square norm within a complete set
_SAME = 1e-3  # phase differences [rad] below which two waves are the same
_ALIKE = 0.25  # distance of unit vectors below which two combinations are the same
_MOST_MODES, _MOST_BRANCHES = 4, 12  # most modes to combine with all signs; most combinations


class Transport:
    """Transforms fields on a cell by maps of its lattice onto itself."""

    def __init__(self, cell: PeriodicCell) -> None:
        self.cell, mesh, self._lattice = cell, cell.cell.mesh, cell.cell.lattice
        self._inverse = np.linalg.inv(self._lattice)
        self._corners = mesh.nodes[mesh.cells[:, :3]]
        self._elements = self._tiled(self._corners.mean(axis=1))
        self._nodes = self._tiled(mesh.nodes)

    def _tiled(self, points: FloatArray) -> tuple[cKDTree, IntArray]:
        """A tree of all copies near the lattice's first cell, and their shifts (9 n, 2)."""
        own = np.floor(points @ self._inverse)
        shift = np.array(list(product((-1, 0, 1), repeat=2)))[:, None] - own
        tiles = (points + shift @ self._lattice).reshape(-1, 2)
        return cKDTree(tiles), shift.reshape(-1, 2).astype(np.int64)

    def _located(self, points: FloatArray) -> tuple[IntArray, FloatArray, IntArray]:
        """For each point: nodes (p, 6), weights (p, 6), and the copy of the cell (p, 2)."""
        cells, count = self.cell.cell.mesh.cells, len(self._corners)
        turns = np.floor(points @ self._inverse).astype(np.int64)
        inside = points - turns @ self._lattice
        tree, shift = self._elements
        near = tree.query(inside, min(_NEIGHBOURS, 9 * count))[1]
        a, b, c = np.moveaxis(self._corners[near % count], 2, 0)
        x = inside[:, None] - (a + shift[near] @ self._lattice)
        sides = np.stack([b - a, c - a], axis=-1)
        part = np.linalg.solve(sides, x[..., None])[..., 0]
        part = np.concatenate([1.0 - part.sum(axis=2, keepdims=True), part], axis=2)
        best = np.argmax(part.min(axis=2), axis=1)
        row = np.arange(len(points))
        L, element = part[row, best], near[row, best]
        weights = np.hstack([L * (2.0 * L - 1.0), 4.0 * L * np.roll(L, -1, axis=1)])
        nodes, copies = cells[element % count], shift[element] + turns
        # A point that coincides with a node needs no interpolation.
        tree, shift = self._nodes
        away, nearest = tree.query(inside)
        same = np.flatnonzero(away < 1e-6 * np.abs(self._lattice).max())
        weights[same] = np.eye(6)[0]
        nodes[same, 0] = nearest[same] % len(self.cell.cell.mesh.nodes)
        copies[same] = shift[nearest[same]] + turns[same]
        return nodes, weights, copies

    def image(self, vectors: Vectors, wave: Wave, by: Symmetry) -> tuple[Vectors, Wave]:
        """Images of a wave's reduced vectors (size, m) under a map, and their wave [rad]."""
        reduction, nodes = self.cell.reduction, self.cell.cell.mesh.nodes
        master = reduction.periodicity.master
        places = nodes[np.unique(master, return_index=True)[1]]
        corners, weights, copies = self._located((places - by.move) @ by.turn)
        u = reduction.bloch_map.at(np.array([wave])).expand(vectors[:, None])[:, 0]
        u = u.reshape(len(nodes), 2, -1)[corners]
        phases = np.exp(1j * (copies @ np.asarray(wave)))
        phases = phases.real if np.abs(phases.imag).max() < 1e-12 else phases
        moved = np.einsum("p,pa,pajm,ij->pim", phases, weights, u, by.turn, optimize=True)
        to = self._lattice @ by.turn @ self._inverse @ np.asarray(wave)
        found = moved.reshape(-1, vectors.shape[1])[reduction.order]
        return found, (float(to[0]), float(to[1]))

    def keeps_cells(self, by: Symmetry) -> bool:
        """Whether a map preserves the lattice of this cell, not only a finer lattice."""
        steps = self._lattice @ by.turn.T @ self._inverse
        return bool(np.abs(steps - np.rint(steps)).max() < 1e-4)


class Degeneracy:
    """Degeneracy by symmetry among the Bloch modes of one state of a lattice."""

    def __init__(self, bloch: BlochWaves) -> None:
        self.bloch, self.cell = bloch, bloch.cell
        operations, gradient = self.cell.cell.symmetry.operations, bloch.state.gradient
        self._kept = [by for by in operations if by.keeps(gradient)]

    @cached_property
    def _transport(self) -> Transport:
        return Transport(self.cell)

    def waves(self, wave: Wave) -> list[Wave]:
        """All images of a wave under symmetries of lattice and load, the wave itself first."""
        lattice, found = self.cell.cell.lattice, [wave]
        for by in self._kept:
            image = folded(lattice @ by.turn @ np.linalg.inv(lattice) @ np.asarray(wave))
            if not any(is_same(image, other) for other in found):
                found.append(image)
        return found

    def count(self, lowest: BlochModes, least: int) -> int:
        """Number of the lowest modes at a wave that form a degenerate set, at least ``least``."""
        most = lowest.vectors.shape[1]
        return next((n for n in range(least, most) if self._is_closed(lowest, n)), least)

    def bound(self, modes: BlochModes) -> float:
        """Upper bound of the eigenvalues of all images of the lowest mode [N/mm^4]."""
        bounds = [float(modes.eigenvalues[0])]
        for by in self._kept:
            x, wave = self._transport.image(modes.vectors[:, :1], modes.wave, by)
            K, M = self.bloch.stiffness(wave), self.cell.mass(wave)
            bounds.append(float(np.vdot(x, K @ x).real / np.vdot(x, M @ x).real))
        return max(bounds)

    def _is_closed(self, modes: BlochModes, count: int) -> bool:
        """Whether maps that keep the wave transform the first ``count`` modes among themselves."""
        vectors, M = modes.vectors[:, :count], self.cell.mass(modes.wave)
        for by in self._kept:
            images, wave = self._transport.image(vectors, modes.wave, by)
            if not is_same(wave, modes.wave):
                continue
            if not is_same(wave, modes.wave, (1.0,)):
                images = images.conj()  # k has become -k
            captured = np.sum(np.abs(vectors.conj().T @ (M @ images)) ** 2, axis=0)
            if np.any(captured < _CLOSED * np.sum(images.conj() * (M @ images), axis=0).real):
                return False
        return True


def distinct_combinations(cell: PeriodicCell, modes: ModeSet) -> tuple[tuple[float, ...], ...]:
    """Combinations of critical modes whose branches are not related by symmetry.

    Coefficients are 0, 1 and -1; combinations of few modes come first. ``cell``: the commensurate
    cell of the modes. A mode and its opposite are distinct unless a symmetry of lattice and load
    relates them. With over four modes or a dozen combinations: each mode alone, and their sum.
    """
    count = len(modes.waves)
    alone = [tuple(float(i == k) for i in range(count)) for k in range(count)]
    few = (*alone, (1.0,) * count) if count > 1 else tuple(alone)
    if count > _MOST_MODES:
        return few
    maps = _actions(cell, modes)  # including the identity
    rows = [row for row in product((1.0, 0.0, -1.0), repeat=count) if any(row)]
    rows.sort(key=lambda row: (np.count_nonzero(row), sum(c < 0 for c in row)))
    units = np.array(rows) / np.linalg.norm(rows, axis=1, keepdims=True)
    off = np.linalg.norm((units @ maps.transpose(0, 2, 1))[:, :, None] - units, axis=3)
    kind = connected_components(coo_array(np.any(off < _ALIKE, axis=0)))[1]
    first = np.sort(np.unique(kind, return_index=True)[1])
    return tuple(rows[k] for k in first) if len(first) <= _MOST_BRANCHES else few


def _actions(cell: PeriodicCell, modes: ModeSet) -> FloatArray:
    """(g, m, m) matrices by which the symmetries of lattice and load act on the modes."""
    transport, symmetry, reduction = Transport(cell), cell.cell.symmetry, cell.reduction
    first = np.unique(reduction.periodicity.master, return_index=True)[1]
    shapes = modes.shapes[:, first].reshape(len(modes.waves), -1).T[reduction.order]
    weighed = cell.mass(CENTRE) @ shapes / (cell.filling * cell.cell.area)
    every = [Symmetry(np.eye(2), move) for move in symmetry.translations]
    turns = (by for by in symmetry.operations if by.keeps(modes.gradient))
    every += [by for by in turns if transport.keeps_cells(by)]
    return np.array([weighed.T @ transport.image(shapes, CENTRE, by)[0] for by in every])


def folded(wave: Sequence[float] | FloatArray) -> Wave:
    """The same wave with both phases in (-pi, pi]; exact near multiples of pi."""
    phases = np.asarray(wave, dtype=np.float64)
    turns = np.rint(phases / np.pi)
    exact = np.where(np.abs(phases - np.pi * turns) < 1e-9, np.pi * turns, phases)
    p, q = np.pi - np.mod(np.pi - exact, 2.0 * np.pi)
    return (float(p), float(q))


def is_same(a: Wave, b: Wave, signs: Sequence[float] = (1.0, -1.0)) -> bool:
    """Whether two waves are equal, or opposite (by default ``signs``)."""
    apart = (folded((a[0] - s * b[0], a[1] - s * b[1])) for s in signs)
    return any(max(abs(p), abs(q)) < _SAME for p, q in apart)
