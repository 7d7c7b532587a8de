"""Cost of a campaign: speed-up by a second worker, overhead of short cases, start of workers.

Three quantities, each measured by whole campaigns, with and without the start of their workers:

* speedup: correlations of the paper's images from perturbed guesses, by one worker and by two;
* overhead: cases that sleep for a second, on two workers: the time beyond the ideal one;
* start: cases that do nothing, run by forks of a server process, as in a campaign, and by new
  processes, dask's default.

The machine should have two idle cores. Results: docs/how-to/studies.md.

Run: scripts/env python benchmarks/campaign.py [--guesses 24] [--sleeps 60] [--pixel 0.02]
     [--repetitions 5]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import LOCAL, Case, Workers

SLEEP_S = 1.0


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds of a campaign.

    Parameters
    ----------
    whole
        Of the whole campaign.
    first, last
        Until the first case was done (start of the workers and one case), and until the last one
        was; the rest is stopping the workers.
    """

    whole: float
    first: float
    last: float


def sleep(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Sleep for ``case["seconds"]``: a case of known duration."""
    time.sleep(case["seconds"])
    return {}


def run(function: str, cases: tuple[Case, ...], folder: Path, workers: int, method: str) -> Timing:
    """Run a campaign and time it; ``method`` is how worker processes are started."""
    LOCAL["distributed.worker.multiprocessing-method"] = method
    campaign = Campaign(function, cases, folder)
    begin, ticks = time.perf_counter(), []

    def listen(done: float, total: float, what: str) -> None:
        ticks.append(time.perf_counter() - begin)

    table = campaign.run(Workers(workers), listen)
    whole = time.perf_counter() - begin
    assert (table["error"] == "").all(), table["error"].iloc[0]
    return Timing(whole, ticks[1], ticks[-1])


def alone(
    function: str, cases: tuple[Case, ...], folder: Path, workers: int, method: str = "forkserver"
) -> Timing:
    """The same in a new process, because an earlier campaign in this one would make it faster."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        return process.submit(run, function, cases, folder, workers, method).result()


def speedup(guesses: int, pixel: float, folder: Path) -> None:
    """Print the times of campaigns with one worker and with two."""
    from modeharvest.fem.field import Solution
    from modeharvest.runs.case import shipped_solution  # here, because workers import this file
    from modeharvest.runs.study import StudyCase
    from modeharvest.validation.studies.robustness import RobustnessStudy
    from modeharvest.validation.studies.study import ImagePairSpec

    path, case = shipped_solution("paper-virtual"), StudyCase()
    imaging = replace(case.imaging, pixel_size=pixel)
    spec = ImagePairSpec(case.experiment, imaging, case.correlation, lambda: Solution.read(path))
    study = RobustnessStudy(initial_guesses=guesses, radii=(), strain_errors=())
    found = {}
    for workers in (1, 2, 2, 1):  # a drift of the machine affects both alike
        own = folder / f"{workers}-{len(found)}-{time.perf_counter_ns()}"
        cases = study.prepare(spec, own)
        timing = alone(study.function, cases, own, workers)
        found.setdefault(workers, []).append(timing)
        print(f"{workers} worker{'s' * (workers > 1)}: {timing.whole:.1f} s, "
              f"{timing.first:.1f} s until the first case was done")  # fmt: skip
    whole = {n: sum(t.whole for t in timings) for n, timings in found.items()}
    after = {n: sum(t.last - t.first for t in timings) for n, timings in found.items()}
    print(f"two workers are {whole[1] / whole[2]:.2f} times one with their start, "
          f"{after[1] / after[2]:.2f} times between the first and the last case\n")  # fmt: skip


def overhead(sleeps: int, folder: Path) -> None:
    """Print the overhead of cases of one second on two workers."""
    cases = grid({"seconds": SLEEP_S, "number": 0}, number=list(range(sleeps)))
    timing = alone("campaign:sleep", cases, folder, 2)
    ideal = SLEEP_S * sleeps / 2
    steady, steady_ideal = timing.last - timing.first, ideal - SLEEP_S
    print(f"{sleeps} cases of {SLEEP_S:g} s on two workers: {timing.whole:.2f} s, "
          f"{timing.first:.2f} s until the first was done")  # fmt: skip
    print(f"overhead {100 * (timing.whole / ideal - 1):.1f} % with the workers' start, "
          f"{100 * (steady / steady_ideal - 1):.1f} % from the first to the last case")  # fmt: skip


def start(repetitions: int, folder: Path) -> None:
    """Print start times with forks of a server process and with new processes, alternately."""
    found: dict[str, list[Timing]] = {}
    for n in range(repetitions):
        for method in ("forkserver", "spawn"):
            cases = grid({"seconds": 0.0, "number": 0}, number=list(range(8)))
            timing = alone("campaign:sleep", cases, folder / f"{method}-{n}", 2, method)
            found.setdefault(method, []).append(timing)
    for method, timings in found.items():
        first, whole = (sorted(getattr(t, name) for t in timings) for name in ("first", "whole"))
        middle = len(timings) // 2
        print(f"{method}: {first[middle]:.2f} s until the first case was done, "
              f"{whole[middle]:.2f} s in all (medians of {len(timings)})")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--guesses", type=int, default=24, help="correlations in each campaign")
    parser.add_argument("--pixel", type=float, default=0.02, help="of their images [mm]")
    parser.add_argument("--sleeps", type=int, default=60, help="cases of a second")
    parser.add_argument("--repetitions", type=int, default=5, help="of the start, in turn")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        speedup(given.guesses, given.pixel, Path(folder) / "speedup")
        overhead(given.sleeps, Path(folder) / "overhead")
        start(given.repetitions, Path(folder) / "start")


if __name__ == "__main__":
    main()
