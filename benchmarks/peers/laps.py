"""Threads, and the time that contestants take in turn."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numba
from threadpoolctl import threadpool_limits

Work = Callable[[], Any]


def use_threads(count: int) -> None:
    """Let kernels, BLAS and OpenCV, ours and the peers', use so many threads from now on."""
    numba.set_num_threads(count)
    threadpool_limits(count)
    cv2.setNumThreads(count)


@dataclass(frozen=True)
class Laps:
    """What some work gave, and how long it took.

    Parameters
    ----------
    result
        Of the last lap.
    first_s
        Seconds of the first call; it compiles where there is something to compile.
    median_s
        Median of the seconds of the laps after it; of the first where there was only one.
    """

    result: Any
    first_s: float
    median_s: float


def in_turn(contestants: dict[str, Work], laps: int) -> dict[str, Laps]:
    """Run all in turn, ``laps`` times after a first one, so that a busy machine hits all alike."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    results: dict[str, Any] = {}
    for _ in range(laps + 1):
        for name, work in contestants.items():
            begin = time.perf_counter()
            results[name] = work()
            seconds[name].append(time.perf_counter() - begin)
    return {
        name: Laps(results[name], s[0], statistics.median(s[1:] or s))
        for name, s in seconds.items()
    }
