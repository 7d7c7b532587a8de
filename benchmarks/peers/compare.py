"""Compare modeharvest with other programs: one run, same images, same machine.

Run: benchmarks/peers/run [--quick] [--again] [ROW ...]

Every row is measured in a new process and stored at once, so that an interrupted run continues
where it stopped; a change of the code, of the packages or of the machine starts a new one. Full
runs write the tables of docs/explanation/benchmarks*.md, quick ones only print them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import correlation
import document
import geometry
import intensity
from record import Record, stamp

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
PAGES = {
    PROJECT / "docs/explanation/benchmarks.md": ("run", "geometry", "intensity"),
    PROJECT / "docs/explanation/benchmarks_correlation.md": ("correlation",),
}
"""Pages, and the tables on each."""
SECTIONS: dict[str, ModuleType] = {
    "geometry": geometry, "intensity": intensity, "correlation": correlation,
}  # fmt: skip
ROW_TIMEOUT_S = 1800.0
"""Time limit, far longer than any row takes on a busy machine; for processes that hang."""


def main() -> int:
    arguments = _arguments()
    if arguments.measure:
        section, options = json.loads(arguments.measure)
        print(json.dumps(SECTIONS[section].measure(options)))
        return 0
    kind = "quick" if arguments.quick else "full"
    record = Record.open(PROJECT / "out" / "peers" / f"{kind}.json", stamp(PROJECT))
    wanted = {
        name: (section, options)
        for section, module in SECTIONS.items()
        for name, options in module.rows(arguments.quick).items()
    }
    chosen = _chosen(arguments.rows, list(wanted))
    failed = 0
    for number, name in enumerate(chosen, start=1):
        label = f"[{number}/{len(chosen)}] {name}"
        if name in record.rows and not arguments.again:
            print(f"{label}: kept from before", flush=True)
            continue
        print(f"{label} ...", end=" ", flush=True)
        begin = time.perf_counter()
        try:
            record.keep(name, _measure(*wanted[name]))
            print(f"{time.perf_counter() - begin:.0f} s", flush=True)
        except RuntimeError as error:
            failed += 1
            print(f"failed: {error}", flush=True)
    _report(record, list(wanted), write=not arguments.quick)
    return 1 if failed else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmarks/peers/run", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("rows", nargs="*", metavar="ROW", help="only these (or all that begin so)")
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it works")
    parser.add_argument("--again", action="store_true", help="measure even what is there")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    return parser.parse_args()


def _chosen(beginnings: list[str], names: list[str]) -> list[str]:
    chosen = [n for n in names if not beginnings or any(n.startswith(b) for b in beginnings)]
    if not chosen:
        raise SystemExit(f"expected rows among {', '.join(names)}; got {' '.join(beginnings)}")
    return chosen


def _measure(section: str, options: dict[str, Any]) -> dict[str, Any]:
    """Measure one row in a new process, so that its memory is freed."""
    command = [sys.executable, __file__, "--measure", json.dumps([section, options])]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ROW_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"it took more than {ROW_TIMEOUT_S:.0f} s") from None
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip().rsplit("\n", 1)[-1] or f"exit {done.returncode}")
    measured: dict[str, Any] = json.loads(done.stdout.rsplit("\n", 2)[-2])
    return measured


def _report(record: Record, names: list[str], *, write: bool) -> None:
    tables = {"run": record.texts()}
    for section, module in SECTIONS.items():
        measured = {n: record.rows[n] for n in module.rows(not write) if n in record.rows}
        tables[section] = module.table(measured)
    for name, lines in tables.items():
        print(f"\n{name}\n" + "\n".join(lines))
    missing = [n for n in names if n not in record.rows]
    if missing:
        print(f"\nnot measured yet: {', '.join(missing)}")
    elif write:
        for page, own in PAGES.items():
            document.write(page, {name: tables[name] for name in own})
            print(f"\nwritten: {page.relative_to(PROJECT)}")


if __name__ == "__main__":
    sys.exit(main())
