"""Work in stages that a folder remembers, so that what is finished is not done again.

``stages.json`` holds for each finished stage a key, the digest of all that its outcome depends
on, and what it took in seconds.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modeharvest.errors import InputError
from modeharvest.files import read_json, require_writable, write_json
from modeharvest.ranks import agreed, is_first


@dataclass(frozen=True)
class Stages:
    """The stages of one folder.

    Parameters
    ----------
    folder
        Where; made if it does not exist.
    """

    folder: Path

    def finished(self, name: str) -> dict[str, Any]:
        """Key and seconds of a finished stage; empty without."""
        return dict(self._record().get(name, {}))

    def is_finished(self, name: str, key: str, *outputs: Path) -> bool:
        """Whether the stage was finished with this key and its files are there."""
        is_known = self.finished(name).get("key") == key
        return is_known and all(path.is_file() for path in outputs)

    def do(
        self,
        name: str,
        key: str,
        work: Callable[[], object],
        *outputs: Path,
        collective: bool = False,
    ) -> None:
        """Do the work unless it was finished with the same key and its files are there.

        Under mpirun, rank 0 does it alone and the others wait, unless it is ``collective``.
        """
        if agreed(self.is_finished(name, key, *outputs)):
            return
        begin = time.perf_counter()
        if is_first():
            require_writable(self.folder)
            for path in outputs:  # what is there is of other inputs: not to be taken for this
                path.unlink(missing_ok=True)
        if is_first() or collective:
            work()
        if is_first():
            record = {"key": key, "seconds": time.perf_counter() - begin}
            write_json(self.folder / "stages.json", {**self._record(), name: record})
        agreed(True)  # nobody reads the files before they are there

    def _record(self) -> dict[str, Any]:
        """What ``stages.json`` says; nothing if it is missing or damaged."""
        try:
            return dict(read_json(self.folder / "stages.json"))
        except (InputError, TypeError, ValueError):
            return {}


def digest(content: object) -> str:
    """A short text that differs for different plain content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path | str) -> str:
    """The same of a file's content; empty if it can't be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return ""
