"""Photographs from a camera: read, converted to grey, checked alone and as a series.

Grey levels stay counts. Integer TIFF (8 and 16 bits, including 10 to 14 bits stored in 16),
float TIFF, PNG and JPEG are read; changes made when reading are in ``Photograph.notes``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from modeharvest.imaging.photographs import files
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError

MOSTLY = 0.5
"""Share of saturated or of black material above which a photograph is refused."""
MANY = 0.01
"""Share of saturated or of black material above which a note is added."""
_BROKEN_OFF = 0.2
"""Share of rows without any noise at the end above which a photograph is refused."""
_BITS = (8, 10, 12, 14, 16)
_NOISE_ONLY = 0.1
"""Correlation of neighbouring pixels below which there is no speckle. Speckle of 3 px has
about 0.6; n px of white noise have 1/sqrt(n)."""
_MEAN_PX = 31
"""Width of the moving average that removes uneven lighting [px]."""
_BLOCK_PX, _BLOCKY = 8, 1.5
"""Edge of the compression blocks [px]; ratio of steps between blocks to those within, above which
blocks are reported: at most 1.2 without compression, 1.5 to 2.8 for JPEG of quality 50."""
_MUSH = (
    "Compression shows, as blocks of 8 x 8 px: it makes errors larger, of which error bars of "
    "modes don't know; save photographs as TIFF or PNG, or as JPEG of quality 95."
)
_MOSAIC, _SURE = 0.3, 6.0
"""Mean alternation of grey levels in blocks of 2 x 2 px, over its standard deviation, above which
an image is a raw mosaic of colours; and the least number of standard errors of that mean."""
_OTHER_SCALE = 4.0
"""Ratio of two frames' bright levels from which on their bit depths must differ."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, converted to grey."""

    path: Path
    """The photograph's file."""
    image: FloatImage
    """(rows, cols) grey levels as counts (float files: as stored). Row 0 is at the top."""
    bits: int
    """Bits that the grey levels fill: 8, 10, 12, 14 or 16; 0 for floats."""
    stored_bits: int
    """Bits per value in the file: 8 or 16; 32 or 64 for floats."""
    full_scale: float
    """The white level: 2^bits - 1; for floats 1, or the largest level if above 1."""
    saturated: BoolArray
    black: BoolArray
    """(rows, cols) ``saturated``: True where any channel is at the level where camera or file clip;
    ``black``: True where all channels are at 0."""
    notes: tuple[str, ...] = ()
    """Texts about changes made when it was read."""
    warnings: tuple[str, ...] = ()
    """Texts about properties that increase errors."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) [px]."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def contrast(self) -> float:
        """Standard deviation of the grey levels, as a fraction of full scale [-]."""
        return float(self.image.std(dtype=np.float64) / self.full_scale)


def read_photograph(path: Path | str) -> Photograph:
    """Read a photograph.

    The first page of a multi-page file is read and the orientation tag applied, which ``notes``
    records. InputError, in one line that names the file, if it is missing, damaged, has no grey or
    colour levels, holds NaN or infinity, every pixel has the same level, or neighbouring pixels
    show different colours.
    """
    stored = files.read_stored(Path(path))
    files.require_grey_levels(stored.levels, path)
    levels = stored.levels
    if levels.ndim == 3 and (levels == levels[..., :1]).all():  # a grey image stored as colour
        levels = levels[..., 0]
    with np.errstate(over="ignore"):  # infinite values are refused later
        image = np.ascontiguousarray(files.luma(levels.astype(np.float32)))
    files.require_visible(image, f"at {path}")
    if levels.ndim == 2 and is_mosaic(image):
        raise InputError(
            f"expected grey levels or colour at {path}, got a colour camera's raw image, whose "
            "neighbouring pixels are red, green and blue; convert it to colour with the camera's "
            "program"
        )
    bits, full_scale = _scale(levels)
    saturated, black = _cut_off(levels, full_scale)
    notes = list(stored.notes)
    if levels.ndim == 3:
        notes.append("Colour was turned to grey: {} R + {} G + {} B.".format(*files.LUMA))
    if levels.dtype == np.uint16 and bits < 16:
        notes.append(f"Its 16-bit numbers fill {bits} bits.")
    return Photograph(
        Path(path), image, bits, 8 * levels.dtype.itemsize, full_scale, saturated, black,
        tuple(notes), (_MUSH,) * shows_blocks(image),
    )  # fmt: skip


def require_usable(photograph: Photograph, mask: BoolArray | None = None) -> tuple[str, ...]:
    """Check whether a photograph shows a pattern; return notes about minor defects.

    ``mask`` (rows, cols): True on material, if known; the background may then have any level.
    InputError if more than half of the material (without a mask: more than 95 % of the image) is
    saturated, or black, or if the photograph shows only noise.
    """
    notes = []
    area, most = ("image", 0.95) if mask is None else ("material", MOSTLY)
    for name, where, remedy in (
        ("saturated", photograph.saturated, "a shorter exposure"),
        ("black", photograph.black, "a longer exposure, or the right mask"),
    ):
        share = float((where if mask is None else where[mask]).mean())
        if share > most:
            raise InputError(
                f"expected grey levels between black and white in {photograph.path}, got "
                f"{100 * share:.1f} % of the {area} {name}; take it again with {remedy}"
            )
        if share > MANY:
            notes.append(f"{photograph.path.name}: {100 * share:.1f} % of the {area} is {name}.")
    alike = neighbour_correlation(photograph.image, mask)
    if alike < _NOISE_ONLY:
        raise InputError(
            f"expected a speckle pattern in {photograph.path}, got a blank image: neighbouring "
            f"pixels have nothing in common (correlation {alike:.2f}), contrast "
            f"{100 * photograph.contrast:.2g} % of full scale; take it again"
        )
    return tuple(notes)


def require_alike(reference: Photograph, frame: Photograph) -> Photograph:
    """The frame with the reference's full scale; InputError if it differs in kind or is broken off.

    Size and bit depth have to be the same.
    """
    files.require_same_shape(reference.image, frame.image, str(reference.path), str(frame.path))
    other = _other_depth(reference, frame)
    if other:
        raise InputError(
            f"expected photographs of one bit depth, got {_depth(reference)} in {reference.path} "
            f"and {_depth(frame)} in {frame.path}{other}; export them alike"
        )
    if (lost := _rows_lost(reference.image, frame.image)) > _BROKEN_OFF * len(frame.image):
        raise InputError(
            f"expected a whole photograph at {frame.path}, got one grey level in its last {lost} "
            f"of {len(frame.image)} rows, where the camera or the copy broke off; take it again"
        )
    bits = max(reference.bits, frame.bits)
    is_alike = frame.bits in (0, bits)  # else the frame is darker and fills fewer bits
    return frame if is_alike else replace(frame, bits=bits, full_scale=float(2**bits - 1))


def _rows_lost(reference: FloatImage, frame: FloatImage) -> int:
    """Number of the frame's last rows that have exactly one grey level, but not in the reference.

    Even a black background has noise, unless it is clipped, and then in both.
    """
    is_lost = (np.ptp(frame, axis=1) == 0.0) & (frame[:, 0] == frame[-1, 0])
    last = int(np.argmin(is_lost[::-1])) if not is_lost.all() else len(is_lost)
    return int((np.ptp(reference[len(frame) - last :], axis=1) > 0.0).sum())


def read_reference(path: Path | str, mask: BoolArray | None = None) -> Photograph:
    """Read the reference; InputError if it shows no pattern, see :func:`require_usable`."""
    reference = read_photograph(path)
    return replace(reference, notes=reference.notes + require_usable(reference, mask))


def read_frame(path: Path | str, reference: Photograph) -> Photograph:
    """Read one frame and check it against the reference.

    InputError, in one line that names the file, if it is damaged, blank, or differs in size or bit
    depth; a sequence then skips the frame, reports the line and continues.
    """
    frame = require_alike(reference, read_photograph(path))
    return replace(frame, notes=frame.notes + require_usable(frame))


def require_any_frame(paths: Sequence[Path], reference: Photograph) -> None:
    """Raise InputError, with the first file's reason, if no frame can be used.

    To be called before files are written, so that a run without any image leaves none.
    """
    reasons = []
    for path in paths:
        try:
            read_frame(path, reference)
        except InputError as error:
            reasons.append(str(error))
        else:
            return
    none = f"none of {len(paths)} deformed images can be used; the first: " * (len(paths) > 1)
    raise InputError(none + reasons[0])


def neighbour_correlation(image: FloatImage, mask: BoolArray | None = None) -> float:
    """Correlation of pixels with their right and lower neighbours, without uneven lighting [-]."""
    weight = np.ones(image.shape, np.float32) if mask is None else mask.astype(np.float32)
    total = scipy.ndimage.uniform_filter(image * weight, _MEAN_PX)
    share = scipy.ndimage.uniform_filter(weight, _MEAN_PX)
    reach = _MEAN_PX // 2  # so far from the border the mean is centred: it removes a ramp exactly
    is_large = min(image.shape) > 2 * _MEAN_PX
    interior = (slice(reach, -reach) if is_large else slice(None),) * 2
    fine = (weight * (image - total / np.maximum(share, 1e-6)))[interior].astype(np.float64)
    power = float((fine**2).mean())
    if power == 0.0 or 1 in fine.shape:
        return 0.0
    pairs = 0.5 * (np.mean(fine[1:] * fine[:-1]) + np.mean(fine[:, 1:] * fine[:, :-1]))
    return float(pairs / power)


def shows_blocks(image: FloatImage) -> bool:
    """Whether an image (rows, cols) has compression blocks, as low-quality JPEG and videos do."""
    for levels in (image[:, ::4], image[::4].T):
        bent = np.abs(np.diff(levels, 3, axis=0)).mean(axis=1)
        if bent.size < _BLOCK_PX**2:
            return False
        typical = [float(np.median(bent[k::_BLOCK_PX])) for k in range(_BLOCK_PX)]
        if max(typical) <= _BLOCKY * float(np.median(typical)):
            return False
    return True


def is_mosaic(image: FloatImage) -> bool:
    """Whether an image (rows, cols) is a colour camera's raw one: green pixels alternate."""
    rows, cols = (size // 2 * 2 for size in image.shape)
    top, bottom = image[:rows:2, :cols], image[1:rows:2, :cols]
    alternating = (top - bottom)[:, ::2] - (top - bottom)[:, 1::2]
    least = max(_MOSAIC, _SURE / np.sqrt(max(alternating.size, 1)))
    return bool(alternating.size and abs(alternating.mean()) > least * alternating.std())


def _other_depth(reference: Photograph, frame: Photograph) -> str:
    """Text on why the bit depths differ; empty if they don't."""
    if frame.stored_bits != reference.stored_bits or (frame.bits == 0) != (reference.bits == 0):
        return " (as stored)"
    if frame.bits == reference.bits:
        return ""
    # A dark frame fills fewer bits than its camera has, so fewer bits alone are no difference.
    bright = [float(np.percentile(p.image[::4, ::4], 99)) for p in (reference, frame)]
    ratio = max(bright) / max(min(bright), 1e-30)
    return f" (bright levels differ by a factor of {ratio:.3g})" if ratio >= _OTHER_SCALE else ""


def _depth(photograph: Photograph) -> str:
    if photograph.bits == 0:
        return f"{photograph.stored_bits}-bit floats"
    if photograph.bits == photograph.stored_bits:
        return f"{photograph.bits} bits"
    return f"{photograph.bits} bits in {photograph.stored_bits}"


def _scale(levels: NDArray[Any]) -> tuple[int, float]:
    """Bits that the levels fill, and the white level."""
    top = float(levels.max())
    if levels.dtype.kind == "f":
        return 0, max(1.0, top)
    bits = next(b for b in _BITS if top <= 2**b - 1)
    return bits, float(2**bits - 1)


def _cut_off(levels: NDArray[Any], full_scale: float) -> tuple[BoolArray, BoolArray]:
    """(saturated, black) pixels; in colour: any channel saturated, or all channels black."""
    top = levels.max()
    ceiling = top if _piles_up(levels, float(top)) else full_scale
    high, low = np.asarray(levels >= ceiling), np.asarray(levels <= 0)
    if levels.ndim == 2:
        return high, low
    return np.asarray(high.any(axis=-1)), np.asarray(low.all(axis=-1))


def _piles_up(levels: NDArray[Any], top: float) -> bool:
    """Whether the camera clipped at level ``top``: more pixels have it than just lower levels."""
    if levels.dtype.kind == "f":
        return False
    step = int(np.gcd.reduce(np.unique(levels).astype(np.int64)))  # 16 for 12 bits shifted up
    below = int((levels >= top - 8 * step).sum()) - (at_top := int((levels == top).sum()))
    return bool(at_top >= 100 and at_top > below)
