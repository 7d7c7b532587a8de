"""Progress on a terminal: a bar for every step, with the time left."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

_NOT_KEPT = (
    "every time: neither the package's folder nor the home folder can be written to; "
    "NUMBA_CACHE_DIR may name one that can"
)


class ProgressBars:
    """A progress listener that draws bars while it is open; use it in a ``with`` block."""

    def __init__(self, console: Console) -> None:
        self._bars = RichProgress(
            TextColumn("{task.description:<28}", markup=False),  # it may name a user's file
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> ProgressBars:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def __call__(self, done: float, total: float, what: str) -> None:
        """Draw the step ``what``; a step that begins finishes the one before."""
        if what not in self._tasks:
            for task in self._bars.tasks:
                self._bars.update(task.id, completed=task.total)
            self._tasks[what] = self._bars.add_task(what, total=total)
        self._bars.update(self._tasks[what], completed=min(done, total), total=total)


@contextmanager
def compilation_announced(console: Console) -> Iterator[None]:
    """Say once, in one line, when a kernel has to be compiled because none is in the cache yet."""
    from numba.core import event  # here: --help needn't wait for it

    from modeharvest.imaging.compiled import are_kept

    class Notice(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if not self.told:
                self.told = True
                kept = "once; they are kept on disk" if are_kept() else _NOT_KEPT
                console.print(f"compiling kernels for this machine: some seconds, {kept}")

        def on_end(self, event: Any) -> None:
            pass

    compiler: Any = event  # which has no types
    notice = Notice()
    compiler.register("numba:compile", notice)
    try:
        yield
    finally:
        compiler.unregister("numba:compile", notice)
