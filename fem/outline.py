"""The outline of a cell: all of it that feels the phase of a Bloch wave."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.copies import Batch, Copies, phases

FloatArray = NDArray[np.float64]


class Outline:
    """The components of displacement with copies in other cells, and how their matrices reduce.

    ``inner`` and ``rim`` are the components without and with copies, ``inner_places`` and
    ``rim_places`` the reduced unknowns that they are; ``copies`` those of the rim alone.

    Parameters
    ----------
    copies
        All components of the mesh's nodes.
    """

    def __init__(self, copies: Copies) -> None:
        is_inner = np.bincount(copies.places)[copies.places] == 1
        inner = np.flatnonzero(is_inner)
        self.inner = inner[np.argsort(copies.places[inner])]  # the order of little fill-in
        self.inner_places = copies.places[self.inner]
        self.rim = np.flatnonzero(~is_inner)
        self.rim_places, column = np.unique(copies.places[self.rim], return_inverse=True)
        shift = copies.shift[self.rim]
        self.copies = Copies(column, shift)
        # Sorted by R' - R once, as in ``Reduction``; here matrices are dense.
        size = len(self.rim_places)
        differences = (shift[None, :] - shift[:, None]).reshape(-1, 2)
        self._differences, phase = np.unique(differences, axis=0, return_inverse=True)
        entry = column[:, None] * size + column
        self._target = phase.ravel() * size**2 + entry.ravel()

    def sorted(self, matrix: FloatArray) -> FloatArray:
        """The entries of a matrix of all the outline's components by their phase."""
        shape = len(self._differences), len(self.rim_places) ** 2
        summed = np.bincount(self._target, matrix.ravel(), shape[0] * shape[1])
        return np.asarray(summed, dtype=np.float64).reshape(shape)

    def reduced(self, blocks: FloatArray, waves: FloatArray) -> Batch:
        """(w, m, m) T^H A T of a sorted matrix A for phases (w, 2) [rad]."""
        factors = phases(self._differences, waves).T
        size = len(factors), len(self.rim_places), len(self.rim_places)
        if factors.dtype.kind == "f":
            return (factors @ blocks).reshape(size)
        result = np.empty((len(factors), blocks.shape[1]), dtype=np.complex128)
        result.real, result.imag = factors.real @ blocks, factors.imag @ blocks
        return result.reshape(size)
