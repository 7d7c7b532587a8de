"""Images and masks as a correlation takes them, or a line that says what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.compiled import readable
from modeharvest.imaging.grid import PixelGrid

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CheckedImages:
    """What is correlated, checked.

    Parameters
    ----------
    f, g
        (rows, cols) float32: reference and deformed image.
    grid
        Their pixels.
    f_mask, g_mask
        (rows, cols) True on material; None for everywhere.
    """

    f: NDArray[Any]
    g: NDArray[Any]
    grid: PixelGrid
    f_mask: BoolArray | None
    g_mask: BoolArray | None

    @classmethod
    def checked(
        cls,
        reference: ArrayLike,
        deformed: ArrayLike,
        grid: PixelGrid,
        mask: ArrayLike | None,
        deformed_mask: ArrayLike | None,
    ) -> CheckedImages:
        """Check them.

        Raises
        ------
        InputError
            If sizes differ, a mask is empty, or an image holds NaN or is constant.
        """
        images = cls(
            checked_image(reference, "reference", grid),
            checked_image(deformed, "deformed", grid),
            grid,
            checked_mask(mask, "mask", grid),
            checked_mask(deformed_mask, "deformed mask", grid),
        )
        for grey, what in zip(images.grey, ("reference", "deformed"), strict=True):
            require_contrast(grey, what)
        return images

    @cached_property
    def grey(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """The grey levels of the material, of f and of g."""
        return seen(self.f, self.f_mask), seen(self.g, self.g_mask)


def seen(image: NDArray[Any], mask: BoolArray | None) -> NDArray[Any]:
    """The grey levels that a mask leaves."""
    return image if mask is None else image[mask]


def checked_image(image: ArrayLike, what: str, grid: PixelGrid) -> NDArray[Any]:
    """The image as read-only float32; raises InputError unless finite and of the grid's shape."""
    pixels = np.asarray(image)
    if pixels.shape != grid.shape:
        raise InputError(
            f"expected a {what} image of {grid.rows} x {grid.cols} px like the grid, got shape "
            f"{pixels.shape}; give two images and a grid of one size"
        )
    pixels = pixels.astype(np.float32, copy=False)
    bad = ~np.isfinite(pixels)
    if bad.any():
        raise InputError(
            f"expected finite grey levels in the {what} image, got NaN or infinity in "
            f"{where(bad)}; fill or crop them"
        )
    return readable(pixels)


def checked_mask(mask: ArrayLike | None, what: str, grid: PixelGrid) -> BoolArray | None:
    """The mask, read-only; raises InputError unless it has the grid's shape and some material."""
    if mask is None:
        return None
    inside = np.ascontiguousarray(mask, dtype=np.bool_)
    if inside.shape != grid.shape:
        raise InputError(
            f"expected a {what} of {grid.rows} x {grid.cols} px like the images, got shape "
            f"{inside.shape}"
        )
    if not inside.any():
        raise InputError(f"expected material in the {what}, got one that is False everywhere")
    return readable(inside)


def require_contrast(grey: NDArray[Any], what: str) -> None:
    """Raise InputError for a blank image."""
    if grey.min() == grey.max():
        raise InputError(
            f"expected a speckle in the {what} image, got the constant grey level {grey.flat[0]}"
        )


def where(bad: BoolArray) -> str:
    """How many pixels are bad, and where the first one is."""
    row, col = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return f"{int(bad.sum())} px, the first at row {row}, column {col}"
