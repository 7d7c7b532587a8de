"""Sequences of photographs: folders in the order of their numbers, videos, and the frames' times.

Videos are read by imageio-ffmpeg, an optional library that brings its own ffmpeg; what is taken of
them is written as TIFF, so that a frame is a file like any other.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from modeharvest.util.errors import InputError, MissingDependencyError
from modeharvest.util.files import require_file

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".webm", ".wmv")
PICTURES = (".tif", ".tiff", ".png", ".jpg", ".jpeg")
HOW_TO_GET = "videos are read by imageio-ffmpeg: install it with 'pip install imageio-ffmpeg'"
_DATE = re.compile(
    r"(20\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[-_.T ]*([0-2]\d)[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d)"
    r"(?:[.,_-](\d{1,6})(?!\d))?"
)
_SECONDS = re.compile(r"(?:^|[_\- ])t?=?(\d+(?:[.,]\d+)?) ?s(?:ec)?(?![a-z0-9])", re.IGNORECASE)
_EXIF, _TAKEN, _FRACTION, _CHANGED = 0x8769, 36867, 37521, 306


@dataclass(frozen=True)
class SequenceFrame:
    """A photograph of a sequence, not read yet."""

    name: str
    """Of its results; differs from all others' in the sequence."""
    path: Path
    """Of the photograph, or of the video that it is in."""
    number: int | None = None
    """In its name, the last one; in a video from 0."""
    time: float | None = None
    """[s] since 1970 by the camera's clock, or since the sequence began; None where not known."""


def natural(path: Path | str) -> tuple[tuple[int, int | str], ...]:
    """What names are sorted by, so that frame_2 comes before frame_10."""
    parts = re.split(r"(\d+)", Path(path).name.lower())
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts if part)


def is_video(path: Path | str) -> bool:
    """Whether a name, perhaps with the number of a frame as in test.mp4#12, is a video's."""
    return Path(str(path).partition("#")[0]).suffix.lower() in VIDEOS


def pictures_in(folder: Path) -> tuple[Path, ...]:
    """The photographs in a folder, in the order of their names' numbers.

    Hidden files are none. Raises InputError if there is no photograph.
    """
    names = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=natural)
    found = tuple(p for p in names if p.suffix.lower() in PICTURES and p.is_file())
    if not found:
        raise InputError(
            f"expected photographs ({', '.join(PICTURES)}) in the folder {folder}, found none "
            f"among its {len(names)} entries"
        )
    return found


def numbered(paths: Iterable[Path]) -> tuple[SequenceFrame, ...]:
    """Photographs as frames, with the last number of each name."""
    digits = ((path, re.findall(r"\d+", path.stem)) for path in paths)
    return tuple(SequenceFrame(p.stem, p, int(d[-1]) if d else None) for p, d in digits)


def odd_numbers(frames: Sequence[SequenceFrame]) -> tuple[str, ...]:
    """Which numbers are there twice, and which are missing, in words."""
    numbers = [frame.number for frame in frames if frame.number is not None]
    if len(numbers) < max(3, len(frames)):
        return ()
    twice = sorted({n for n in numbers if numbers.count(n) > 1}) if len(frames) < 10_000 else []
    text = [f"The photographs' numbers {_listed(twice)} are there twice."] if twice else []
    unique = np.unique(numbers)
    steps = np.diff(unique)
    step = int(np.median(steps)) if steps.size else 0
    if step and not (steps % step).any():
        missing = sorted(set(range(unique[0], unique[-1], step)) - set(unique.tolist()))
        if missing:
            text.append(f"Photographs are missing: {_listed(missing)} of {unique[-1]}.")
    return tuple(text)


def _listed(numbers: Sequence[int]) -> str:
    few = ", ".join(map(str, numbers[:6]))
    return few if len(numbers) <= 6 else f"{few} and {len(numbers) - 6} more"


# -- when a photograph was taken ---------------------------------------------------------


