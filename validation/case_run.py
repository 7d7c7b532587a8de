"""What a worker does with one case of a campaign: run it and store what becomes of it.

Workers import this module and the case's function, nothing else of a campaign: they must start
fast.
"""

from __future__ import annotations

import importlib
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numba

from modeharvest import __version__
from modeharvest.errors import InputError
from modeharvest.files import read_json, write_json
from modeharvest.stages import digest, stage_key
from modeharvest.versions import source_digest

Case = Mapping[str, Any]
"""Plain values, the seed among them."""
CaseFunction = Callable[[Case, Path], Mapping[str, Any]]
"""Takes a case and the campaign's folder, returns plain values: the row of the table."""


def named(function: str) -> CaseFunction:
    """The function that "package.module:name" stands for; InputError if there is none."""
    module, _, name = function.partition(":")
    try:
        found: CaseFunction = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"expected a function 'package.module:name', got {function!r}") from error
    return found


def result_path(function: str, case: Case, folder: Path) -> Path:
    """Where the result of a case is stored: under a digest of all that it depends on."""
    key = stage_key([function, dict(case)])[:24]
    return folder / "cases" / f"{key}.json"


def run_case(function: str, case: Case, folder: str, code: str) -> None:
    """Run one case in a worker and store what becomes of it; nothing if it is stored as done.

    Dask has a case run again whose worker dies before the campaign has heard that it is done.

    Parameters
    ----------
    function
        "package.module:name".
    case
        What to run it with.
    folder
        The campaign's, absolute: a worker elsewhere has another current one.
    code
        Digest of modeharvest's where the campaign was begun.

    Raises
    ------
    InputError
        If this worker has another: it came after the campaign had begun.
    """
    if code != source_digest():
        raise InputError(
            f"expected a worker with modeharvest's code {code[:12]}, got {source_digest()[:12]}"
        )
    path = result_path(function, case, Path(folder))
    if read_result(path).get("error") == "":
        return
    numba.set_num_threads(1)  # also in workers of a scheduler that were started without a limit
    result, error = None, ""
    try:
        result = dict(named(function)(case, Path(folder)))
    except Exception:  # a case may fail in any way: that is its result
        error = traceback.format_exc()
    store(path, case, result, error)


def store(path: Path, case: Case, result: Mapping[str, Any] | None, error: str) -> None:
    """Write what became of a case: its result, or the traceback of its failure."""
    content = {"version": __version__, "case": dict(case), "error": error, "result": result}
    write_json(path, {**content, "digest": digest(content)})


def read_result(path: Path) -> dict[str, Any]:
    """What is stored of a case, its ``error`` empty if it succeeded; empty if none, or damaged."""
    content = stored(path)
    return content if content.pop("digest", "") == digest(content) else {}


def stored(path: Path) -> dict[str, Any]:
    """What a case's file says, as it is; empty if nothing."""
    try:
        return dict(read_json(path))
    except (InputError, TypeError, ValueError):
        return {}
