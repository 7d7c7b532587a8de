"""The root of the command line: registers all commands, and handles all their errors."""

from __future__ import annotations

import inspect
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand

from modeharvest.cli import benchmark, commands, design, homogenization, identification, messages
from modeharvest.cli.demo import ABOUT, EXIT_CODES, FIRST, demo
from modeharvest.cli.doctor import doctor
from modeharvest.cli.fields import animate, export, gauges
from modeharvest.cli.sharing import COMMANDS, share
from modeharvest.util import version as own_version
from modeharvest.util.machine import is_first

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


app = typer.Typer(
    help=ABOUT,
    epilog=EXIT_CODES,
    invoke_without_command=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
benchmark_app = typer.Typer(
    help="Make image sets for any DIC code, and grade what it measures.", no_args_is_help=True
)

_FAMILIES: dict[str, tuple[Callable[..., None], ...]] = {
    "A virtual experiment": (
        commands.run, commands.fem, commands.image, commands.correlate, commands.validate,
    ),
    "An infinite lattice": (commands.bloch, commands.modes),
    "Homogenization with modes": (homogenization.homogenize,),
    "Photographs of a test": (commands.harvest, commands.measure, identification.identify),
    "Measured fields": (gauges, animate, export),
    "Accuracy of a measurement": (design.design, commands.study, benchmark.score),
    "Getting started, and sharing": (demo, doctor, commands.cases, share),
}  # fmt: skip


class _Command(TyperCommand):
    """A command whose interruptions and errors are handled here instead of by typer."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except messages.UsageError as error:
            error.ctx = ctx  # not set if an option lacks its value
            raise

    def invoke(self, ctx: Any) -> None:
        try:
            super().invoke(ctx)
            messages.end_if_interrupted()
        except KeyboardInterrupt as error:
            raise messages.InterruptionError from error


def _help(command: Callable[..., None]) -> str:
    """Help text of a command without the source's line breaks, which typer would keep."""
    paragraphs = inspect.cleandoc(command.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(text.split()) for text in paragraphs)


for family, members in _FAMILIES.items():
    for command in members:
        app.command(cls=_Command, help=_help(command), rich_help_panel=family)(command)
for command in (benchmark.make, benchmark.star, benchmark.resolution, *COMMANDS):
    benchmark_app.command(cls=_Command, help=_help(command))(command)
app.add_typer(benchmark_app, name="benchmark", rich_help_panel="Accuracy of a measurement")


def _version(wanted: bool) -> None:
    if wanted:
        print(own_version())
        raise typer.Exit


@app.callback()
def _common(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(FIRST.format(version=own_version()))


def main() -> None:
    """Entry point of the ``modeharvest`` command."""
    _open_streams()
    with _interruptions_remembered():
        if is_first():
            _run()
        else:  # under mpirun only rank 0 prints
            messages.console.quiet = True
            with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
                _run()


def _run() -> None:
    try:
        try:
            sys.exit(app(prog_name="modeharvest", standalone_mode=False) or 0)
        finally:
            sys.stdout.flush()  # raises an error now if the disk is full
    except SystemExit:
        raise
    except BaseException as error:
        _drop_output()
        sys.exit(messages.report_error(error))


def _open_streams() -> None:
    """Open standard streams that the caller has closed; escape characters they can't encode.

    Otherwise the next file opened would get a closed stream's number, and libraries' output.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        pass
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        if hasattr(stream := getattr(sys, name), "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _drop_output() -> None:
    """Discard output that a full or closed stdout can't take, as it would fail again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _interruptions_remembered() -> Iterator[None]:
    """Record Ctrl-C, unless the caller ignores it, as shells do for background processes."""
    messages.was_interrupted = False
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    hook = sys.unraisablehook
    signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _unless_interrupted
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = hook


def _interrupt(number: int, frame: object) -> NoReturn:
    """Record Ctrl-C and raise its exception, which may get lost: see ``end_if_interrupted``."""
    messages.was_interrupted = True
    raise KeyboardInterrupt


def _unless_interrupted(ignored: UnraisableHookArgs) -> None:
    """Print errors of destructors and callbacks, except for Ctrl-C, which was recorded."""
    if not issubclass(ignored.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(ignored)
