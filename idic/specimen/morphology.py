"""Masks grown, shrunk and cleaned by distances in pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

BoolArray = NDArray[np.bool_]


def grown(mask: BoolArray, px: float) -> BoolArray:
    """The mask and all pixels within this distance of it [px]."""
    if not mask.any():  # has no distance
        return mask
    return np.asarray(distance_transform_edt(~mask) <= px)


def shrunk(mask: BoolArray, px: float) -> BoolArray:
    """The mask without the pixels within this distance of the rest [px]."""
    return ~grown(~mask, px)


def opened(mask: BoolArray, radius: float) -> BoolArray:
    """What of a mask a disk of this radius [px] can cover without leaving it."""
    return grown(shrunk(mask, radius), radius)


def without_small(mask: BoolArray, px: int) -> BoolArray:
    """The mask without connected parts of up to ``px`` pixels."""
    parts, _ = label(mask)
    keep = np.bincount(parts.ravel()) > px
    keep[0] = False
    return np.asarray(keep[parts])


def connected_to(seed: BoolArray, mask: BoolArray) -> BoolArray:
    """The connected parts of a mask that share a pixel with ``seed``."""
    parts, count = label(mask)
    keep = np.zeros(count + 1, dtype=np.bool_)
    keep[np.unique(parts[seed])] = True
    keep[0] = False
    return np.asarray(keep[parts])
