"""Sequences of photographs: numbered files in a folder, videos, and the times of the frames.

Videos are read by imageio-ffmpeg, an optional library that brings its own ffmpeg. The frames used
are written as TIFF, so that each is a file like any other photograph.
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
PICTURES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp")
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
    """Name of its results, unique in the sequence."""
    path: Path
    """File of the photograph, or of the video that contains it."""
    number: int | None = None
    """The last number in the file's name; in a video the frame number, from 0."""
    time: float | None = None
    """Time [s] since 1970 by the camera's clock, or since the sequence began; None if unknown."""


def natural(path: Path | str) -> tuple[tuple[int, int | str], ...]:
    """Sort key of file names that orders numbers by value: frame_2 comes before frame_10."""
    parts = re.split(r"(\d+)", Path(path).name.lower())
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts if part)


def is_video(path: Path | str) -> bool:
    """Whether a path is a video's, with or without a frame number as in test.mp4#12."""
    return Path(str(path).partition("#")[0]).suffix.lower() in VIDEOS


def pictures_in(folder: Path) -> tuple[Path, ...]:
    """The photographs in a folder, in the order of the numbers in their names.

    Hidden files are ignored. Raises InputError if there is no photograph.
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
    """Photographs as frames, numbered by the last number in each name."""
    digits = ((path, re.findall(r"\d+", path.stem)) for path in paths)
    return tuple(SequenceFrame(p.stem, p, int(d[-1]) if d else None) for p, d in digits)


def odd_numbers(frames: Sequence[SequenceFrame]) -> tuple[str, ...]:
    """Texts about frame numbers that occur twice or are missing."""
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
    """Times of the photographs [s] and their source: names, Exif, or else the files' dates.

    The first source that gives every photograph a different time is used; None if there is none.
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
    """Time of a file's last change [s] in local time, treated as UTC."""
    stamp = path.stat().st_mtime
    offset = datetime.fromtimestamp(stamp).astimezone().utcoffset()
    return stamp + (offset.total_seconds() if offset else 0.0)


# -- videos ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Video:
    """A video file, not decoded yet."""

    path: Path
    times: tuple[float, ...]
    """Times of the frames since the first [s], of the file's packets, without decoding them."""
    bits_per_pixel: float
    """Size of the packets over the number of pixels of all frames [bit]."""

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.times)

    @property
    def rate(self) -> float:
        """Frames per second, on average."""
        return (self.count - 1) / self.times[-1] if self.count > 1 else 1.0

    @property
    def is_steady(self) -> bool:
        """Whether its frames follow each other at equal times; those of telephones don't."""
        steps = np.diff(self.times)
        return bool(steps.size == 0 or np.ptp(steps) < np.median(steps))

    @classmethod
    def of(cls, path: Path) -> Video:
        """Open a video; raises InputError if it isn't one, or ffmpeg finds no frames in it."""
        require_file(path, "a video", _REMEDY)
        copied = subprocess.run(
            [_ffmpeg(), "-nostdin", "-i", str(path), "-map", "0:v:0", "-c", "copy", "-f",
             "framecrc", "-"], capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        packets = [line.split(",") for line in copied.stdout.splitlines() if line[:1] == "0"]
        base = re.search(r"^#tb 0: (\d+)/(\d+)", copied.stdout, re.MULTILINE)
        rate = re.search(r"([\d.]+) fps", copied.stderr) or re.search(
            r"([\d.]+) tbr", copied.stderr
        )
        size = re.search(r"Video: .*?, (\d+)x(\d+)", copied.stderr)
        if not packets or not base or not rate or not size:
            last = (copied.stderr.strip().splitlines() or ["no word"])[-1].strip()
            raise InputError(f"expected a video at {path}, ffmpeg says: {last:.100}; {_REMEDY}")
        stamps = np.sort([int(packet[2]) for packet in packets])
        times = (stamps - stamps[0]) * int(base[1]) / int(base[2])
        if stamps[0] == _UNKNOWN or not np.all(np.diff(stamps)):
            times = np.arange(len(packets)) / float(rate[1])
        bits = 8 * sum(int(packet[4]) for packet in packets)
        pixels = len(packets) * int(size[1]) * int(size[2])
        return cls(path, tuple(times.tolist()), bits / pixels)

    def about(self) -> tuple[str, ...]:
        """Texts about its frames, and on what increases errors."""
        steady = "" if self.is_steady else ", at unequal times, which are read from it"
        text = f"{self.path.name}: {self.count} frames, {self.rate:.4g} a second{steady}."
        if self.bits_per_pixel >= _FEW_BITS:
            return (text,)
        return text, (
            f"{self.path.name} is compressed to {self.bits_per_pixel:.2g} bits a pixel, less than "
            "a camera's noise has: errors are larger than error bars say; film with less "
            "compression, best with none."
        )

    def frame(self, number: int) -> SequenceFrame:
        """The frame with a given number, from 0."""
        name = f"{self.path.stem}_{number:06d}"
        return SequenceFrame(name, self.path, number, self.times[number])

    def levels(self, wanted: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Decode the wanted frames: yield each number, from 0, and its grey levels (rows, cols).

        Frames after a damaged one, or beyond the video's end, are not yielded.
        """
        left = set(wanted)
        # At times of our own: to keep a rate, ffmpeg would repeat frames and leave out others.
        command = [_ffmpeg(), "-nostdin", "-v", "quiet", "-i", str(self.path), "-map", "0:v:0",
                   "-vf", "settb=1/25,setpts=N,fps=25",
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


_FEW_BITS = 1.0
"""Bits a pixel below which a video is reported: as many as noise of a quarter of a level has."""
_UNKNOWN = -(2**63)
"""ffmpeg's time stamp of a packet without one."""
_REMEDY = "convert it, best to single TIFF images, or export it again"


def _ffmpeg() -> str:
    """Path of the program that decodes videos."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingDependencyError(HOW_TO_GET) from error
    return str(imageio_ffmpeg.get_ffmpeg_exe())
