"""What the campaigns of test_campaign.py run, in workers of their own."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil


def square(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Wait, tell on what process, fail where told to."""
    time.sleep(case["wait"])
    if case["x"] == case["bad"]:
        raise ValueError(f"{case['x']} is bad")
    return {"square": case["x"] ** 2, "process": os.getpid()}


def holding(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Wait, for all but the five that begin first, until a file says to go on.

    Whatever order dask has them begin in: with some that wait by their x, these could be on every
    worker before one that ends by itself has begun, and nothing would ever end.
    """
    place, me = 0, str(case["x"])
    while True:
        taken = folder / f"place_{place}"
        try:
            taken.symlink_to(me)  # by one only, and known whose it is at once
        except FileExistsError:
            if str(taken.readlink()) != me:  # it isn't begun a second time
                place += 1
                continue
        break
    while place >= 5 and not (folder / "go").exists():
        time.sleep(0.02)
    return {"x_again": case["x"]}


def dies_once(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Kill its own worker, -9, the first time that x is 2; leave a line for each time it is run."""
    mark = folder / "died"
    with (folder / "runs").open("a") as runs:
        runs.write(f"{case['x']}\n")
    if case["x"] == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"x_again": case["x"]}


def duel(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Case 0 kills, -9, the worker of case 1 as often as told, which succeeds when left alone."""
    name = folder / "victim"
    if case["x"] == 1:
        name.write_text(str(os.getpid()))
        while not (folder / "over").exists():
            time.sleep(0.01)
        return {"pid": os.getpid()}
    killed: set[str] = set()
    while len(killed) < case["kills"]:
        time.sleep(0.01)
        pid = name.read_text() if name.exists() else ""
        if pid and pid not in killed:
            os.kill(int(pid), signal.SIGKILL)
            killed.add(pid)
    (folder / "over").touch()
    return {"pid": os.getpid()}


def listening(case: Mapping[str, Any], folder: Path) -> dict[str, list[str]]:
    """Tell all addresses at which the campaign's processes listen."""
    run = psutil.Process(case["x"])
    processes = [run, *run.children(recursive=True)]
    connections = [c for process in processes for c in process.net_connections("inet")]
    return {"at": [c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN]}


def dies(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Kill its own worker, -9, when x is 4."""
    if case["x"] == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"x_again": case["x"]}


def dies_later(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """Likewise, but not before a file says to go on."""
    while case["x"] == 4 and not (folder / "go").exists():
        time.sleep(0.02)
    return dies(case, folder)
