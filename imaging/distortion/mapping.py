"""What every optical distortion can do: show where a point is seen, and what is seen at a point.

A lens shows the ideal image position p at phi_S(p) = p + S(p), the paper's Eq. (r2). Here S is in
px and in the image frame: components along the rows' index (down) and the columns' index (right).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError

FloatArray = NDArray[np.float64]

_CHUNK = 8192
"""Points that are inverted at a time, so that they stay in the cache."""
_SETTLED_PX = 1e-7
"""Newton's error is squared by a step: one this short leaves less than rounding."""
_STEPS = 30


class Distortion(ABC):
    """A mapping of ideal image positions to those where a lens shows them.

    Kinds say :meth:`shift` and :meth:`gradient`; the mapping and its inverse follow. Positions
    are (row, col) in px, whole numbers at pixel centres, of any shapes that broadcast together;
    an open grid, (rows, 1) and (1, cols), is fastest.
    """

    @abstractmethod
    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""

    @abstractmethod
    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""

    def observed(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """phi_S: where ideal positions (row, col) are seen [px]."""
        d_row, d_col = self.shift(row, col)
        return np.add(row, d_row), np.add(col, d_col)

    def ideal(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Invert phi_S: the ideal positions of what is seen at (row, col) [px].

        By Newton's method, to rounding (better than 1e-10 px); NaN where a position is NaN.

        Raises
        ------
        InputError
            If the mapping is not one-to-one there: it folds.
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        seen = np.stack([row.ravel(), col.ravel()])
        found = np.empty_like(seen)
        for first in range(0, seen.shape[1], _CHUNK):
            part = slice(first, first + _CHUNK)
            found[:, part] = self._newton(seen[:, part])
        return found[0].reshape(row.shape), found[1].reshape(row.shape)

    def _newton(self, seen: FloatArray) -> FloatArray:
        """(2, n) ideal positions of (2, n) seen ones."""
        found = seen - np.stack(self.shift(*seen))
        for _ in range(_STEPS):
            misfit = np.stack(self.observed(*found)) - seen
            (rr, rc), (cr, cc) = self.gradient(*found)
            det = (1.0 + rr) * (1.0 + cc) - rc * cr
            if (det <= 0.0).any():
                raise _folds(seen[:, int(np.argmax(det <= 0.0))])
            found[0] -= ((1.0 + cc) * misfit[0] - rc * misfit[1]) / det
            found[1] -= ((1.0 + rr) * misfit[1] - cr * misfit[0]) / det
            length = np.abs(misfit).max(axis=0) / np.minimum(det, 1.0)
            if not (length > _SETTLED_PX).any():  # NaN counts as settled
                return found
        raise _folds(seen[:, int(np.nanargmax(length))])


def _folds(position: FloatArray) -> InputError:
    return InputError(
        "expected a distortion that is one-to-one over the image, got one that folds at row "
        f"{position[0]:.0f}, column {position[1]:.0f}; check its coefficients and their units"
    )


def require_finite(values: FloatArray, what: str) -> None:
    """Raise InputError if a number of a distortion isn't one."""
    if not np.isfinite(values).all():
        raise InputError(f"distortion: expected finite {what}, got NaN or infinity")
