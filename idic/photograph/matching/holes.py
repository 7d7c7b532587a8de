"""Motion of the holes between two photographs, and the rigid motion of the specimen.

Holes are identified by their place in the lattice, not by their distance, so displacements may be
larger than half the pitch.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import map_coordinates

from modeharvest.idic.local.field import LocalField, field_between
from modeharvest.idic.photograph.holes import HoleLattice, find_hole_lattice
from modeharvest.idic.photograph.matching.blocks import (
    BlockMatch,
    match_blocks,
    require_same_surface,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage, IntArray
from modeharvest.util.errors import InputError

_ALIKE = 0.4
"""Relative change of the lattice vectors beyond which two lattices are not the same specimen's."""
_RIVAL = 0.8
"""Share of the most matched holes from which on another alignment of two lattices counts."""


@dataclass(frozen=True, eq=False)
class HoleMotion:
    """The same holes in two images."""

    before: FloatArray
    after: FloatArray
    """(n, 2) centres in the reference and in the deformed image, (row, col) [px]."""
    index: IntArray
    """(n, 2) indices (i, j) in the reference's lattice."""
    rivals: int
    """Number of other alignments of the lattices that match as many holes."""
    text: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.before)

    def in_mm(self, grid: PixelGrid) -> LocalField:
        """The centres in the reference and their displacements."""
        return field_between(self.before, self.after, grid, "centres of holes")

    def at(self, points: ArrayLike) -> FloatArray:
        """Positions (n, 2) to which positions (n, 2) of the reference moved, (row, col) [px].

        Between the holes the displacement is interpolated by linear radial functions and a plane.
        """
        where = np.asarray(points, dtype=np.float64)
        between = RBFInterpolator(self.before, self.after - self.before, kernel="linear", degree=1)
        return np.asarray(where + between(where))


def possible_motions(reference: HoleLattice, deformed: HoleLattice) -> tuple[HoleMotion, ...]:
    """All alignments of the deformed lattice with the reference's, the likeliest first.

    A lattice looks the same when shifted by a whole cell. Therefore the number of holes with a
    partner decides, then the shorter mean displacement. If the outer rows of a specimen leave the
    image, several alignments match as many holes, and only the speckle can decide. Raises
    InputError if the lattices can't be the same specimen's.
    """
    index = _in_basis_of(reference, deformed)
    steps = Counter(
        (int(a[0] - b[0]), int(a[1] - b[1])) for a, b in product(reference.index, index)
    )
    most = max(steps.values())
    rivals = sum(count == most for count in steps.values()) - 1
    likely = [step for step, count in steps.items() if count >= _RIVAL * most]
    motions = [_motion(reference, deformed, index + step, rivals) for step in likely]
    shifts = [np.linalg.norm((m.after - m.before).mean(axis=0)) for m in motions]
    order = sorted(range(len(motions)), key=lambda k: (-len(motions[k]), shifts[k]))
    return tuple(motions[k] for k in order)


@dataclass(frozen=True)
class RigidMotion:
    """Rotation and translation of the whole specimen: x goes to turn (x - before) + after."""

    angle_deg: float
    """Counter-clockwise as the photograph is seen [degrees]."""
    before: tuple[float, float]
    after: tuple[float, float]
    """A point of the specimen in the reference and in the deformed image, (row, col) [px]."""

    def undone(self, image: FloatImage, mask: BoolArray) -> tuple[FloatImage, BoolArray]:
        """Remove the motion from a deformed image (rows, cols) and the mask of its material.

        Interpolated by a quintic spline. Pixels from outside the image are not material; their grey
        level is the median of what isn't material.
        """
        grid = np.indices(image.shape, np.float64) - np.reshape(self.before, (2, 1, 1))
        c, s = math.cos(math.radians(self.angle_deg)), math.sin(math.radians(self.angle_deg))
        row, col = (c * grid[0] - s * grid[1] + self.after[0],
                    s * grid[0] + c * grid[1] + self.after[1])  # fmt: skip
        shown = SplineImage.of(image, 5).sample(row, col)[0].astype(np.float32)
        material = map_coordinates(mask.astype(np.float32), (row, col), order=1) > 0.5
        beyond = ~np.isfinite(shown)
        shown[beyond] = np.median(image if mask.all() else image[~mask])
        return shown, material & ~beyond


