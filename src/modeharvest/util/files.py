"""Reading and writing files: errors are reported in one line; new files are complete or absent.

Libraries that read file formats raise exceptions of any type for a damaged file. Their calls are
made in a ``with reading(...)`` block, which turns all of these into InputError. HDF5 is opened by
:func:`open_hdf5`, which refuses files that would read others or fill the memory. Formats whose
parsers may crash: :func:`read_in_child`. New files are written under a temporary name and
then renamed: :func:`atomic`.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
from numpy.typing import NDArray

from modeharvest.util import child
from modeharvest.util.errors import InputError, WriteError
from modeharvest.util.machine import require_memory

_CHILD_SECONDS, _CHILD_SECONDS_PER_BYTE = 60.0, 1e-5
"""Time limit of a parser [s], and what it is extended by per byte of the file."""
_LARGEST_SEARCHED = 1e8  # bytes


@contextmanager
def reading(path: Path | str, what: str, remedy: str = "make it again") -> Iterator[Path]:
    """Turn any exception in the block into InputError; the block must only read the file.

    ``what``: the expected content of ``path``, such as "a solution (HDF5)". ``remedy``: advice to
    the user. InputError also if there is no such file or it is a folder. The message of an
    InputError raised in the block is kept, after the file's name.
    """
    path = Path(path)
    require_file(path, what, remedy)
    try:
        yield path
    except InputError as error:
        line = " ".join(str(error).split())
        raise InputError(line if str(path) in line else f"{path}: {line}") from error
    except Exception as error:  # exceptions differ between formats and libraries
        raise InputError(f"expected {what} at {path}, got: {reason(error)}; {remedy}") from error


def require_file(path: Path, what: str, remedy: str) -> None:
    """Raise InputError unless ``path`` is an existing file."""
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise InputError(f"expected {what} at {path}, found {found}; {remedy}")
    if path.stat().st_size == 0:
        raise InputError(
            f"expected {what} at {path}, got: an empty file, cut short at 0 bytes; {remedy}"
        )


def encoding_of(path: Path) -> str:
    """Encoding of a text file: UTF-16 where it begins with that one's mark, else UTF-8."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def reason(error: BaseException) -> str:
    """The message of a library's exception, in one line."""
    if isinstance(error, KeyError) and len(error.args) == 1 and " " not in str(error.args[0]):
        return f"no {error.args[0]!r}"
    if isinstance(error, MemoryError):
        return "more numbers than there is memory for"
    text = " ".join(str(error).split())
    return text if len(text) > 3 else f"{type(error).__name__} {text}".strip()


