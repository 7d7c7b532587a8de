#!/usr/bin/env python3
"""Run every shipped case and study in a checkout, and compare the results of two checkouts.

    scripts/compare_outputs.py make CHECKOUT OUT [--whole] [--only NAME ...]
    scripts/env python scripts/compare_outputs.py compare BEFORE AFTER [--tolerance 1e-12]

``make`` runs the commands below with CHECKOUT (studies with --quick unless --whole is given), each
in a separate folder in OUT; finished commands are not repeated. ``compare`` compares all numbers
and texts in the JSON, CSV, HDF5, NPZ and TIFF files of BEFORE, and the points and point data of VTU
files; ``scripts/renamed_outputs.toml`` has the new names of renamed ones. Pages, pictures,
durations, software versions, digests and files named by a digest (tables repeat their content) are
left out. New files and values and changed sentences are listed, but don't count as differences. The
exit code is 1 if anything else is missing or differs by more than the tolerance (relative; absolute
below 1).
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from itertools import product
from pathlib import Path

COMMANDS = {
    "paper-virtual": "run paper-virtual --out {out}",
    "benchmark": "benchmark make paper-virtual --out {out}",
    "square-lattice": "modes square-lattice --out {out}",
    "hexagonal-lattice": "modes hexagonal-lattice --out {out}",
    "chiral-lattice": "modes chiral-lattice --out {out}",
    "mode-study": "modes mode-study --out {out}",
    "star": "benchmark star --out {out}",
    "modes": "study modes {quick} --out {out}",
    "resolution": "study resolution {quick} --out {out}",
    "robustness": "study robustness {quick} --out {out}",
    "noise": "study noise {quick} --out {out}",
    "systematic": "study systematic {quick} --out {out}",
    "paper-real-twin": "run paper-real-twin --out {out}",
}
"""Commands of all shipped cases and studies, by the names of their folders in OUT."""

RENAMED = Path(__file__).with_name("renamed_outputs.toml")
NOT_COMPUTED = {"timings.json", "stages.json"}
READ = {".json", ".csv", ".npz", ".tif", ".tiff", ".h5", ".vtu"}
PROSE = "a sentence"
DIGEST = re.compile(r"[0-9a-f]{12,64}")
LEAST_WORDS = 4
"""A text of at least this many words is a sentence for readers."""
SKIPPED = {"seconds", "versions", "source", "sha256", "digest", "key", "software", "files"}


def make(checkout: Path, out: Path, whole: bool, only: list[str]) -> int:
    """Run the commands with a checkout; go on after failures, and return their number."""
    failed = 0
    for name, command in COMMANDS.items():
        done = out / f"{name}.done"
        if (only and name not in only) or done.exists():
            continue
        words = command.format(out=out / name, quick="" if whole else "--quick").split()
        print("modeharvest", *words, flush=True)
        run = subprocess.run([checkout / "scripts/env", "modeharvest", *words], check=False)
        if run.returncode:
            print(f"failed: {name}", file=sys.stderr)
            failed += 1
        else:
            done.touch()
    return failed


class Renamed:
    """New names of files, keys, columns and values that have been renamed; removed keys."""

    def __init__(self, table: Path) -> None:
        content = tomllib.loads(table.read_text()) if table.is_file() else {}
        self.names: dict[str, str] = content.get("names", {})
        self.values: dict[str, str] = content.get("values", {})
        self.files: dict[str, str] = content.get("files", {})
        self.removed: dict[str, list[str]] = content.get("removed", {})

    def gone(self, path: Path) -> set[str]:
        """Keys of a file of the earlier run that have been removed since."""
        return {key for file, keys in self.removed.items() if path.match(file) for key in keys}

    def path(self, path: Path) -> Path:
        """Path of a file of the earlier run with its present name."""
        return next(
            (path.with_name(new) for old, new in self.files.items() if path.match(old)), path
        )


def flat(
    thing: object, renamed: Renamed, skipped: set[str], at: str = ""
) -> Iterator[tuple[str, object]]:
    """Path of keys, and value, of every number and text of a JSON file."""
    if isinstance(thing, dict):
        for key, value in thing.items():
            if key not in skipped:
                yield from flat(value, renamed, skipped, f"{at}/{renamed.names.get(key, key)}")
    elif isinstance(thing, list):
        for index, value in enumerate(thing):
            yield from flat(value, renamed, skipped, f"{at}/{index}")
    else:
        yield at, renamed.values.get(thing, thing) if isinstance(thing, str) else thing


def contents(path: Path, renamed: Renamed) -> Iterator[tuple[str, object]]:
    """Name and value of every number, text, array and attribute of a file."""
    import h5py
    import meshio
    import numpy as np
    import pandas as pd
    import tifffile

    names = renamed.names
    match path.suffix:
        case ".json":
            skipped = SKIPPED | renamed.gone(path)
            yield from flat(json.loads(path.read_text()), renamed, skipped)
        case ".csv":
            for key, column in pd.read_csv(path, comment="#").items():
                values = [renamed.values.get(v, v) if isinstance(v, str) else v for v in column]
                yield names.get(str(key), str(key)), np.array(values)
        case ".npz":
            with np.load(path, allow_pickle=False) as content:
                yield from ((names.get(key, key), content[key]) for key in content.files)
        case ".tif" | ".tiff":
            yield "image", tifffile.imread(path)
        case ".vtu":
            mesh = meshio.read(path)
            yield "points", mesh.points
            yield from ((names.get(key, key), value) for key, value in mesh.point_data.items())
        case ".h5":
            found: list[tuple[str, object]] = []

            def visit(key: str, node: h5py.Group | h5py.Dataset) -> None:
                at = "/".join(names.get(part, part) for part in key.split("/"))
                if isinstance(node, h5py.Dataset):
                    found.append((at, node[()]))
                for name, value in node.attrs.items():
                    if name not in SKIPPED:
                        found.append((f"{at}@{names.get(name, name)}", value))

            with h5py.File(path) as file:
                visit("", file)
                file.visititems(visit)
            yield from found


def difference(before: object, now: object, tolerance: float) -> str:
    """Text of the difference of two values; empty if they agree."""
    import numpy as np

    one, other = np.asarray(before), np.asarray(now)
    if one.shape != other.shape:
        return f"shape {one.shape} is now {other.shape}"
    if one.dtype.kind not in "biufc" or other.dtype.kind not in "biufc":
        pairs = [(str(x), str(y)) for x, y in zip(one.flat, other.flat, strict=True)]
        unlike = [(x, y) for x, y in pairs if x != y and not DIGEST.fullmatch(x)]
        if any(len(x.split()) < LEAST_WORDS for x, _ in unlike):
            return f"{len(unlike)} of {one.size} differ, e.g. {unlike[0]}"
        return f"{PROSE}: {unlike[0][0]!r} is now {unlike[0][1]!r}" if unlike else ""
    one, other = one.astype(complex), other.astype(complex)
    equal = (one == other) | (np.isnan(one) & np.isnan(other))
    with np.errstate(invalid="ignore"):
        distance = np.where(equal, 0, np.abs(one - other) / np.maximum(1, np.abs(one)))
    worst = float(np.nan_to_num(distance, nan=math.inf).max(initial=0))
    return "" if worst <= tolerance else f"differs by {worst:.3g}"


def alternatives(key: str) -> list[str]:
    """The paths that a path of keys stands for, where parts may be alternatives "a|b"."""
    return ["/".join(parts) for parts in product(*(part.split("|") for part in key.split("/")))]


def compared(folder: Path) -> list[Path]:
    """The files of a folder that are compared, relative to it."""
    return [
        path.relative_to(folder)
        for path in sorted(folder.rglob("*"))
        if path.suffix in READ
        and path.name not in NOT_COMPUTED
        and not any(DIGEST.fullmatch(Path(p).stem) for p in path.relative_to(folder).parts)
    ]


def compare(before: Path, after: Path, tolerance: float) -> int:
    """Print all differences; return their number, without what is new and changed sentences."""
    renamed, as_is, differences, values = Renamed(RENAMED), Renamed(Path()), 0, 0
    files, added = compared(before), set(compared(after))
    for path in files:
        old, new = before / path, after / renamed.path(path)
        added.discard(renamed.path(path))
        if not new.exists():
            print(f"{path}: missing")
            differences += 1
            continue
        now = dict(contents(new, as_is))
        for key, value in contents(old, renamed):
            values += 1
            name = next((name for name in alternatives(key) if name in now), None)
            what = "missing" if name is None else difference(value, now.pop(name), tolerance)
            if what:
                print(f"{path}: {key}: {what}")
                differences += not what.startswith(PROSE)
        for key in now:
            print(f"{path}: {key}: new")
    for path in sorted(added):
        print(f"{path}: new file")
    print(f"{len(files)} files, {values} values and arrays compared: {differences} differences")
    return differences


def main() -> int:
    """Run ``make`` or ``compare`` as given by the arguments; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("make", help="run all in a checkout")
    one.add_argument("checkout", type=Path)
    one.add_argument("out", type=Path)
    one.add_argument("--whole", action="store_true", help="studies without --quick (hours)")
    one.add_argument("--only", nargs="*", default=[], choices=[*COMMANDS], metavar="NAME")
    two = commands.add_parser("compare", help="compare two folders that make left")
    two.add_argument("before", type=Path)
    two.add_argument("after", type=Path)
    two.add_argument("--tolerance", type=float, default=1e-12)
    given = parser.parse_args()
    if given.command == "make":
        return int(make(given.checkout.resolve(), given.out.resolve(), given.whole, given.only) > 0)
    return int(compare(given.before, given.after, given.tolerance) > 0)


if __name__ == "__main__":
    sys.exit(main())
