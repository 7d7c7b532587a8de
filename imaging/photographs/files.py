"""Image files: stored levels in upright orientation, masks, grey images, writing of TIFF.

TIFF is read by tifffile, which keeps 16-bit colour. TIFF compressions that tifffile can't decode
alone (LZW, JPEG, ...) are read by Pillow if that is lossless, as are PNG and JPEG. Files are
checked when read, and written atomically.

Colour becomes grey by luma, 0.2125 R + 0.7154 G + 0.0721 B (ITU-R BT.709, as in scikit-image).
"""

from __future__ import annotations

import io
import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageOps

from modeharvest.util.arrays import BoolArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, reading, require_plausible

LUMA = (0.2125, 0.7154, 0.0721)
"""Weights of red, green and blue in a grey level."""
_TIFF = {".tif", ".tiff"}
_LABELS = 16
"""A mostly white mask with more levels than this has soft edges; otherwise levels are labels."""
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # no output beside our messages
_ORIENTATION = 274
"""Number of the orientation tag in TIFF and Exif."""
_TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored about its diagonal",
    6: "turned clockwise by 90 degrees",
    7: "mirrored about its other diagonal",
    8: "turned anticlockwise by 90 degrees",
}


@dataclass(frozen=True, eq=False)
class StoredImage:
    """Content of an image file."""

    levels: NDArray[Any]
    """(rows, cols) grey levels, or (rows, cols, 3) colour."""
    notes: tuple[str, ...]
    """Texts about changes made when it was read."""

    @property
    def grey(self) -> NDArray[Any]:
        """(rows, cols) floating-point grey levels; integers become fractions of full scale."""
        whole = self.levels.dtype.kind == "u"
        return luma(self.levels / (float(np.iinfo(self.levels.dtype).max) if whole else 1.0))


def luma(levels: NDArray[Any]) -> NDArray[Any]:
    """(rows, cols) grey levels from floating-point grey or colour levels."""
    if levels.ndim == 2:
        return levels
    return np.asarray(levels @ np.asarray(LUMA, dtype=levels.dtype))


def read_stored(path: Path, *, single: bool = False) -> StoredImage:
    """Read a TIFF, PNG or JPEG; an alpha channel is dropped.

    The first page of a multi-page file is read, unless ``single``, which allows only one page.
    InputError if the file is missing, empty, damaged, or its levels can't be read unchanged.
    """
    remedy = "if it is a damaged file, or one cut short, copy or export it again"
    with reading(path, "a TIFF, PNG or JPEG image", remedy), warnings.catch_warnings():
        warnings.simplefilter("error")  # Pillow warns of files cut short
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # size is checked here
        is_tiff = path.suffix.lower() in _TIFF
        stored = _read_tiff(path, single) if is_tiff else _read_other(path, single)
        levels = stored.levels
        if not (levels.ndim == 2 or (levels.ndim == 3 and levels.shape[2] <= 4)) or not levels.size:
            raise _not_plane(levels.shape, path)
        if levels.ndim == 3:
            levels = levels[..., 0] if levels.shape[2] < 3 else levels[..., :3]
        return StoredImage(levels, stored.notes)


def _not_plane(shape: tuple[int, ...], path: Path) -> InputError:
    return InputError(
        f"expected one plane image (rows x cols) at {path}, got an array of shape {shape}; "
        "split stacks into single files"
    )


def require_grey_levels(levels: NDArray[Any], path: Path | str) -> None:
    """Raise InputError for a type of numbers without full scale, or that no camera stores."""
    if levels.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        what = f"8-bit, 16-bit or float grey levels at {path}"
        raise InputError(f"expected {what}, got {levels.dtype}; convert it to one of them")


def require_visible(grey: NDArray[Any], where: str) -> None:
    """Raise InputError for grey levels with NaN or infinity, or all equal.

    ``where``: text for the message, such as "at PATH" or "in the reference image".
    """
    count = int(np.count_nonzero(~np.isfinite(grey)))
    if count:
        raise InputError(
            f"expected finite grey levels {where}, got {count} NaN or infinite px; "
            "replace them and exclude them by a mask"
        )
    if grey.min() == grey.max():
        got = f"the constant grey level {grey.flat[0]:g}"
        raise InputError(f"expected an image with contrast {where}, got {got}")


