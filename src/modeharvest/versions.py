"""Which software made a result: what belongs into every summary, and into every key."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator
from functools import cache
from importlib import resources
from importlib.metadata import version
from importlib.resources.abc import Traversable

from modeharvest import __version__

_SOURCES = (".py", ".html", ".css")


def versions(*libraries: str) -> dict[str, str]:
    """Versions of modeharvest, of Python, and of installed libraries, by their names."""
    own = {"modeharvest": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in libraries}


@cache
def source_digest(*folders: str) -> str:
    """SHA-256 of the package's own code, hexadecimal: a version's number lags behind it.

    Parameters
    ----------
    folders
        Folders of the package that count, such as "fem" and "imaging", besides the modules at
        its root, which always do; all of them if none is named. Since imports go one way, those
        up to the one that does the work are all that it can depend on.
    """
    found = hashlib.sha256()
    root = resources.files("modeharvest")
    for name, file in sorted(_sources(root, "", folders), key=lambda source: source[0]):
        content = hashlib.sha256(file.read_bytes()).hexdigest()
        found.update(f"{name} {content}\n".encode())
    return found.hexdigest()


def _sources(
    folder: Traversable, name: str, only: tuple[str, ...]
) -> Iterator[tuple[str, Traversable]]:
    """Code and templates in a folder of the package and below, by their names."""
    for entry in folder.iterdir():
        if entry.is_dir():
            if entry.name != "__pycache__" and (not only or entry.name in only):
                yield from _sources(entry, f"{name}{entry.name}/", ())
        elif entry.name.endswith(_SOURCES):
            yield f"{name}{entry.name}", entry
