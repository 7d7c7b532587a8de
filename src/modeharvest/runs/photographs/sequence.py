"""Which photographs of a sequence are measured, and what a testing machine recorded with each.

Names stand for files, folders, videos or, with wildcards, many of them. Only the measured frames of
a video are written, as TIFF, to ``frames/`` in a run's folder.
"""

from __future__ import annotations

import glob
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.photographs.sequence import (
    SequenceFrame,
    Video,
    is_video,
    natural,
    numbered,
    odd_numbers,
    pictures_in,
    times_of,
)
from modeharvest.runs.photographs.machine_log import LogTable, offset_between, read_log
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.files import require_file, sha256_of
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import Stages, digest

FRAMES = "frames"
_CHECK = "check its name"
RECORDED = ("number", "time_s", "force_N", "crosshead_mm", "crosshead_strain")


@dataclass(frozen=True, kw_only=True)
class FrameChoice:
    """Which frames of a sequence are measured; all by default."""

    every: int = 1
    """Measure only every n-th frame, from the first on."""
    frames: tuple[int, ...] = ()
    """Numbers of the measured frames: last number in a photograph's name; in a video from 0."""
    between_s: tuple[float, float] | None = None
    """Times [s] of the first and last measured frame, since the sequence began."""
    strains: tuple[float, ...] = ()
    """Nominal strains by the crosshead [-]; the frame nearest to each; needs a log with a length.
    """
    per_second: float | None = None
    """Frame rate [photographs per second], used if neither names nor files give times."""

    def __post_init__(self) -> None:
        require_within("images: expected every", self.every, 1)
        if self.per_second is not None:
            require_within("images: expected per_second", self.per_second, 0, above=True)
        if self.between_s is not None and not self.between_s[0] <= self.between_s[1]:
            raise InputError(
                "images: expected between_s from an earlier to a later moment [s], got "
                f"{list(self.between_s)}"
            )


@dataclass(frozen=True, eq=False)
class ChosenFrames:
    """The photographs of a sequence that are measured, as files."""

    reference: Path
    deformed: tuple[Path, ...]
    """Deformed photographs in the order of the test; their stems are unique."""
    notes: tuple[str, ...] = ()
    """How the photographs were found and chosen."""
    skipped: tuple[tuple[str, str], ...] = ()
    """Names of files that were left out, and the reasons."""
    recorded: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By photograph name: those of the data ``RECORDED`` that are known."""


def recorded_with(sequence: ChosenFrames | None, name: str) -> dict[str, Any]:
    """A photograph's number, time since the sequence began, and logged data.

    The keys are ``RECORDED``; unknown values are None.
    """
    known = sequence.recorded.get(name, {}) if sequence else {}
    return {key: known.get(key) for key in RECORDED}


def named_files(base: Path, names: Sequence[str], unique: bool = True) -> tuple[Path, ...]:
    """The files that names, folders of photographs, or patterns with wildcards stand for.

    Sorted by the numbers in their names. Raises InputError if no file has a name or matches a
    pattern, or, with ``unique``, if two files have the same stem, by which results are named.
    """
    paths: list[Path] = []
    for name in names:
        if any(sign in name for sign in "*?[") and not (base / name).exists():
            matches = (base / match for match in glob.glob(name, root_dir=base))
            found = sorted((p for p in matches if p.is_file()), key=natural)
            if not found:
                raise InputError(f"expected files that match {base / name}, found none")
            paths += found
        elif (base / name).is_dir():
            paths += pictures_in(base / name)
        else:
            if not (base / name).exists():
                raise InputError(f"expected a file at {base / name}, found no such file; {_CHECK}")
            paths.append(base / name)
    stems = Counter(path.stem for path in paths)
    twice = next((stem for stem, n in stems.items() if n > 1 or stem == "reference"), None)
    if unique and twice is not None and len(paths) > 1:
        raise InputError(
            f"expected images whose names differ, and none called 'reference', got {twice!r} "
            "again; rename it, or narrow the pattern"
        )
    return tuple(paths)


def chosen_frames(
    base: Path, reference: str, deformed: Sequence[str], choice: FrameChoice, log: LogTable,
    folder: Path, progress: Progress = silent,
) -> ChosenFrames:  # fmt: skip
    """Find the photographs that names stand for, choose among them, and join a machine's log.

    ``base``: folder to which names are relative; ``folder``: the run's, for frames of videos.
    Raises InputError if no photograph is chosen, or a file can't be used; MissingDependencyError
    for a video if the library that reads it isn't installed.
    """
    first = _reference(base, reference)
    frames, notes, skipped = _all_frames(base, deformed)
    needs_time = bool(log.file or choice.between_s or choice.per_second)
    times, source = _times(frames, choice.per_second) if needs_time else (None, ())
    notes = (*notes, *source)
    if times is not None:
        frames = tuple(replace(f, time=t) for f, t in zip(frames, times, strict=True))
    recorded, more = _recorded(frames, base, log)
    frames = tuple(frame for frame in frames if not _are_one(frame, first))
    frames = _chosen(frames, choice, recorded)
    start, *paths = _written((first, *frames), folder, progress)
    lost = [path for path in paths if path.parent == folder / FRAMES and not path.exists()]
    skipped = (*skipped, *((path.stem, "the video can't be decoded there") for path in lost))
    return ChosenFrames(
        start,
        tuple(path for path in paths if path not in lost),
        (*notes, *more),
        skipped,
        {f.name: recorded[f.name] for f in frames if recorded.get(f.name)},
    )


def _reference(base: Path, name: str) -> SequenceFrame:
    """The frame of the undeformed state; of a video the first, or frame 12 of test.mp4#12."""
    if not is_video(name):
        require_file(base / name, "a photograph", _CHECK)
        return SequenceFrame("reference", base / name)
    file, _, number = name.partition("#")
    if number and not number.isdecimal():
        raise InputError(f"expected a reference as in {file}#12, got {name!r}")
    return replace(Video.of(base / file).frame(int(number or 0)), name="reference")


