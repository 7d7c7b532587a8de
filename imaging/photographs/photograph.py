"""Photographs as a camera leaves them: read, turned to grey, and checked one by one.

Grey levels stay counts. Whole-number TIFF (8 and 16 bit, 10 to 14 bits stored in 16 included),
float TIFF, PNG and JPEG are read; what was changed on the way is said in ``Photograph.notes``.
Colour becomes grey by luma, 0.2125 R + 0.7154 G + 0.0721 B (ITU-R BT.709, the weights of
scikit-image). What is wrong with a series as a whole is found by
:mod:`modeharvest.imaging.photographs.series`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from modeharvest.imaging.photographs.files import StoredImage, read_stored
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError

LUMA = (0.2125, 0.7154, 0.0721)
"""Weights of red, green and blue in a grey level."""
MOSTLY = 0.5
"""Share of saturated or of black material above which a photograph is refused."""
MANY = 0.01
"""Share of saturated or of black material above which that is said."""
_BITS = (8, 10, 12, 14, 16)
_NOISE_ONLY = 0.1
"""Correlation of neighbouring pixels below which there is no speckle: speckles of 3 px have
about 0.6, and n px of white noise have 1/sqrt(n)."""
_SHADE_PX = 31
"""Lighting that is uneven over more than this is no pattern."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph in grey.

    Parameters
    ----------
    path
        Its file.
    image
        (rows, cols) grey levels as counts; of a float file as they are. Row 0 is the top.
    bits
        Bits that the grey levels fill: 8, 10, 12, 14 or 16; 0 for floats.
    stored_bits
        Bits of a number in the file: 8, 16, or 32 or 64 for floats.
    full_scale
        The grey level that counts as white: 2^bits - 1; for floats 1, or the largest level if
        that is above 1.
    was_colour
        Whether it was made grey from colour.
    saturated, black
        (rows, cols) True where a channel is at the level beyond which the camera or the file
        cuts off, or at 0.
    notes
        Sentences about what was changed when it was read.
    """

    path: Path
    image: FloatImage
    bits: int
    stored_bits: int
    full_scale: float
    was_colour: bool
    saturated: BoolArray
    black: BoolArray
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) [px]."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def saturated_share(self) -> float:
        """Share of the pixels that are saturated [-]."""
        return float(self.saturated.mean())

    @property
    def contrast(self) -> float:
        """Standard deviation of the grey levels, as a share of full scale [-]."""
        return float(self.image.std(dtype=np.float64) / self.full_scale)

    def rescaled(self, bits: int) -> Photograph:
        """The same grey levels, said to fill ``bits`` bits (a darker frame of a series)."""
        if bits == self.bits:
            return self
        return replace(self, bits=bits, full_scale=float(2**bits - 1))


def read_photograph(path: Path | str) -> Photograph:
    """Read a photograph.

    Of a file with several pages the first is taken, the orientation tag is obeyed, an alpha
    channel is dropped, and all of it is said in ``notes``.

    Raises
    ------
    InputError
        One line that names the file: it is missing, damaged, not a picture of grey or colour
        levels, holds NaN or infinity, or every pixel has the same level.
    """
    stored = read_stored(Path(path))
    levels = _without_alpha(stored)
    if levels.dtype.kind == "f" and not np.isfinite(levels).all():
        count = int((~np.isfinite(levels)).sum())
        raise InputError(
            f"expected finite grey levels in {path}, got {count} NaN or infinite ones; replace "
            "them and exclude them by a mask"
        )
    if levels.min() == levels.max():
        raise InputError(
            f"expected a photograph with contrast in {path}, got the level {levels.flat[0]:g} in "
            "100 % of its pixels; take it again"
        )
    was_colour = levels.ndim == 3
    bits, full_scale = _scale(levels)
    saturated, black = _cut_off(levels, full_scale)
    notes = list(stored.notes)
    if was_colour:
        notes.append("Colour was turned to grey: {} R + {} G + {} B.".format(*LUMA))
    if levels.dtype == np.uint16 and bits < 16:
        notes.append(f"Its 16-bit numbers fill {bits} bits.")
    return Photograph(
        path=Path(path),
        image=_grey(levels),
        bits=bits,
        stored_bits=8 * levels.dtype.itemsize,
        full_scale=full_scale,
        was_colour=was_colour,
        saturated=saturated,
        black=black,
        notes=tuple(notes),
    )


def require_usable(photograph: Photograph, mask: BoolArray | None = None) -> tuple[str, ...]:
    """Judge whether a photograph shows a pattern at all.

    Parameters
    ----------
    photograph
        To be judged.
    mask
        (rows, cols) True on material, if that is known; a background may be as white or black
        as it likes.

    Returns
    -------
    Sentences about what is not as good as it should be.

    Raises
    ------
    InputError
        If more than half of the material (without a mask: more than 95 % of the image) is
        saturated or black, or if there is nothing but noise.
    """
    said = []
    for name, where, remedy in (
        ("saturated", photograph.saturated, "a shorter exposure"),
        ("black", photograph.black, "a longer exposure, or the right mask"),
    ):
        share = float((where if mask is None else where[mask]).mean())
        seen = "image" if mask is None else "material"
        if share > (MOSTLY if mask is not None else 0.95):
            raise InputError(
                f"expected grey levels between black and white in {photograph.path}, got "
                f"{100 * share:.1f} % of the {seen} {name}; take it again with {remedy}"
            )
        if share > MANY:
            said.append(f"{photograph.path.name}: {100 * share:.1f} % of the {seen} is {name}.")
    alike = neighbour_correlation(photograph.image, mask)
    if alike < _NOISE_ONLY:
        raise InputError(
            f"expected a speckle pattern in {photograph.path}, got a blank image: neighbouring "
            f"pixels have nothing in common (correlation {alike:.2f}), contrast "
            f"{100 * photograph.contrast:.2g} % of full scale; take it again"
        )
    return tuple(said)


def neighbour_correlation(image: FloatImage, mask: BoolArray | None = None) -> float:
    """Correlation of pixels with their right and lower neighbours, uneven lighting removed [-].

    About 0 for noise, 0.6 for speckles of 3 px, more for larger ones.
    """
    weight = np.ones(image.shape, np.float32) if mask is None else mask.astype(np.float32)
    total = scipy.ndimage.uniform_filter(image * weight, _SHADE_PX)
    share = scipy.ndimage.uniform_filter(weight, _SHADE_PX)
    reach = _SHADE_PX // 2  # beyond it the mean is not one-sided, so a ramp leaves nothing
    inner = (slice(reach, -reach),) * 2 if min(image.shape) > 2 * _SHADE_PX else (slice(None),) * 2
    fine = (weight * (image - total / np.maximum(share, 1e-6)))[inner].astype(np.float64)
    power = float((fine**2).mean())
    if power == 0.0:
        return 0.0
    pairs = 0.5 * (np.mean(fine[1:] * fine[:-1]) + np.mean(fine[:, 1:] * fine[:, :-1]))
    return float(pairs / power)


def pixel_size(first: tuple[float, float], second: tuple[float, float], length_mm: float) -> float:
    """Size of a pixel [mm/px] from a scale in the image: two points and their distance.

    Parameters
    ----------
    first, second
        (row, col) [px].
    length_mm
        Their distance [mm].

    Raises
    ------
    InputError
        If the length isn't positive or the points are less than 1 px apart.
    """
    distance = float(np.hypot(second[0] - first[0], second[1] - first[1]))
    if not (length_mm > 0 and np.isfinite(length_mm)) or not distance >= 1.0:
        raise InputError(
            "expected a scale of more than 0 mm between two points at least 1 px apart, got "
            f"{length_mm} mm between {tuple(first)} and {tuple(second)} (row, col)"
        )
    return length_mm / distance


def _without_alpha(stored: StoredImage) -> NDArray[Any]:
    """(rows, cols) grey or (rows, cols, 3) colour."""
    levels = stored.levels
    if levels.ndim == 3 and levels.shape[2] in (1, 2):
        return np.asarray(levels[..., 0])
    if levels.ndim == 3:
        colour = levels[..., :3]
        if all(np.array_equal(colour[..., 0], colour[..., k]) for k in (1, 2)):
            return np.asarray(colour[..., 0])  # grey that was stored as colour
        return np.asarray(colour)
    return levels


def _scale(levels: NDArray[Any]) -> tuple[int, float]:
    """Bits that the levels fill, and the level that counts as white."""
    top = float(levels.max())
    if levels.dtype.kind == "f":
        return 0, max(1.0, top)
    stored = 8 * levels.dtype.itemsize
    bits = next(b for b in _fitting(stored) if top <= 2**b - 1)
    return bits, float(2**bits - 1)


def _fitting(stored: int) -> Iterable[int]:
    return (stored,) if stored not in (8, 16) else (b for b in _BITS if b <= stored)


def _cut_off(levels: NDArray[Any], full_scale: float) -> tuple[BoolArray, BoolArray]:
    """(saturated, black) pixels: of a colour image those with any channel at its end."""
    top = levels.max()
    ceiling = top if _piles_up(levels, float(top)) else full_scale
    high, low = np.asarray(levels >= ceiling), np.asarray(levels <= 0)
    if levels.ndim == 2:
        return high, low
    return np.asarray(high.any(axis=-1)), np.asarray(low.all(axis=-1))


def _piles_up(levels: NDArray[Any], top: float) -> bool:
    """Whether a camera cut off below full scale: far more pixels at the top than just under it."""
    if levels.dtype.kind == "f":
        return False
    step = int(np.gcd.reduce(np.unique(levels).astype(np.int64)))  # 16 for 12 bits shifted up
    below = int((levels >= top - 8 * step).sum()) - (at_top := int((levels == top).sum()))
    return bool(at_top >= 100 and at_top > below)


def _grey(levels: NDArray[Any]) -> FloatImage:
    if levels.ndim == 2:
        return np.ascontiguousarray(levels, dtype=np.float32)
    return np.asarray(levels.astype(np.float32) @ np.asarray(LUMA, dtype=np.float32))
