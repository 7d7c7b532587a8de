"""Files that others made: whatever is wrong with one is told in one line that names it.

The libraries that read formats raise anything for a damaged file. What a reader does with them
stands in a ``with reading(...)`` block, which turns all of it into InputError, and HDF5 is opened
by :func:`open_hdf5`, which refuses files that would read others or fill the memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from modeharvest.errors import InputError
from modeharvest.memory import require_memory


@contextmanager
def reading(path: Path | str, what: str, remedy: str = "make it again") -> Iterator[Path]:
    """Turn whatever ends the block into InputError; nothing but reading the file belongs in it.

    Parameters
    ----------
    path
        The file.
    what
        Is expected there: "a solution (HDF5)".
    remedy
        What to do.

    Raises
    ------
    InputError
        If there is no such file, it is a folder, or the block raises. What the block itself says
        is kept, behind the file's name.
    """
    path = Path(path)
    require_file(path, what, remedy)
    try:
        yield path
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # every format and library has exceptions of its own
        raise InputError(f"expected {what} at {path}, got: {reason(error)}; {remedy}") from error


def require_file(path: Path, what: str, remedy: str) -> None:
    """Raise InputError unless there is a file."""
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise InputError(f"expected {what} at {path}, found {found}; {remedy}")
    if path.stat().st_size == 0:
        raise InputError(
            f"expected {what} at {path}, got: an empty file, cut short at 0 bytes; {remedy}"
        )


def reason(error: BaseException) -> str:
    """Why a library gave up, in one line."""
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
    """An HDF5 file to read from; see :func:`reading` for what happens to errors.

    Parameters
    ----------
    path, what, remedy
        As there.
    form
        What its attribute ``format`` has to say; None for any.

    Raises
    ------
    InputError
        Also if the file is of another format, reaches into other files (external storage, external
        links, virtual data), or holds more than there is memory for: a file of a few hundred bytes
        can hand out any other one, and declare any size.
    """
    with reading(path, what, remedy) as path, h5py.File(path, "r") as file:
        if form is not None and (got := file.attrs.get("format")) != form:
            raise InputError(f"expected a {form} file at {path}, got format {got!r}; {remedy}")
        _require_self_contained(file)
        yield file


def _require_self_contained(file: h5py.File) -> None:
    total = 0.0

    def look_at_link(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            raise InputError(
                f"expected all data in the file itself, got {name!r}, which is in another file: "
                f"{link.filename}; copy it in (h5repack, h5copy)"
            )

    def look_at_object(name: str, thing: Any) -> None:
        nonlocal total
        if not isinstance(thing, h5py.Dataset):
            return
        if thing.external or thing.is_virtual:
            raise InputError(
                f"expected all data in the file itself, got {name!r}, whose numbers are in another "
                "file; copy them in (h5repack)"
            )
        total += thing.nbytes

    file.visititems_links(look_at_link)
    file.visititems(look_at_object)
    require_memory(total, "a file", "take a part of it")
