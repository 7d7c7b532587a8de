"""How far every hole has moved between two images: a start for a correlation, from masks alone.

Holes are told apart by their place in the lattice, not by their distance, so displacements may be
larger than half the pitch.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RBFInterpolator

from modeharvest.errors import InputError
from modeharvest.idic.specimen.hole_lattice import HoleLattice
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ALIKE = 0.4
"""Relative change of the lattice vectors beyond which two lattices are not the same specimen's."""
_RIVAL = 0.8
"""Share of the most matched holes with which another way to lay one lattice on the other counts."""


@dataclass(frozen=True, eq=False)
class HoleMotion:
    """The same holes in two images.

    Parameters
    ----------
    index
        (n, 2) their (i, j) in the reference's lattice.
    before, after
        (n, 2) centres in the reference and in the deformed image, (row, col) [px].
    rivals
        Number of other ways to lay the lattices on each other that match as many holes.
    sentences
        What was matched.
    """

    index: IntArray
    before: FloatArray
    after: FloatArray
    rivals: int
    sentences: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.index)

    def in_mm(self, grid: PixelGrid) -> tuple[FloatArray, FloatArray]:
        """(positions, displacements), both (n, 2) along x and y [mm]."""
        x, y = grid.to_mm(self.before[:, 0], self.before[:, 1])
        x2, y2 = grid.to_mm(self.after[:, 0], self.after[:, 1])
        return np.column_stack([x, y]), np.column_stack([x2 - x, y2 - y])

    def at(self, points: ArrayLike) -> FloatArray:
        """Where positions (n, 2) (row, col) of the reference have moved to, from the holes around.

        Between the holes the displacement is interpolated by linear radial functions and a plane
        [px].
        """
        where = np.asarray(points, dtype=np.float64)
        between = RBFInterpolator(self.before, self.after - self.before, kernel="linear", degree=1)
        return np.asarray(where + between(where))

    def affine(self) -> tuple[FloatArray, FloatArray]:
        """Fit (offset, matrix): after = offset + before @ matrix, in (row, col) [px]."""
        design = np.column_stack([np.ones(len(self)), self.before])
        found = np.asarray(np.linalg.lstsq(design, self.after, rcond=None)[0], dtype=np.float64)
        return found[0], found[1:]


def match(reference: HoleLattice, deformed: HoleLattice) -> HoleMotion:
    """Match the holes of two images; see :func:`possible_motions` for when that is ambiguous.

    Raises
    ------
    InputError
        If the lattices can't be the same specimen's.
    """
    return possible_motions(reference, deformed)[0]


def possible_motions(reference: HoleLattice, deformed: HoleLattice) -> tuple[HoleMotion, ...]:
    """All ways to lay the deformed lattice on the reference's, the likeliest first.

    Lattices look alike when moved by a whole cell; what decides is how many holes find a
    partner, then the shorter mean displacement. If the outer rows of a specimen leave the
    image, several ways match as many, and only the speckle can decide.

    Raises
    ------
    InputError
        If the lattices can't be the same specimen's.
    """
    index = _in_basis_of(reference, deformed)
    steps = Counter(
        (int(a[0] - b[0]), int(a[1] - b[1])) for a, b in product(reference.index, index)
    )
    most = max(steps.values())
    motions = [
        (count, _moved(reference, deformed, index + step))
        for step, count in steps.items()
        if count >= _RIVAL * most
    ]
    motions.sort(key=lambda found: (-found[0], _length(found[1])))
    rivals = sum(count == most for count, _ in motions) - 1
    return tuple(_told(motion, reference, deformed, rivals) for _, motion in motions)


def _in_basis_of(reference: HoleLattice, deformed: HoleLattice) -> IntArray:
    """Indices of the deformed holes with respect to the vectors that were the reference's.

    A lattice has many bases, and compression can change which one is the shortest.
    """
    changes = [
        np.array(entries).reshape(2, 2)
        for entries in product((-1, 0, 1), repeat=4)
        if entries[0] * entries[3] - entries[1] * entries[2] == 1
    ]
    off = [np.linalg.norm(u @ deformed.vectors - reference.vectors) for u in changes]
    best = int(np.argmin(off))
    relative = off[best] / np.linalg.norm(reference.vectors)
    if relative > _ALIKE:
        raise InputError(
            "expected the same lattice of holes in both images, got cells of "
            f"{reference.pitch_px:.0f} px and of {deformed.pitch_px:.0f} px, turned by "
            f"{reference.rotation_deg:.0f} and {deformed.rotation_deg:.0f} degrees; is the "
            "reference the reference?"
        )
    back = np.rint(np.linalg.inv(changes[best])).astype(np.int64)
    return np.asarray(deformed.index @ back)


def _moved(reference: HoleLattice, deformed: HoleLattice, index: IntArray) -> HoleMotion:
    place = {(int(i), int(j)): k for k, (i, j) in enumerate(index)}
    pairs = [
        (n, place[key])
        for n, (i, j) in enumerate(reference.index)
        if (key := (int(i), int(j))) in place
    ]
    first, second = np.array(pairs).T
    return HoleMotion(
        reference.index[first], reference.centres[first], deformed.centres[second], 0, ()
    )


def _length(motion: HoleMotion) -> float:
    return float(np.linalg.norm((motion.after - motion.before).mean(axis=0)))


def _told(
    motion: HoleMotion, reference: HoleLattice, deformed: HoleLattice, rivals: int
) -> HoleMotion:
    moved = np.linalg.norm(motion.after - motion.before, axis=1)
    said = [
        f"{len(motion)} holes were found in both images, of {len(reference)} in the reference and "
        f"{len(deformed)} in the deformed one; they moved by {moved.min():.0f} to "
        f"{moved.max():.0f} px."
    ]
    if rivals:
        said.append(
            f"{rivals + 1} ways to lay one lattice on the other match as many holes; the one with "
            "the shortest mean displacement comes first."
        )
    return HoleMotion(motion.index, motion.before, motion.after, rivals, tuple(said))
