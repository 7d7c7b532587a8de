"""What the campaigns of test_campaign.py run, in workers of their own."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def square(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Wait, tell on what process, fail where told to."""
    time.sleep(case["wait"])
    if case["x"] == case["bad"]:
        raise ValueError(f"{case['x']} is bad")
    return {"square": case["x"] ** 2, "process": os.getpid()}


def dies_once(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Kill its own worker, -9, the first time that x is 2."""
    mark = folder / "died"
    if case["x"] == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"x_again": case["x"]}


def dies(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Kill its own worker, -9, when x is 4."""
    if case["x"] == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"x_again": case["x"]}
