"""Bloch waves on a deformed lattice: their lowest eigenvalues, for any wave vector.

K x = lambda M x with both matrices reduced by T(k)^H . T(k) to the primitive cell; a wave with
negative lambda grows. Wave vectors are given as phases from cell to cell, (k . a1, k . a2) [rad].
Eigenpairs are computed by a block Lanczos method, for many wave vectors at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from modeharvest.fem.lattice.bloch_map import (
    Batch,
    Condensation,
    CondensedWaves,
    applied,
    factorise,
)
from modeharvest.fem.lattice.cell import CellState, PeriodicCell
from modeharvest.fem.lattice.options import Wave, wave_of
from modeharvest.fem.sparse_factor import negative_pivots
from modeharvest.util.arrays import FloatArray

_SCAN_TOLERANCE = 1e-10  # of lambda + s, relative
_BATCH = 30  # number of waves iterated at once; more only need more memory
_NOISE = 0.2  # relative noise in a start vector
_DIRECTIONS = 36  # number of directions over 180 degrees


@dataclass(frozen=True, eq=False)
class BlochModes:
    """The lowest eigenpairs at one wave vector."""

    wave: Wave
    eigenvalues: FloatArray
    """(m,) ascending [N/mm^4]."""
    vectors: NDArray[Any]
    """(size, m) with x^H M x = 1, in the order of ``Reduction``."""


class BlochWaves:
    """Bloch waves on one state of a primitive cell; counts factorisations of its matrices."""

    def __init__(self, cell: PeriodicCell, state: CellState) -> None:
        self.cell, self.state = cell, state
        self.stiffness = cell.reduction.reduced(state.stiffness)
        self.factorisations = 0
        # A shift below the spectrum keeps Γ, with its translations, regular.
        scale = np.linalg.norm(state.moduli.ravel()) / (cell.filling * cell.cell.area)
        self._below = 0.02 * float(scale)
        self._condense()

    def lowest(
        self, wave: Wave, count: int = 1, near: BlochModes | None = None, tolerance: float = 1e-14
    ) -> BlochModes:
        """The ``count`` lowest eigenpairs, at Γ without the two translations.

        Lanczos with the inverse of K + s M; s is so large that this is positive definite, which its
        factors prove, so the eigenvalues nearest to -s are the lowest. ``near``: modes of a nearby
        wave vector as start; ``tolerance``: approximate relative error of lambda + s.
        """
        values, vectors = self.iterated(phases_of([wave]), count, near, tolerance)
        return BlochModes(wave, values[0], vectors[:, 0])

    def iterated(
        self, waves: FloatArray, count: int, near: BlochModes | None, tolerance: float
    ) -> tuple[FloatArray, Batch]:
        """Values (w, count) and vectors (size, w, count) as of ``lowest`` for several waves.

        ``waves``: phases (w, 2) [rad] of one kind: all Γ, all others with real T(k), or all others.
        """
        solver, below = self._solver_below(waves)
        T = self.cell.reduction.bloch_map.at(waves)

        def weigh(block: Batch) -> Batch:
            return T.restrict(applied(self.cell.nodal_mass.__matmul__, T.expand(block)))

        start = self._start(T.dtype, count, near)[:, None]
        fixed = start[:, :, :0]
        if _are_centre(waves).all():  # orthonormal translations along x and y
            moves = np.stack([self.cell.reduction.order % 2 == axis for axis in (0, 1)], axis=1)
            fixed = moves[:, None] / math.sqrt(self.cell.filling * self.cell.cell.area)
        start, fixed = (np.repeat(vectors, len(waves), axis=1) for vectors in (start, fixed))
        inverse, vectors = largest(solver.solve, weigh, start, fixed, tolerance)
        return 1.0 / inverse - below, vectors

    def unstable(self, wave: Wave) -> int:
        """Number of negative eigenvalues, by the inertia of one factor; not for Γ itself."""
        self.factorisations += 1
        return negative_pivots(factorise(self.stiffness(wave_of(wave))))

    def unstable_among(self, points: Sequence[Wave]) -> tuple[Wave, ...]:
        """The wave vectors except Γ at which K isn't positive definite, proved by Cholesky."""
        self.factorisations += 1
        condensation = Condensation(self.state.stiffness, self.cell.reduction.boundary)
        waves = phases_of(points)
        bad = [np.any(wave) and condensation.at(wave[None]) is None for wave in waves]
        return tuple(wave for wave, is_bad in zip(points, bad, strict=True) if is_bad)

    def slope(self, modes: BlochModes) -> FloatArray:
        """(2,) derivatives of the lowest eigenvalue by k . a1 and k . a2 (Hellmann-Feynman)."""
        reduction = self.cell.reduction
        u = reduction.displacement(modes.vectors[:, 0], modes.wave)
        vector = u.reshape(-1, 1, 1)
        forces = applied(self.state.stiffness.__matmul__, vector)
        forces -= modes.eigenvalues[0] * applied(self.cell.nodal_mass.__matmul__, vector)
        # dT(k)/dk_a = i R_a T(k), so the quotient changes by the work of rotated displacements.
        work = np.sum(u.conj() * forces.reshape(u.shape), axis=1)
        return np.asarray(2.0 * work.imag @ reduction.periodicity.shift)

    def acoustic(self, angle: float) -> float:
        """Smallest eigenvalue of the acoustic tensor Q_ik = L_ijkl n_j n_l [MPa].

        The limit of filling * lambda / |k|^2 for waves much longer than the cell that travel
        along n = (cos, sin) of ``angle`` [rad]. Where it reaches zero the effective medium
        loses ellipticity (Geymonat, Mueller & Triantafyllidis, Arch. Ration. Mech. Anal. 122
        (1993) 231-290).
        """
        n = np.array([np.cos(angle), np.sin(angle)])
        Q = np.einsum("ijkl,j,l->ik", self.state.moduli, n, n)
        return float(np.linalg.eigvalsh(0.5 * (Q + Q.T))[0])

    def long_wave(self) -> tuple[float, float]:
        """The smallest acoustic eigenvalue over all directions [MPa], and its angle [rad]."""
        angles, width = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS, np.pi / _DIRECTIONS
        best = float(min(angles, key=self.acoustic))
        found = minimize_scalar(
            lambda turn: self.acoustic(best + turn), bounds=(-width, width), method="bounded"
        )
        turned = (float(found.fun), best + float(found.x))
        return min((self.acoustic(best), best), turned, key=lambda pair: pair[0])

    def _solver_below(self, waves: FloatArray) -> tuple[CondensedWaves, float]:
        """The solvers with K + s M, and s, which is increased for good if not sufficient."""
        while True:
            solver = self._condensation.at(waves)
            if solver is not None:
                return solver, self._below
            self._below *= 2.0
            self._condense()

    def _condense(self) -> None:
        self.factorisations += 1
        shifted = csr_array(self.state.stiffness + self._below * self.cell.nodal_mass)
        self._condensation = Condensation(shifted, self.cell.reduction.boundary)

    def _start(self, dtype: Any, count: int, near: BlochModes | None) -> Batch:
        """(size, count) start vectors: those of ``near``, plus noise in any case.

        Eigenvectors of one wave vector may all lack the symmetry of a mode that becomes lowest at
        the next; without noise the iteration would never find it.
        """
        shape = 2, self.cell.reduction.size, count
        real, imaginary = np.random.default_rng(7).standard_normal(shape)
        noise = real if dtype.kind == "f" else real + 1j * imaginary
        if near is None or near.vectors.dtype != dtype or near.vectors.shape != noise.shape:
            return np.asarray(noise)
        sizes = np.linalg.norm(near.vectors, axis=0) / np.linalg.norm(noise, axis=0)
        return np.asarray(near.vectors + _NOISE * sizes * noise)


