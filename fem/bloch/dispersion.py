"""The dispersion of a lattice under load: lowest eigenvalues as functions of the wave vector.

They are computed along a path through the zone at several loads, and over the whole zone at one
load. Results are plain numpy, written and read without dolfinx.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from modeharvest.fem.field import read_values, write_values
from modeharvest.fem.lattice.options import CENTRE, Wave, wave_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic_hdf5, open_hdf5
from modeharvest.util.progress import Progress, counted, silent

if TYPE_CHECKING:
    from modeharvest.fem.bloch.eigen import BlochWaves
    from modeharvest.fem.lattice.cell import CellPath, CellState


_PI = math.pi
_GAMMA = ("Γ", CENTRE)
_M = ("M", (_PI, _PI))
_K = ("K", (4 * _PI / 3, 2 * _PI / 3))
_X, _Y = ("X", (_PI, 0.0)), ("Y", (0.0, _PI))
_M1, _M2 = ("M₁", (_PI, _PI)), ("M₂", (0.0, _PI))
ZONES: dict[str, tuple[tuple[str, Wave], ...]] = {
    "oblique": (_GAMMA, _X, _M, _Y, _GAMMA, _M),
    "square": (_GAMMA, _X, _M, _GAMMA),
    "hexagonal": (_GAMMA, _M, _K, _GAMMA),
    "rhombic": (_GAMMA, _K, _M1, ("K′", (2 * _PI / 3, 4 * _PI / 3)), _M2, _GAMMA, _M1),
}
"""Closed tours of a zone by its symmetry, corners as phases (k . a1, k . a2) [rad].

"square" and "hexagonal" (60 degrees between a1 and a2): rotations by 90 and 60 degrees preserve
the lattice under its load. "rhombic": the hexagonal lattice under a load without this symmetry, K
at 0 and K′ at 60 degrees from x, M₁ at 30 and M₂ at 90. "oblique": any other; as k and -k are
equivalent, the edges X-M and Y-M are the whole boundary."""

_ARRAYS = ("waves", "distances", "loads", "eigenvalues")


@dataclass(frozen=True, eq=False)
class ZoneMap:
    """The lowest eigenvalue over the whole zone at one load [-]."""

    load: float
    phases: FloatArray
    """(g,) grid of both phases k . a1 and k . a2, from -pi to pi [rad]."""
    eigenvalues: FloatArray
    """(g, g) [N/mm^4]; the first index is k . a1. 0 at (0, 0), a translation."""
    lattice: FloatArray
    """(2, 2) lattice vectors as rows [mm]: k = phases . inv(lattice).T [rad/mm]."""

    @property
    def least_stable(self) -> tuple[float, Wave]:
        """Eigenvalue [N/mm^4] and phases [rad] of the lowest lambda / |k|^2, excluding Γ."""
        half = self.phases[1:]  # -pi and pi are the same
        turns = 2.0 * _PI * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        grid = np.stack(np.meshgrid(half, half, indexing="ij"), axis=-1)
        k = (grid[:, :, None] + turns) @ np.linalg.inv(self.lattice).T
        squared = np.sum(k**2, axis=-1).min(axis=-1)
        values = self.eigenvalues[1:, 1:] / np.where(squared > 0, squared, np.inf)
        values[squared == 0] = np.inf
        i, j = np.unravel_index(int(np.argmin(values)), values.shape)
        return float(self.eigenvalues[i + 1, j + 1]), (float(half[i]), float(half[j]))


@dataclass(frozen=True, eq=False)
class Dispersion:
    """Lowest eigenvalues of K x = lambda M x, M of unit density, along a path of wave vectors."""

    labels: tuple[str, ...]
    """Names of the path's corners."""
    stops: tuple[int, ...]
    """Indices of the corners among the path's points."""
    waves: FloatArray
    """(p, 2) phases [rad]."""
    distances: FloatArray
    """(p,) length along the path [rad/mm]."""
    loads: FloatArray
    """(s,) loads [-]."""
    eigenvalues: FloatArray
    """(s, p, bands) ascending [N/mm^4]; at Γ including the zeros of translations."""
    zone: tuple[ZoneMap, ...] = ()
    """Maps of the zone, one for each requested load."""

    def __post_init__(self) -> None:
        expected = (len(self.loads), len(self.waves))
        if self.eigenvalues.shape[:2] != expected or len(self.labels) != len(self.stops):
            raise InputError(
                f"dispersion: expected eigenvalues of {expected} and as many labels as stops, got "
                f"{self.eigenvalues.shape}, {len(self.labels)} and {len(self.stops)}"
            )

    @property
    def bands(self) -> int:
        """Number of eigenvalues at each wave vector."""
        return int(self.eigenvalues.shape[2])

    def write(self, path: Path | str) -> None:
        """Write an HDF5 file atomically: these arrays by name, maps in ``zone/0``, ..."""
        with atomic_hdf5(path) as file:
            file.attrs["labels"] = list(self.labels)
            file["stops"] = np.array(self.stops)
            for name in _ARRAYS:
                file[name] = getattr(self, name)
            for k, part in enumerate(self.zone):
                write_values(file.create_group(f"zone/{k}"), part)

    @classmethod
    def read(cls, path: Path | str) -> Dispersion:
        """Read a file of ``write``; InputError for any other file."""
        with open_hdf5(path, "a dispersion file (HDF5)") as file:
            arrays = {name: file[name][()] for name in _ARRAYS}
            labels, stops = tuple(map(str, file.attrs["labels"])), tuple(map(int, file["stops"]))
            zone = tuple(read_values(group, ZoneMap) for group in file.get("zone", {}).values())
            return cls(labels, stops, **arrays, zone=zone)


