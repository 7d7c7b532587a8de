"""Bloch waves on a deformed lattice: their lowest eigenvalues, for any wave vector.

K x = lambda M x with both matrices reduced by T(k)^H . T(k) to the primitive cell; a negative
lambda means that a wave of this length and direction grows. Wave vectors are given as phases
from cell to cell, (k . a1, k . a2) in rad: M of the square lattice is (pi, pi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.sparse import csc_array, csr_array

from modeharvest.fem.cell import CellState, PeriodicCell
from modeharvest.fem.condensation import Condensation, CondensedWave
from modeharvest.fem.reduction import factorise, negative_pivots

FloatArray = NDArray[np.float64]
Wave = tuple[float, float]

_LARGEST_SPACE = 60  # of the Lanczos iteration, in blocks
_SCAN_TOLERANCE = 1e-9  # of lambda + s, relative
_NOISE = 0.2  # in a start vector, relative
_DIRECTIONS = 36  # over half a turn


@dataclass(frozen=True, eq=False)
class BlochModes:
    """The lowest eigenpairs at one wave vector.

    Parameters
    ----------
    wave
        Phases (k . a1, k . a2) [rad].
    eigenvalues
        (m,) ascending [N/mm^4].
    vectors
        (size, m) x with x^H M x = 1, in the order of ``Reduction``.
    """

    wave: Wave
    eigenvalues: FloatArray
    vectors: NDArray[Any]


class BlochWaves:
    """All Bloch waves on one state of a cell; the stiffness is assembled and sorted once.

    ``factorisations`` counts those of reduced matrices.

    Parameters
    ----------
    cell
        The cell, primitive for all wave vectors to mean what they say.
    state
        An equilibrium of it.
    """

    def __init__(self, cell: PeriodicCell, state: CellState) -> None:
        self.cell, self.state = cell, state
        self.stiffness = cell.reduction.reduced(state.stiffness)
        self.factorisations = 0
        # Eigenvalues are looked for from below, so that Γ with its translations is regular.
        scale = np.linalg.norm(state.moduli.ravel()) / (cell.filling * cell.cell.area)
        self._below = 0.02 * float(scale)
        self._condense()
        self._noise = np.random.default_rng(7).standard_normal((2, cell.reduction.size, 8))

    def lowest(
        self,
        wave: Wave,
        count: int = 1,
        near: BlochModes | None = None,
        tolerance: float = 1e-14,
    ) -> BlochModes:
        """The ``count`` lowest eigenpairs, at Γ without the two translations.

        Lanczos with the inverse of K + s M; s is so large that this is positive definite, which
        its factors prove, so the eigenvalues nearest to -s are the lowest.

        Parameters
        ----------
        wave
            Phases (k . a1, k . a2) [rad].
        count
            Number of eigenpairs.
        near
            Those of a wave vector nearby, as a start.
        tolerance
            About the relative error of lambda + s that is allowed.
        """
        mass = self.cell.mass.at(wave)
        solver, below = self._solver_below(wave)
        start = self._start(mass.dtype, count, near)
        fixed = self._translations(mass) if _is_centre(wave) else start[:, :0]
        inverse, vectors = _block_lanczos(solver, mass, start, fixed, tolerance)
        return BlochModes(wave, 1.0 / inverse - below, vectors)

    def unstable(self, wave: Wave) -> int:
        """Number of negative eigenvalues, by the inertia of one factor; not for Γ itself."""
        self.factorisations += 1
        return negative_pivots(factorise(self.stiffness.at(wave)))

    def unstable_among(self, points: Sequence[Wave]) -> tuple[Wave, ...]:
        """Those wave vectors, not Γ, at which K is not positive definite: proven by Cholesky."""
        self.factorisations += 1
        condensation = Condensation(self.state.stiffness, self.cell.reduction)
        return tuple(wave for wave in points if condensation.at(wave) is None)

    def slope(self, modes: BlochModes) -> FloatArray:
        """(2,) derivatives of the lowest eigenvalue by k . a1 and k . a2 (Hellmann-Feynman)."""
        x, value = modes.vectors[:, 0], modes.eigenvalues[0]
        parts = [
            self.stiffness.slope(modes.wave, axis) @ x
            - value * (self.cell.mass.slope(modes.wave, axis) @ x)
            for axis in (0, 1)
        ]
        return np.array([np.vdot(x, part).real for part in parts])

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
        angles = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
        best = float(min(angles, key=self.acoustic))
        width = np.pi / _DIRECTIONS
        found = minimize_scalar(
            lambda turn: self.acoustic(best + turn), bounds=(-width, width), method="bounded"
        )
        if found.fun < self.acoustic(best):
            return float(found.fun), best + float(found.x)
        return self.acoustic(best), best

    def _solver_below(self, wave: Wave) -> tuple[CondensedWave, float]:
        """The inverse of K + s M, and s; from now on a larger s where that isn't enough."""
        while True:
            solver = self._condensation.at(wave)
            if solver is not None:
                return solver, self._below
            self._below *= 2.0
            self._condense()

    def _condense(self) -> None:
        self.factorisations += 1
        shifted = self.state.stiffness + self._below * self.cell.nodal_mass
        self._condensation = Condensation(csr_array(shifted), self.cell.reduction)

    def _start(self, dtype: Any, count: int, near: BlochModes | None) -> NDArray[Any]:
        """(size, count) vectors to begin with: those of ``near``, and always some noise.

        Eigenvectors of one wave vector may all lack the symmetry of a mode that comes down at
        the next; without noise the iteration would never find it.
        """
        real, imaginary = self._noise[:, :, :count]
        noise = real if dtype.kind == "f" else real + 1j * imaginary
        if near is None or near.vectors.dtype != dtype or near.vectors.shape != noise.shape:
            return np.asarray(noise)
        sizes = np.linalg.norm(near.vectors, axis=0) / np.linalg.norm(noise, axis=0)
        return np.asarray(near.vectors + _NOISE * sizes * noise)

    def _translations(self, mass: csc_array) -> FloatArray:
        """(size, 2) orthonormal translations along x and y."""
        axis = self.cell.reduction.order % 2
        moves = np.stack([axis == 0, axis == 1], axis=1).astype(np.float64)
        return np.asarray(moves / np.sqrt(np.sum(moves * (mass @ moves), axis=0)))