def scan(waves: BlochWaves, points: Sequence[Wave], count: int = 1) -> FloatArray:
    """(n, count) lowest eigenvalues at many wave vectors, iterated together [N/mm^4]."""
    phases = phases_of(points)
    values = np.empty((len(points), count))
    for group in _groups(phases):
        values[group], _ = waves.iterated(phases[group], count, None, _SCAN_TOLERANCE)
    return values


def phases_of(points: Sequence[Wave]) -> FloatArray:
    """(n, 2) phases [rad] of wave vectors, each checked by :func:`wave_of`."""
    return np.array([wave_of(point) for point in points], dtype=np.float64).reshape(-1, 2)


def _groups(waves: FloatArray) -> list[NDArray[np.int64]]:
    """Indices of waves that can be iterated together: Γ, other real ones, batches of the rest."""
    is_real, is_centre = _are_centre(2.0 * waves), _are_centre(waves)
    others = np.flatnonzero(~is_real)
    parts = np.array_split(others, math.ceil(len(others) / _BATCH) or 1)
    groups = [np.flatnonzero(is_centre), np.flatnonzero(is_real & ~is_centre), *parts]
    return [group for group in groups if len(group)]


def _are_centre(waves: FloatArray) -> NDArray[np.bool_]:
    turns = waves / (2.0 * np.pi)
    return np.asarray(np.all(np.abs(turns - np.rint(turns)) < 1e-12, axis=1))


