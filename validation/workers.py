"""Workers of a campaign: local processes or a dask scheduler's, and how they run a case.

Local processes are those of dask's ``LocalCluster``. They listen on 127.0.0.1 only, without a
dashboard. No timeout declares a slow process dead: its end is detected from the process itself.
Remote workers are first checked for whether they can run the function. A worker imports only this
module and the case's function, because it must start fast.
"""

from __future__ import annotations

import gc
import importlib
import logging
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numba

from modeharvest.util import RELEASE
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, require_writable, write_json
from modeharvest.util.stages import digest, source_digest, stage_key

Case = Mapping[str, Any]
"""Plain values, including the seed."""
Cases = tuple[Case, ...]
Row = dict[str, Any]
"""Result of a case: plain values by the columns of the table."""
CaseFunction = Callable[[Case, Path], Row]
"""Takes a case and the campaign's folder."""


def named(function: str) -> CaseFunction:
    """The function named "package.module:name"; InputError if there is none."""
    module, _, name = function.partition(":")
    try:
        found: CaseFunction = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"expected a function 'package.module:name', got {function!r}") from error
    return found


def result_path(function: str, case: Case, folder: Path) -> Path:
    """File for the result of a case, named by a digest of everything the result depends on."""
    key = stage_key([function, dict(case)])[:24]
    return folder / "cases" / f"{key}.json"


def leave(content: Mapping[str, Any], folder: Path, path: str) -> str:
    """Write input of cases to a campaign's folder, named by its digest; return the name.

    ``path``: path of the file in the folder, with {} for the name.
    """
    name = digest(content)[:16]
    write_json(folder / path.format(name), content)
    return name


def run_case(function: str, case: Case, folder: str, code: str) -> None:
    """Run one case in a worker and store its result or failure; do nothing if it is already done.

    Dask repeats a case whose worker dies before the campaign has received its result.

    ``folder``: absolute path of the campaign's folder, as remote workers have another current one;
    ``code``: digest of the campaign's modeharvest; InputError if that of this worker differs.
    """
    if code != source_digest():
        raise InputError(
            f"expected a worker with modeharvest's code {code[:12]}, got {source_digest()[:12]}"
        )
    path = result_path(function, case, Path(folder))
    if read_result(path).get("error") == "":
        return
    numba.set_num_threads(1)  # also in a scheduler's workers, which may have no limit
    result, error = None, ""
    try:
        result = named(function)(case, Path(folder))
    except Exception:  # any failure of a case is its result
        error = traceback.format_exc()
    store(path, case, result, error)


def store(path: Path, case: Case, result: Mapping[str, Any] | None, error: str) -> None:
    """Write the result of a case, or the traceback of its failure."""
    content = {"version": RELEASE, "case": dict(case), "error": error, "result": result}
    write_json(path, {**content, "digest": digest(content)})


def read_result(path: Path) -> dict[str, Any]:
    """Stored record of a case; ``error`` is empty if it succeeded. {} if missing or damaged."""
    content = stored(path)
    return content if content.pop("digest", "") == digest(content) else {}


def stored(path: Path) -> dict[str, Any]:
    """Content of a case's file, without a check; empty if there is none."""
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        return {}


