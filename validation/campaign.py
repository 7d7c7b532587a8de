"""Campaigns: one function for a grid of cases, run by workers, each case stored when it is done.

A case is a mapping of plain values, its seed among them. What becomes of it is written, whole or
not at all, by the worker that ran it, to ``cases/KEY.json`` with KEY the digest of the function's
name, the case and modeharvest's version: a campaign that is killed goes on where it was, an
option that is changed makes anew what it touches and nothing else, and results of another
version are never mixed with this one's. A case that fails is stored with its traceback, and the
rest goes on.

Workers are processes of dask.distributed: of this machine, or of any scheduler by its address.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import pandas as pd

from modeharvest import __version__
from modeharvest.errors import InputError
from modeharvest.files import atomic, read_json, require_writable, write_json
from modeharvest.progress import Progress, silent
from modeharvest.stages import digest

Case = Mapping[str, Any]
CaseFunction = Callable[[Case, Path], Mapping[str, Any]]

_PATIENCE_S = 10.0
"""How long to wait for a scheduler that does not answer."""
_LIBRARIES = ("OMP", "MKL", "OPENBLAS")
_ENVIRONMENT = {f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}
"""A worker has one thread: cores are shared out by cases. numba is told in each case, because dask
says this in the parent's own environment, where numba must not change its mind."""


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
        the campaign's folder.
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


@dataclass(frozen=True)
class Campaign:
    """A function and its cases.

    Parameters
    ----------
    function
        "package.module:name" of a function that takes a case and the campaign's folder and
        returns a mapping of plain values, the row of the table.
    cases
        What to run it with; all have the same keys. What the function reads from the folder
        belongs in them by a digest, so that a result is known to be of other inputs.
    folder
        Where the results go.
    """

    function: str
    cases: tuple[Case, ...]
    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "cases", tuple(dict(case) for case in self.cases))
        if not self.cases:
            raise InputError("expected at least one case in a campaign, got none")
        keys = set(self.cases[0])
        other = next((set(case) for case in self.cases if set(case) != keys), None)
        if other is not None:
            raise InputError(
                "expected cases with the same keys, got "
                f"{sorted(keys ^ other)} in some of them only"
            )
        named(self.function)

    def path(self, case: Case) -> Path:
        """Where the result of a case is stored."""
        key = digest([self.function, dict(case), __version__])[:24]
        return self.folder / "cases" / f"{key}.json"

    def missing(self) -> tuple[Case, ...]:
        """The cases that have no result yet, or failed."""
        return tuple(case for case in self.cases if not _is_done(self.path(case)))

    def run(self, workers: Workers | None = None, progress: Progress = silent) -> pd.DataFrame:
        """Run what is missing and return the table; also left as ``table.csv``.

        And, where pyarrow is there, as ``table.parquet``. Lists are left in the cases' files.

        Parameters
        ----------
        workers
            Who; two processes of this machine by default.
        progress
            Listener.

        Raises
        ------
        InputError
            If the folder can't be written to, or the scheduler is not there.
        """
        require_writable(self.folder)
        missing = self.missing()
        done = len(self.cases) - len(missing)
        progress(done, len(self.cases), "campaign")
        if missing:
            with _client(workers or Workers()) as client:
                for _ in self._finished(client, missing):
                    done += 1
                    progress(done, len(self.cases), "campaign")
        table = self.table()
        _write(table, self.folder)
        return table

    def table(self) -> pd.DataFrame:
        """A row for each case: its values, ``seconds``, ``error`` (empty if none), its result."""
        return pd.DataFrame([self._row(case) for case in self.cases])

    def of_other_versions(self) -> dict[str, int]:
        """How many stored results are of another version or no longer asked for, by version."""
        wanted = {self.path(case) for case in self.cases}
        counts: dict[str, int] = {}
        for path in sorted((self.folder / "cases").glob("*.json")):
            if path not in wanted:
                version = str(_record(path).get("version", "unknown"))
                counts[version] = counts.get(version, 0) + 1
        return counts

    def _row(self, case: Case) -> dict[str, Any]:
        record = _record(self.path(case))
        error = record.get("error", "not run") if record else "not run"
        last = error.strip().splitlines()[-1] if error else ""
        found = record.get("result") or {}
        return {**case, "seconds": record.get("seconds"), "error": last, **found}

    def _finished(self, client: Any, missing: Sequence[Case]) -> Iterator[Case]:
        """The cases as they get done; one whose worker dies again and again is stored as failed."""
        from distributed import as_completed

        futures = {
            client.submit(_work, self.function, case, str(self.folder), pure=False): case
            for case in missing
        }
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            if future.status == "error":
                failure = f"{type(future.exception()).__name__}: {future.exception()}"
                _store(self.path(futures[future]), futures[future], None, failure, 0.0)
            yield futures[future]


