"""Work in stages recorded in a folder, so that finished stages are not repeated.

::

    stages.json     for each finished stage: its key (the digest of all that its outcome depends
                    on), and the size and the SHA-256 of every file that it wrote
    timings.json    durations of the stages [s]; the only file that differs from run to run
    .lock           the process that works in the folder, as long as it does

Every key includes a digest of the package's code, which may change without the version number.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache, lru_cache, partial
from importlib import resources
from importlib.metadata import version
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Generic, TypeVar

import psutil

from modeharvest.util import RELEASE
from modeharvest.util.errors import InputError, WriteError
from modeharvest.util.files import make_folder, read_json, remove_orphans, sha256_of, write_json
from modeharvest.util.machine import on_first
from modeharvest.util.progress import Progress, silent
from modeharvest.util.typed import to_plain

_SOURCES = (".py", ".html", ".css", ".toml")
C = TypeVar("C")
R = TypeVar("R")


def versions(*libraries: str) -> dict[str, str]:
    """Versions of modeharvest, of Python, and of installed libraries, by their names."""
    own = {"modeharvest": RELEASE, "python": platform.python_version()}
    return own | {name: version(name) for name in libraries}


@cache
def source_digest(*folders: str) -> str:
    """SHA-256 of the package's code, hexadecimal; it may change without the version number.

    ``folders`` of the package to include, such as "fem" and "imaging"; all if none is named. The
    modules at its root and in util are always included. Imports between folders go one way: work
    done in a folder can depend only on that folder and those below it.
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
    """Code and templates in a folder of the package and below; util is always included."""
    for entry in folder.iterdir():
        if entry.is_dir():
            if entry.name != "__pycache__" and (not only or entry.name in ("util", *only)):
                yield from _sources(entry, f"{name}{entry.name}/", ())
        elif entry.name.endswith(_SOURCES):
            yield f"{name}{entry.name}", entry


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

RECORD, TIMINGS, LOCK = "stages.json", "timings.json", ".lock"


class Stages:
    """The stages of one folder, which is made if it does not exist."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def is_finished(self, name: str, key: str) -> bool:
        """Whether a stage was finished with this key and its files are unchanged since."""
        stage = self._record().get(name)
        return stage is not None and stage.get("key") == key and all(
            _is_whole(self.folder / path, entry) for path, entry in stage["files"].items()
        )  # fmt: skip

    def do(
        self, name: str, key: str, work: Callable[[], Iterable[Path]], *, collective: bool = False
    ) -> None:
        """Do the work unless it was finished with the same key and its files are unchanged.

        ``key``: see :func:`stage_key`. ``work`` writes files in the folder and returns their paths.
        ``collective``: under mpirun all ranks work; otherwise rank 0 works and the others wait.
        Raises InputError if files can't be written or another process works in the folder, and any
        exception of the work.
        """
        if on_first(lambda: self.is_finished(name, key)):
            return
        with exclusive(self.folder), self.timed(name):
            on_first(lambda: self._forget(name))
            files = list(work() if collective else on_first(lambda: list(work())))
            on_first(lambda: self._remember(name, key, files))

    def require_whole(self, path: Path, advice: str) -> None:
        """Raise InputError if a file has changed since its stage wrote it.

        A file that no stage wrote is accepted.
        """
        name = path.relative_to(self.folder).as_posix()
        for stage in self._record().values():
            if name in stage["files"] and not _is_whole(path, stage["files"][name]):
                raise InputError(
                    f"expected {path} as {RECORD} has its SHA-256, got another file or none; "
                    f"{advice}"
                )

    @property
    def timings(self) -> dict[str, float]:
        """Durations of the stages [s]; empty if there is no record."""
        return dict(_table(self.folder / TIMINGS))

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Record how long the work of a stage takes [s]."""
        begin = time.perf_counter()
        yield
        seconds = {name: time.perf_counter() - begin}
        on_first(lambda: write_json(self.folder / TIMINGS, self.timings | seconds))

    def _record(self) -> dict[str, dict[str, Any]]:
        """The finished stages; invalid entries, as of a damaged file, are left out."""
        every = _table(self.folder / RECORD).items()
        return {n: s for n, s in every if isinstance(s, dict) and isinstance(s.get("files"), dict)}

    def _forget(self, name: str) -> None:
        """Remove a stage's record, then its files, which belong to other inputs."""
        record = self._record()
        if (stage := record.pop(name, None)) is None:
            return
        write_json(self.folder / RECORD, record)
        for path in map(Path, stage["files"]):
            if not path.is_absolute() and ".." not in path.parts:  # whatever the record says
                (self.folder / path).unlink(missing_ok=True)

    def _remember(self, name: str, key: str, files: Iterable[Path]) -> None:
        """Record that a stage is finished."""
        entries = {
            path.relative_to(self.folder).as_posix():
            {"bytes": path.stat().st_size, "sha256": sha256_of(path)} for path in files
        }  # fmt: skip
        record = {**self._record(), name: {"key": key, "files": entries}}
        write_json(self.folder / RECORD, dict(sorted(record.items())))


