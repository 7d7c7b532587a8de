#!/usr/bin/env python3
"""Compare processor time and peak memory of commands between two checkouts.

    scripts/compare_speed.py BEFORE AFTER [--rounds 5] [--only NAME ...]

Every command runs with ``scripts/env`` of both checkouts in turn, B A B A ..., on one thread, after
a first run for compilation that isn't counted. Time [s] is processor time of the process and its
children; memory [MiB] is that of the largest process. The table has the median of the rounds'
ratios with their range: a difference within this range is noise. The cases are made once, in a
temporary folder. Images are made from the shipped solution of paper-virtual, with T6 elements or
divided into T3, and pixels that sample points or average (``fill_factor``, ``psf_px``).
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CASE = """
[imaging]
pixel_size = {pixel}
{sensor}
[correlation]
order = 5
gradient = "deformed"
"""
"""Case file, with values of the options whose defaults may differ between the versions."""
AVERAGING = "[imaging.sensor]\nfill_factor = 1.0\npsf_px = 0.5"

CUT = """
import sys, h5py, numpy as np
with h5py.File(sys.argv[1], "r+") as f:
    cells = f["cells"][:]
    del f["cells"]
    f["cells"] = np.vstack([cells[:, c] for c in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))])
    f.attrs["element"] = "T3"
"""
"""Program that divides each T6 element of a file, straight or curved, into four T3 elements."""


@dataclass(frozen=True)
class Checkout:
    """A version of the program, and the folder of its results."""

    path: Path
    folder: Path

    def run(self, command: str) -> tuple[float, float]:
        """Processor time [s] and peak memory [MiB] of a command, with the folders filled in."""
        words = command.format(out=self.folder, cases=self.folder.parent).split()
        environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [str(self.path / "scripts" / "env"), "env", "NUMBA_NUM_THREADS=1", *words],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert process.stdout is not None
        message = process.stdout.read().decode(errors="replace")
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            what = f"{' '.join(words)} ended with {process.returncode}"
            raise SystemExit(f"{self.path}: {what}\n{message}")
        return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0


@dataclass(frozen=True)
class Contest:
    """A command to be timed, commands to run ``first``, and results ``removed`` before each run."""

    command: str
    first: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()

    def prepare(self, checkout: Checkout) -> None:
        """Run the commands that come first."""
        for command in self.first:
            checkout.run(command)

    def once(self, checkout: Checkout) -> tuple[float, float]:
        """Processor time [s] and peak memory [MiB] of one run of the command."""
        for name in self.removed:
            path = checkout.folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return checkout.run(self.command)


MAIN = "python -m modeharvest"


def image(case: str, element: str) -> Contest:
    """Making all images of a case, from the solution with ``element``."""
    solution = f"--solution {{cases}}/{element}.h5"
    out = f"{case}-{element}"
    command = f"{MAIN} image {{cases}}/{case}.toml {solution} --out {{out}}/{out}"
    return Contest(command, removed=(out,))


POINTS = "{cases}/points.toml"
SOLVED = "--solution {cases}/T6.h5"
IMAGES = f"{MAIN} image {POINTS} {SOLVED} --out {{out}}/chain"
CORRELATE = f"{MAIN} correlate {POINTS} --out {{out}}/chain"
CONTESTS = {
    "import": Contest("python {cases}/import.py"),
    "help": Contest(f"{MAIN} --help"),
    "image, T6": image("points", "T6"),
    "image, T3": image("points", "T3"),
    "image, T6, averaging": image("averaging", "T6"),
    "image, T3, averaging": image("averaging", "T3"),
    "correlate": Contest(CORRELATE, (IMAGES,), ("chain/correlation",)),
    "validate": Contest(
        f"{MAIN} validate {POINTS} {SOLVED} --out {{out}}/chain",
        (IMAGES, CORRELATE),
        ("chain/report.html", "chain/summary.json"),
    ),
    "fem": Contest(f"{MAIN} fem {POINTS} --out {{out}}/fem", removed=("fem",)),
    "harvest": Contest(
        f"{MAIN} harvest {{out}}/twin/twin/experiment/experiment.toml --out {{out}}/harvest",
        (f"{MAIN} run {{cases}}/twin.toml --out {{out}}/twin",),
        ("harvest",),
    ),
}


def make_cases(folder: Path, after: Checkout) -> None:
    """Write the cases and solutions that both checkouts read."""
    shipped = after.path / "src" / "modeharvest" / "cases"
    for name, sensor in (("points", ""), ("averaging", AVERAGING)):
        (folder / f"{name}.toml").write_text(CASE.format(pixel=0.01, sensor=sensor))
    for element in ("T6", "T3"):
        shutil.copy(shipped / "paper-virtual.h5", folder / f"{element}.h5")
    (folder / "cut.py").write_text(CUT)
    (folder / "import.py").write_text("import modeharvest\n")
    after.run(f"python {folder}/cut.py {folder}/T3.h5")
    twin = (shipped / "paper-real-twin.toml").read_text("utf-8")
    (folder / "twin.toml").write_text(twin)


def rows(names: list[str], both: tuple[Checkout, Checkout], rounds: int) -> Iterator[str]:
    """The rows of the table, one for each command, as Markdown."""
    for name in names:
        contest = CONTESTS[name]
        for checkout in both:
            contest.prepare(checkout)
            contest.once(checkout)
        laps = [[contest.once(checkout) for checkout in both] for _ in range(rounds)]
        ratios = [after[0] / before[0] for before, after in laps]
        seconds = [statistics.median(lap[k][0] for lap in laps) for k in (0, 1)]
        memory = [statistics.median(lap[k][1] for lap in laps) for k in (0, 1)]
        yield (
            f"| {name} | {seconds[0]:.2f} | {seconds[1]:.2f} | **{statistics.median(ratios):.2f}** "
            f"({min(ratios):.2f} … {max(ratios):.2f}) | {memory[0]:.0f} | {memory[1]:.0f} | "
            f"{memory[1] / memory[0]:.2f} |"
        )


def main() -> None:
    """Run the commands and print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("before", type=Path, help="a checkout")
    parser.add_argument("after", type=Path, help="another one")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="+", choices=list(CONTESTS), default=list(CONTESTS))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        both = tuple(
            Checkout(path.resolve(), folder / kind)
            for kind, path in (("before", options.before), ("after", options.after))
        )
        for checkout in both:
            checkout.folder.mkdir()
        make_cases(folder, both[1])
        print("| command | before [s] | after [s] | ratio | before [MiB] | after [MiB] | ratio |")
        print("|---|---|---|---|---|---|---|", flush=True)
        for row in rows(options.only, (both[0], both[1]), options.rounds):
            print(row, flush=True)


if __name__ == "__main__":
    main()
