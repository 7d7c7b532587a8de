"""T(k): from the masters' displacements of a Bloch wave to those of all their copies.

For many wave vectors at once, so that numpy's own time is shared by all of them. A batch of
vectors is an array (size, w, m): m vectors for each of w wave vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Batch = NDArray[Any]  # of real or complex numbers


class Copies:
    """Components of displacement that are copies of others, some in other cells.

    Parameters
    ----------
    places
        (n,) which unknown, 0 ... size - 1, each component follows.
    shift
        (n, 2) integers R: it lies R1 a1 + R2 a2 from there.
    """

    def __init__(self, places: IntArray, shift: IntArray) -> None:
        self.places, self.shift = places, shift
        self._turned = np.flatnonzero(np.any(shift != 0, axis=1))
        # The first copies of all unknowns, the second copies of those that have one, ...
        order = np.argsort(places, kind="stable")
        starts = np.searchsorted(places[order], np.arange(places.max() + 1))
        rank = np.arange(len(places)) - starts[places[order]]
        self._ranks = [order[rank == k] for k in range(int(rank.max()) + 1)]

    def at(self, waves: FloatArray) -> Transformation:
        """T(k) for wave vectors given as phases (w, 2) [rad]; real if all its entries are."""
        return Transformation(self, phases(self.shift[self._turned], waves))


class Transformation:
    """T(k) for some wave vectors; made by ``Copies.at``."""

    def __init__(self, copies: Copies, factors: Batch) -> None:
        self.dtype = factors.dtype
        self._copies, self._factors = copies, factors[:, :, None]

    def spread(self, vectors: Batch) -> Batch:
        """T x for x (size, w, m)."""
        copies = self._copies
        result = vectors[copies.places]
        result[copies._turned] *= self._factors
        return np.asarray(result)

    def gather(self, forces: Batch) -> Batch:
        """T^H f for f (n, w, m), which is overwritten."""
        copies = self._copies
        forces[copies._turned] *= self._factors.conj()
        first, *others = copies._ranks
        result = forces[first]
        for rank in others:
            result[copies.places[rank]] += forces[rank]
        return np.asarray(result)


def phases(shift: IntArray, waves: FloatArray) -> Batch:
    """(n, w) exp(i k . R) for shifts (n, 2) and phases (w, 2) [rad]; real if all of them are."""
    factors = np.exp(1j * (shift @ waves.T))
    is_real = np.abs(factors.imag).max(initial=0.0) < 1e-12
    return np.asarray(factors.real.copy() if is_real else factors)


def applied(operator: Callable[[FloatArray], FloatArray], vectors: Batch) -> Batch:
    """A real linear operator (n, c) -> (n', c) applied to a batch (n, w, m), complex or not."""
    kind, flat = vectors.dtype, np.ascontiguousarray(vectors).reshape(len(vectors), -1)
    result = np.ascontiguousarray(operator(flat.view(np.float64))).view(kind)
    return result.reshape(len(result), *vectors.shape[1:])
