"""What an ansatz makes of a small wave: the least-squares fit of its sensitivities, no images.

Near a state a the ansatz can follow small changes S da of the displacement; the best it can make of
a wave w are the da that minimise the sum of |w - S da|^2 over the material. A correlation weighs
the same sum by the speckle's gradient, which averages out over many speckles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Parts:
    """Changes of the displacement in the parts of an ansatz, at points.

    Parameters
    ----------
    v0, v1
        (points, 2, waves): of v0 and of v1 phi1 [mm].
    """

    v0: FloatArray
    v1: FloatArray

    @property
    def whole(self) -> FloatArray:
        """(points, 2, waves): of the displacement [mm]."""
        return self.v0 + self.v1

    def of(self, part: str) -> FloatArray:
        """One of "v0", "v1" and "whole"."""
        return np.asarray(getattr(self, part))


@dataclass(frozen=True, eq=False)
class Tangent:
    """An ansatz with one mode near some unknowns.

    Parameters
    ----------
    ansatz, unknowns
        The kinematics, and (n,) where.
    points
        (m, 2) of the material that the fit counts [mm].
    """

    ansatz: Ansatz
    unknowns: FloatArray
    points: FloatArray

    def fit(self, waves: FloatArray) -> Parts:
        """The best fits of waves (m, 2, k) at the points [mm]."""
        x, y = self.points.T
        S = self.ansatz.sensitivities(self.unknowns, x[:, None], y[:, None])[:, 0]
        flat = S.reshape(-1, self.ansatz.size)
        scale = np.sqrt((flat**2).sum(axis=0))
        q, r = np.linalg.qr(flat / scale)
        step = np.linalg.solve(r, q.T @ waves.reshape(len(flat), -1)) / scale[:, None]
        slow = 2 * self.ansatz.v0_space.size
        v0, v1 = S[..., :slow] @ step[:slow], S[..., slow:] @ step[slow:]
        return Parts(v0, v1)


def share(found: FloatArray, wave: FloatArray) -> FloatArray:
    """(k,) slope of what was found (m, 2, k) against the waves (m, 2, k) [-]."""
    return np.asarray((found * wave).sum(axis=(0, 1)) / (wave**2).sum(axis=(0, 1)))
