"""Progress of long work, reported to a listener that the caller chooses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """A listener for progress; that of the command line shows a bar and the time left."""

    def __call__(self, done: float, total: float, what: str) -> None:
        """Report that ``done`` of ``total`` units of the step ``what`` are finished."""


def silent(done: float, total: float, what: str) -> None:
    """The listener that shows nothing: the default of every function."""


def named(progress: Progress, name: str) -> Progress:
    """The same listener, with another name for the step."""

    def listener(done: float, total: float, what: str) -> None:
        progress(done, total, name)

    return listener


def counted(items: Sequence[T], progress: Progress, what: str) -> Iterator[T]:
    """Iterate over the items and report the progress as the step ``what``."""
    for done, item in enumerate(items):
        progress(done, len(items), what)
        yield item
    progress(1, 1, what)
