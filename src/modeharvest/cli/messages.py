"""Common parts of commands: arguments; progress bars, warnings, errors on stderr; exit codes."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from modeharvest.util.errors import InputError, MissingDependencyError
from modeharvest.util.progress import Progress

CaseName = Annotated[
    str,
    typer.Argument(
        metavar="CASE", help="A shipped case ('modeharvest cases' lists them) or a TOML file."
    ),
]


def _folder(text: str | None) -> Path | None:
    """Path of a folder that will be written to; InputError if it can't be a folder."""
    if text is None:
        return None
    if not text:
        raise InputError("expected a folder, got an empty name; '.' is the current one")
    from modeharvest.util.files import require_no_file  # here, so that --help is fast

    require_no_file(Path(text))
    return Path(text)


def folder_option(name: str, about: str) -> Any:
    """Make an option that names a folder to write to, which is checked before any work begins."""
    return typer.Option(name, help=about, metavar="DIR", parser=str, callback=_folder)


OutFolder = Annotated[Path, folder_option("--out", "Folder for the results.")]
SolutionFile = Annotated[
    Path | None,
    typer.Option(
        "--solution", help="Use this solution (HDF5) instead of DIR/solution.h5.", metavar="FILE"
    ),
]

_NOT_KEPT = "every time: their folder can't be written to; set NUMBA_CACHE_DIR to one that can"


class ProgressBars(RichProgress):
    """A progress listener that draws bars while it is open; use it in a ``with`` block."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            TextColumn("{task.description:<28}", markup=False),  # may contain a file's name
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
        )
        self._steps: dict[str, TaskID] = {}
        self.disable = True  # until the first step, or an empty line would be drawn

    def __call__(self, done: float, total: float, what: str) -> None:
        """Show the progress of the step ``what``; a new step completes those before it."""
        if what not in self._steps:
            self.disable = False
            self.start()
            for task in self.tasks:
                self.update(task.id, completed=task.total)
            self._steps[what] = self.add_task(what, total=total)
        self.update(self._steps[what], completed=min(done, total), total=total)


@contextmanager
def compilation_announced(console: Console) -> Iterator[None]:
    """Print one line when the first kernel is compiled that is not in the cache."""
    from numba.core import event  # here, so that --help is fast

    from modeharvest.util.compiled import is_cached

    class Notice(event.Listener):
        announced = False

        def on_start(self, event: Any) -> None:
            if not self.announced:
                self.announced = True
                kept = "once; they are kept on disk" if is_cached() else _NOT_KEPT
                console.print(f"compiling kernels for this machine: some seconds, {kept}")

        def on_end(self, event: Any) -> None:
            pass

    compiler: Any = event  # has no type hints
    with compiler.install_listener("numba:compile", Notice()):
        yield


console = Console(stderr=True)

UNUSABLE, FAULT, INTERRUPTED, UNREAD = 2, 70, 130, 1
"""Exit codes: unusable input or environment; a fault in the program (EX_SOFTWARE of sysexits.h);
Ctrl-C; a closed pipe that can't take the output (as in ``| head``)."""

was_interrupted = False
"""Set by Ctrl-C, because its exception can get lost: Python drops it in destructors and callbacks,
numba while it searches for a kernel, and PETSc replaces it by another exception."""


UsageError: type[Any] = typer.BadParameter.__bases__[0]
"""Click's class of usage errors, of which newer versions of typer contain a copy."""


class InterruptionError(Exception):
    """Replaces the KeyboardInterrupt of Ctrl-C, which typer would handle itself."""


def end_if_interrupted() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was pressed, in case its exception got lost."""
    if was_interrupted:
        raise KeyboardInterrupt


@contextmanager
def bars() -> Iterator[Progress]:
    """Show progress bars in a ``with`` block; after Ctrl-C the next step ends the block."""
    with ProgressBars(console) as drawn, compilation_announced(console):

        def listener(done: float, total: float, what: str) -> None:
            end_if_interrupted()
            drawn(done, total, what)

        yield listener


def warn(message: str) -> None:
    """Print a warning to stderr."""
    console.print(f"[yellow]warning:[/yellow] {escape(message)}", highlight=False)


def refuse(reasons: Mapping[str, str]) -> None:
    """Print why files were not used, and exit with code 2 if there are any."""
    for why in reasons.values():
        report_error(InputError(why))
    if reasons:
        raise typer.Exit(UNUSABLE)


def report_error(error: BaseException) -> int:
    """Print in one line why a command ended early; returns the exit code.

    Tracebacks are not printed: those of unexpected errors are written to a file.
    """
    if isinstance(error, BrokenPipeError):
        return UNREAD
    if was_interrupted or isinstance(error, (InterruptionError, KeyboardInterrupt)):
        _print("interrupted; run the same command again to continue where it stopped")
        return INTERRUPTED
    if line := _line(error):
        _print(f"[red]error:[/red] {escape(line)}")
    return UNUSABLE if isinstance(error, _FORESEEN) else FAULT


_FORESEEN = (
    InputError, UsageError, MissingDependencyError, MemoryError, OSError, UnicodeError,
    RecursionError,
)  # fmt: skip


def _print(line: str) -> None:
    with suppress(OSError):  # stderr may be full or closed
        console.print(line, highlight=False, soft_wrap=True)


def _line(error: BaseException) -> str:
    """An error in one line; empty if everything was printed already."""
    if isinstance(error, UsageError):
        return _usage(error)
    if isinstance(error, (InputError, MissingDependencyError)):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return "the memory is full; take larger pixels or elements, or fewer unknowns"
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"the operating system refuses: {where}{error.strerror}"
    what = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(error, _FORESEEN):
        return what
    return f"a fault in modeharvest itself ({what:.200}); please report it with {_log(error)}"


def _usage(error: Any) -> str:
    """A usage error in one line; empty if no command was given, because help is printed then."""
    what, where = " ".join(error.format_message().split()), error.ctx.command_path
    if (param := getattr(error, "param", None)) is not None:
        option = param.opts[0] if param.param_type_name == "option" else ""
        if not error.message:
            name = " ".join(filter(None, (param.param_type_name, option, param.metavar)))
            what = f"missing {name}: {param.help}"
        elif hasattr(error.__cause__, "errors"):  # of pydantic
            first = error.__cause__.errors()[0]
            expected = first["msg"].partition(",")[0].replace("Input should be", "expected")
            what = f"{option or param.metavar}: {expected}, got {first['input']!r}"
    if near := getattr(error, "possibilities", None):
        what = f"{error.message}. Did you mean {' or '.join(sorted(near))}?"
    stop = "" if what.endswith(("?", ".")) else "."
    return what and f"{where}: {what[0].lower()}{what[1:]}{stop} See {where} --help"


def _log(error: BaseException) -> str:
    """Write an error's traceback to a new file; returns its name, or if this fails, the text."""
    text = f"{' '.join(map(repr, sys.argv))}\n{sys.version}\n\n"
    text += "".join(traceback.format_exception(error))
    try:
        handle, name = tempfile.mkstemp(".log", "modeharvest-")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    except OSError:
        return f"what could be written to no file: {text}"
    return name
