"""Number of threads, and times of calls that run alternately."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import cv2
import numba
from threadpoolctl import threadpool_limits

Work = Callable[[], Any]


def use_threads(count: int) -> None:
    """Set the number of threads of kernels, BLAS and OpenCV, in all programs."""
    numba.set_num_threads(count)
    threadpool_limits(count)
    cv2.setNumThreads(count)


@dataclass(frozen=True)
class Laps:
    """Result of a call, and how long it took.

    Parameters
    ----------
    result
        Of the last lap.
    first_s
        Seconds of the first call; it compiles where there is something to compile.
    median_s
        Median of the seconds of the laps.
    """

    result: Any
    first_s: float
    median_s: float


def in_turn(
    contestants: dict[str, Work], laps: int, warm_up: Collection[str] | None = None
) -> dict[str, Laps]:
    """Run all alternately, ``laps`` times, so that other load affects all alike.

    Before that, those named in ``warm_up`` (all by default) run once, to compile.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    first: dict[str, float] = {}
    results: dict[str, Any] = {}
    for name, work in contestants.items():
        if warm_up is None or name in warm_up:
            first[name] = _timed(work)[1]
    for _ in range(laps):
        for name, work in contestants.items():
            results[name], took = _timed(work)
            seconds[name].append(took)
    return {
        name: Laps(results[name], first.get(name, s[0]), statistics.median(s))
        for name, s in seconds.items()
    }


def _timed(work: Work) -> tuple[Any, float]:
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin
