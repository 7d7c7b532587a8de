"""Record of measured rows, machine and code: a JSON file, from which a run continues."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from modeharvest.util.files import write_json

PACKAGES = ("riley-raster", "pyxel-dic", "numpy", "scipy", "numba", "finufft")
CODE = ("fem/field.py", "imaging/**/*.py", "idic/**/*.py", "benchmarks/peers/*.py")


def stamp(project: Path) -> dict[str, Any]:
    """Code, packages and machine, which all rows of a run must have in common."""
    code = hashlib.sha256()
    for pattern in CODE:
        for path in sorted(project.glob(pattern)):
            code.update(path.read_bytes())
    return {
        "code": code.hexdigest()[:12],
        "packages": {name: version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {_processor()}",
        "cores": os.cpu_count(),
    }


def _processor() -> str:
    """The processor's name, if the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "unknown processor"


@dataclass(eq=False)
class Record:
    """The rows measured so far in a run.

    Parameters
    ----------
    path
        Path of the file.
    run
        The run's stamp.
    rows
        Numbers of each row, with the time at which it was measured.
    """

    path: Path
    run: dict[str, Any]
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path, run: dict[str, Any]) -> Record:
        """Continue the run in a file if its stamp is the same, else start a new one."""
        try:
            known = json.loads(path.read_text())
        except (OSError, json.JSONDecodeError):
            return cls(path, run)
        if known.get("run") != run:
            print(f"code, packages or machine have changed since {path}: beginning anew")
            return cls(path, run)
        return cls(path, run, known["rows"])

    def keep(self, name: str, row: dict[str, Any]) -> None:
        """Add a row, and write the file."""
        self.rows[name] = row | {"when": time.strftime("%Y-%m-%d %H:%M", time.gmtime())}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, {"run": self.run, "rows": self.rows})

    def texts(self) -> list[str]:
        """Markdown that says when, where and with which versions the rows were measured."""
        if not self.rows:
            return ["Nothing has been measured yet."]
        times = sorted(row["when"] for row in self.rows.values())
        packages = ", ".join(f"{name} {number}" for name, number in self.run["packages"].items())
        return [
            f"Measured from {times[0]} to {times[-1]} UTC on {self.run['cores']} cores "
            f"({self.run['machine']}); Python {self.run['python']}, {packages}; "
            f"digest of the code {self.run['code']}."
        ]
