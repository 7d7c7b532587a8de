"""Parsers that can crash, run in a separate process: ``python child.py KIND FILE TARGET``.

scipy (MAT files) and meshio (meshes) trust the sizes that a file declares. A damaged file can make
scipy read outside its memory, which ends the process, and meshio fill the memory. The content goes
to TARGET, an NPZ file of numbers and texts, whose names are in its array ``names``. Imports nothing
of modeharvest, to start fast.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import Any

import numpy as np

BASE_BYTES, BYTES_PER_BYTE = 1e9, 2000.0
"""Additional memory allowed [bytes], and per byte of the file; no format compresses further."""

Arrays = dict[str, np.ndarray[Any, Any]]


def read_mat(path: str) -> Arrays:
    """Numbers and texts of a MAT file before version 7.3, by their path in structures."""
    from scipy.io import loadmat

    return dict(_flattened(loadmat(path, simplify_cells=True)))


def _flattened(content: dict[str, Any], above: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in content.items():
        if name.startswith("__"):
            continue
        if isinstance(value, dict):
            yield from _flattened(value, f"{above}{name}/")
        elif isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            yield from _flattened({str(k): one for k, one in enumerate(value)}, f"{above}{name}/")
        else:
            yield above + name, np.asarray(value)


def read_mesh(path: str) -> Arrays:
    """``points``, ``cells/N/TYPE``, ``cell_sets/N/NAME`` and ``point_data/NAME`` of a mesh."""
    import meshio

    _add_plane_elements()
    mesh = meshio.read(path)
    cells = {f"cells/{k}/{block.type}": block.data for k, block in enumerate(mesh.cells)}
    fields = {f"point_data/{name}": values for name, values in mesh.point_data.items()}
    sets = {f"cell_sets/{k}/{n}": s for n, v in mesh.cell_sets.items() for k, s in enumerate(v)}
    return {"points": mesh.points, **cells, **fields, **sets}


def _add_plane_elements() -> None:
    """Complete meshio's list of Abaqus' plane elements: plane strain, reduced, hybrid, ..."""
    from meshio.abaqus._abaqus import abaqus_to_meshio_type as known

    for nodes, name in {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8"}.items():
        for kind in ("CPS", "CPE", "CPEG"):
            for end in ("", "H", "I", "IH", "M", "MH", "R", "RH"):
                known[f"{kind}{nodes}{end}"] = name


KINDS = {"mat": read_mat, "mesh": read_mesh}


def convert(kind: str, path: str, target: str) -> str:
    """Read ``path``, of one of ``KINDS``, and write NPZ; returns why that failed, or ""."""
    output = StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(output), redirect_stderr(output):
            warnings.simplefilter("ignore")  # doubtful content is left out below
            found = {name: np.asarray(values) for name, values in KINDS[kind](path).items()}
        kept = {name: array for name, array in found.items() if array.dtype.kind in "fiubU"}
        np.savez(target, *kept.values(), names=np.array(list(kept), dtype=np.str_))
    except (Exception, SystemExit) as error:  # parsers raise any type, print the cause, may exit
        if isinstance(error, MemoryError):
            return "it declares more numbers than a file of its size can hold"
        return " ".join((output.getvalue() or str(error)).split()) or type(error).__name__
    return ""


def limit_memory(path: str) -> None:
    """Limit this process's memory (Linux only), so that excessive allocations fail."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            taken = int(file.read().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):  # not Linux
        return
    most = int(taken + BASE_BYTES + BYTES_PER_BYTE * os.path.getsize(path))
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def main(arguments: Sequence[str]) -> int:
    """Convert a file as the module describes; returns 0, or 1 with the cause on stderr."""
    kind, path, target = arguments
    limit_memory(path)
    failure = convert(kind, path, target)
    print(failure, file=sys.stderr)
    return int(bool(failure))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
