"""The zone of wave vectors of one lattice, and the wave in it that is nearest to instability.

Wave vectors are phases (k . a1, k . a2) [rad]; k, -k and k plus 2 pi are the same mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize

from modeharvest.fem.bloch.eigen import BlochModes, BlochWaves, phases_of, scan
from modeharvest.fem.lattice.cell import CellState, PeriodicCell
from modeharvest.fem.lattice.options import CENTRE, Wave
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

_CANDIDATES = 3  # grid points from which to descend
_SAME = 1e-3  # phases [rad] that far apart are the same wave


@dataclass(frozen=True)
class LeastStable:
    """The wave that is nearest to instability at one load."""

    load: float
    value: float
    """filling * lambda / |k|^2, with a |k|^2 that has the lattice's period; for long waves its
    limit, the acoustic tensor's eigenvalue [MPa]. Negative: unstable."""
    wave: Wave
    """Phases [rad]; (0, 0) for long waves and for modes with the cell's own period."""
    angle: float | None = None
    """Direction of k for long waves [rad]; None otherwise."""


class Zone:
    """Stability over all waves; an even number of ``divisions`` has the points M and X."""

    def __init__(self, cell: PeriodicCell, divisions: int) -> None:
        self.cell = cell
        inverse = np.linalg.inv(cell.cell.lattice)
        self._metric = inverse.T @ inverse  # |k|^2 = phases . metric . phases
        self._spacing = 2.0 * math.pi / divisions
        phases = [self._spacing * (n - (divisions - 1) // 2) for n in range(divisions)]
        points = [(p, q) for p in phases for q in phases if (p, q) != CENTRE]
        self.grid = [(p, q) for p, q in points if folded((p, q)) >= folded((-p, -q))]

    def least_stable(self, state: CellState) -> LeastStable:
        """The wave with the smallest measure, over all of the zone."""
        waves = BlochWaves(self.cell, state)
        value, angle = waves.long_wave()
        found = [LeastStable(state.load, value, CENTRE, angle), self.at(waves, CENTRE)]
        values = self.on_grid(waves)
        for k in np.argsort(values)[:_CANDIDATES]:
            value, wave = self._descend(waves, self.grid[k], float(values[k]))
            found.append(LeastStable(state.load, value, wave))
        return min(found, key=lambda least: least.value)

    def at(self, waves: BlochWaves, wave: Wave) -> LeastStable:
        """The measure at one wave vector."""
        value = float(waves.lowest(wave).eigenvalues[0])
        return LeastStable(waves.state.load, self._value(wave, value), wave)

    def on_grid(self, waves: BlochWaves) -> FloatArray:
        """The measure at every point of ``grid`` [MPa]."""
        lowest = scan(waves, self.grid)[:, 0]
        pairs = zip(self.grid, lowest, strict=True)
        return np.array([self._value(wave, float(value)) for wave, value in pairs])

    def _value(self, wave: Wave, eigenvalue: float) -> float:
        """filling * lambda / |k|^2 [MPa]; for modes with the cell's period over 4 / area."""
        squared = self._squared(wave)[0]
        squared = squared if squared > 1e-12 else 4.0 / self.cell.cell.area
        return self.cell.filling * eigenvalue / squared

    def _squared(self, wave: Wave) -> tuple[float, FloatArray]:
        """|k|^2 made periodic, k_i k_j being turned into cosines; and its gradient."""
        g, mixed = self._metric, float(self._metric[0, 1])
        sign = -1.0 if mixed < 0 else 1.0
        weights = np.array([g[0, 0] - abs(mixed), g[1, 1] - abs(mixed), abs(mixed)])
        directions = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, sign]])
        phases = directions @ np.asarray(wave)
        gradient = (2.0 * weights * np.sin(phases)) @ directions
        return float(weights @ (2.0 - 2.0 * np.cos(phases))), gradient

    def _descend(self, waves: BlochWaves, start: Wave, value: float) -> tuple[float, Wave]:
        """A local minimum of the measure near a grid point, whose value is known."""
        near: list[BlochModes] = []

        def measure(point: FloatArray) -> tuple[float, FloatArray]:
            wave = (float(point[0]), float(point[1]))
            modes = waves.lowest(wave, near=near[-1] if near else None, tolerance=1e-12)
            near[:] = [modes]
            squared, slope_of_squared = self._squared(wave)
            slope = waves.slope(modes) - modes.eigenvalues[0] * slope_of_squared / squared
            value = self._value(wave, float(modes.eigenvalues[0]))
            return value, self.cell.filling * slope / squared

        # Off the grid, where symmetry may make a saddle look like a minimum; not as far as the
        # next points, one of which may be Γ.
        reach = 0.9 * self._spacing
        bounds = [(phase - reach, phase + reach) for phase in start]
        offset = np.add(start, [0.11, 0.07])
        found = minimize(measure, offset, jac=True, method="L-BFGS-B", bounds=bounds)
        wave = (float(found.x[0]), float(found.x[1]))
        # The grid point itself, if it is as good: exactly M rather than nearly.
        if found.fun < value - 1e-9 * abs(value) and not is_same(wave, start):
            return float(found.fun), folded(wave)
        return value, start


def zone_path(
    corners: Sequence[tuple[str, Wave]], lattice: FloatArray, count: int
) -> tuple[list[Wave], list[int]]:
    """``count`` wave vectors through the corners of a zone, about evenly spaced.

    ``corners`` are names and phases [rad], such as ``ZONES["square"]``, ``lattice`` (2, 2) the
    vectors as rows [mm]. Returns phases [rad], and the places of the corners among them. An
    InputError refuses fewer than two corners, or fewer points than corners.
    """
    if len(corners) < 2 or count < len(corners):
        what = "two corners or more and at least as many points"
        raise InputError(f"zone path: expected {what}, got {len(corners)} and {count}")
    ends = phases_of([wave for _, wave in corners])
    vectors = ends @ np.linalg.inv(lattice).T
    lengths = np.linalg.norm(np.diff(vectors, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    spare = count - len(corners)
    stops = [round(float(r) * spare) + k for k, r in enumerate(reached)]
    points: list[Wave] = []
    for (a, b), (start, stop) in zip(pairwise(ends), pairwise(stops), strict=True):
        steps = np.arange(stop - start) / (stop - start)
        points += [(float(p[0]), float(p[1])) for p in a + steps[:, None] * (b - a)]
    points.append((float(ends[-1, 0]), float(ends[-1, 1])))
    return points, stops


def folded(wave: Wave) -> Wave:
    """The same wave with both phases in (-pi, pi]."""
    p, q = (math.pi - (math.pi - phase) % (2.0 * math.pi) for phase in wave)
    return (p, q)


def is_same(a: Wave, b: Wave) -> bool:
    """Whether two waves are the same one, or each other's opposites."""
    differences = (folded((a[0] - s * b[0], a[1] - s * b[1])) for s in (1.0, -1.0))
    return any(max(abs(d[0]), abs(d[1])) < _SAME for d in differences)