Operator = Callable[[Batch], Batch]

_LARGEST_SPACE = 60  # in blocks


def largest(
    solve: Operator, weigh: Operator, start: Batch, fixed: Batch, tolerance: float
) -> tuple[FloatArray, Batch]:
    """The largest eigenvalues of A^-1 M, for each problem as many as ``start`` has vectors.

    Every new block is orthogonalised against all others, of which there are few.

    ``solve`` and ``weigh`` apply A^-1 and M, both positive definite, to batches (size, w, m);
    ``fixed`` (size, w, f): M-orthonormal vectors excluded from the space; ``tolerance``: about the
    relative error of the eigenvalues. Returns values (w, m), descending, and M-orthonormal vectors.
    """
    count, width = start.shape[2], start.shape[1]
    images, spaces = [weigh(fixed)], [fixed]
    block = start - _mixed(fixed, _products(images[0], start))
    block, image, _ = _orthonormal(block, weigh)
    projected: Batch = np.zeros((width, 0, 0), dtype=block.dtype)
    for _ in range(_LARGEST_SPACE):
        spaces.append(block)
        images.append(image)
        block = solve(image)
        columns = [_products(weighted, block) for weighted in images]
        for vectors, column in zip(spaces, columns, strict=True):
            block = block - _mixed(vectors, column)
        column, old = np.concatenate(columns[1:], axis=1), projected.shape[1]
        upper, corner = column[:, :old], column[:, old:]
        projected = np.block([[projected, upper], [upper.conj().transpose(0, 2, 1), corner]])
        block, image, rest = _orthonormal(block, weigh)
        values, mix = np.linalg.eigh(projected)
        values, mix = values[:, ::-1][:, :count], mix[:, :, ::-1][:, :, :count]
        residual = np.linalg.norm(rest @ mix[:, -count:], axis=1)
        if np.all(residual**2 <= tolerance * values**2):
            break
    parts = np.split(mix, len(spaces) - 1, axis=1)
    found = sum(_mixed(vectors, part) for vectors, part in zip(spaces[1:], parts, strict=True))
    return values, np.asarray(found)


def _products(left: Batch, right: Batch) -> Batch:
    """(w, i, j) inner products left_i^H right_j."""
    return np.asarray(np.einsum("nwi,nwj->wij", left.conj(), right))


def _mixed(vectors: Batch, factors: Batch) -> Batch:
    """(size, w, j) linear combinations: sum of vectors_i factors_ij."""
    return np.asarray(np.einsum("nwi,wij->nwj", vectors, factors))


def _orthonormal(block: Batch, weigh: Operator) -> tuple[Batch, Batch, Batch]:
    """M-orthonormalise a block: orthonormal block, its image by M, R: block = orthonormal . R."""
    image = weigh(block)
    R = np.linalg.cholesky(_products(block, image)).conj().transpose(0, 2, 1)
    inverse = np.linalg.inv(R)
    return _mixed(block, inverse), _mixed(image, inverse), R
