"""numba's compiler behind a typed face: a decorated function keeps its signature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*, parallel: bool = False, inline: bool = False) -> Callable[[F], F]:
    """Compile a kernel at its first call; the machine code is cached on disk.

    ``parallel`` runs its ``prange`` loops on numba's threads. Floating-point arithmetic stays
    strict, so that NaN marks what it marks and results don't depend on the threads.
    """
    options = {"cache": True, "parallel": parallel, "inline": "always" if inline else "never"}
    return cast(Callable[[F], F], cast(Any, numba.njit)(**options))
