"""Blocks of speckle of the reference, searched for in the deformed photograph.

Blocks of the reference are searched where they should have moved to and, for comparison, where they
surely are not. If they correlate no better at the former places, the reference is the wrong image,
or the motion is larger than expected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft, rfft2
from scipy.ndimage import map_coordinates

from modeharvest.idic.local.field import LocalField, field_between
from modeharvest.idic.local.motion import Slow
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.masks import room_around

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
_SPECKLES, _FEWEST, _WIDE = 3.0, 1.5, 0.8
"""Edge of a block over a coarse speckle's size, or least edge where ligaments are narrow; share of
the largest room on the material that this may take: one speckle is found anywhere."""
REACH_PX = 24
"""Largest distance of a block from where it is expected, along rows and along columns."""
TURNS_DEG = (0.0, -12.0, 12.0, -24.0, 24.0)
"""Rotations of blocks that are tried [degrees]: junctions between buckling holes turn that much."""
_SPARSE = 0.25
"""Share of material in an image below which blocks are closer to each other, to be enough."""
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
    centres, half = _blocks(pair.masks[0], count, speckle_size(f, pair.masks[0]))
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
    is_near = (abs(elsewhere - aims) <= 2 * reach_px).all(axis=1)  # there mirror images are not
    decoys = [
        _search(g, blocks[i][..., ::-1] if is_near[i] else blocks[i], elsewhere[i], reach_px)
        for i in some
    ]
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


def _blocks(material: BoolArray, count: int, speckle_px: float) -> tuple[NDArray[np.int64], int]:
    """(centres (n, 2), half an edge) of blocks on material, spread over the image."""
    room = room_around(material)
    cell = max(8, int(np.sqrt(min(material.size, material.sum() / _SPARSE) / count)))
    rows, cols = (n // cell for n in material.shape)
    tiles = room[: rows * cell, : cols * cell].reshape(rows, cell, cols, cell).swapaxes(1, 2)
    flat = tiles.reshape(rows, cols, -1)
    widest, where = flat.max(axis=-1), flat.argmax(axis=-1)
    half = int(np.quantile(widest[widest > 0], 0.5)) - 1 if widest.any() else 0
    least = SMALLEST_PX // 2
    if speckle_px > SMALLEST_PX:
        least = max(least, int(min(0.5 * _FEWEST * speckle_px, _WIDE * widest.max(initial=0))))
    half = min(max(BLOCK_PX, int(_SPECKLES * speckle_px)) // 2, max(half, least))
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


def _correlation(window: FloatImage, blocks: FloatImage) -> FloatImage:
    """Normalised cross-correlation of blocks (n, k, k) at all places in a window (rows, cols).

    Like ``skimage.feature.match_template``, which would transform the window again for each block:
    (n, rows - k + 1, cols - k + 1), 0 where a block or the window below it has one grey level.
    """
    k = blocks.shape[-1]
    shape = tuple(next_fast_len(size, real=True) for size in window.shape)
    window = window - window.mean()  # for sums without loss of digits
    blocks = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    rows, cols = (size - k + 1 for size in window.shape)
    product = rfft2(window, shape) * np.conj(fft(rfft(blocks, shape[1]), shape[0], axis=1))
    cross = irfft(ifft(product, axis=1)[:, :rows], shape[1])[:, :, :cols]
    deviation = np.sqrt(np.maximum(0.0, _box_mean(window**2, k) - _box_mean(window, k) ** 2))
    norm = np.linalg.norm(blocks, axis=(1, 2), keepdims=True) * (k * deviation).astype(cross.dtype)
    there = norm > np.finfo(np.float32).eps
    return np.asarray(np.divide(cross, norm, out=np.zeros_like(cross), where=there))


def _box_mean(values: FloatImage, k: int) -> FloatArray:
    """(rows - k + 1, cols - k + 1) mean over squares of k x k values."""
    total = np.pad(values.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    return np.asarray((total[k:, k:] - total[:-k, k:] - total[k:, :-k] + total[:-k, :-k]) / k**2)
