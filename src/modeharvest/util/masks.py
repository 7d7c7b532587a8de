"""Morphology of masks: dilation, erosion, opening, connected parts, distance to the boundary."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_cdt, label

from modeharvest.util.arrays import BoolArray, IntArray


def grown(mask: BoolArray, px: float) -> BoolArray:
    """Dilation: all pixels within the distance ``px`` of the mask; an empty mask stays empty."""
    found, wide, half = mask.copy(), mask.copy(), 0
    px = px if mask.any() else 0.0
    for off in range(min(int(px), len(mask) - 1), -1, -1):  # rows of a disk, the outermost first
        while np.sqrt((half + 1) ** 2 + off**2) <= px:
            half += 1
            wide[:, half:] |= mask[:, :-half]
            wide[:, :-half] |= mask[:, half:]
        found[off:] |= wide[: len(wide) - off]
        found[: len(wide) - off] |= wide[off:]
    return found


def shrunk(mask: BoolArray, px: float, *, at_border: bool = False) -> BoolArray:
    """Erosion: the mask without pixels within the distance ``px`` of pixels outside the mask.

    ``at_border``: the area beyond the image counts as outside the mask.
    """
    if at_border:
        return shrunk(np.pad(mask, 1), px)[1:-1, 1:-1]
    return ~grown(~mask, px)


def opened(mask: BoolArray, radius: float, *, at_border: bool = False) -> BoolArray:
    """Opening by a disk of this radius [px]; ``at_border`` as for :func:`shrunk`."""
    return grown(shrunk(mask, radius, at_border=at_border), radius)


def large_parts(mask: BoolArray, least_px: float) -> BoolArray:
    """The connected parts of a mask that have at least ``least_px`` pixels."""
    parts, _ = label(mask)
    keep = np.bincount(parts.ravel()) >= least_px
    keep[0] = False
    return np.asarray(keep[parts])


def connected_to(seed: BoolArray, mask: BoolArray) -> BoolArray:
    """The connected parts of a mask that share a pixel with ``seed``."""
    parts, _ = label(mask)
    return np.isin(parts, np.setdiff1d(parts[seed], 0))


def room_around(mask: BoolArray) -> IntArray:
    """(rows, cols) chessboard distance [px] to the nearest pixel outside mask or image."""
    distance = distance_transform_cdt(np.pad(mask, 1), "chessboard")
    return np.asarray(distance[1:-1, 1:-1], dtype=np.int64)
