"""A typed wrapper of numba's compiler: a decorated function keeps its signature."""

from __future__ import annotations

import hashlib
import inspect
import re
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding
import numba
import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered, so that they are vectorised; NaN and infinity keep their meaning.
_RELAXED = {"contract", "reassoc", "nsz", "arcp"}
_PACKAGE = Path(__file__).parents[1]
_kept = True


def compiled(
    *, inner: bool = False, inline: bool = False, relaxed: bool = False
) -> Callable[[F], F]:
    """Compile a kernel at its first call; the machine code is cached on disk where possible.

    ``inner``: callable from other kernels only, without Python's wrapper. ``inline``: the same, and
    inlined in their code. ``relaxed``: let the compiler reorder sums and divide as numpy does; by
    default floating-point arithmetic is strict, and division by zero raises an error.
    """
    options: dict[str, Any] = {"forceinline": inline, "nogil": True, "no_cfunc_wrapper": True}
    options["no_cpython_wrapper"] = inner or inline
    if relaxed:
        options |= {"fastmath": _RELAXED, "error_model": "numpy"}

    def decorate(kernel: F) -> F:
        global _kept
        try:
            return cast(F, _stamped(_for_types(numba.njit(kernel, cache=True, **options))))
        except RuntimeError:  # no folder for it can be written to
            _kept = False
            return cast(F, _for_types(numba.njit(kernel, **options)))

    return decorate


def _for_types(kernel: Any) -> Any:
    """Compile a kernel once for each type, and not again for literal values in a calling kernel.

    The kernel is returned unchanged if this version of numba lacks ``get_call_template``.
    """
    template, of = getattr(kernel, "get_call_template", None), cast(Any, numba.types).unliteral
    if template is not None:

        def of_types(args: Any, kws: Any) -> Any:
            return template([of(value) for value in args], {k: of(v) for k, v in kws.items()})

        kernel.get_call_template = of_types
    return kernel


def _stamped(kernel: Any) -> Any:
    """Recompile a cached kernel also when the file of a kernel that it calls has changed.

    numba by itself checks the kernel's own file only. The attributes used are private to numba: if
    they are not found, numba's behaviour is left unchanged.
    """
    index = cast(Any, getattr(getattr(kernel, "_cache", None), "_cache_file", None))
    if index is not None and hasattr(index, "_source_stamp"):
        callees = _read_by(Path(inspect.getfile(kernel.py_func)))
        index._source_stamp = index._source_stamp, _digest(*callees)
    return kernel


_IMPORTED = re.compile(r"^from modeharvest\.([\w.]+) import", re.MULTILINE)


@cache
def _read_by(path: Path) -> tuple[Path, ...]:
    """All files with kernels that a file imports, directly or indirectly, and itself."""
    found, waiting = {path}, [path]
    while waiting:
        for name in _IMPORTED.findall(waiting.pop().read_text("utf-8")):
            other = _PACKAGE / f"{name.replace('.', '/')}.py"
            if other not in found and _has_kernels(other):
                found.add(other)
                waiting.append(other)
    return tuple(sorted(found))


@cache
def _has_kernels(path: Path) -> bool:
    return path.is_file() and "compiled" in path.read_text("utf-8")


@cache
def _digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()[:16]


def sources() -> str:
    """Digest of the kernels' sources, the versions of numba and Python, and the processor."""
    folders = [_PACKAGE / name for name in ("util", "imaging", "idic")]
    files = [path for folder in folders for path in folder.rglob("*.py")]
    host = numba.__version__, llvmlite.binding.get_host_cpu_name(), sys.version
    text = _digest(*sorted(filter(_has_kernels, files))), *host
    return hashlib.sha256("".join(text).encode()).hexdigest()[:16]


def cached_in(kernel: Callable[..., object]) -> Path | None:
    """The folder in which a kernel is cached; None if it is not cached."""
    stats = getattr(kernel, "stats", None)
    return Path(stats.cache_path) if stats is not None and stats.cache_path else None


def is_cached() -> bool:
    """Whether compiled kernels are cached on disk, for use by later processes."""
    return _kept


def readable(values: NDArray[Any]) -> NDArray[Any]:
    """A contiguous, aligned, read-only view of an array for kernels, or a copy where needed.

    Kernels are compiled for the types of their arguments, and layout and writability belong to
    an array's type. Any array can be viewed read-only, so that one compilation serves all.
    """
    view = np.require(values, requirements=["C_CONTIGUOUS", "ALIGNED"]).view()
    view.flags.writeable = False
    return view


def in_parallel(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call ``kernel(*arguments, k, count)``, k = 0 ... count - 1, on as many threads as numba has.

    Each call does every count-th part of the work, starting with part k. numba's own ``prange``
    takes three times as long to compile.
    """
    count = numba.get_num_threads()
    if count == 1:
        kernel(*arguments, 0, 1)
        return
    with ThreadPoolExecutor(count) as threads:
        # The first call compiles, once; the others wait for it.
        for done in [threads.submit(kernel, *arguments, k, count) for k in range(count)]:
            done.result()