@contextmanager
def open_hdf5(
    path: Path | str, what: str, remedy: str = "make it again", form: str | None = None
) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; errors are handled as by :func:`reading`.

    ``form``: required value of its attribute ``format``; None for any. InputError also if the file
    is of another format, refers to other files (external storage, external links, virtual data), or
    declares more data than there is memory for. Otherwise a file of a few hundred bytes could
    expose any other file, and declare any size.
    """
    with reading(path, what, remedy) as path:
        _require_sound_heaps(path)
        with h5py.File(path, "r") as file:
            if form is not None and (got := file.attrs.get("format")) != form:
                raise InputError(f"expected a {form} file at {path}, got format {got!r}; {remedy}")
            _require_self_contained(file, path)
            yield file


def _require_sound_heaps(path: Path) -> None:
    """Refuse a file in which libhdf5 1.14 would search for a text without end.

    The library steps through a global heap by its objects' sizes; in a damaged file one may be 0.
    Files above 100 MB aren't searched: they come from runs, which check their digests.
    """
    content = path.read_bytes() if path.stat().st_size < _LARGEST_SEARCHED else b""
    at = -1
    while (at := content.find(b"GCOL\x01\0\0\0", at + 1)) >= 0:
        size = int.from_bytes(content[at + 8 : at + 16], "little")
        place, end = at + 16, min(at + size, len(content))
        while place + 16 <= end:
            is_object = any(content[place : place + 2])
            size = int.from_bytes(content[place + 8 : place + 16], "little")
            if not (is_object or size):
                raise InputError(f"expected texts that end at byte {place}, got none")
            place += 16 + -(-size // 8) * 8 if is_object else size


def require_plausible(path: Path, declared: float) -> None:
    """Raise InputError if a file declares more bytes than it can hold or memory can take.

    A header of a few bytes can declare any size.
    """
    size = path.stat().st_size
    if not declared <= child.BASE_BYTES / 10.0 + child.BYTES_PER_BYTE * size:
        raise InputError(
            f"expected a whole file at {path}, got {size} bytes that declare {declared:.3g}"
        )
    require_memory(declared, f"the file {path}", "take a part of it")


def read_in_child(kind: str, path: Path | str, what: str, remedy: str) -> dict[str, NDArray[Any]]:
    """Numbers and texts of a file, by their names, read by :mod:`modeharvest.util.child`.

    ``kind``: "mat" or "mesh"; other arguments as for :func:`reading`. Raises InputError as that
    function does, also if the parser fails, crashes, or exceeds its time limit.
    """
    with reading(path, what, remedy) as path, tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "read.npz"
        command = [sys.executable, "-P", child.__file__, kind, str(path.resolve()), str(target)]
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", check=False,
            timeout=_CHILD_SECONDS + path.stat().st_size * _CHILD_SECONDS_PER_BYTE,
        )  # fmt: skip
        if done.returncode < 0:
            raise ValueError(f"a file that makes its parser crash (signal {-done.returncode})")
        if done.returncode:
            raise ValueError((done.stderr.strip().splitlines() or ["nothing"])[-1])
        with np.load(target, allow_pickle=False) as file:
            return {str(name): file[f"arr_{k}"] for k, name in enumerate(file["names"])}


def _require_self_contained(file: h5py.File, path: Path) -> None:
    total = 0.0

    # Returning anything but None ends the visit; an exception would get lost in HDF5.
    def outside(name: str, link: Any) -> str | None:
        is_external = isinstance(link, h5py.ExternalLink)
        return f"{name!r}, which is in another file, {link.filename!r}" if is_external else None

    def stored_outside(name: str, thing: Any) -> str | None:
        nonlocal total
        if not isinstance(thing, h5py.Dataset):
            return None
        total += thing.nbytes
        is_external = thing.external or thing.is_virtual
        return f"{name!r}, whose numbers are in another file" if is_external else None

    found = file.visititems_links(outside) or file.visititems(stored_outside)
    if found:
        raise InputError(
            f"expected all data in the file itself, got {found}; copy them in (h5repack)"
        )
    require_plausible(path, total)


_TEMPORARY = re.compile(r"\..+\.(\d+)\.part(\.[^.]*)?")
"""Temporary names given by :func:`atomic`; they contain the process id."""


@contextmanager
def atomic(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` if the block succeeds.

    If the block ends early (an exception, a full disk, Ctrl-C), the temporary file is removed, so
    a reader never sees half a file. Files of a killed process are removed by the next process that
    writes in the same folder. File and folder reach the disk before the block ends, so that a
    power cut leaves no empty file under a finished name. The suffix is kept, because libraries
    choose formats by it. Raises InputError if the operating system refuses the write (disk full, no
    permission).
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        make_folder(path.parent)
        remove_orphans(path.parent)
        yield temporary
        _flush(temporary, os.O_RDWR)
        os.replace(temporary, path)
        if os.name == "posix":  # elsewhere a folder can't be opened
            _flush(path.parent, os.O_RDONLY)
    except OSError as error:
        raise WriteError(f"could not write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # the file, or its folder, may not exist
            temporary.unlink(missing_ok=True)


def _flush(path: Path, mode: int) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_orphans(folder: Path | str) -> None:
    """Remove the temporary files in a folder whose process has ended."""
    for name in os.listdir(folder):
        orphan = _TEMPORARY.fullmatch(name)
        if orphan and not psutil.pid_exists(int(orphan[1])):
            Path(folder, name).unlink(missing_ok=True)


def make_folder(folder: Path | str) -> None:
    """Make a folder and its parents, where they do not exist yet.

    Raises InputError if the path, or a parent of it, is a file; OSError if the operating system
    refuses it for another reason.
    """
    folder = Path(folder)
    require_no_file(folder)
    folder.mkdir(parents=True, exist_ok=True)


def require_no_file(folder: Path) -> None:
    """Raise InputError if the path of a folder, or one of its parents, is a file."""
    for place in (folder, *folder.parents):
        if os.path.isdir(place):
            return
        if os.path.lexists(place):
            raise InputError(
                f"expected a folder at {place}, found a file; remove it, or take another folder"
            )


def require_writable(folder: Path | str) -> None:
    """Make ``folder`` and check that files can be written there, before long work begins."""
    with atomic(Path(folder) / "writable") as temporary:
        temporary.touch()
    (Path(folder) / "writable").unlink()


@contextmanager
def atomic_hdf5(path: Path | str) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that appears at ``path`` when the block has succeeded.

    The file is made in memory first: on a full disk HDF5 can't close a file on it, and prints
    errors until the program ends.
    """
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    with atomic(path) as temporary:
        # A copy, not the buffer: a buffer exported to a failed write can't be freed.
        temporary.write_bytes(memory.getvalue())


def copy_whole(source: Path | str, path: Path | str) -> None:
    """Copy a file; ``path`` is complete or absent, see :func:`atomic`."""
    with atomic(path) as temporary:
        shutil.copyfile(source, temporary)


def write_json(path: Path | str, content: Any) -> None:
    """Write ``content`` as indented JSON, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", "utf-8")


def write_csv(path: Path | str, heads: Iterable[object], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV table, atomically; numbers in full precision, None as an empty field."""
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([heads, *rows])


def read_json(path: Path | str) -> Any:
    """Read JSON; raises InputError if the file is missing, cut short or nested too deeply."""
    with reading(path, "a JSON file"):
        return json.loads(Path(path).read_text("utf-8-sig"))


def read_record(path: Path | str, form: str, what: str, remedy: str) -> dict[str, Any]:
    """Read a JSON object whose ``format`` is ``form``.

    ``what`` (the expected content) and ``remedy`` (advice) are for the message of the InputError
    that is raised if the file is missing, damaged, or of another format.
    """
    with reading(path, what, remedy):
        content = read_json(path)
        got = content.get("format") if isinstance(content, dict) else type(content).__name__
        if got != form:
            raise InputError(f"expected {form} in {path}, got {got!r}; {remedy}")
        return dict(content)


def sha256_of(path: Path | str) -> str:
    """SHA-256 of a file's content, hexadecimal; empty if it can't be read."""
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):  # ValueError: a name with a null character
        return ""
