"""Holes, and blocks of speckle, of the reference matched with those of a deformed photograph.

Holes are identified by their place in the lattice, not by their distance, so displacements may be
larger than half the pitch.

Blocks of the reference are searched where they should have moved to and, for comparison, where they
surely are not. If they correlate no better at the former places, the reference is the wrong image,
or the motion is larger than expected.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import map_coordinates

from modeharvest.idic.local.field import LocalField, field_between
from modeharvest.idic.local.motion import Slow
from modeharvest.idic.photograph.holes import HoleLattice, find_hole_lattice
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.masks import room_around

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

    The least-squares solution of G. Wahba's problem, for the likeliest match of the holes: below
    some 25 degrees, and up to whole cells. InputError if they aren't the same specimen's.
    """
    motion = possible_motions(reference, deformed)[0]
    before, after = motion.before.mean(axis=0), motion.after.mean(axis=0)
    pairs = (motion.before - before).T @ (motion.after - after)
    # Rows go down: counter-clockwise is from +col to -row.
    angle = math.atan2(pairs[0, 1] - pairs[1, 0], pairs[0, 0] + pairs[1, 1])
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
    return HoleMotion(before, after, rivals, tuple(text))


Expected = Callable[[FloatArray], FloatArray]
"""From (n, 2) (row, col) in the reference to (n, 2) (row, col) in the deformed image [px]."""


def expected_by(displacement: Slow, grid: PixelGrid) -> Expected:
    """Map positions of the reference to those that a displacement [mm] takes them to."""

    def moved(points: FloatArray) -> FloatArray:
        before = np.column_stack(grid.to_mm(*points.T))
        return np.column_stack(grid.to_px(*(before + displacement(before)).T))

    return moved


BLOCKS, BLOCK_PX, SMALLEST_PX = 120, 41, 15
"""Approximate number of blocks, and their edge, smaller where ligaments are too narrow for it."""
REACH_PX = 24
"""Largest distance of a block from where it is expected, along rows and along columns."""
TURNS_DEG = (0.0, -12.0, 12.0, -24.0, 24.0)
"""Rotations of blocks that are tried [degrees]: junctions between buckling holes turn that much."""
_SAME = 0.5
"""Share of blocks that must be found."""
_CLEAR = 0.1
"""Least excess of a correlation over that by chance, as a share of 1 minus the latter."""
_LEAST_AREA = 0.1
"""Least expected area of a block, over that in the reference; below, the expectation is wrong."""


@dataclass(frozen=True, eq=False)
class BlockMatch:
    """Blocks of the reference, found in the deformed image or not."""

    before: FloatArray
    after: FloatArray
    """(n, 2) centres in the reference and where they correlate best, (row, col) whole pixels."""
    correlation: FloatArray
    """(n,) normalised cross-correlation there [-]."""
    chance: float
    """Correlation that 95 % of the blocks don't reach at places where they can't be [-]."""
    block_px: int
    """Edge of a block [px]."""

    @property
    def found(self) -> BoolArray:
        """(n,) whether a block correlates clearly better than by chance."""
        return np.asarray(self.correlation > self.chance + _CLEAR * (1.0 - self.chance))

    @property
    def share(self) -> float:
        """Share of blocks that were found [-]."""
        return float(self.found.mean())

    @property
    def is_same(self) -> bool:
        """Whether the images show the same surface."""
        return self.share >= _SAME

    def in_mm(self, grid: PixelGrid) -> LocalField:
        """Displacements of the blocks found, to about a pixel; enough for an initial guess."""
        return field_between(self.before[self.found], self.after[self.found], grid, "blocks")

    @property
    def text(self) -> str:
        """What was found."""
        return (
            f"{int(self.found.sum())} of {len(self.found)} blocks of {self.block_px} px of the "
            f"reference were found in the deformed image (median correlation "
            f"{np.median(self.correlation):.2f}, by chance up to {self.chance:.2f})."
        )