_ATTEMPTS = 5
"""Attempts to start an event loop."""
_PATIENCE_S = 30.0
"""Time to wait for a scheduler's answer [s]: it may be on a busy machine."""
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS")}
"""A worker has one thread, as cases run in parallel. For numba this is set in each case instead:
these variables are temporarily set in the parent process too, whose numba must not change."""
_FORKS = "forkserver" in multiprocessing.get_all_start_methods()
_LOOPBACK = "127.0.0.1"
_MOST_WORKERS = 1000
_LEAST_BYTES = 2**28
"""Least memory of a worker: with less, dask restarts it before it has done anything."""
LOCAL: dict[str, object] = {
    # Forks of one server process that has imported dask start faster than new processes.
    "distributed.worker.multiprocessing-method": "forkserver" if _FORKS else "spawn",
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
    # Without a network, a worker that does not answer is only slow. By default dask drops a worker
    # whose case blocks the interpreter for five minutes, and drops for good one that is not
    # back 15 s after its process was killed.
    "distributed.scheduler.worker-ttl": None,
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.comm.timeouts.connect": "10 minutes",
    "distributed.comm.timeouts.tcp": "1 hour",
    # A case whose worker dies is repeated once among others, then alone: see Campaign.
    "distributed.scheduler.allowed-failures": 1,
    # No HTTP pages.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
"""Dask's options for workers of this machine."""


@dataclass(frozen=True)
class Workers:
    """The processes that run a campaign's cases."""

    count: int = 2
    """Number of processes on this machine."""
    memory: str = "4GiB"
    """Memory limit of each, e.g. "4GiB"; a process above it is stopped and its case fails."""
    scheduler: str | None = None
    """Address of a dask scheduler to use instead, "tcp://host:8786"; its workers must have access
    to the folder and the same modeharvest."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"expected at least 1 worker, got {self.count}")
        if self.count > _MOST_WORKERS:
            raise InputError(f"expected at most {_MOST_WORKERS} workers, got {self.count}")
        from dask.utils import parse_bytes

        try:
            if not _LEAST_BYTES <= parse_bytes(self.memory) < 2**60:
                raise ValueError("too little to begin with, or more than there is anywhere")
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(
                f"expected a worker's memory like 4GiB or 500MB, got {self.memory!r}; at least "
                "256MiB, which it takes before its first case"
            ) from error

    def require_ready(self, function: str, folder: Path) -> None:
        """Raise InputError early if a scheduler's workers can't run the function."""
        if self.scheduler is not None:
            with self.client(function, folder):
                pass

    @contextmanager
    def client(self, function: str, folder: Path) -> Iterator[Any]:
        """A dask client of the workers; local workers end with it.

        InputError if the scheduler can't be reached, or its workers can't run the function.
        """
        if self.scheduler is None:
            with _processes(self.count, self.memory) as client:
                yield client
        else:
            with _client_of(self.scheduler) as client:
                _require_able(client, self.scheduler, function, folder)
                yield client


@contextmanager
def _environment_kept() -> Iterator[None]:
    """Undo dask's changes of environment variables."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Processes started in this context ignore Ctrl-C; this process receives it afterwards."""
    if not _FORKS:
        yield
        return
    resource_tracker.ensure_running()  # started later, it would unblock interrupts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _processes(count: int, memory: str) -> Iterator[Any]:
    """A client of local processes."""
    import dask
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        stack.enter_context(_environment_kept())
        stack.enter_context(dask.config.set(LOCAL))
        with _interrupts_deferred():
            cluster = _begun(
                LocalCluster,
                n_workers=count,
                threads_per_worker=1,
                memory_limit=memory,
                host=_LOOPBACK,
                # Any free port, as campaigns may run in parallel; None would use 8787.
                dashboard_address=f"{_LOOPBACK}:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
            stack.enter_context(cluster)
        yield stack.enter_context(_begun(Client, cluster))


def _begun(make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Make a cluster or client; retry if its event loop takes over dask's 10 s to start."""
    for left in reversed(range(_ATTEMPTS)):
        gc.collect()
        gc.disable()  # collecting a failed client in here would wait for this one: deadlock
        try:
            return make(*arguments, **options)
        except AssertionError:
            if not left:
                raise
        finally:
            gc.enable()


@contextmanager
def _client_of(scheduler: str) -> Iterator[Any]:
    """A client of a running scheduler."""
    from distributed import Client

    for logger in ("distributed", "distributed.client"):  # failures are reported in one line
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        client = _begun(Client, scheduler, timeout=_PATIENCE_S)
    except Exception as error:  # another kind of server can cause any exception
        raise InputError(
            f"expected a dask scheduler at {scheduler}, got no answer that is one's; start one "
            "with 'dask scheduler', or leave the address out"
        ) from error
    with client:
        yield client


def _require_able(client: Any, scheduler: str, function: str, folder: Path) -> None:
    """Raise InputError for workers without the function, the same modeharvest, or the folder."""
    require_writable(folder)
    folder = folder.resolve()
    with NamedTemporaryFile(dir=folder, prefix=".seen-") as mark:
        answers = client.run(handshake, function, mark.name, on_error="return")
    if not answers:
        raise InputError(
            f"expected workers at the dask scheduler {scheduler}, got none; start some with "
            f"'dask worker {scheduler}'"
        )
    for worker, answer in answers.items():
        if isinstance(answer, Exception):
            raise InputError(
                f"expected workers of {scheduler} with this modeharvest and {function}, "
                f"but the one at {worker} says {type(answer).__name__}: {answer}; install both"
            )
        version, code, sees = answer
        if (version, code) != (RELEASE, source_digest()):
            raise InputError(
                f"expected modeharvest {RELEASE} with the code {source_digest()[:12]} on all "
                f"workers of {scheduler}, got {version} with {code[:12]} on the one at {worker}; "
                "install the same there"
            )
        if not sees:
            raise InputError(
                f"expected workers that can write to the folder {folder}, but the one at {worker} "
                "can't; take a folder that all of them see under the same path"
            )


def handshake(function: str, mark: str) -> tuple[str, str, bool]:
    """A worker's version, code digest, and whether it can write to the folder of ``mark``."""
    named(function)
    sees = Path(mark).exists() and os.access(Path(mark).parent, os.W_OK)
    return RELEASE, source_digest(), sees
