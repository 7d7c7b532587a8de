"""What goes to stderr: progress bars, warnings, errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape

from modeharvest.console import ProgressBars, compilation_announced

console = Console(stderr=True)


class InterruptionError(Exception):
    """Ctrl-C, under a name that the command-line library does not take for its own."""


@contextmanager
def bars() -> Iterator[ProgressBars]:
    """Progress bars for the work of a ``with`` block, which Ctrl-C ends.

    Raises
    ------
    InterruptionError
        In place of KeyboardInterrupt.
    """
    try:
        with ProgressBars(console) as drawn, compilation_announced(console):
            yield drawn
    except KeyboardInterrupt as error:
        raise InterruptionError from error


def warn(message: str) -> None:
    """Print a warning."""
    console.print(f"[yellow]warning:[/yellow] {escape(message)}", highlight=False)


def tell_error(error: Exception) -> None:
    """Print an error's message in one line."""
    message = " ".join(str(error).split())
    console.print(f"[red]error:[/red] {escape(message)}", highlight=False, soft_wrap=True)
