"""Progress of long work, reported without knowing who listens."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """A listener for progress; the command line shows a bar with the time left."""

    def __call__(self, done: float, total: float, what: str) -> None:
        """Take note that ``done`` of ``total`` units of the step ``what`` are finished."""


def silent(done: float, total: float, what: str) -> None:
    """The listener that shows nothing: the default of every function."""


def named(progress: Progress, name: str) -> Progress:
    """The same listener, with another name for the step."""

    def listener(done: float, total: float, what: str) -> None:
        progress(done, total, name)

    return listener
