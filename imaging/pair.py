"""A pair of images to correlate, and the truth behind the deformed one.

A truth file is one HDF5 per deformed image, readable with h5py alone::

    displacement           (2, rows, cols) float64 [mm]  at the reference image's pixels
    reference_point        (2, rows, cols) float64 [mm]  shown by the deformed image's pixels
    deformed_displacement  (2, rows, cols) float32 [mm]  at the deformed image's pixels
    element                (rows, cols)    int32   [-]   at the deformed image's pixels
    residual_px            (rows, cols)    float32 [px]  of the inverse mapping there

In the file the leading axis holds the components (x, y), so that each is one contiguous image;
in Python they come last. x right, y up; rows run down the image. NaN (in ``element``: -1) marks
background. Attributes: nominal_strain and the pixel grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import require_visible
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.compiled import readable
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic_hdf5, open_hdf5

TRUTH_FORMAT = "modeharvest-truth-1"
_PARTS = {
    "displacement": ("mm", "displacement (x, y) at the reference image's pixels"),
    "reference_point": ("mm", "reference point (x, y) shown by the deformed image's pixels"),
    "deformed_displacement": ("mm", "displacement (x, y) at the deformed image's pixels"),
    "element": ("-", "element shown by the deformed image's pixels, -1: background"),
    "residual_px": ("px", "residual of the inverse mapping at the deformed image's pixels"),
}
_TYPES = {"element": np.int32, "deformed_displacement": np.float32, "residual_px": np.float32}
"""Types of the arrays that aren't float64."""
_CHUNK_ROWS = 64
_FEW, _EVERY = 0.02, 7
"""Share of the material, at each end, whose grey levels may be far beyond those of the rest; every
how many pixels quantiles are taken."""


class HasDisplacement(Protocol):
    """A measurement: any object that gives a displacement field at pixels."""

    def displacement(self, grid: PixelGrid, /) -> FloatArray:
        """(rows, cols, 2) u [mm] at the pixels of a grid."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The exact fields of one deformed image; each part is read or computed on access.

    The last axis of length 2 holds the components (x, y) along the physical axes; NaN where there
    is no material.
    """

    part: Callable[[str], NDArray[Any]]
    """Returns a part, given the name of its property."""

    @classmethod
    def of(cls, **parts: NDArray[Any]) -> Truth:
        """A truth in memory, from the parts that are known."""
        return cls(parts.__getitem__)

    @classmethod
    def read(cls, path: Path | str) -> Truth:
        """A truth in a file; access raises InputError if the file is missing or cut short."""
        return cls(partial(_read_part, path))

    @cached_property
    def displacement(self) -> FloatArray:
        """(rows, cols, 2) u at the *reference* image's pixels [mm]."""
        return self.part("displacement")

    @cached_property
    def reference_point(self) -> FloatArray:
        """(rows, cols, 2) reference position X of the *deformed* image's pixels [mm]."""
        return self.part("reference_point")

    @cached_property
    def deformed_displacement(self) -> FloatImage:
        """(rows, cols, 2) float32 u at the *deformed* image's pixels [mm]."""
        return self.part("deformed_displacement")

    @cached_property
    def element(self) -> NDArray[np.int32]:
        """(rows, cols) int32 element shown by the deformed image's pixels, -1 for background."""
        return self.part("element")

    @cached_property
    def residual_px(self) -> FloatImage:
        """(rows, cols) float32 residual of the inverse mapping in the deformed image [px]."""
        return self.part("residual_px")

    def write(self, path: Path | str, nominal_strain: float, grid: PixelGrid) -> None:
        """Write a truth file, atomically, of the pixels of a grid at a nominal strain [-]."""
        with atomic_hdf5(path) as file:
            file.attrs.update(format=TRUTH_FORMAT, nominal_strain=nominal_strain, **asdict(grid))
            for name, (unit, meaning) in _PARTS.items():
                data = self.part(name)
                data = np.moveaxis(data, -1, 0) if data.ndim == 3 else data
                chunk = (1,) * (data.ndim - 2) + (min(_CHUNK_ROWS, grid.rows), grid.cols)
                options = {"chunks": chunk, "compression": "lzf", "shuffle": True}
                dataset = file.create_dataset(name, data=data, **options)
                dataset.attrs.update(unit=unit, meaning=meaning)


def _read_part(path: Path | str, name: str) -> NDArray[Any]:
    """Read an array of a truth file, components last."""
    remedy = "make it again with 'modeharvest image'"
    with open_hdf5(path, "a truth file (HDF5)", remedy, TRUTH_FORMAT) as file:
        plane = np.asarray(file[name], dtype=_TYPES.get(name, np.float64))
        size = file["element"].shape
        if len(size) != 2 or plane.shape not in (size, (2, *size)):
            raise InputError(f"expected {name} of (2 x) rows x cols, got {plane.shape}")
        return np.moveaxis(plane, 0, -1) if plane.ndim == 3 else plane