def _are_one(frame: SequenceFrame, other: SequenceFrame) -> bool:
    """Whether two frames are the same file, and of a video the same number."""
    is_file = frame.path.absolute() == other.path.absolute()
    return is_file and (not is_video(frame.path) or frame.number == other.number)


def _all_frames(
    base: Path, names: Sequence[str]
) -> tuple[tuple[SequenceFrame, ...], tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Every frame, also the reference if it is among them; notes; files left out, with reasons."""
    frames: list[SequenceFrame] = []
    skipped: list[tuple[str, str]] = []
    notes: list[str] = []
    for name in names:
        if is_video(name):
            video = Video.of(base / name)
            notes += video.about()
            frames += map(video.frame, range(video.count))
            continue
        taken = {frame.name for frame in frames}
        for frame in numbered(named_files(base, [name], unique=False)):
            if frame.name in taken:
                skipped.append((frame.path.name, "another photograph has this name"))
                continue
            taken.add(frame.name)
            frames.append(frame)
    if len(frames) > 1 and not is_video(frames[0].path):
        notes += odd_numbers(frames)
    return tuple(frames), tuple(notes), tuple(skipped)


def _times(
    frames: Sequence[SequenceFrame], per_second: float | None
) -> tuple[list[float] | None, tuple[str, ...]]:
    """Time at which each frame was taken [s], and notes on the source of the times."""
    if per_second is not None:
        return [k / per_second for k in range(len(frames))], ()
    if all(frame.time is not None for frame in frames):
        return [frame.time or 0.0 for frame in frames], ()
    times, source = times_of([frame.path for frame in frames])
    text = f"Times of the photographs are taken from their {source}."
    if source == "times of change":
        text += " These are the files' times, wrong if files were copied or edited: check them."
    if times is None:
        text = "When the photographs were taken isn't known: give per_second in [images]."
    return times, (text,)


def _recorded(
    frames: Sequence[SequenceFrame], base: Path, log: LogTable
) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """Recorded data of every frame, by name, and notes on their source."""
    times = np.array([math.nan if f.time is None else f.time for f in frames])
    began = float(times[0]) if len(frames) else 0.0
    known: dict[str, dict[str, Any]] = {
        f.name: {"number": f.number, **({} if f.time is None else {"time_s": f.time - began})}
        for f in frames
    }  # fmt: skip
    if not log.file:
        return known, ()
    read = read_log(base / log.file, log)
    if not np.isfinite(times).all():
        raise InputError(
            f"log: expected photographs whose times are known, to join {log.file}, got none; give "
            "per_second in [images]"
        )
    offset, text = offset_between(read, times, log.offset_s)
    columns = read.at(times + offset)
    if log.length is not None and read.crosshead is not None:
        moved = np.abs(columns["crosshead_mm"] - read.crosshead[0])
        columns["crosshead_strain"] = moved / log.length
    for name, column in columns.items():
        for frame, value in zip(frames, column, strict=True):
            known[frame.name][name] = float(value) if np.isfinite(value) else None
    lost = int(sum(not np.isfinite(c).all() for c in zip(*columns.values(), strict=True)))
    if lost:
        text = (*text, f"{lost} of {len(frames)} photographs were taken while nothing was logged.")
    return known, (*read.text, *text)


def _chosen(
    frames: Sequence[SequenceFrame], choice: FrameChoice, recorded: Mapping[str, Mapping[str, Any]]
) -> tuple[SequenceFrame, ...]:
    """The chosen frames; InputError if there is none."""
    left = list(frames)
    if choice.frames:
        wanted = set(choice.frames)
        left = [frame for frame in left if frame.number in wanted]
        missing = sorted(wanted - {frame.number for frame in left if frame.number is not None})
        if missing:
            raise InputError(
                f"images.frames: expected numbers of photographs, got {missing[0]}"
                f"{f' and {len(missing) - 1} more' if missing[1:] else ''} that none has; there "
                f"are {_range(frames)}"
            )
    if choice.between_s is not None:
        low, high = choice.between_s
        left = [f for f in left if low <= recorded[f.name].get("time_s", math.nan) <= high]
    if choice.strains:
        left = _at_strains(left, choice.strains, recorded)
    left = left[:: choice.every]
    if not left:
        raise InputError(
            "images: expected photographs to measure besides the reference, got none of "
            f"{len(frames)}; choose others"
        )
    return tuple(left)


def _range(frames: Iterable[SequenceFrame]) -> str:
    numbers = [frame.number for frame in frames if frame.number is not None]
    return f"{min(numbers)} to {max(numbers)}" if numbers else "no numbers in their names"


def _at_strains(
    frames: Sequence[SequenceFrame],
    strains: Sequence[float],
    recorded: Mapping[str, Mapping[str, Any]],
) -> list[SequenceFrame]:
    """The frame nearest to each strain by the crosshead, in the order of the test."""
    by = [recorded[frame.name].get("crosshead_strain") for frame in frames]
    known = np.array([math.inf if strain is None else strain for strain in by])
    if not np.isfinite(known).any():
        raise InputError(
            "images.strains: expected a log with a crosshead and a length, to know the frames' "
            "strains, got none; set file and length in [log], or choose by frames"
        )
    return [frames[k] for k in sorted({int(np.argmin(np.abs(known - s))) for s in strains})]


def _written(frames: Sequence[SequenceFrame], folder: Path, progress: Progress) -> tuple[Path, ...]:
    """The frames as files; frames of videos are written to the run's folder, in a stage."""
    wanted: dict[Path, dict[int, Path]] = {}
    paths: list[Path] = []
    for frame in frames:
        path = frame.path
        if is_video(path) and frame.number is not None:
            path = folder / FRAMES / f"{frame.path.stem}_{frame.number:06d}.tif"
            wanted.setdefault(frame.path, {})[frame.number] = path
        paths.append(path)
    for video, numbers in wanted.items():

        def work(video: Path = video, numbers: dict[int, Path] = numbers) -> tuple[Path, ...]:
            written = []
            for number, levels in Video.of(video).levels(numbers):
                write_image(numbers[number], levels)
                written.append(numbers[number])
                progress(len(written), len(numbers), "frames of the video")
            return tuple(written)

        Stages(folder).do(f"frames {video.name}", digest([sha256_of(video), sorted(numbers)]), work)
    return tuple(paths)