def grid(base: Case, **axes: Sequence[Any]) -> tuple[Case, ...]:
    """All combinations of some values, each on top of a base case.

    Parameters
    ----------
    base
        The values of all keys.
    axes
        The values that keys run through; the last runs fastest.

    Raises
    ------
    InputError
        If an axis is not a key of the base, or has no value or one twice.
    """
    for name, values in axes.items():
        if name not in base:
            raise InputError(f"expected axes among {sorted(base)}, got {name!r}")
        seen = [repr(value) for value in values]
        if not seen or len(set(seen)) < len(seen):
            raise InputError(f"expected different values of {name!r}, got {list(values)}")
    combinations = itertools.product(*axes.values())
    return tuple({**base, **dict(zip(axes, c, strict=True))} for c in combinations)


def named(function: str) -> CaseFunction:
    """The function that "package.module:name" stands for; InputError if there is none."""
    module, _, name = function.partition(":")
    try:
        found: CaseFunction = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"expected a function 'package.module:name', got {function!r}") from error
    return found


def _work(function: str, case: Case, folder: str) -> None:
    """Run one case in a worker and store what becomes of it."""
    numba.set_num_threads(1)  # also in workers of a scheduler that were started without a limit
    begin = time.perf_counter()
    result, error = None, ""
    try:
        result = dict(named(function)(case, Path(folder)))
    except Exception:  # a case may fail in any way: that is its result
        error = traceback.format_exc()
    path = Campaign(function, (case,), Path(folder)).path(case)
    _store(path, case, result, error, time.perf_counter() - begin)


def _store(
    path: Path, case: Case, result: Mapping[str, Any] | None, error: str, seconds: float
) -> None:
    content = {"version": __version__, "case": dict(case), "seconds": seconds, "error": error}
    write_json(path, {**content, "result": result})


def _write(table: pd.DataFrame, folder: Path) -> None:
    """Leave the table for others to read."""
    lists = [name for name in table if table[name].map(lambda v: isinstance(v, list)).any()]
    plain = table.drop(columns=lists)
    with atomic(folder / "table.csv") as temporary:
        plain.to_csv(temporary, index=False)
    if importlib.util.find_spec("pyarrow"):
        with atomic(folder / "table.parquet") as temporary:
            plain.to_parquet(temporary, index=False)


def _record(path: Path) -> dict[str, Any]:
    """What is stored of a case; empty if nothing, or damaged."""
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        return {}


def _is_done(path: Path) -> bool:
    return _record(path).get("error") == ""


@contextmanager
def _client(workers: Workers) -> Iterator[Any]:
    """A client of the scheduler, or of processes that end with it."""
    import dask
    from distributed import Client, LocalCluster

    if workers.scheduler is not None:
        try:
            client = Client(workers.scheduler, timeout=_PATIENCE_S)  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise InputError(
                f"expected a dask scheduler at {workers.scheduler}, got no answer; start one "
                "with 'dask scheduler', or leave the address out"
            ) from error
        with client:
            yield client
        return
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": _ENVIRONMENT}),
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=workers.count,
            threads_per_worker=1,
            memory_limit=workers.memory,
            dashboard_address=":0",  # any free port: campaigns may run side by side
        ) as cluster,
        Client(cluster) as client,  # type: ignore[no-untyped-call]
    ):
        yield client
