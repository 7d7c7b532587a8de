"""numba's compiler behind a typed face: a decorated function keeps its signature."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered, so that they are vectorised; NaN and infinity keep their meaning.
_RELAXED = {"contract", "reassoc", "nsz", "arcp"}
_kept = True


def compiled(
    *, parallel: bool = False, inline: bool = False, relaxed: bool = False
) -> Callable[[F], F]:
    """Compile a kernel at its first call; the machine code is cached on disk, if that is allowed.

    Parameters
    ----------
    parallel
        Run the kernel's ``prange`` loops on numba's threads.
    inline
        Put the function's code into those that call it.
    relaxed
        Let the compiler reorder sums and divide as numpy does; by default floating-point
        arithmetic is strict, and division by zero an error.
    """
    options: dict[str, Any] = {"parallel": parallel, "forceinline": inline, "nogil": True}
    if relaxed:
        options |= {"fastmath": _RELAXED, "error_model": "numpy"}

    def decorate(kernel: F) -> F:
        global _kept
        try:
            return cast(F, numba.njit(kernel, cache=True, **options))
        except RuntimeError:  # no folder for it can be written to
            _kept = False
            return cast(F, numba.njit(kernel, **options))

    return decorate


def are_kept() -> bool:
    """Whether compiled kernels are found again by the next process."""
    return _kept


def readable(values: NDArray[Any]) -> NDArray[Any]:
    """Show an array to kernels: contiguous, aligned and read-only, copied only where it isn't.

    Kernels are compiled for the types of their arguments, and layout and writability belong to
    an array's type. Everybody's arrays can be made read-only, so that one compilation serves all.
    """
    view = np.require(values, requirements=["C_CONTIGUOUS", "ALIGNED"]).view()
    view.flags.writeable = False
    return view


def side_by_side(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call ``kernel(*arguments, k, count)``, k = 0 ... count - 1, on as many threads as numba has.

    For kernels that share out their work themselves, every count-th part to one thread. Those
    with ``prange`` are simpler, and take three times as long to compile.
    """
    count = numba.get_num_threads()
    if count == 1:
        kernel(*arguments, 0, 1)
        return
    with ThreadPoolExecutor(count) as threads:
        # The first call compiles, once; the others wait for it.
        for done in [threads.submit(kernel, *arguments, k, count) for k in range(count)]:
            done.result()