class Kept(Mapping[str, R]):
    """Results of stages, by their names: read when accessed; only the last one stays in memory.

    Thousands of images need no more memory than two.
    """

    def __init__(self) -> None:
        self._read: dict[str, Callable[[], R]] = {}
        self._kept = lru_cache(1)(lambda name: self._read[name]())

    def add(self, name: str, read: Callable[[], R]) -> None:
        """Append a result; ``read`` is the function that reads it."""
        self._read[name] = read

    def __getitem__(self, name: str) -> R:
        return self._kept(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._read)

    def __len__(self) -> int:
        return len(self._read)


def command_line(*words: object) -> str:
    """A command of the program, to be typed again: words with spaces are quoted."""
    return shlex.join(["modeharvest", *map(str, words)])


@dataclass(frozen=True)
class StagedRun(Stages, Generic[C]):
    """Base of all kinds of runs: a case, a folder, and stages that are not repeated."""

    case: C
    folder: Path
    """The folder of the results; it is made if it does not exist."""
    progress: Progress = silent

    def do_in_turn(
        self,
        what: str,
        keys: Mapping[str, str],
        records: Path,
        work: Callable[[str, tuple[str, R] | None], tuple[Sequence[Path], dict[str, Any]]],
        read: Callable[[str, dict[str, Any]], R],
    ) -> tuple[Kept[R], dict[str, str]]:
        """One stage for each of several images, each starting from the last successful result.

        ``keys``: stage keys by image name. ``work`` gets a name, and name and result of the last
        success (or None); it writes files and returns them with the content of ``NAME_start.json``
        in the folder ``records``. ``read`` reads a result. Returns results, and messages of
        failures: an InputError is recorded as ``failed``, unless files couldn't be written.
        """
        found: Kept[R] = Kept()
        failed: dict[str, str] = {}

        def one(name: str, path: Path) -> Sequence[Path]:
            try:
                last = next(reversed(tuple(found)), None)
                files, about = work(name, None if last is None else (last, found[last]))
            except WriteError:
                raise
            except InputError as error:
                files, about = (), {"failed": str(error)}
            write_json(path, to_plain({"failed": "", **about}))
            return *files, path

        for name, key in keys.items():
            path = records / f"{name}_start.json"
            self.do(f"{what} {name}", key, partial(one, name, path))
            about = read_json(path)
            if about["failed"]:
                failed[name] = about["failed"]
            else:
                found.add(name, partial(read, name, about))
        return found, failed


def stage_key(content: object, *folders: str) -> str:
    """The digest of all that a stage's outcome depends on.

    ``content``: plain values (options, digests of files, keys of other stages). ``folders`` of the
    package whose code is included: see :func:`source_digest`.
    """
    return digest([source_digest(*folders), content])


def digest(content: object) -> str:
    """A short hash of plain content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _table(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty if the file is missing or damaged."""
    try:
        content = read_json(path)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}


