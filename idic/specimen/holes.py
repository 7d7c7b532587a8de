"""The holes in a mask of the material: openings with material all around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import center_of_mass, label

from modeharvest.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MUCH_SMALLER = 0.25
"""Openings below this share of the typical area are scratches, bubbles and noise."""


@dataclass(frozen=True, eq=False)
class Holes:
    """Holes of one image.

    Parameters
    ----------
    centres
        (n, 2) centroids, (row, col) [px].
    areas
        (n,) [px^2].
    too_small
        Number of openings left out because the others are much larger.
    at_border
        Number of openings that reach the image's border: background, or holes cut off.
    """

    centres: FloatArray
    areas: FloatArray
    too_small: int
    at_border: int

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def diameters(self) -> FloatArray:
        """(n,) diameters of circles of the same area [px]."""
        return np.asarray(2.0 * np.sqrt(self.areas / np.pi))


def find_holes(mask: ArrayLike) -> Holes:
    """Find the holes in a mask.

    Parameters
    ----------
    mask
        (rows, cols) True on material.

    Raises
    ------
    InputError
        If the mask is not plane, or has no material or nothing else in it.
    """
    material = np.asarray(mask, dtype=np.bool_)
    if material.ndim != 2:
        raise InputError(f"expected a mask of rows x columns, got shape {material.shape}")
    if not material.any() or material.all():
        raise InputError(
            "expected material and holes in the mask, got a mask with nothing in it: "
            f"{'True' if material.any() else 'False'} everywhere"
        )
    parts, count = label(~material)
    border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    border = border[border > 0]
    areas = np.bincount(parts.ravel(), minlength=count + 1).astype(np.float64)
    inner = np.setdiff1d(np.arange(1, count + 1), border)
    typical = _typical(areas[inner]) if inner.size else 0.0
    large = inner[areas[inner] >= _MUCH_SMALLER * typical]
    centres = np.array(center_of_mass(~material, parts, large), dtype=np.float64)
    return Holes(
        centres=centres.reshape(-1, 2),
        areas=areas[large],
        too_small=int(inner.size - large.size),
        at_border=int(border.size),
    )


def _typical(areas: FloatArray) -> float:
    """The area above which half of all the hole area lies: many specks don't change it."""
    ordered = np.sort(areas)[::-1]
    return float(ordered[np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())])