def dispersion(
    path: CellPath,
    corners: Sequence[tuple[str, Wave]],
    loads: Sequence[float],
    count: int = 60,
    bands: int = 3,
    progress: Progress = silent,
) -> Dispersion:
    """The lowest eigenvalues along a zone path, at several loads [-] of a primitive cell's path.

    InputError for wave vectors that aren't two finite phases, and for loads out of reach.

    corners : names and phases [rad] of the path's corners, such as ``ZONES["square"]``.
    count, bands : number of wave vectors, including corners, and of eigenvalues at each.
    """
    from modeharvest.fem.bloch.eigen import BlochWaves

    corners = [(label, wave_of(wave)) for label, wave in corners]
    if bands < 1 or not len(loads):
        raise InputError(f"dispersion: expected a band and a load or more, got {bands}, {loads}")
    lattice = path.cell.cell.lattice
    points, stops = zone_path(corners, lattice, count)
    values = []
    for load in counted(loads, progress, "dispersion"):
        values.append(_along(BlochWaves(path.cell, _state(path, load)), points, bands))
    steps = np.diff(np.array(points), axis=0) @ np.linalg.inv(lattice).T
    distances = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    labels = tuple(label for label, _ in corners)
    arrays = (np.array(points), distances, np.array(loads, dtype=np.float64), np.array(values))
    return Dispersion(labels, tuple(stops), *arrays)


def zone_path(
    corners: Sequence[tuple[str, Wave]], lattice: FloatArray, count: int
) -> tuple[list[Wave], list[int]]:
    """``count`` wave vectors through the corners of a zone, about evenly spaced.

    ``corners``: names and phases [rad], such as ``ZONES["square"]``; ``lattice`` (2, 2): lattice
    vectors as rows [mm]. Returns phases [rad], and the indices of the corners among them.
    InputError for fewer than two corners, or fewer points than corners.
    """
    if len(corners) < 2 or count < len(corners):
        what = "two corners or more and at least as many points"
        raise InputError(f"zone path: expected {what}, got {len(corners)} and {count}")
    ends = np.array([wave_of(wave) for _, wave in corners])
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


def zone_map(
    path: CellPath, load: float, divisions: int = 24, progress: Progress = silent
) -> ZoneMap:
    """The lowest eigenvalue over a grid of the zone at one load [-] of a primitive cell's path.

    ``divisions`` of each axis must be even, so that Γ, X and M are on the grid; InputError if it is
    odd, or if the load can't be reached.
    """
    from modeharvest.fem.bloch.eigen import BlochWaves

    if divisions < 2 or divisions % 2:
        raise InputError(f"zone map: expected an even number of divisions, got {divisions}")
    waves = BlochWaves(path.cell, _state(path, load))
    phases = np.asarray(np.linspace(-_PI, _PI, divisions + 1), dtype=np.float64)
    phases[divisions // 2] = 0.0
    values = np.empty((divisions + 1, divisions + 1))
    # k and -k are equivalent: the rows from -pi to 0 are sufficient.
    half = divisions // 2 + 1
    for i in range(half):
        progress(i, half, "zone map")
        values[i] = _along(waves, [(float(phases[i]), float(q)) for q in phases], 1)[:, 0]
    values[half:] = values[: half - 1][::-1, ::-1]
    progress(half, half, "zone map")
    return ZoneMap(load, phases, values, path.cell.cell.lattice)


def _state(path: CellPath, load: float) -> CellState:
    state = path.at(load)
    if state is None:
        reached = max(known.load for known in path.states) if path.states else 0.0
        raise InputError(
            f"dispersion: expected loads that the lattice's path reaches, got {load:.6g}; Newton's "
            f"method converged up to {reached:.6g}"
        )
    return state


def _along(waves: BlochWaves, points: Sequence[Wave], bands: int) -> FloatArray:
    """(p, bands) eigenvalues; those at Γ include the two zeros of translations."""
    from modeharvest.fem.bloch.eigen import scan

    centre = np.abs(points).max(axis=1) < 1e-12
    values = np.empty((len(points), bands))
    values[~centre] = scan(waves, [points[k] for k in np.flatnonzero(~centre)], bands)
    if centre.any():
        others = waves.lowest(CENTRE, bands).eigenvalues
        values[centre] = np.sort([0.0, 0.0, *others])[:bands]
    return values
