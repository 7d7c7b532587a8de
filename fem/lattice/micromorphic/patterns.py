"""Patterning modes phi for homogenization: sums of plane waves, snapped to a lattice.

Any function of points (n, 2) [mm] with values (n, 2) [-] can be a mode, and so can nodal values on
a cell. Positions are in the coordinates of the lattice that the cell is part of. Plain numpy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

ModeField = Callable[[FloatArray], FloatArray] | FloatArray
"""phi(X): a function of points, or values (n, 2) at the nodes of the corresponding cell."""

_SNAP = 0.1  # largest change of a wave vector, over its length


@dataclass(frozen=True, eq=False)
class PlaneWaves:
    """phi(X) = sum_w cosine_w cos(k_w . X) + sine_w sin(k_w . X)."""

    vectors: FloatArray
    """(w, 2) wave vectors k [rad/mm]."""
    cosine: FloatArray
    sine: FloatArray
    """(w, 2) amplitudes along x and y [-]."""

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.vectors))
        for name in ("vectors", "cosine", "sine"):
            values = np.array(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, values)
            if values.shape != (count, 2) or not count or not np.isfinite(values).all():
                what = f"finite {name} of shape (w, 2), alike for vectors, cosine and sine"
                raise InputError(f"plane waves: expected {what}, got {values.shape}")

    @classmethod
    def of_sines(cls, waves: ArrayLike, half_wavelength: float, scale: float = 1.0) -> PlaneWaves:
        """From rows A, B, kx, ky [-], c [mm] (w, 5): s sum (A, B) sin(pi/l (kx x + ky y + c)).

        ``half_wavelength`` is l [mm], ``scale`` is s [-]. This is Eq. (6) and its families.
        """
        values, per_mm = np.atleast_2d(np.asarray(waves, np.float64)), np.pi / half_wavelength
        if values.ndim != 2 or values.shape[1] != 5:
            raise InputError(f"plane waves: expected waves (w, 5), got {values.shape}")
        amplitudes, phase = scale * values[:, :2], per_mm * values[:, 4:]
        return cls(per_mm * values[:, 2:4], amplitudes * np.sin(phase), amplitudes * np.cos(phase))

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n, 2) phi at points (n, 2) [mm]."""
        angle = points @ self.vectors.T
        return np.asarray(np.cos(angle) @ self.cosine + np.sin(angle) @ self.sine)

    def moved(self, by: ArrayLike) -> PlaneWaves:
        """phi(X - by), the pattern translated by ``by`` (2,) [mm]."""
        return self._turned(-self.vectors @ np.asarray(by, np.float64))

    def _turned(self, angle: FloatArray) -> PlaneWaves:
        """The waves with their phases k . X increased by ``angle`` (w,) [rad]."""
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        cosine, sine = c * self.cosine + s * self.sine, c * self.sine - s * self.cosine
        return replace(self, cosine=cosine, sine=sine)


def rotation_pattern(pitch: float, pitch_y: float | None = None) -> PlaneWaves:
    """The paper's Eq. (6) for square or rectangular stacking, max |phi| = 1.

    phi = (sin x cos y, -cos x sin y), x and y in units of l/pi and l_y/pi, with the origin at the
    centre of a hole: holes become ellipses, neighbours at right angles.
    """
    kx, ky = np.pi / pitch, np.pi / (pitch if pitch_y is None else pitch_y)
    vectors, sine = [[kx, ky], [kx, -ky]], [[0.5, -0.5], [0.5, 0.5]]
    return PlaneWaves(np.array(vectors), np.zeros((2, 2)), np.array(sine))


def snapped(
    mode: PlaneWaves, lattice: ArrayLike, about: ArrayLike = (0.0, 0.0),
    inversion_centre: ArrayLike | None = None,
) -> PlaneWaves:  # fmt: skip
    """The mode with its wave vectors replaced by the nearest ones that are periodic on a cell.

    An error of 1 % in a wave number changes the critical strain by 10 %, so measured modes need
    this. InputError for wave vectors that would change by more than a tenth, or vanish.

    lattice : vectors of the cell as rows (2, 2) [mm].
    about : the point at which phases are kept, such as the centre of the measured region [mm].
    inversion_centre : if given, phases are snapped too: phi is made odd or even about this point
        of the lattice, whichever is nearer, and every wave keeps its amplitudes.
    """
    vectors = np.asarray(lattice, dtype=np.float64)
    turns = np.rint(mode.vectors @ vectors.T / (2.0 * np.pi))
    nearest = 2.0 * np.pi * turns @ np.linalg.inv(vectors).T
    change = np.linalg.norm(nearest - mode.vectors, axis=1) / np.linalg.norm(mode.vectors, axis=1)
    worst = int(np.argmax(change))
    if not change[worst] <= _SNAP:
        k = ", ".join(f"{value:.4g}" for value in mode.vectors[worst])
        what = f"wave vectors within {_SNAP:.0%} of one that repeats on the cell"
        got = f"({k}) rad/mm, which is {change[worst]:.0%} off; take a larger cell (enlarged)"
        raise InputError(f"mode: expected {what}, got {got}")
    found = replace(mode, vectors=nearest)._turned(
        (mode.vectors - nearest) @ np.asarray(about, dtype=np.float64)
    )
    if inversion_centre is None:
        return found
    centre = np.asarray(inversion_centre, dtype=np.float64)
    even, odd = (p := found.moved(-centre)).cosine, p.sine
    size, is_odd = np.hypot(even, odd), np.sum(odd**2) >= np.sum(even**2)
    kept = np.copysign(size, odd if is_odd else even)
    none = np.zeros_like(kept)
    parts = (none, kept) if is_odd else (kept, none)
    return PlaneWaves(nearest, *parts).moved(centre)