def match_blocks(
    pair: ImagePair, expected: Expected, reach_px: int = REACH_PX, count: int = BLOCKS
) -> BlockMatch:
    """Look for blocks of the reference's material in the deformed image.

    InputError if there is no room for blocks.

    expected : Where positions should have moved to, as ``HoleMotion.at`` gives it.
    reach_px : How far from there a block is searched for, along rows and columns [px].
    count : Approximate number of blocks that a whole image would hold.
    """
    f, g = pair.reference, pair.deformed
    centres, half = _blocks(pair.masks[0], count)
    aims = np.rint(expected(centres.astype(np.float64)))
    inside = ((aims >= half) & (aims < np.array(f.shape) - half)).all(axis=1)
    centres, aims = centres[inside], aims[inside].astype(np.int64)
    if len(centres) < 4:
        raise InputError(
            f"expected blocks of the reference to lie in the deformed image, got {len(centres)} "
            "that do; the motion is too large, or the mask is of another image"
        )
    blocks = _turned(f, centres, half, _gradient(expected, centres, half))
    there = [_search(g, block, aim, reach_px) for block, aim in zip(blocks, aims, strict=True)]
    # Some of many blocks suffice for the correlation by chance.
    some = range(0, len(aims), max(1, len(aims) // BLOCKS))
    elsewhere = np.roll(aims, len(aims) // 2, axis=0)
    decoys = [_search(g, blocks[i], elsewhere[i], reach_px) for i in some]
    return BlockMatch(
        before=centres.astype(np.float64),
        after=np.array([place for place, _ in there], dtype=np.float64),
        correlation=np.array([value for _, value in there]),
        chance=float(np.quantile([value for _, value in decoys], 0.95)),
        block_px=2 * half + 1,
    )


def require_same_surface(
    match: BlockMatch, reference: str = "the reference", deformed: str = "the deformed one"
) -> None:
    """Raise InputError unless two images, named for the message, show the same surface."""
    if not match.is_same:
        raise InputError(
            f"expected two images of one surface, got {reference} and {deformed}, of which only "
            f"{int(match.found.sum())} of {len(match.found)} blocks agree; the reference is not "
            "the reference, or the motion is too large: give frames in between"
        )


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


def _blocks(material: BoolArray, count: int) -> tuple[NDArray[np.int64], int]:
    """(centres (n, 2), half an edge) of blocks on material, spread over the image."""
    room = room_around(material)
    cell = max(8, int(np.sqrt(material.size / count)))
    rows, cols = (n // cell for n in material.shape)
    tiles = room[: rows * cell, : cols * cell].reshape(rows, cell, cols, cell).swapaxes(1, 2)
    flat = tiles.reshape(rows, cols, -1)
    widest, where = flat.max(axis=-1), flat.argmax(axis=-1)
    half = int(np.quantile(widest[widest > 0], 0.5)) - 1 if widest.any() else 0
    half = min(BLOCK_PX // 2, max(half, SMALLEST_PX // 2))
    if widest.max(initial=0) <= half:
        raise InputError(
            f"expected room for blocks of {SMALLEST_PX} px on the material, got ligaments "
            f"narrower than that or an image of {material.shape} px; check the mask"
        )
    i, j = np.nonzero(widest > half)
    inner_row, inner_col = np.divmod(where[i, j], cell)
    return np.column_stack([i * cell + inner_row, j * cell + inner_col]).astype(np.int64), half


def _search(
    g: FloatImage, block: FloatImage, aim: NDArray[np.int64], reach: int
) -> tuple[NDArray[np.int64], float]:
    """Position near ``aim`` where a block (turns, edge, edge) fits best; its correlation."""
    half = block.shape[-1] // 2
    low = np.maximum(aim - half - reach, 0)
    high = np.minimum(aim + half + reach + 1, g.shape)
    window = g[low[0] : high[0], low[1] : high[1]]
    correlation = _correlation(window, block)
    best = np.array(np.unravel_index(int(np.argmax(correlation)), correlation.shape)[1:])
    value = float(correlation.max())
    return (low + half + best, value) if value > 0.0 else (aim, 0.0)


def _gradient(expected: Expected, centres: NDArray[np.int64], half: int) -> FloatArray:
    """(n, 2, 2) expected deformation gradient around centres (n, 2)."""
    sides = [(expected(centres + d) - expected(centres - d)) / 2.0 for d in np.eye(2) * 2 * half]
    F = np.stack(sides, axis=-1) / (2 * half)
    return np.where(np.linalg.det(F)[:, None, None] < _LEAST_AREA, np.eye(2), F)


def _turned(
    f: FloatImage, centres: NDArray[np.int64], half: int, gradient: FloatArray
) -> FloatImage:
    """(n, turns, edge, edge) blocks around pixels (n, 2), stretched, turned by ``TURNS_DEG``."""
    offsets = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    c, s = np.cos(np.radians(TURNS_DEG)), np.sin(np.radians(TURNS_DEG))
    back = np.linalg.inv(gradient)[:, None] @ np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    at = np.einsum("ntij,jrc->intrc", back, offsets) + centres.T[:, :, None, None, None]
    return np.asarray(map_coordinates(f, at, order=1, mode="nearest"), dtype=np.float32)


def _correlation(window: FloatImage, blocks: FloatImage) -> FloatArray:
    """Normalised cross-correlation of blocks (n, k, k) at all places in a window (rows, cols).

    Like ``skimage.feature.match_template``, which would transform the window again for each block:
    (n, rows - k + 1, cols - k + 1), 0 where a block or the window below it has one grey level.
    """
    k = blocks.shape[-1]
    shape = tuple(next_fast_len(size, real=True) for size in window.shape)
    window = window - window.mean()  # for sums without loss of digits
    blocks = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    rows, cols = (size - k + 1 for size in window.shape)
    product = rfft2(window, shape) * np.conj(rfft2(blocks, shape))
    cross = irfft2(product, shape)[:, :rows, :cols].astype(np.float64)
    variance = np.maximum(0.0, _box_mean(window**2, k) - _box_mean(window, k) ** 2)
    norm = np.sqrt((blocks**2).sum(axis=(1, 2)))[:, None, None] * (k * np.sqrt(variance))
    there = norm > np.finfo(np.float32).eps
    return np.asarray(np.divide(cross, norm, out=np.zeros_like(cross), where=there))


def _box_mean(values: FloatImage, k: int) -> FloatArray:
    """(rows - k + 1, cols - k + 1) mean over squares of k x k values."""
    total = np.pad(values.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    return np.asarray((total[k:, k:] - total[:-k, k:] - total[k:, :-k] + total[:-k, :-k]) / k**2)
