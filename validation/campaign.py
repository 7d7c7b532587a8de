"""Campaigns: one function for a grid of cases, run by workers, each case stored when it is done.

A case is a mapping of plain values, including its seed. The worker that ran it writes its result
atomically to ``cases/KEY.json``, where KEY is the digest of the function's name, the case and
modeharvest's code. So a killed campaign continues where it stopped, a changed option repeats only
the cases that depend on it, and results of different code are never mixed. A case that fails is
stored with its traceback, and the other cases continue.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, require_writable
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import exclusive, source_digest
from modeharvest.validation import workers as work
from modeharvest.validation.workers import Case, Cases, Workers

_Outcome = Literal["stored", "killed", "cut off"]
"""Outcome of a case in dask: result or failure stored, worker died twice, connection broke."""
_KILLED = "KilledWorker: its workers died; it may need more memory than they are given"
_ATTEMPTS = 3
"""Number of consecutive connections that may break before any case is done."""


@dataclass(frozen=True)
class Campaign:
    """A function and its cases."""

    function: str
    """A :data:`~modeharvest.validation.workers.CaseFunction`, as "package.module:name"."""
    cases: Cases
    """Arguments of the function, all with the same keys. For input that it reads from ``folder``, a
    digest belongs in the case, so that results of other inputs are recognised."""
    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "cases", tuple(dict(case) for case in self.cases))
        if not self.cases:
            raise InputError("expected at least one case in a campaign, got none")
        keys = set(self.cases[0])
        for other in map(set, self.cases):
            if other != keys:
                some = sorted(keys ^ other)
                raise InputError(f"expected cases with the same keys, got {some} in some only")
        work.named(self.function)

    def path(self, case: Case) -> Path:
        """The file in which the result of a case is stored."""
        return work.result_path(self.function, case, self.folder)

    def missing(self) -> Cases:
        """The cases that have no result yet, or failed."""
        done = (work.read_result(self.path(case)).get("error") == "" for case in self.cases)
        return tuple(case for case, is_done in zip(self.cases, done, strict=True) if not is_done)

    def run(self, workers: Workers | None = None, progress: Progress = silent) -> pd.DataFrame:
        """Run the missing cases and return the table; ``table.csv`` has it without lists.

        The default workers are two local processes. InputError if the folder can't be written to or
        is in use, the scheduler can't be reached or stops, or its workers can't run the function.
        """
        require_writable(self.folder)
        with exclusive(self.folder):
            missing = self.missing()
            done = len(self.cases) - len(missing)
            progress(done, len(self.cases), "campaign")
            for _ in self._settled(missing, workers or Workers()):
                done += 1
                progress(done, len(self.cases), "campaign")
            table = self.table()
            lists = [name for name in table if table[name].map(lambda v: isinstance(v, list)).any()]
            with atomic(self.folder / "table.csv") as temporary:
                table.drop(columns=lists).to_csv(temporary, index=False)
        return table

    def table(self) -> pd.DataFrame:
        """A row for each case: its values, ``error`` (empty if it succeeded), its result."""
        rows = []
        for case in self.cases:
            record = work.read_result(self.path(case)) or {"error": "not run"}
            error = (record["error"].strip().splitlines() or [""])[-1]
            rows.append({**case, "error": error, **(record.get("result") or {})})
        return pd.DataFrame(rows)

    def of_other_versions(self) -> dict[str, int]:
        """Number of stored results of other versions or of cases no longer in use, by version."""
        wanted = {self.path(case) for case in self.cases}
        others = set((self.folder / "cases").glob("*.json")) - wanted
        return Counter(str(work.stored(path).get("version", "unknown")) for path in sorted(others))

    def _settled(self, cases: Sequence[Case], workers: Workers) -> Iterator[Case]:
        """Yield each case when it is done or has finally failed.

        A broken connection is renewed. The scheduler counts as lost only if that fails, whatever
        dask reports about a case (docs/decisions/0011-campaigns-on-busy-machines.md).
        """
        left, in_vain = list(cases), 0
        while left:
            cut_off: list[Case] = []
            with ExitStack() as stack:
                try:
                    client = stack.enter_context(workers.client(self.function, self.folder))
                except InputError as error:
                    if len(left) == len(cases):  # scheduler never reached, or unable to work
                        raise
                    raise InputError(self._gone(error)) from error
                for case, outcome in self._tried(client, left):
                    if outcome == "cut off":
                        cut_off.append(case)
                    else:
                        yield case
            in_vain = in_vain + 1 if len(cut_off) == len(left) else 0
            if in_vain == _ATTEMPTS:
                raise InputError(self._gone(f"{in_vain} connections to it broke"))
            left = cut_off

    def _gone(self, how: object) -> str:
        """The message for a scheduler that doesn't come back."""
        done = len(self.cases) - len(self.missing())
        return (
            f"expected the dask scheduler to stay until all cases are done, but it went away; "
            f"{done} of {len(self.cases)} are done and kept: start it anew and run the same again "
            f"({how})"
        )

    def _tried(self, client: Any, cases: Sequence[Case]) -> Iterator[tuple[Case, _Outcome]]:
        """Yield each case with its final outcome.

        A worker may have died because of another case that ran at the same time. Cases whose worker
        died are therefore repeated, each alone, and only then stored as failed.
        """
        killed = []
        for case, outcome in self._submitted(client, cases):
            if outcome == "killed":
                killed.append(case)
            else:
                yield case, outcome
        for suspect in killed:
            for case, outcome in self._submitted(client, [suspect]):
                if outcome == "killed":
                    work.store(self.path(case), case, None, _KILLED)
                yield case, outcome

    def _submitted(self, client: Any, cases: Sequence[Case]) -> Iterator[tuple[Case, _Outcome]]:
        """Run cases in parallel; yield each with its outcome when it is done."""
        from distributed import KilledWorker, as_completed

        folder = str(self.folder.resolve())  # remote workers have another current folder
        submit = partial(client.submit, work.run_case, self.function, pure=False)
        futures = {submit(case, folder, source_digest()): case for case in cases}
        completed = as_completed(list(futures))  # type: ignore[no-untyped-call]
        for future in completed:
            if future.status not in ("finished", "error", "cancelled"):
                # The worker that held the result has died: dask runs the case on another one.
                completed.add(future)  # type: ignore[no-untyped-call]
                continue
            case = futures.pop(future)  # so that dask can release its result
            if future.status == "cancelled":
                yield case, "cut off"
            elif future.status == "finished":
                yield case, "stored"
            elif isinstance(failure := future.exception(), KilledWorker):
                yield case, "killed"
            else:
                work.store(self.path(case), case, None, f"{type(failure).__name__}: {failure}")
                yield case, "stored"


def grid(base: Case, **axes: Sequence[Any]) -> Cases:
    """All combinations of some values, each replacing those of a base case.

    ``axes``: the values of keys of the base, the last key varying fastest. InputError if a name is
    not a key of the base, or has no values or the same value twice.
    """
    for name, values in axes.items():
        if name not in base:
            raise InputError(f"expected axes among {sorted(base)}, got {name!r}")
        found = [repr(value) for value in values]
        if not found or len(set(found)) < len(found):
            raise InputError(f"expected different values of {name!r}, got {list(values)}")
    combinations = itertools.product(*axes.values())
    return tuple({**base, **dict(zip(axes, c, strict=True))} for c in combinations)
