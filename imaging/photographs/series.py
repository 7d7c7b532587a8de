"""A series of photographs of one test: do they belong together, which frames are damaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modeharvest.imaging.photographs.photograph import Photograph, read_photograph, require_usable
from modeharvest.util.arrays import BoolArray
from modeharvest.util.errors import InputError

_OTHER_SCALE = 4.0
"""Ratio of two frames' bright levels from which on they can't be of one bit depth."""


@dataclass(frozen=True)
class SkippedFrame:
    """A frame of a series that can't be used.

    Parameters
    ----------
    number
        Its place in the series, from 0.
    path
        Its file.
    reason
        One line that names the file.
    """

    number: int
    path: Path
    reason: str


def require_alike(reference: Photograph, frame: Photograph) -> Photograph:
    """The frame, its grey levels on the reference's scale.

    Raises
    ------
    InputError
        If its size or its bit depth is another one.
    """
    if frame.shape != reference.shape:
        raise InputError(
            f"expected photographs of one size, got {_size(reference)} in {reference.path} and "
            f"{_size(frame)} in {frame.path} (rows x cols px); crop or take them alike"
        )
    other = _other_depth(reference, frame)
    if other:
        raise InputError(
            f"expected photographs of one bit depth, got {_depth(reference)} in {reference.path} "
            f"and {_depth(frame)} in {frame.path}{other}; export them alike"
        )
    if 0 in (reference.bits, frame.bits):
        return frame
    return frame.rescaled(max(reference.bits, frame.bits))


def read_reference(path: Path | str, mask: BoolArray | None = None) -> Photograph:
    """Read the reference and refuse it if it shows no pattern; see ``require_usable``."""
    reference = read_photograph(path)
    said = require_usable(reference, mask)
    return _with_notes(reference, said)


def read_frame(path: Path | str, reference: Photograph) -> Photograph:
    """Read one frame and compare it with the reference.

    Raises
    ------
    InputError
        One line that names the file, if it is damaged, blank, or of another size or bit depth.
        A sequence catches it, skips the frame, reports the line and goes on.
    """
    frame = require_alike(reference, read_photograph(path))
    return _with_notes(frame, require_usable(frame))


def usable_frames(
    paths: Sequence[Path | str], reference: Photograph
) -> tuple[tuple[Path, ...], tuple[SkippedFrame, ...]]:
    """Look at all frames, one at a time, and split them into those to use and those to skip.

    Returns
    -------
    paths, skipped
        In the order of the series.
    """
    good, skipped = [], []
    for number, path in enumerate(map(Path, paths)):
        try:
            read_frame(path, reference)
        except InputError as error:
            skipped.append(SkippedFrame(number, path, str(error)))
        else:
            good.append(path)
    return tuple(good), tuple(skipped)


def _with_notes(photograph: Photograph, said: tuple[str, ...]) -> Photograph:
    return replace(photograph, notes=(*photograph.notes, *said)) if said else photograph


def _other_depth(reference: Photograph, frame: Photograph) -> str:
    """Why the two have different depths; empty if they don't."""
    if frame.stored_bits != reference.stored_bits or (frame.bits == 0) != (reference.bits == 0):
        return " (as stored)"
    if frame.bits == reference.bits:
        return ""
    # A dark frame fills fewer bits than its camera has: that alone says nothing.
    bright = [float(np.percentile(p.image[::4, ::4], 99)) for p in (reference, frame)]
    ratio = max(bright) / max(min(bright), 1e-30)
    return f" (bright levels differ by a factor of {ratio:.3g})" if ratio >= _OTHER_SCALE else ""


def _depth(photograph: Photograph) -> str:
    if photograph.bits == 0:
        return f"{photograph.stored_bits}-bit floats"
    if photograph.bits == photograph.stored_bits:
        return f"{photograph.bits} bits"
    return f"{photograph.bits} bits in {photograph.stored_bits}"


def _size(photograph: Photograph) -> str:
    return " x ".join(map(str, photograph.shape))
