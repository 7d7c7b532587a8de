"""From a pattern's waves, or from the lattice of holes where there is no pattern, to modes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.idic.equivalents import mode_equivalent
from modeharvest.idic.fourier import ModeFamily, free_family, square_family
from modeharvest.idic.pattern import Pattern
from modeharvest.idic.waves import Wave

FloatArray = NDArray[np.float64]

WRONG_CELL = 0.07
"""Relative difference of the cell size that peaks belong to from the one given, beyond which they
contradict it: over the paper's six cells the phase then drifts by 1.3 rad, and a correlation may
settle in a local minimum. Peaks of a measured field are known to a few hundredths."""
DIAGONAL = 0.1
"""Difference of |kx| and |ky|, relative, up to which a wave lies along a diagonal."""
SAME_WAVE = 0.15
"""Distance [1/l] within which two wave vectors are one, up to a reciprocal lattice vector."""
NEARLY_SQUARE = 0.05
"""Relative difference of lengths, and cosine between directions, of a square lattice's vectors."""


@dataclass(frozen=True, eq=False)
class StartMode:
    """A mode to start with.

    Parameters
    ----------
    family
        Its start is the pattern.
    amplitude
        What the family's waves at its start are to be multiplied by, with sign [mm].
    """

    family: ModeFamily
    amplitude: float


def lattice_vectors(cell_size: float, lattice: ArrayLike | None) -> FloatArray:
    """(2, 2) vectors of the lattice of holes as rows [mm], the first one nearest to the x axis.

    Raises
    ------
    InputError
        If the lattice given isn't one, or has no distance that is the cell size within 7 %.
    """
    if lattice is None:
        return cell_size * np.eye(2)
    vectors = np.asarray(lattice, dtype=np.float64)
    if vectors.shape != (2, 2) or not abs(np.linalg.det(vectors)) > 1e-6 * np.sum(vectors**2):
        raise InputError(
            f"automatic start: expected two lattice vectors [mm] as rows, got {vectors.tolist()}"
        )
    i = np.arange(-3, 4)
    lengths = np.linalg.norm(np.stack(np.meshgrid(i, i), -1).reshape(-1, 2) @ vectors, axis=1)
    lengths = np.sort(lengths[lengths > 0])
    nearest = lengths[np.argmin(np.abs(lengths - cell_size))]
    if abs(nearest - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"automatic start: expected a cell size that is a distance of holes, got {cell_size:g} "
            f"mm where the holes repeat every {lengths[0]:.3g} mm; give cell size {lengths[0]:.3g}"
        )
    if abs(vectors[1, 0]) * abs(vectors[0, 1]) > abs(vectors[0, 0]) * abs(vectors[1, 1]):
        vectors = vectors[::-1]
    signs = np.sign([vectors[0, 0] or 1.0, vectors[1, 1] or 1.0])
    return np.asarray(vectors * signs[:, None])


def is_square(vectors: FloatArray) -> bool:
    """Whether two lattice vectors are as long as each other, and at right angles."""
    a, b = np.linalg.norm(vectors, axis=1)
    cosine = abs(vectors[0] @ vectors[1]) / (a * b)
    return bool(abs(a - b) <= NEARLY_SQUARE * a and cosine <= NEARLY_SQUARE)


def require_cell_size(pattern: Pattern, cell_size: float) -> None:
    """Raise InputError if a pattern's waves are those of a square lattice of another cell size.

    Two waves along both diagonals, equally long, are what the square pattern looks like with a
    wrong cell size: at |ξ| = l / 2l₀ along each axis, where l₀ is the right one.
    """
    k = np.abs([w.k for w in pattern.waves])
    if len(k) != 2 or np.ptp(k) > DIAGONAL * k.mean():
        return
    found = cell_size / float(k.mean())
    if abs(found - cell_size) > WRONG_CELL * cell_size:
        xi = 0.5 * float(k.mean())
        raise InputError(
            f"automatic start: expected the spectrum's peaks at ξ = (±0.50, ±0.50) for a cell of "
            f"{cell_size:g} mm, got (±{xi:.2f}, ±{xi:.2f}), which belong to a cell of {found:.3g} "
            f"mm; give that cell size, or the lattice of the holes if the pattern isn't theirs"
        )


def modes_of(pattern: Pattern, vectors: FloatArray, cell_size: float) -> list[StartMode]:
    """Modes for the waves of a pattern: the paper's family if it is the square one, else free ones.

    Waves whose vectors differ by one of the reciprocal lattice are coupled by the holes, and make
    one mode; any others share nothing, and each group has a mode, and an amplitude v, of its own.

    Parameters
    ----------
    pattern
        With at least one wave.
    vectors
        (2, 2) of the lattice of holes [mm].
    cell_size
        l [mm].
    """
    if pattern.start is not None:
        family = square_family()
        off = []
        for origin in ("junction", "hole"):
            like = square_family(origin)
            start, sign = mode_equivalent(pattern.start, cell_size, like.start)
            off.append((float(np.abs(start[5:]).sum()), sign, replace(like, start=start)))
        _, sign, family = min(off, key=lambda o: round(o[0], 6))
        return [StartMode(replace(family, name="square"), sign * pattern.start_amplitude)]
    groups: list[list[Wave]] = []
    for wave in pattern.waves:
        home = next((g for g in groups if _coupled(g[0], wave, vectors, cell_size)), None)
        if home is None:
            groups.append([wave])
        else:
            home.append(wave)
    return [_free_mode(group) for group in groups]


def _coupled(one: Wave, other: Wave, vectors: FloatArray, cell_size: float) -> bool:
    """Whether two wave vectors, or one and the other's opposite, differ by a reciprocal vector."""
    for sign in (1.0, -1.0):
        difference = (np.array(other.xi) - sign * np.array(one.xi)) / cell_size
        periods = vectors @ difference
        if (
            np.abs((periods - np.round(periods)) @ np.linalg.inv(vectors).T).max() * cell_size
            <= SAME_WAVE
        ):
            return True
    return False


def _free_mode(waves: list[Wave]) -> StartMode:
    rows = np.array([[*w.amplitude, *w.k, w.phase] for w in waves])
    amplitude = float(np.abs(rows[:, :2]).max())
    rows[:, :2] /= amplitude
    count = "1 wave" if len(waves) == 1 else f"{len(waves)} waves"
    return StartMode(free_family(rows, f"{count}, free"), amplitude)


def held_square(vectors: FloatArray, cell_size: float, junction: ArrayLike) -> ModeFamily:
    """The square pattern that the holes allow, without parameters: for images that show none.

    Parameters
    ----------
    vectors
        (2, 2) of the lattice of holes [mm].
    cell_size
        l [mm].
    junction
        (2,) a point of the solid between four holes [mm].
    """
    first, second = cell_size * np.linalg.inv(vectors).T
    family = square_family()
    start = np.array([1.0, *(first + second), *(second - first), 0.0, 0.0])
    return replace(family, start=start).moved(junction).held()
