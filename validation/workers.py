"""Who runs a campaign's cases: processes of this machine, or those of a dask scheduler.

Processes of this machine are forks of one server process, which imports what they need while the
parent imports dask: a campaign of short cases must not wait for its workers. Workers elsewhere
are asked at once whether they can do the work at all.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import Any
from uuid import uuid4

from modeharvest import __version__
from modeharvest.errors import InputError
from modeharvest.files import require_writable
from modeharvest.validation.case_run import named

_PATIENCE_S = 5.0
"""How long to wait for a scheduler that does not answer."""
_LIBRARIES = ("OMP", "MKL", "OPENBLAS")
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}
"""A worker has one thread: cores are shared out by cases. numba is told in each case, because
this stands in the parent's own environment for a while, where numba must not change its mind."""
_SERVED = ("distributed.nanny", "modeharvest.validation.case_run")
_FORKS = "forkserver" in multiprocessing.get_all_start_methods()


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    Parameters
    ----------
    count
        Processes on this machine.
    memory
        Most that each may take, e.g. "4GiB"; one that takes more is stopped and its case fails.
    scheduler
        Address of a running dask scheduler instead, e.g. "tcp://host:8786". Its workers must see
        the campaign's folder and have this version of modeharvest.
    """

    count: int = 2
    memory: str = "4GiB"
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"expected at least 1 worker, got {self.count}")
        from dask.utils import parse_bytes

        try:
            parse_bytes(self.memory)
        except (ValueError, TypeError) as error:
            raise InputError(
                f"expected a worker's memory like 4GiB or 500MB, got {self.memory!r}"
            ) from error

    def get_ready(self, function: str, folder: Path) -> None:
        """Have the workers ready by when they are needed; what takes long can be done meanwhile.

        Parameters
        ----------
        function
            "package.module:name" of what they will run.
        folder
            Where its results go.

        Raises
        ------
        InputError
            If the scheduler is not there, or its workers can't do the work.
        """
        if self.scheduler is None:
            _start_server(function)
            return
        with _client_of(self.scheduler) as client:
            _require_able(client, self.scheduler, function, folder)

    @contextmanager
    def client(self, function: str, folder: Path) -> Iterator[Any]:
        """A dask client of the workers, which end with it if they are of this machine.

        Parameters
        ----------
        function, folder
            As for :meth:`get_ready`.

        Raises
        ------
        InputError
            If the scheduler is not there, or its workers can't do the work.
        """
        if self.scheduler is None:
            with _processes(function, self.count, self.memory) as client:
                yield client
            return
        with _client_of(self.scheduler) as client:
            _require_able(client, self.scheduler, function, folder)
            yield client


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Variables set for a while; dask's own changes are undone with them."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Processes begun in here never hear Ctrl-C, which is for this one; it hears it afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_server(function: str) -> None:
    """Start the process that workers are forks of; it goes on importing what they need."""
    if not _FORKS:
        return
    modules = list(_SERVED)
    if "mpi4py.MPI" not in sys.modules:  # of this process, so the function's module has no MPI:
        modules.append(function.partition(":")[0])  # once begun, it can't be forked
    multiprocessing.get_context("forkserver").set_forkserver_preload(modules)
    resource_tracker.ensure_running()  # which the server needs and which lets interrupts through
    with _environment(_ONE_THREAD), _interrupts_held():
        forkserver.ensure_running()


@contextmanager
def _processes(function: str, count: int, memory: str) -> Iterator[Any]:
    """A client of processes of this machine."""
    _start_server(function)
    import dask
    from distributed import Client, LocalCluster

    options = {
        "distributed.worker.multiprocessing-method": "forkserver" if _FORKS else "spawn",
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
    }
    with (
        _environment({}),
        dask.config.set(options),
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=count,
            threads_per_worker=1,
            memory_limit=memory,
            dashboard_address=":0",  # any free port: campaigns may run side by side
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,  # type: ignore[no-untyped-call]
    ):
        yield client


@contextmanager
def _client_of(scheduler: str) -> Iterator[Any]:
    """A client of a scheduler that runs already."""
    from distributed import Client

    for logger in ("distributed", "distributed.client"):  # what fails is said in one line
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=_PATIENCE_S)  # type: ignore[no-untyped-call]
    except Exception as error:  # anything, where another kind of server answers
        raise InputError(
            f"expected a dask scheduler at {scheduler}, got no answer that is one's; start one "
            "with 'dask scheduler', or leave the address out"
        ) from error
    with client:
        yield client


def _require_able(client: Any, scheduler: str, function: str, folder: Path) -> None:
    """Recognise workers without the function, with another modeharvest, or without the folder."""
    require_writable(folder)
    mark = folder.resolve() / f".seen-{uuid4().hex}"
    mark.touch()
    try:
        answers = client.run(introduce, function, str(mark), on_error="return")
    finally:
        mark.unlink(missing_ok=True)
    if not answers:
        raise InputError(
            f"expected workers at the dask scheduler {scheduler}, got none; start some with "
            f"'dask worker {scheduler}'"
        )
    for worker, answer in answers.items():
        if isinstance(answer, Exception):
            raise InputError(
                f"expected workers of {scheduler} with modeharvest {__version__} and {function}, "
                f"but the one at {worker} says {type(answer).__name__}: {answer}; install both"
            )
        version, sees = answer
        if version != __version__:
            raise InputError(
                f"expected modeharvest {__version__} on all workers of {scheduler}, got {version} "
                f"on the one at {worker}; install the same version there"
            )
        if not sees:
            raise InputError(
                f"expected workers that can write to the folder {folder.resolve()}, but the one "
                f"at {worker} can't; take a folder that all of them see under the same path"
            )


def introduce(function: str, mark: str) -> tuple[str, bool]:
    """What a worker says of itself: its version, and whether it can write where a file is."""
    named(function)
    return __version__, Path(mark).exists() and os.access(Path(mark).parent, os.W_OK)