@dataclass(frozen=True, eq=False)
class ImagePair:
    """A reference and a deformed image of the same size; checked, and read-only.

    InputError if sizes differ, a mask is empty, or an image has NaN or only one level on material.
    """

    reference: FloatImage
    deformed: FloatImage
    """(rows, cols) grey levels f and g; stored as float32."""
    grid: PixelGrid
    """The pixel grid of both images."""
    mask: BoolArray | None = None
    deformed_mask: BoolArray | None = None
    """(rows, cols) True on material, in f and in g; None for everywhere."""
    truth: Truth | None = None
    """The exact fields, if known."""
    strain: float = math.nan
    """Nominal strain of the deformed image [-]; NaN if unknown."""
    is_plain: bool = False
    """Whether only the material's contours are used: the material may have one grey level."""

    def __post_init__(self) -> None:
        for name in ("reference", "deformed"):
            object.__setattr__(self, name, checked_image(getattr(self, name), name, self.grid))
        for name in ("mask", "deformed_mask"):
            mask = checked_mask(getattr(self, name), name.replace("_", " "), self.grid)
            object.__setattr__(self, name, mask)
        shown = (self.reference, self.deformed) if self.is_plain else self.grey
        for grey, what in zip(shown, ("reference", "deformed"), strict=True):
            require_visible(grey, f"in the {what} image")

    @property
    def grey(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The grey levels of f and of g on the material, (n,) with a mask."""
        f, g = self.reference, self.deformed
        return grey_levels_in(f, self.mask), grey_levels_in(g, self.deformed_mask)

    @property
    def masks(self) -> tuple[BoolArray, BoolArray]:
        """(rows, cols) True on material, of f and of g; all True without a mask."""
        everywhere, f, g = np.ones(self.grid.shape, np.bool_), self.mask, self.deformed_mask
        return everywhere if f is None else f, everywhere if g is None else g

    def with_images(self, reference: NDArray[Any], deformed: NDArray[Any]) -> Self:
        """The same pair with other grey levels, for example noisy or blurred ones."""
        return replace(self, reference=reference, deformed=deformed)

    def without_extremes(self) -> Self:
        """The same pair, with grey levels far beyond those of nearly all material at the median.

        Blurs would spread reflections and defective pixels of images of many bits. Levels that the
        reference's material has are never extreme: the deformed one may be elsewhere.
        """
        images, least, most = [], np.inf, -np.inf
        for image in (self.reference, self.deformed):
            grey = image[self.masks[0]][::_EVERY]
            low, high = np.quantile(grey, [_FEW, 1.0 - _FEW])
            least, most = min(least, 2.0 * low - high), max(most, 2.0 * high - low)
            extreme = (image < least) | (image > most)
            images.append(np.where(extreme, np.median(grey), image) if extreme.any() else image)
        return self.with_images(*images)

    def rms(self, measured: HasDisplacement) -> float:
        """Rms *per component* of truth - measured on material [mm]; InputError without a truth."""
        if self.truth is None:
            raise InputError("expected a pair whose true displacement is known, got one without")
        error = self.truth.displacement - measured.displacement(self.grid)
        return float(np.sqrt(np.mean(grey_levels_in(error, self.mask) ** 2)))


@dataclass(frozen=True, eq=False)
class KnownPair(ImagePair):
    """A pair of rendered images: the masks and the exact fields are known."""

    mask: BoolArray
    deformed_mask: BoolArray
    truth: Truth


def grey_levels_in(image: NDArray[Any], mask: BoolArray | None) -> NDArray[Any]:
    """The grey levels where the mask is True; the whole image without a mask."""
    return image if mask is None else image[mask]


def checked_image(image: ArrayLike, what: str, grid: PixelGrid) -> FloatImage:
    """The image as read-only float32; InputError unless finite and of the grid's shape."""
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
            f"{location_of(bad)}; fill or crop them"
        )
    return readable(pixels)


def checked_mask(mask: ArrayLike | None, what: str, grid: PixelGrid) -> BoolArray | None:
    """The mask, read-only; InputError unless it has the grid's shape and some material."""
    if mask is None:
        return None
    inside = np.ascontiguousarray(mask, dtype=np.bool_)
    if inside.shape != grid.shape:
        size = f"{grid.rows} x {grid.cols} px"
        raise InputError(f"expected a {what} of {size} like the images, got shape {inside.shape}")
    if not inside.any():
        raise InputError(f"expected material in the {what}, got one that is False everywhere")
    return readable(inside)


def location_of(bad: BoolArray) -> str:
    """Text: the number of bad pixels and the position of the first one."""
    row, col = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return f"{int(bad.sum())} px, the first at row {row}, column {col}"
