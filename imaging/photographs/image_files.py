"""Image files of cameras as arrays: the numbers that are stored, right side up, and nothing else.

TIFF is read by tifffile, which keeps 16-bit colour; its compressions that tifffile leaves to
another package (LZW, JPEG, ...) are read by Pillow where that loses nothing. PNG and JPEG are
read by Pillow.
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageOps

from modeharvest.errors import InputError
from modeharvest.reading import reading, require_plausible

TIFF = {".tif", ".tiff"}
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # it would print beside our line
_ORIENTATION = 274
"""The tag of TIFF and of Exif."""


@dataclass(frozen=True, eq=False)
class Stored:
    """What a file holds.

    Parameters
    ----------
    levels
        (rows, cols) or (rows, cols, channels) uint8, uint16, float32 or float64.
    notes
        Sentences about pages left out and turns made.
    """

    levels: NDArray[Any]
    notes: tuple[str, ...]


def read_stored(path: Path) -> Stored:
    """Read a TIFF, PNG or JPEG.

    Raises
    ------
    InputError
        One line: the file is missing, empty, damaged, or its numbers can't be read unchanged.
    """
    remedy = "if it is a damaged file, copy it or take it again"
    with reading(path, "a photograph (TIFF, PNG or JPEG)", remedy), warnings.catch_warnings():
        warnings.simplefilter("error")  # how Pillow tells of files cut short
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # its size is looked at
        is_tiff = path.suffix.lower() in TIFF
        return _checked(_read_tiff(path) if is_tiff else _read_other(path), path)


def _checked(stored: Stored, path: Path) -> Stored:
    levels = stored.levels
    plane = levels.ndim == 2 or (levels.ndim == 3 and levels.shape[2] in (1, 2, 3, 4))
    if not plane or levels.size == 0:
        raise InputError(
            f"expected one picture of rows x columns at {path}, got an array of shape "
            f"{levels.shape}; split it into single files"
        )
    if levels.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError(
            f"expected 8-bit, 16-bit or float grey levels at {path}, got {levels.dtype}; convert "
            "it to one of them"
        )
    return stored


def _read_tiff(path: Path) -> Stored:
    with tifffile.TiffFile(path) as file:
        page, count = file.pages.first, len(file.pages)
        notes = [f"Of its {count} pages the first was taken."] if count > 1 else []
        require_plausible(path, page.nbytes)
        try:
            levels = np.asarray(page.asarray())
        except (ValueError, ImportError) as error:
            if "imagecodecs" not in str(error) and not isinstance(error, ImportError):
                raise
            return _by_pillow(path, page, notes)
        if page.axes == "SYX":  # colours one after the other
            levels = np.moveaxis(levels, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and levels.dtype.kind == "u":
            levels = np.iinfo(levels.dtype).max - levels
            notes.append("It stores white as 0 and was inverted.")
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE and page.colormap is not None:
            levels = np.moveaxis(page.colormap[:, levels], 0, -1)
        if levels.dtype == np.bool_:
            levels = np.where(levels, np.uint8(255), np.uint8(0))
        tag = page.tags.get(_ORIENTATION)
        turned, said = _upright(levels, int(tag.value) if tag is not None else 1)
        return Stored(turned, (*notes, *said))


def _by_pillow(path: Path, page: tifffile.TiffPage, notes: list[str]) -> Stored:
    if page.samplesperpixel > 1 and page.bitspersample != 8:
        # Pillow would drop the lower bits without a word.
        codec = tifffile.COMPRESSION(page.compression).name
        raise InputError(
            f"expected a TIFF that can be read unchanged at {path}, got {page.bitspersample}-bit "
            f"colour with {codec} compression; save it without compression, or "
            "install imagecodecs"
        )
    with Image.open(path) as picture:
        return _from_pillow(picture, notes)


def _read_other(path: Path) -> Stored:
    with Image.open(path) as picture:
        require_plausible(path, float(picture.width) * picture.height)
        if picture.format == "PNG" and _png_is_deep_colour(path):
            raise InputError(
                f"expected 8-bit colour, or grey of up to 16 bits, in the PNG {path}, got 16-bit "
                "colour, which can't be read unchanged; save it as TIFF or as grey PNG"
            )
        count = int(getattr(picture, "n_frames", 1))
        notes = [f"Of its {count} pages the first was taken."] if count > 1 else []
        return _from_pillow(picture, notes)


def _from_pillow(picture: Image.Image, notes: list[str]) -> Stored:
    orientation = int(picture.getexif().get(_ORIENTATION, 1))
    turned = ImageOps.exif_transpose(picture)
    if orientation in _TURNS:
        notes = [*notes, _turn_note(orientation)]
    if turned.mode in ("1", "P", "PA", "CMYK", "YCbCr", "LAB", "HSV"):
        turned = turned.convert("L" if turned.mode == "1" else "RGB")
    levels = np.asarray(turned)
    if levels.dtype == np.int32 and levels.min() >= 0 and levels.max() < 2**16:
        levels = levels.astype(np.uint16)  # how some versions hand out 16-bit grey PNG
    return Stored(np.asarray(levels), tuple(notes))


def _png_is_deep_colour(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(26)
    return header[12:16] == b"IHDR" and header[24] == 16 and header[25] in (2, 6)


_TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored about its diagonal",
    6: "turned clockwise by 90 degrees",
    7: "mirrored about its other diagonal",
    8: "turned anticlockwise by 90 degrees",
}


def _turn_note(orientation: int) -> str:
    return f"It was {_TURNS[orientation]}, as its orientation tag says."


def _upright(levels: NDArray[Any], orientation: int) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Obey the orientation tag: 1 to 8, by which corner the first row and column start from."""
    if orientation not in _TURNS:
        return levels, ()
    if orientation >= 5:
        levels = levels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        levels = levels[::-1]
    if orientation in (2, 3, 6, 7):
        levels = levels[:, ::-1]
    return np.ascontiguousarray(levels), (_turn_note(orientation),)
