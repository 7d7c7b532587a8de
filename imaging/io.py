"""Images and masks from and to files, checked on the way in, whole or absent on the way out."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import skimage.color
import skimage.io
import tifffile
from numpy.typing import NDArray
from PIL import Image

from modeharvest.errors import InputError
from modeharvest.files import atomic
from modeharvest.reading import reading, require_plausible

BoolArray = NDArray[np.bool_]

_TIFF = {".tif", ".tiff"}


def read_image(path: Path | str) -> NDArray[np.float32]:
    """Read a grey image.

    Whole-number images are scaled to fractions of their type's full scale (uint8: /255,
    uint16: /65535); floating-point images are taken as they are; colour becomes grey by luma
    (0.2125 R + 0.7154 G + 0.0721 B), an alpha channel is dropped.

    Returns
    -------
    (rows, cols) float32, row 0 at the top.

    Raises
    ------
    InputError
        If the file is missing, cut short, not one plane image, holds NaN or infinity, or all
        its pixels are equal.
    """
    raw = _read(Path(path))
    if raw.dtype == np.bool_ or raw.dtype.kind not in "uf":
        raise InputError(
            f"expected an image of unsigned integers or floats at {path}, got {raw.dtype}; "
            "convert it to 8-bit, 16-bit or float TIFF"
        )
    grey = _grey(raw, path)
    image = np.asarray(grey, dtype=np.float32)
    if not np.isfinite(image).all():
        count = int((~np.isfinite(image)).sum())
        raise InputError(
            f"expected finite grey values at {path}, got {count} NaN or infinite px; "
            "replace them and exclude them by a mask"
        )
    if image.min() == image.max():
        raise InputError(
            f"expected an image with contrast at {path}, got {image.flat[0]:g} in every pixel"
        )
    return image


def read_mask(path: Path | str) -> BoolArray:
    """Read a mask: True where the file isn't zero, that is, where there is material.

    Raises
    ------
    InputError
        If the file is missing, cut short, not one plane image, or zero everywhere.
    """
    raw = _read(Path(path))
    if raw.ndim == 3:
        raw = raw[..., :3].max(axis=2) if raw.shape[2] > 2 else raw[..., 0]
    mask = _require_plane(raw, path) != 0
    if not mask.any():
        raise InputError(
            f"expected a mask with material (values above 0) at {path}, got black everywhere"
        )
    return np.asarray(mask)


def require_same_shape(
    image: NDArray[Any], other: NDArray[Any], what: str, other_what: str
) -> None:
    """Raise InputError unless two images have the same size.

    ``what`` and ``other_what`` name them, best with their file names.
    """
    if image.shape != other.shape:
        raise InputError(
            f"expected images of one size, got {what} with {_size(image)} and {other_what} with "
            f"{_size(other)} (rows x cols px); crop or make them again so that they match"
        )


def quantise(image: NDArray[Any], bits: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Grey levels as a camera stores them: 0 ... 1 clipped, times 2^bits - 1, rounded to nearest.

    Up to 8 bits give uint8, up to 16 uint16; values fill the range of ``bits``.

    Raises
    ------
    InputError
        If the bits are not 1 to 16.
    """
    if not 1 <= bits <= 16:
        raise InputError(f"expected 1 to 16 bits, got {bits}")
    levels = np.rint(np.clip(image, 0.0, 1.0) * (2**bits - 1))
    if bits <= 8:
        return np.asarray(levels, dtype=np.uint8)
    return np.asarray(levels, dtype=np.uint16)


def write_image(path: Path | str, image: NDArray[Any]) -> None:
    """Write a float32, uint8 or uint16 image (rows, cols) as TIFF, whole or not at all.

    Values are stored as they are (float64 is rounded to float32); for a camera's grey levels
    see :func:`quantise`. Bool (a mask) is written as 0 and 255.

    Raises
    ------
    InputError
        If the name is not of a TIFF file, the image not plane, or of another type.
    """
    path = Path(path)
    if path.suffix.lower() not in _TIFF:
        raise InputError(f"expected a file name ending in .tif or .tiff, got {path}")
    if image.ndim != 2:
        raise InputError(f"expected an image of shape (rows, cols) for {path}, got {image.shape}")
    if image.dtype == np.bool_:
        image = np.where(image, np.uint8(255), np.uint8(0))
    elif image.dtype == np.float64:
        image = image.astype(np.float32)
    elif image.dtype not in (np.float32, np.uint8, np.uint16):
        raise InputError(f"expected float32, uint8 or uint16 for {path}, got {image.dtype}")
    # In memory first: on a full disk it would say how many values it could not write, not why.
    memory = io.BytesIO()
    tifffile.imwrite(memory, image, photometric="minisblack")
    with atomic(path) as temporary:
        # Not its buffer: memory that is lent to a failed write can't be freed.
        temporary.write_bytes(memory.getvalue())


def _read(path: Path) -> NDArray[Any]:
    remedy = "the file may be cut short, make or copy it again"
    with reading(path, "a whole TIFF, PNG or JPEG image", remedy):
        if path.suffix.lower() in _TIFF:
            with tifffile.TiffFile(path) as file:
                require_plausible(path, file.series[0].nbytes)
                return np.asarray(file.asarray())
        with Image.open(path) as picture:
            require_plausible(path, float(picture.width) * picture.height)
        return np.asarray(skimage.io.imread(path))


def _grey(raw: NDArray[Any], path: Path | str) -> NDArray[Any]:
    scale = float(np.iinfo(raw.dtype).max) if raw.dtype.kind == "u" else 1.0
    if raw.ndim == 3 and raw.shape[2] in (3, 4):
        return np.asarray(skimage.color.rgb2gray(raw[..., :3] / scale))
    if raw.ndim == 3 and raw.shape[2] == 2:
        raw = raw[..., 0]
    return np.asarray(_require_plane(raw, path) / scale)


def _require_plane(raw: NDArray[Any], path: Path | str) -> NDArray[Any]:
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2 or raw.size == 0:
        raise InputError(
            f"expected one plane image (rows x cols) at {path}, got an array of shape {raw.shape}; "
            "split stacks into single files"
        )
    return raw


def _size(image: NDArray[Any]) -> str:
    return " x ".join(str(n) for n in image.shape)
