"""numba's compiler behind a typed face: a decorated function keeps its signature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered, so that they are vectorised; NaN and infinity keep their meaning.
_RELAXED = {"contract", "reassoc", "nsz", "arcp"}


def compiled(
    *, parallel: bool = False, inline: bool = False, relaxed: bool = False
) -> Callable[[F], F]:
    """Compile a kernel at its first call; the machine code is cached on disk.

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
    options: dict[str, Any] = {"cache": True, "parallel": parallel, "forceinline": inline}
    if relaxed:
        options |= {"fastmath": _RELAXED, "error_model": "numpy"}
    return cast(Callable[[F], F], cast(Any, numba.njit)(**options))