def times_of(paths: Sequence[Path]) -> tuple[list[float] | None, str]:
    """When photographs were taken [s], and by what: names, Exif, or, as a last resort, the files.

    The first of these that tells all photographs apart.
    """
    known = (_named_time, "names"), (_exif_time, "Exif"), (_changed, "times of change")
    for read, source in known:
        times = [read(path) for path in paths]
        given = [time for time in times if time is not None]
        if len(given) == len(times) and len(set(given)) == len(given):
            return given, source
    return None, "nothing"


def _named_time(path: Path) -> float | None:
    if match := _DATE.search(path.stem):
        *whole, fraction = match.groups()
        return _moment(" ".join(whole), "%Y %m %d %H %M %S", fraction)
    match = _SECONDS.search(path.stem)
    return float(match[1].replace(",", ".")) if match else None


def _exif_time(path: Path) -> float | None:
    try:
        with Image.open(path) as picture:
            tags = picture.getexif()
            inner = tags.get_ifd(_EXIF)
    except (OSError, ValueError, SyntaxError):
        return None
    text = str(inner.get(_TAKEN) or tags.get(_CHANGED) or "")
    fraction = re.sub(r"\D", "", str(inner.get(_FRACTION, "")))
    return _moment(text[:19], "%Y:%m:%d %H:%M:%S", fraction)


def _moment(text: str, form: str, fraction: str | None) -> float | None:
    try:
        moment = datetime.strptime(text, form).replace(tzinfo=UTC)
    except ValueError:
        return None
    return moment.timestamp() + float(f"0.{fraction or 0}")


def _changed(path: Path) -> float:
    """When a file was changed last, as this machine's clock on the wall showed it."""
    stamp = path.stat().st_mtime
    offset = datetime.fromtimestamp(stamp).astimezone().utcoffset()
    return stamp + (offset.total_seconds() if offset else 0.0)


# -- videos ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Video:
    """A video file, not decoded yet."""

    path: Path
    count: int
    """Of its frames, as far as its header knows."""
    rate: float
    """Frames a second."""

    @classmethod
    def of(cls, path: Path) -> Video:
        """Open a video; raises InputError if it is none, or ffmpeg finds no frames in it."""
        require_file(path, "a video", _REMEDY)
        copied = subprocess.run(
            [_ffmpeg(), "-nostdin", "-i", str(path), "-map", "0:v:0", "-c", "copy", "-f", "null",
             "-"], capture_output=True, text=True, errors="replace", check=False,
        ).stderr  # fmt: skip
        counts = re.findall(r"frame= *(\d+)", copied)
        rate = re.search(r"([\d.]+) fps", copied) or re.search(r"([\d.]+) tbr", copied)
        if not counts or not int(counts[-1]) or not rate:
            last = (copied.strip().splitlines() or ["no word"])[-1].strip()
            raise InputError(f"expected a video at {path}, ffmpeg says: {last:.100}; {_REMEDY}")
        return cls(path, int(counts[-1]), float(rate[1]))

    def frame(self, number: int) -> SequenceFrame:
        """One of its frames, by its number from 0."""
        name = f"{self.path.stem}_{number:06d}"
        return SequenceFrame(name, self.path, number, number / self.rate)

    def levels(self, wanted: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Decode frames: their numbers from 0 and grey levels (rows, cols), one at a time.

        What lies behind a damaged place, or the end, doesn't come.
        """
        left = set(wanted)
        command = [_ffmpeg(), "-nostdin", "-v", "quiet", "-i", str(self.path), "-map", "0:v:0",
                   "-f", "image2pipe", "-c:v", "pgm", "-pix_fmt", "gray", "-"]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE) as decoder:
            assert decoder.stdout
            try:
                for number in range(max(left, default=-1) + 1):
                    head = [decoder.stdout.readline() for _ in range(3)]  # P5, size, white
                    if not head[2]:
                        return
                    cols, rows = map(int, head[1].split())
                    content = decoder.stdout.read(rows * cols)
                    if number in left and len(content) == rows * cols:
                        yield number, np.frombuffer(content, np.uint8).reshape(rows, cols)
            finally:
                decoder.kill()


_REMEDY = "convert it, best to single TIFF images, or export it again"


def _ffmpeg() -> str:
    """Path of the program that decodes videos."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingDependencyError(HOW_TO_GET) from error
    return str(imageio_ffmpeg.get_ffmpeg_exe())
