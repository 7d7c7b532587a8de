"""Time and memory of ``modeharvest run paper-virtual``, stage by stage, and of the demo.

``python benchmarks/demo.py`` (two minutes) runs the case twice in new processes: first with all to
be compiled, as on a new machine (numba's kernels and dolfinx' forms), then with it cached. "other"
is the time outside of the stages: Python's start, and the wait for kernels that children compile
during the finite elements. Seconds depend on the machine; shares of stages and peak memory (of the
largest process) hardly do. Printed before are the best of five times of ``modeharvest --help``, and
four of ``modeharvest demo``, of which the last is cached. Table: docs/explanation/speed.md.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from modeharvest.util.stages import Stages

STAGES = ("fem", "image", "correlate", "validate")
COMMAND = [sys.executable, "-m", "modeharvest"]


def timed(*arguments: str, environment: Mapping[str, str]) -> tuple[float, float]:
    """Wall-clock time and time of all processors that a command takes [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    subprocess.run([*COMMAND, *arguments], env=environment, check=True, capture_output=True)
    seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        own = {"NUMBA_CACHE_DIR": f"{folder}/numba", "XDG_CACHE_HOME": f"{folder}/cache"}
        environment = {**os.environ, **own}
        best = min(timed("--help", environment=environment)[0] for _ in range(5))
        print(f"modeharvest --help: {best:.2f} s")
        for k, which in enumerate(("first", "first", "first", "again")):
            kernels = {"NUMBA_CACHE_DIR": f"{folder}/demo{min(k, 2)}"}
            out = f"{folder}/modeharvest-demo{k}"
            seconds, busy = timed("demo", "--out", out, environment=environment | kernels)
            print(f"modeharvest demo, {which}: {seconds:.1f} s, {busy:.1f} s of processors")
        columns = (*STAGES, "other", "whole", "processors")
        print(f"{'kernels':10}" + "".join(f"{name + ' [s]':>16}" for name in columns), end="")
        print(f"{'peak [MiB]':>16}")
        for kernels in ("compiled", "cached"):
            out = Path(folder) / kernels
            whole, processors = timed("run", "paper-virtual", "--out", str(out),
                                      environment=environment)  # fmt: skip
            taken = Stages(out).timings
            stages = [taken[stage] for stage in STAGES]
            row = (*stages, whole - sum(stages), whole, processors)
            peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            print(f"{kernels:10}" + "".join(f"{s:16.1f}" for s in row) + f"{peak:16.0f}")


if __name__ == "__main__":
    main()
