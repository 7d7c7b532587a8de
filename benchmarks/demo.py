"""Time and memory of the whole demo, stage by stage: ``python benchmarks/demo.py``.

Runs ``modeharvest run paper-virtual`` twice in processes of its own: with numba's kernels to be
compiled, as on a new machine, and with the kernels cached. Seconds are this machine's; the shares
of the stages and the peak memory carry over.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from modeharvest.stages import Stages

STAGES = ("fem", "image", "correlate", "validate")


def main() -> None:
    """Print the table."""
    print(f"{'kernels':10}" + "".join(f"{stage + ' [s]':>14}" for stage in STAGES), end="")
    print(f"{'whole [s]':>14}{'peak [MiB]':>14}")
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": f"{folder}/numba"}
        for kernels in ("compiled", "cached"):
            out = Path(folder) / kernels
            command = [
                sys.executable,
                "-m",
                "modeharvest",
                "run",
                "paper-virtual",
                "--out",
                str(out),
            ]
            begin = time.perf_counter()
            subprocess.run(command, env=environment, check=True, capture_output=True)
            whole = time.perf_counter() - begin
            seconds = Stages(out).timings
            peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            print(f"{kernels:10}" + "".join(f"{seconds[s]:14.1f}" for s in STAGES), end="")
            print(f"{whole:14.1f}{peak:14.0f}")


if __name__ == "__main__":
    main()
