"""Time of an identification, and its memory by parts of the program.

Runs a case in this process, as `modeharvest identify` does. Twenty times a second a thread reads
the resident memory and the active function (docs/explanation/identification_accuracy.md).

Run: scripts/env python benchmarks/identification_memory.py [identify-paper] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil

from modeharvest.runs.identification.pipeline import run_identification

PARTS = (
    "_make_twin", "_data", "joint_score", "omitted_terms", "_finished", "minimise",
    "_path_warnings", "write_page",
)  # fmt: skip
"""Functions whose memory is recorded separately; the innermost one counts."""


def watched(thread: int, stop: threading.Event, most: dict[str, float]) -> None:
    """Record the largest resident memory [MiB] of each part that ``thread`` runs."""
    process = psutil.Process()
    while not stop.wait(0.05):
        frame, part = sys._current_frames().get(thread), "the rest"
        while frame is not None:
            if frame.f_code.co_name in PARTS:
                part = frame.f_code.co_name
                break
            frame = frame.f_back
        most[part] = max(most.get(part, 0.0), process.memory_info().rss / 2**20)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("case", nargs="?", default="identify-paper")
    parser.add_argument("--out", type=Path, help="a new folder; by default one that is removed")
    how = parser.parse_args()
    stop, most = threading.Event(), dict[str, float]()
    watch = threading.Thread(target=watched, args=(threading.get_ident(), stop, most))
    watch.start()
    begin, wall = time.process_time(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        summary = run_identification(how.case, how.out or Path(folder))
    seconds, wall = time.process_time() - begin, time.perf_counter() - wall
    stop.set()
    watch.join()
    print("| part | resident at most [MiB] |\n|---|---|")
    for part, memory in sorted(most.items(), key=lambda item: item[1]):
        print(f"| {part} | {memory:.0f} |")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n{seconds:.0f} s of processor, {wall:.0f} s, {peak:.0f} MiB at most, "
          f"{summary['evaluations']} evaluations of the model")  # fmt: skip


if __name__ == "__main__":
    main()