def rigid_motion(reference: HoleLattice, deformed: HoleLattice) -> RigidMotion:
    """Rotation and translation of the holes as a whole, without strain and pattern.

    The polar rotation of an affine motion, for the likeliest match of the holes: below some 25
    degrees, and up to whole cells. A pattern that alternates from hole to hole is fitted beside it,
    as across an odd number of holes it turns the specimen's mean. InputError if the holes aren't
    the same specimen's.
    """
    motion = possible_motions(reference, deformed)[0]
    before = motion.before.mean(axis=0)
    i, j = motion.index.T
    waves = [i + j, *(k for k in (i, j) if np.ptp(k) > 1)]  # two rows alternate as they strain
    columns = [np.ones(len(i)), *(motion.before - before).T, *((-1.0) ** k for k in waves)]
    found = np.linalg.lstsq(np.column_stack(columns), motion.after, rcond=None)[0]
    after, to_row, to_col = found[:3]
    # Rows go down: counter-clockwise is from +col to -row.
    angle = math.atan2(to_row[1] - to_col[0], to_row[0] + to_col[1])
    first, second = ((float(row), float(col)) for row, col in (before, after))
    return RigidMotion(math.degrees(angle), first, second)


def _in_basis_of(reference: HoleLattice, deformed: HoleLattice) -> IntArray:
    """Indices of the deformed holes in the basis that corresponds to the reference's vectors.

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


def _motion(
    reference: HoleLattice, deformed: HoleLattice, index: IntArray, rivals: int
) -> HoleMotion:
    """Match holes; ``index``: indices of the deformed ones in the reference's lattice."""
    first, second = np.nonzero((reference.index[:, None] == index).all(axis=-1))
    before, after = reference.centres[first], deformed.centres[second]
    moved = np.linalg.norm(after - before, axis=1)
    text = [
        f"{len(first)} holes were found in both images, of {len(reference)} in the reference and "
        f"{len(deformed)} in the deformed one; they moved by {moved.min():.0f} to "
        f"{moved.max():.0f} px."
    ]
    if rivals:
        text.append(
            f"{rivals + 1} ways to lay one lattice on the other match as many holes; the one with "
            "the shortest mean displacement comes first."
        )
    return HoleMotion(before, after, reference.index[first], rivals, tuple(text))


def matched_holes(pair: ImagePair, lattice: HoleLattice | None) -> tuple[HoleMotion | None, str]:
    """Find the motion of the reference's holes, None where unknown, and a text about it.

    Where a column of holes has left the image, the holes alone allow several answers; the speckle
    between them decides. Raises InputError if the images don't show the same surface.
    """
    if lattice is None:
        return None, "The reference shows no lattice of holes to follow."
    try:
        motions = possible_motions(lattice, find_hole_lattice(pair.masks[1]))
    except InputError as error:
        return None, f"The holes could not be followed: {error}."
    tied = motions[0].rivals + 1
    motion, blocks = _best(pair, motions[:tied])
    if not blocks.is_same and len(motions) > tied:  # those that match fewer holes
        other, others_blocks = _best(pair, motions[tied:])
        if others_blocks.share > blocks.share:
            motion, blocks = other, others_blocks
    require_same_surface(blocks)
    text = [*motion.text, blocks.text]
    if motion is not motions[0] or motion.rivals:
        text.append("Which hole is which was decided by the speckle between them.")
    return motion, " ".join(text)


def _best(pair: ImagePair, motions: Sequence[HoleMotion]) -> tuple[HoleMotion, BlockMatch]:
    """The motion that the speckle agrees with best."""
    matches = [match_blocks(pair, motion.at) for motion in motions]
    best = int(np.argmax([match.share for match in matches]))
    return motions[best], matches[best]
