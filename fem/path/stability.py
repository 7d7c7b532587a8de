"""The stability of an equilibrium: eigenpairs of the tangent stiffness nearest to zero.

Stability itself follows from the inertia of the LDL^T factor
(``BodyFactor.negative_pivots``), which can't miss a mode. The eigenpairs, computed by a block
Lanczos method, give the mode and the distance of its eigenvalue from zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from modeharvest.fem.path.factor import BodyFactor
from modeharvest.util.arrays import FloatArray

_NOISE = 1  # number of random start vectors: the given modes may lack a symmetry
_MOST_NEGATIVE = 24  # largest number of negative modes computed
_LARGEST_SPACE = 60  # in blocks
_ROOM = 48  # in vectors, at first
_LITTLE, _DEPENDENT = 1e-4, 1e-12  # eigenvalues of a normalised Gram matrix: small, zero


@dataclass(frozen=True, eq=False)
class Mode:
    """An eigenpair K x = lambda M x, with x normalised to x . M x = 1."""

    eigenvalue: float
    """lambda [N/mm^4]: stiffness per unit thickness over area."""
    vector: PETSc.Vec
    """x, zero at the constrained components."""
    weighted: PETSc.Vec
    """M x, so that overlaps with other vectors are dot products."""

    def overlap(self, other: PETSc.Vec) -> float:
        """x . M other; its absolute value is at most 1 if ``other`` is normalised likewise."""
        return float(self.weighted.dot(other))

    def reversed(self) -> Mode:
        """The same mode with the opposite sign."""
        return Mode(self.eigenvalue, -self.vector, -self.weighted)


def lowest_modes(
    factor: BodyFactor,
    mass: PETSc.Mat,
    count: int,
    near: Sequence[Mode] = (),
    tolerance: float = 1e-10,
) -> list[Mode]:
    """The lowest modes, by ascending eigenvalue: all negative ones, and at least one positive.

    Block Lanczos method with the inverse of the stiffness, whose factor is available. The inertia
    gives the number of negative eigenvalues to find; of more than 24, those nearest to zero.

    factor, mass : factor of the tangent stiffness; mass matrix, rows 0 at constrained components.
    count, near : number of modes (more if more are negative); modes of a nearby state.
    tolerance : largest admixture of other modes, for the mode with the largest eigenvalue; smaller
        for those nearer to zero. Relative errors of eigenvalues are proportional to its square.
    """
    negative = min(factor.negative_pivots, _MOST_NEGATIVE)
    positive = max(count - negative, 1)
    krylov = _Krylov(factor, mass, _start(mass, count, near))
    for _ in range(_LARGEST_SPACE):
        krylov.grow()
        inverse, mix = np.linalg.eigh(krylov.projected)
        place = np.arange(len(inverse))
        is_chosen = np.where(inverse < 0, place < negative, place >= len(place) - positive)
        residual = np.linalg.norm(krylov.rest @ mix[-krylov.rest.shape[1] :], axis=0)
        are_there = np.sum(is_chosen) == negative + positive
        if krylov.is_exhausted or (
            are_there and residual[is_chosen].max() <= tolerance * np.abs(inverse[is_chosen]).min()
        ):
            break
    vectors, weighted = mix[:, is_chosen].T @ krylov.vectors, mix[:, is_chosen].T @ krylov.images
    modes = [
        Mode(1.0 / float(value), _distributed(mass, x), _distributed(mass, y))
        for value, x, y in zip(inverse[is_chosen], vectors, weighted, strict=True)
    ]
    return sorted(modes, key=lambda mode: mode.eigenvalue)


class _Krylov:
    """A Krylov space, extended by blocks of K^-1 M times the last block.

    Vectors are rows, distributed by columns over the ranks: ``vectors`` (k, n) are M-orthonormal,
    ``images`` are M times them, ``projected`` (k, k) is K^-1 M within the space, and ``rest``: the
    part of K^-1 M that leads out of it, as combinations of the next block's vectors.
    """

    def __init__(self, factor: BodyFactor, mass: PETSc.Mat, start: FloatArray) -> None:
        self._factor, self._mass = factor, mass
        self._comm = mass.comm.tompi4py()
        self._rows: FloatArray = np.empty((2, _ROOM, start.shape[1]))
        self.projected: FloatArray = np.zeros((0, 0))
        self._next = self._orthonormal(start)

    @property
    def vectors(self) -> FloatArray:
        return self._rows[0, : len(self.projected)]

    @property
    def images(self) -> FloatArray:
        return self._rows[1, : len(self.projected)]

    @property
    def is_exhausted(self) -> bool:
        """Whether the space is invariant under K^-1 M."""
        return len(self._next[0]) == 0

    def grow(self) -> None:
        """Add the next block to the space, and compute the following one."""
        old, new = len(self.projected), len(self.projected) + len(self._next[0])
        while new > self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)], axis=1)
        self._rows[:, old:new] = self._next
        ahead = self._applied(self._factor.solve_block, self._rows[1, old:new])
        self.projected = np.pad(self.projected, (0, new - old))
        column = self._products(self.images, ahead)
        self.projected[:, old:], self.projected[old:, :] = column, column.T
        self.projected[old:, old:] = 0.5 * (column[old:] + column[old:].T)
        self._next = self._orthonormal(ahead - column.T @ self.vectors)
        self.rest = self._products(self._next[1], ahead)

    def _orthonormal(self, block: FloatArray) -> tuple[FloatArray, FloatArray]:
        """M-orthonormal basis of a block already orthogonal to the space, and M times it.

        If little of some vectors remains, it is mostly rounding: the block is orthogonalised
        again against the space, and normalised anew (Stathopoulos & Wu, SIAM J. Sci. Comput. 23
        (2002) 2165-2182).
        """
        block, image, kept = self._normalised(block, self._applied(self._mass.matMult, block))
        if kept < _LITTLE:
            known = self._products(block, self.images)
            block, image = block - known @ self.vectors, image - known @ self.images
            block, image, _ = self._normalised(block, image)
        return block, image

    def _normalised(
        self, block: FloatArray, image: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Orthonormal combinations, without dependent vectors, and the least Gram eigenvalue."""
        gram = self._products(block, image)
        size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        squares, turn = np.linalg.eigh(gram / np.outer(size, size))
        kept = squares > _DEPENDENT
        change = (turn[:, kept] / np.sqrt(squares[kept]) / size[:, None]).T
        return change @ block, change @ image, float(squares[0])

    def _applied(self, operator: Callable[[PETSc.Mat], PETSc.Mat], block: FloatArray) -> FloatArray:
        """Apply a linear operator to the vectors of a block."""
        size = (self._mass.getSizes()[0], (PETSc.DECIDE, len(block)))
        columns = PETSc.Mat().createDense(size, array=block.T, comm=self._mass.comm)
        result = operator(columns)  # named, because its array doesn't keep it alive
        return np.array(result.getDenseArray().T)

    def _products(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """All inner products of two sets of vectors, summed over all ranks."""
        products = left @ right.T
        self._comm.Allreduce(MPI.IN_PLACE, products)
        return np.asarray(products)


def _start(mass: PETSc.Mat, count: int, near: Sequence[Mode]) -> FloatArray:
    """The given modes and random vectors, zero at the constrained components."""
    free = mass.getDiagonal().array != 0
    width = _NOISE if near else count
    noise = np.random.default_rng(mass.comm.rank).standard_normal((width, len(free)))
    return np.vstack([*(mode.vector.array for mode in near), noise * free])


def _distributed(mass: PETSc.Mat, values: FloatArray) -> PETSc.Vec:
    vector = mass.createVecRight()
    vector.array[:] = values
    return vector