def _is_whole(path: Path, entry: object) -> bool:
    """Whether a file is as recorded; compares its size first, then its SHA-256."""
    if not isinstance(entry, dict) or not path.is_file():
        return False
    return path.stat().st_size == entry.get("bytes") and sha256_of(path) == entry.get("sha256")


# -- one folder, one process -------------------------------------------------------------

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)
_READ_ONLY = (errno.EACCES, errno.EPERM, errno.EROFS)
_of_this_thread = threading.local()


@contextmanager
def exclusive(folder: Path | str) -> Iterator[None]:
    """Lock a folder for this process; the same thread may lock it again within the block.

    The operating system releases the lock when its holder ends, however it ends; folders made for
    it in which nothing was written are removed. On file systems
    without locks (some network drives, Windows) the file ``.lock`` alone decides; it is ignored
    only if it names a process of this machine that has ended. Where nothing can be written nothing
    is locked. Under mpirun rank 0 holds the lock for all. Raises InputError if another process
    holds it (which, where and since when), or the file can't be written.
    """
    folder = Path(folder).resolve()
    mine: set[Path] = _of_this_thread.__dict__.setdefault("folders", set())
    if folder in mine:
        yield
        return
    lock = _Lock(folder / LOCK)
    on_first(lock.acquire)
    mine.add(folder)
    try:
        yield
    finally:
        mine.discard(folder)
        lock.release()


class _Lock:
    """A file that is locked while a process works in its folder, and names that process."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: int | None = None
        self._made: list[Path] = []

    def acquire(self) -> None:
        try:
            self._made = [folder for folder in self._path.parents if not folder.exists()]
            make_folder(self._path.parent)
            while self._file is None:
                self._file = self._locked()
            remove_orphans(self._path.parent)
        except OSError as error:
            if error.errno not in _READ_ONLY:
                reason = error.strerror or error
                raise InputError(f"could not write {self._path}: {reason}") from error

    def release(self) -> None:
        if self._file is None:
            return
        if os.name != "posix":  # where an open file can't be removed
            os.close(self._file)
        with suppress(OSError):  # it may have been removed by hand
            self._path.unlink()
        if os.name == "posix":  # last: opening this name now makes a new file
            os.close(self._file)
        self._file = None
        with suppress(OSError):  # where nothing was written, no folder is left
            for folder in self._made:
                folder.rmdir()

    def _locked(self) -> int | None:
        """The file, opened and locked; None if its holder has just removed it."""
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._require_free(file)
            if not os.path.samestat(os.fstat(file), self._path.stat()):
                raise FileNotFoundError
        except BaseException as error:
            os.close(file)
            if isinstance(error, FileNotFoundError):
                return None
            raise
        with suppress(OSError):  # a full disk: the lock holds nevertheless
            os.truncate(file, 0)
            os.write(file, json.dumps(_this_process()).encode())
        return file

    def _require_free(self, file: int) -> None:
        """Lock the file; InputError if another process has locked it."""
        holder = _table(self._path)
        try:
            if fcntl is None:
                raise OSError(errno.ENOSYS, "no locks")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(self._occupied(holder)) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            if holder and not _is_gone(holder):
                reason = f"{self._occupied(holder)}; if it is gone, remove {self._path}"
                raise InputError(reason) from None

    def _occupied(self, holder: dict[str, Any]) -> str:
        by = "another process"
        if holder:
            about = {name: holder.get(name, "?") for name in _this_process()}
            by = "process {process} on {host}, since {since}: {command}".format_map(about)
        return (
            f"expected {self._path.parent} for this process alone, but it is used by {by}; wait "
            "until that ends, or take another folder"
        )


def _this_process() -> dict[str, Any]:
    """Description of this process, as the holder of a lock."""
    return {
        "process": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.now().isoformat(" ", "seconds"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def _is_gone(holder: dict[str, Any]) -> bool:
    """Whether a holder was a process of this machine that has ended."""
    process, is_here = holder.get("process"), holder.get("host") == socket.gethostname()
    return is_here and isinstance(process, int) and not psutil.pid_exists(process)
