"""The script that compares the results of two checkouts."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "scripts/compare_outputs.py"


def test_files_of_one_folder_alone_are_named(tmp_path: Path) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    for folder, names in ((before, ("both", "old")), (after, ("both", "new"))):
        folder.mkdir()
        for name in names:
            (folder / f"{name}.json").write_text(json.dumps({"a": 1.0}))
    (after / "timings.json").write_text("{}")  # isn't compared
    done = subprocess.run(
        [sys.executable, SCRIPT, "compare", before, after],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        "old.json: missing",
        "new.json: new file",
        "2 files, 1 values and arrays compared: 1 differences",
    ]
