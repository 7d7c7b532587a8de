"""Initial modes: from a pattern's waves, or from the hole lattice where there is no pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from modeharvest.idic.local.field import LocalField
from modeharvest.idic.modes import ModeFamily, free_family, square_family
from modeharvest.idic.photograph.holes import find_holes
from modeharvest.idic.slow_fields import Box
from modeharvest.idic.spectra.pattern import WavePattern, nearest_origin
from modeharvest.idic.spectra.waves import PlaneWave
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

DIAGONAL = 0.1
"""Difference of |kx| and |ky|, relative, up to which a wave lies along a diagonal."""
SAME_WAVE = 0.15
"""Distance [1/l] within which two wave vectors are one, up to a reciprocal lattice vector."""
NEARLY_SQUARE = 0.05
"""Relative difference of lengths, and cosine between directions, of a square lattice's vectors."""

WRONG_CELL = 0.07
"""Relative difference of a cell size given from one found, beyond which they contradict each
other: over the paper's six cells the phase of its mode drifts by 1.3 rad, and a correlation may
settle in a local minimum. A measured field's peaks are known to a few hundredths."""
_FEWEST_HOLES = 4
_SMALLEST_HOLE = 0.01
"""Area of a hole [cells] below which it is a speck in the mask."""


@dataclass(frozen=True, eq=False)
class InitialMode:
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


@dataclass(frozen=True, eq=False)
class Cells:
    """The lattice of holes.

    Parameters
    ----------
    cell_size
        l, the distance of neighbouring holes [mm].
    vectors
        (2, 2) lattice vectors as rows [mm].
    given
        Whether they were given, or are square for want of better knowledge.
    hole
        (2,) centre of one hole [mm].
    """

    cell_size: float
    vectors: FloatArray
    given: bool
    hole: FloatArray

    @classmethod
    def found(
        cls,
        cell_size: float,
        lattice: ArrayLike | None,
        pair: ImagePair,
        boxes: Sequence[Box],
        holes: LocalField | None,
    ) -> Cells:
        """Take what is given, and the rest from the mask; raises InputError if at odds."""
        if not cell_size > 0:
            raise InputError(f"automatic start: expected a positive cell size, got {cell_size} mm")
        vectors = lattice_vectors(cell_size, lattice)
        centres = np.zeros((0, 2)) if holes is None else np.column_stack([holes.x, holes.y])
        if holes is None and pair.mask is not None and not pair.mask.all():
            centres = hole_centres(pair, boxes, cell_size)
        centres = centres[np.isfinite(centres).all(axis=1)]
        require_hole_distance(centres, cell_size)
        corner = np.array([boxes[0].x_min, boxes[0].y_min])
        hole = _middle_hole(centres, vectors) if len(centres) else corner + vectors.sum(axis=0) / 2
        return cls(cell_size, vectors, lattice is not None, hole)

    @property
    def square(self) -> bool:
        """Whether the lattice vectors are as long as each other, and at right angles."""
        a, b = np.linalg.norm(self.vectors, axis=1)
        cosine = abs(self.vectors[0] @ self.vectors[1]) / (a * b)
        return bool(abs(a - b) <= NEARLY_SQUARE * a and cosine <= NEARLY_SQUARE)

    @property
    def junction(self) -> FloatArray:
        """(2,) the middle of the solid between four holes [mm]."""
        return np.asarray(self.hole - 0.5 * self.vectors.sum(axis=0))


def hole_centres(pair: ImagePair, boxes: Sequence[Box], cell_size: float) -> FloatArray:
    """(n, 2) centres of the holes of the reference that lie in boxes [mm]; specks are left out."""
    holes = find_holes(pair.masks[0], _SMALLEST_HOLE * (cell_size / pair.grid.pixel_size) ** 2)
    x, y = pair.grid.to_mm(*holes.centres.T)
    inside = [
        (x > box.x_min) & (x < box.x_max) & (y > box.y_min) & (y < box.y_max) for box in boxes
    ]
    return np.vstack([np.column_stack([x, y])[within] for within in inside])


def require_hole_distance(centres: FloatArray, cell_size: float) -> None:
    """Raise InputError if neighbouring holes are not a cell size apart; few holes say nothing."""
    if len(centres) < _FEWEST_HOLES:
        return
    apart = float(np.median(KDTree(centres).query(centres, k=2)[0][:, 1]))
    if abs(apart - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"automatic start: expected holes {cell_size:g} mm apart, the cell size given, got "
            f"{apart:.3g} mm between neighbours of {len(centres)} holes; give cell size "
            f"{apart:.3g} mm, or check the pixel size"
        )