def _read_tiff(path: Path, single: bool) -> StoredImage:
    with tifffile.TiffFile(path) as file:
        page, notes = file.pages.first, _page_notes(len(file.pages))
        if single and len(file.series[0].pages) > 1:
            raise _not_plane(file.series[0].shape, path)
        require_plausible(path, page.nbytes)
        if page.photometric == tifffile.PHOTOMETRIC.SEPARATED:  # inks, CMYK
            return _by_pillow(path, page, notes)
        try:
            levels = np.asarray(page.asarray())
        except (ValueError, ImportError) as error:
            if "imagecodecs" not in str(error) and not isinstance(error, ImportError):
                raise
            return _by_pillow(path, page, notes)
        if page.axes == "SYX":  # planar colour: channels first
            levels = np.moveaxis(levels, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and levels.dtype.kind == "u":
            levels = np.iinfo(levels.dtype).max - levels
            notes.append("It stores white as 0 and was inverted.")
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE and page.colormap is not None:
            levels = np.moveaxis(page.colormap[:, levels], 0, -1)
        if levels.dtype == np.bool_:
            levels = np.where(levels, np.uint8(255), np.uint8(0))
        tag = page.tags.get(_ORIENTATION)
        turned, more = _upright(levels, int(tag.value) if tag is not None else 1)
        return StoredImage(turned, (*notes, *more))


def _page_notes(count: int) -> list[str]:
    return [f"Of its {count} pages the first was taken."] if count > 1 else []


def _by_pillow(path: Path, page: tifffile.TiffPage, notes: list[str]) -> StoredImage:
    if page.samplesperpixel > 1 and page.bitspersample != 8:
        # Pillow would drop the lower bits without a warning.
        codec = tifffile.COMPRESSION(page.compression).name
        raise InputError(
            f"expected a TIFF that can be read unchanged at {path}, got {page.bitspersample}-bit "
            f"colour with {codec} compression; save it as grey or RGB without compression, "
            "or install imagecodecs"
        )
    with Image.open(path) as picture:
        return _from_pillow(picture, notes)


def _read_other(path: Path, single: bool) -> StoredImage:
    with Image.open(path) as picture:
        require_plausible(path, float(picture.width) * picture.height)
        if picture.format == "PNG" and _png_is_deep_colour(path):
            raise InputError(
                f"expected 8-bit colour, or grey of up to 16 bits, in the PNG {path}, got 16-bit "
                "colour, which can't be read unchanged; save it as TIFF or as grey PNG"
            )
        count = int(getattr(picture, "n_frames", 1))
        if single and count > 1:
            raise _not_plane((count, picture.height, picture.width), path)
        return _from_pillow(picture, _page_notes(count))


def _from_pillow(picture: Image.Image, notes: list[str]) -> StoredImage:
    orientation = int(picture.getexif().get(_ORIENTATION, 1))
    turned = ImageOps.exif_transpose(picture)
    if orientation in _TURNS:
        notes = [*notes, _turn_note(orientation)]
    if turned.mode in ("1", "P", "PA", "CMYK", "YCbCr", "LAB", "HSV"):
        turned = turned.convert("L" if turned.mode == "1" else "RGB")
    levels = np.asarray(turned)
    if levels.dtype == np.int32 and levels.min() >= 0 and levels.max() < 2**16:
        levels = levels.astype(np.uint16)  # some versions return 16-bit grey PNG as int32
    return StoredImage(np.asarray(levels), tuple(notes))


def _png_is_deep_colour(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(26)
    return header[12:16] == b"IHDR" and header[24] == 16 and header[25] in (2, 6)


def _turn_note(orientation: int) -> str:
    return f"It was {_TURNS[orientation]}, as its orientation tag says."


def _upright(levels: NDArray[Any], orientation: int) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Apply the orientation tag, 1 to 8: the corner where the first row and column start."""
    if orientation not in _TURNS:
        return levels, ()
    if orientation >= 5:
        levels = levels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        levels = levels[::-1]
    if orientation in (2, 3, 6, 7):
        levels = levels[:, ::-1]
    return np.ascontiguousarray(levels), (_turn_note(orientation),)


def read_image(path: Path | str) -> NDArray[np.float32]:
    """Read a grey image.

    Integer images are scaled to fractions of their type's full scale (uint8: /255,
    uint16: /65535); floating-point images are not scaled. Row 0 is at the top.

    InputError if the file is missing, cut short, not a single image of 8 or 16 bits or floats,
    holds NaN or infinity, or all its pixels are equal.
    """
    stored = read_stored(Path(path), single=True)
    require_grey_levels(stored.levels, path)
    image = np.asarray(stored.grey, dtype=np.float32)
    require_visible(image, f"at {path}")
    return image


def read_mask(path: Path | str) -> BoolArray:
    """Read a mask (rows, cols): True where the file isn't zero, that is, where there is material.

    In a white mask with soft edges (many levels), levels above half the largest one are True.
    InputError if the file is missing, cut short, not a single image, zero everywhere, has several
    levels but no zero, or holds NaN or infinity.
    """
    levels = read_stored(Path(path), single=True).levels
    if not np.isfinite(levels).all():
        raise InputError(f"expected a mask of finite numbers at {path}, got NaN or infinity")
    levels = levels if levels.ndim == 2 else levels.max(axis=2)
    low, high = levels.min(), levels.max()
    has_many, white = len(np.unique(levels)) > _LABELS, np.sum(levels > 0.9 * high)
    mask = levels > (0.5 * high if has_many and 2 * white > np.sum(levels > 0) else 0)
    if not mask.any():
        raise InputError(f"expected a mask with material (above 0) at {path}, got black everywhere")
    if low > 0 and low != high:
        got = f"no black at all, levels from {low} to {high}"
        raise InputError(f"expected a mask that is black off the material at {path}, got {got}")
    return np.asarray(mask)


def require_same_shape(
    image: NDArray[Any], other: NDArray[Any], what: str, other_what: str
) -> None:
    """Raise InputError unless two images have the same size; ``what``: names for the message."""
    if image.shape != other.shape:
        size, other_size = (" x ".join(map(str, each.shape)) for each in (image, other))
        raise InputError(
            f"expected images of one size, got {what} with {size} and {other_what} with "
            f"{other_size} (rows x cols px); crop or make them again so that they match"
        )


def write_image(path: Path | str, image: NDArray[Any]) -> None:
    """Write a float32, uint8 or uint16 image (rows, cols) as TIFF, atomically.

    Values are stored unscaled (float64 is rounded to float32), bool (a mask) as 0 and 255.
    InputError if the name isn't a TIFF file's, the image isn't 2-D, or has another type.
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
    # In memory first: on a full disk tifffile's error message doesn't say why writing failed.
    memory = io.BytesIO()
    tifffile.imwrite(memory, image, photometric="minisblack")
    with atomic(path) as temporary:
        # A copy, not the buffer: a buffer exported to a failed write can't be freed.
        temporary.write_bytes(memory.getvalue())
