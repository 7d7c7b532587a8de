"""Commands run again and again, disturbed each time, until they succeed; in one way after another.

Each line of stdin is a JSON list [WAYS, OUT, COMMAND]. ``WAYS`` is a list of [folder, way, number,
...], each begun in its own folder::

    [FOLDER, "kill", SEED]          killed while it writes a file; undisturbed with a seed of 0
    [FOLDER, "disk", BYTES, STEP]   on a disk of BYTES, and STEP more each time

``OUT`` is what the command, a list of words, leaves there. Prints a JSON object for each attempt:
``folder``, ``code``, its exit code or minus the signal that ended it, ``message``, what it wrote to
stderr, and ``files``, the digests of what is there afterwards; and after the last one an exit code.

Each attempt is a fork of this process, which has imported what takes long and computed nothing.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba

NO_DISK = 77
_MODULES = (
    "modeharvest.runs.experiment",
    "modeharvest.runs.photographs.pipeline",
    "modeharvest.report.photographs",
    "modeharvest.runs.study",
    "modeharvest.cli.root",
    "distributed",
    "gmsh",
)
_NEW_USER, _NEW_MOUNTS, _REMOUNT = 0x10000000, 0x00020000, 0x20
_ATTEMPTS, _LONGEST_S = 60, 600
_DANGER = 0.3
"""Probability to be killed at a write."""


def deadly(seed: int, is_armed: bool) -> None:
    """Let this process be killed amid a write, before or after the rename, within a stage.

    That is the first it works on if it ``is_armed``, or else the one after the first that it
    finishes. It never gets as far as to take down that it is finished.
    """
    rng, replace = random.Random(seed), os.replace

    def killing(source: Any, target: Any) -> None:
        nonlocal is_armed
        is_end = Path(target).name in ("stages.json", "timings.json") and keys(source) > keys(
            target
        )
        if not is_armed or not (is_end or rng.random() < _DANGER):
            replace(source, target)
            is_armed = is_armed or (is_end and Path(target).name == "timings.json")
            return
        moment = rng.choice(("amid", "before") if is_end else ("amid", "before", "after"))
        if moment == "amid":
            os.truncate(source, os.path.getsize(source) // 2)
        elif moment == "after":
            replace(source, target)
        os.kill(os.getpid(), signal.SIGKILL)

    os.replace = killing  # type: ignore[assignment]


def keys(path: Any) -> set[str]:
    """Of a JSON object; none of no file."""
    return set(json.loads(Path(path).read_text())) if Path(path).exists() else set()


class Disk:
    """A file system in memory that nobody else sees, over a folder."""

    def __init__(self, folder: Path) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._folder = folder
        user, group = os.getuid(), os.getgid()
        self._require(self._libc.unshare(_NEW_USER | _NEW_MOUNTS))
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
        folder.mkdir(parents=True)
        self._mount(4096, 0)

    def resize(self, size: int) -> None:
        self._mount(size, _REMOUNT)

    def _mount(self, size: int, flags: int) -> None:
        options = f"size={size}".encode()
        where = os.fsencode(self._folder)
        self._require(self._libc.mount(b"none", where, b"tmpfs", flags, options))

    def _require(self, answer: int) -> None:
        if answer:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def attempt(command: list[str], out: Path, prepare: Callable[[], None]) -> int:
    """Run the command once in a fork, and print what became of it."""
    from modeharvest.cli.root import main

    with tempfile.TemporaryFile() as message:
        child = os.fork()
        if child == 0:
            signal.alarm(_LONGEST_S)  # ends what hangs
            os.dup2(message.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            sys.argv = ["modeharvest", *command]
            prepare()
            try:
                main()
            except SystemExit as end:
                sys.stderr.flush()
                os._exit(int(end.code or 0))
            except BaseException:
                sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
            os._exit(1)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        message.seek(0)
        text = message.read().decode()
    made = {"folder": os.getcwd(), "code": code, "message": text, "files": digests(out)}
    print(json.dumps(made), flush=True)
    return code


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file in a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def disturb(out: Path, command: list[str], way: str, first: int, step: int = 0) -> None:
    """Attempt the command until it succeeds."""
    disk = None
    if way == "disk":
        try:
            disk = Disk(out)
        except OSError as error:
            print(error, file=sys.stderr)
            sys.exit(NO_DISK)
    for number in range(_ATTEMPTS):
        prepare: Callable[[], None] = int  # does nothing
        if disk is not None:
            disk.resize(first + number * step)
        elif first:
            prepare = partial(deadly, 1000 * first + number, number == 0)
        code = attempt(command, out, prepare)
        if code != (-signal.SIGKILL if disk is None else 2):
            return
    sys.exit("it never succeeded")


def disturb_all(ways: list[list[Any]], out: str, command: list[str]) -> int:
    """Each way in a fork, since a disk of one's own is for good; the exit code of the first bad."""
    for folder, *way in ways:
        child = os.fork()
        if child == 0:
            os.chdir(folder)
            disturb(Path(out).absolute(), command, *way)
            sys.exit()
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code:
            return code
    return 0


def main() -> None:
    for module in _MODULES:
        if importlib.util.find_spec(module) is not None:  # gmsh may be missing
            importlib.import_module(module)
    output = sys.modules["modeharvest.report.model.output"]
    output.draw_figures = lambda figures, _: {f.name: "" for f in figures}  # type: ignore[attr-defined]
    output.page_template()
    numba.njit(lambda x: x)(0)  # has the compiler import the rest of itself; begins no threads
    assert "mpi4py.MPI" not in sys.modules, "MPI, once begun, can't be forked"
    gc.freeze()  # no attempt looks through what is there already
    while line := sys.stdin.readline():
        print(disturb_all(*json.loads(line)), flush=True)


if __name__ == "__main__":
    main()
