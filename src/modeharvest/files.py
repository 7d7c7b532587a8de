"""Files that are either whole or absent: written under a temporary name, then renamed."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from modeharvest.errors import InputError
from modeharvest.reading import reading

_TEMPORARY = re.compile(r"\..+\.(\d+)\.part(\.[^.]*)?")
"""Names that :func:`atomic` gives, with the process in them."""


@contextmanager
def atomic(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` if the block succeeds.

    Whatever ends the block early (an exception, a full disk, Ctrl-C) removes the temporary
    file, so a reader never sees half a file; what a killed process left is removed by the next
    that writes in the same folder. File and folder reach the disk before the block ends, so that a
    power cut leaves no empty file under a finished name. The suffix is kept, because libraries
    choose formats by it.

    Raises
    ------
    InputError
        If the operating system refuses the write (disk full, no permission).
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
        raise InputError(f"could not write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # it may never have been there, nor its folder
            temporary.unlink(missing_ok=True)


def _flush(path: Path, mode: int) -> None:
    """Have the disk itself store a file or a folder's names."""
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_orphans(folder: Path | str) -> None:
    """Remove temporary files in a folder whose process is no more."""
    for name in os.listdir(folder):
        orphan = _TEMPORARY.fullmatch(name)
        if orphan and not may_be_alive(int(orphan[1])):
            Path(folder, name).unlink(missing_ok=True)


def may_be_alive(process: int) -> bool:
    """Whether this machine may have a process of that id; where it can't tell, it says yes."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)  # sends nothing
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's; no id at all
        return True
    return True


def make_folder(folder: Path | str) -> None:
    """Make a folder, and those above it, where they are not there yet.

    Raises
    ------
    InputError
        If there is a file in its place, or in that of one above it.
    OSError
        If the operating system refuses it for another reason.
    """
    folder = Path(folder)
    require_no_file(folder)
    folder.mkdir(parents=True, exist_ok=True)


def require_no_file(folder: Path) -> None:
    """Check that a folder is there or can be: that no file is in its place, or above it.

    Raises
    ------
    InputError
        If one is.
    """
    for place in (folder, *folder.parents):
        if os.path.isdir(place):
            return
        if os.path.lexists(place):
            raise InputError(
                f"expected a folder at {place}, found a file; remove it, or take another folder"
            )


def require_writable(folder: Path | str) -> None:
    """Make ``folder`` and check that files can be written there, before long work begins.

    Raises
    ------
    InputError
        If not.
    """
    with atomic(Path(folder) / "writable") as temporary:
        temporary.touch()
    (Path(folder) / "writable").unlink()


@contextmanager
def atomic_hdf5(path: Path | str) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that appears at ``path`` when the block has succeeded.

    It is made in memory first: on a full disk HDF5 can't close a file of its own and complains
    about it until the program ends.
    """
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    with atomic(path) as temporary:
        # Not its buffer: memory that is lent to a failed write can't be freed.
        temporary.write_bytes(memory.getvalue())


def copy_whole(source: Path | str, path: Path | str) -> None:
    """Copy a file, atomically."""
    with atomic(path) as temporary:
        shutil.copyfile(source, temporary)


def write_json(path: Path | str, content: Any) -> None:
    """Write ``content`` as indented JSON, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", "utf-8")


def read_json(path: Path | str) -> Any:
    """Read JSON; raises InputError if the file is missing, cut short or nested too deeply."""
    with reading(path, "a JSON file"):
        return json.loads(Path(path).read_text("utf-8-sig"))


def read_record(path: Path | str, form: str, what: str, remedy: str) -> dict[str, Any]:
    """Read a JSON object whose ``format`` is ``form``.

    Parameters
    ----------
    path
        The file.
    form
        What its key ``format`` has to say.
    what, remedy
        For the message: what is expected there, and what to do.

    Raises
    ------
    InputError
        If it is missing, damaged, or of another format.
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
    except OSError:
        return ""