def scan(waves: BlochWaves, points: Sequence[Wave], count: int = 1) -> FloatArray:
    """(n, count) lowest eigenvalues at wave vectors that follow each other [N/mm^4].

    Each costs a few solves with the one factorisation of the cell's interior.
    """
    values = np.empty((len(points), count))
    near: BlochModes | None = None
    for row, wave in zip(values, points, strict=True):
        near = waves.lowest(wave, count, near, _SCAN_TOLERANCE)
        row[:] = near.eigenvalues
    return values


def _is_centre(wave: Wave) -> bool:
    turns = np.asarray(wave) / (2.0 * np.pi)
    return bool(np.all(np.abs(turns - np.rint(turns)) < 1e-12))


def _block_lanczos(
    solver: CondensedWave,
    mass: csc_array,
    start: NDArray[Any],
    fixed: NDArray[Any],
    tolerance: float,
) -> tuple[FloatArray, NDArray[Any]]:
    """The largest eigenvalues of A^-1 M, as many as ``start`` has columns, descending.

    Every new block is made orthogonal to all others: there are few. ``fixed`` are M-orthonormal
    vectors to be left out of the space.
    """
    count, skipped = start.shape[1], fixed.shape[1]
    vectors, weighted = fixed, mass @ fixed
    projected: NDArray[Any] = np.zeros((0, 0))
    block, image, rest = _orthonormal(start - vectors @ (weighted.conj().T @ start), mass)
    for _ in range(_LARGEST_SPACE):
        vectors, weighted = np.hstack([vectors, block]), np.hstack([weighted, image])
        block = solver.solve(image)
        column = weighted.conj().T @ block
        projected = _bordered(projected, column[skipped:])
        block, image, rest = _orthonormal(block - vectors @ column, mass)
        values, mix = np.linalg.eigh(projected)
        values, mix = values[::-1][:count], mix[:, ::-1][:, :count]
        residual = np.linalg.norm(rest @ mix[-count:], axis=0)
        if len(values) == count and np.all(residual**2 <= tolerance * values**2):
            break
    return values, vectors[:, skipped:] @ mix


def _orthonormal(
    block: NDArray[Any], mass: csc_array
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The block made M-orthonormal, its image by M, and R with block = orthonormal . R."""
    image = mass @ block
    R = np.linalg.cholesky(block.conj().T @ image).conj().T
    inverse = np.linalg.inv(R)
    return block @ inverse, image @ inverse, R


def _bordered(projected: NDArray[Any], column: NDArray[Any]) -> NDArray[Any]:
    """The projected matrix with one block column more, Hermitian."""
    old, new = len(projected), len(column)
    result = np.zeros((new, new), dtype=column.dtype)
    result[:old, :old] = projected
    result[:, old:] = column
    result[old:, :old] = column[:old].conj().T
    return result