def _middle_hole(centres: FloatArray, vectors: FloatArray) -> FloatArray:
    """(2,) where the hole in the middle should be, by itself and its neighbours [mm]."""
    middle = centres[np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1))]
    steps = np.linalg.solve(vectors.T, (centres - middle).T).T
    near = np.abs(steps).max(axis=1) < 1.5
    return np.asarray((centres - np.round(steps) @ vectors)[near].mean(axis=0))


def lattice_vectors(cell_size: float, lattice: ArrayLike | None) -> FloatArray:
    """(2, 2) vectors of the lattice of holes as rows [mm], the first one nearest to the x axis.

    Raises
    ------
    InputError
        If the lattice given isn't one, or its shortest distance isn't the cell size within 7 %.
    """
    if lattice is None:
        return cell_size * np.eye(2)
    vectors = np.asarray(lattice, dtype=np.float64)
    if vectors.shape != (2, 2) or not abs(np.linalg.det(vectors)) > 1e-6 * np.sum(vectors**2):
        raise InputError(
            f"automatic start: expected two lattice vectors [mm] as rows, got {vectors.tolist()}"
        )
    i = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)
    lengths = np.linalg.norm(i[np.any(i != 0, axis=1)] @ vectors, axis=1)
    shortest = float(lengths.min())
    if abs(shortest - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"automatic start: expected holes {cell_size:g} mm apart, the cell size given, got a "
            f"lattice of holes {shortest:.3g} mm apart; give cell size {shortest:.3g} mm, or check "
            "the pixel size"
        )
    if np.prod(np.abs(np.diag(vectors[::-1]))) > np.prod(np.abs(np.diag(vectors))):
        vectors = vectors[::-1]
    signs = np.where(np.diag(vectors) < 0, -1.0, 1.0)
    return np.asarray(vectors * signs[:, None])


def require_cell_size(pattern: WavePattern, cell_size: float) -> None:
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


def modes_of(pattern: WavePattern, cells: Cells) -> list[InitialMode]:
    """Modes for the waves of a pattern: the paper's family if it is the square one, else free ones.

    Waves whose vectors differ by one of the reciprocal lattice are coupled by the holes, and make
    one mode; any others share nothing, and each group has a mode, and an amplitude v, of its own.

    Parameters
    ----------
    pattern
        With at least one wave.
    cells
        The lattice of holes.
    """
    cell_size = cells.cell_size
    if pattern.start is not None:
        family, sign = nearest_origin(pattern.start, cell_size)
        return [InitialMode(replace(family, name="square"), sign * pattern.start_amplitude)]
    groups: list[list[PlaneWave]] = []
    for wave in pattern.waves:
        home = next((g for g in groups if _coupled(g[0], wave, cells)), None)
        if home is None:
            groups.append([wave])
        else:
            home.append(wave)
    return [_free_mode(group) for group in groups]


def _coupled(one: PlaneWave, other: PlaneWave, cells: Cells) -> bool:
    """Whether two wave vectors, or one and the other's opposite, differ by a reciprocal vector."""
    for sign in (1.0, -1.0):
        apart = (np.array(other.xi) - sign * np.array(one.xi)) / cells.cell_size
        periods = cells.vectors @ apart
        left = np.linalg.solve(cells.vectors, periods - np.round(periods)) * cells.cell_size
        if np.linalg.norm(left) <= SAME_WAVE:
            return True
    return False


def _free_mode(waves: list[PlaneWave]) -> InitialMode:
    rows = np.array([w.row for w in waves])
    amplitude = float(np.abs(rows[:, :2]).max())
    rows[:, :2] /= amplitude
    count = "1 wave" if len(waves) == 1 else f"{len(waves)} waves"
    return InitialMode(free_family(rows, f"{count}, free"), amplitude)


def fixed_square(cells: Cells) -> ModeFamily:
    """The square pattern that the holes allow, without parameters: for images that show none."""
    first, second = cells.cell_size * np.linalg.inv(cells.vectors).T
    start = np.array([1.0, *(first + second), *(second - first), 0.0, 0.0])
    return replace(square_family(), start=start).moved(cells.junction).fixed()
