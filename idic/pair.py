"""Pairs of images: reference, deformed image and masks, checked or from prepared photographs.

Prepared photographs are a folder::

    prepared/reference.tif  reference_mask.tif
    prepared/NAME.tif       NAME_mask.tif        of each deformed image
    prepared/prepared.json                       what was done and what was skipped; written last

The images are grey levels as the camera counts them, float32, on the ideal pixel grid; the masks
are white on material.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from modeharvest.idic.uncertainty.noise import CameraNoise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import checked_image, checked_mask, grey_levels_in
from modeharvest.imaging.photographs.files import read_image, read_mask, require_contrast
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.files import read_json, reading
from modeharvest.util.typed import made

PREPARED_FILE = "prepared.json"


@dataclass(frozen=True, eq=False)
class PreparedPhotographs:
    """Photographs on the ideal grid, in a folder; read when asked for.

    Parameters
    ----------
    folder
        Where they are.
    info
        The content of ``prepared.json``.
    """

    folder: Path
    info: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> PreparedPhotographs:
        """Open a finished folder; raises InputError if it isn't one."""
        path = folder / PREPARED_FILE
        with reading(path, "prepared photographs", "remove it, and harvest again"):
            found = cls(folder, dict(read_json(path)))
            _ = found.names, found.skipped, found.noise, found.grid
            return found

    @property
    def names(self) -> tuple[str, ...]:
        """Of the deformed images that can be used, in the order of the test."""
        return tuple(map(str, self.info["names"]))

    @property
    def skipped(self) -> tuple[tuple[str, str], ...]:
        """Name of each file that can't be used, and why."""
        return tuple((name, reason) for name, reason in self.info["skipped"])

    @property
    def noise(self) -> CameraNoise:
        """The camera's."""
        return made(CameraNoise, self.info["noise"])

    @property
    def grid(self) -> PixelGrid:
        """The ideal pixels; the physical origin is the middle of the image."""
        return made(PixelGrid, self.info["grid"])

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file, the record last."""
        stems = (f"{name}{kind}" for name in ("reference", *self.names) for kind in ("", "_mask"))
        return (*(self.folder / f"{stem}.tif" for stem in stems), self.folder / PREPARED_FILE)

    def image(self, name: str = "reference") -> FloatImage:
        """(rows, cols) grey levels."""
        return read_image(self.folder / f"{name}.tif")

    def mask(self, name: str = "reference") -> BoolArray:
        """(rows, cols) True on material."""
        return read_mask(self.folder / f"{name}_mask.tif")


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
        return grey_levels_in(self.f, self.f_mask), grey_levels_in(self.g, self.g_mask)
