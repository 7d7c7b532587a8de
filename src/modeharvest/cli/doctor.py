"""``modeharvest doctor``: installed and missing libraries, and the locations of caches."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shlex import quote

FEM = ("fenics-dolfinx", "petsc4py", "gmsh")
OPTIONAL = {
    "fenics-dolfinx": "finite elements: conda, or apt install python3-dolfinx",
    "petsc4py": "comes with fenics-dolfinx",
    "gmsh": "meshes: pip install gmsh; beside dolfinx: conda, or apt install python3-gmsh",
    "imageio-ffmpeg": "videos: pip install imageio-ffmpeg",
}
"""Libraries that only some commands need, and how to install them."""
NEEDS: Mapping[str, tuple[str, ...]] = {
    "demo": (), "doctor": (), "cases": (), "image": (), "correlate": (), "validate": (),
    "share": (), "harvest": (), "design": (), "study": (), "score": (), "benchmark": (), "run": (),
    "measure": ("gmsh",), "fem": FEM, "bloch": FEM, "modes": FEM,
    "homogenize": FEM, "identify": FEM, "gauges": (), "animate": (), "export": (),
}  # fmt: skip
"""Libraries that each command needs beyond the package's dependencies."""
REMARKS = {
    "run": "for a specimen without a solution: fenics-dolfinx; with --whole-field: gmsh",
    "harvest": "with --whole-field: gmsh; for videos: imageio-ffmpeg",
    "design": "for other specimens than those shipped: fenics-dolfinx",
    "animate": "for MP4: imageio-ffmpeg",
    "measure": "gmsh is not needed with --mesh; for videos: imageio-ffmpeg",
    "study": "for specimens without a solution: fenics-dolfinx",
    "benchmark": "for specimens without a solution: fenics-dolfinx",
}
Row = tuple[str, str, str]


@dataclass(frozen=True)
class Diagnosis:
    """Rows of the four tables: name, value, remark."""

    machine: tuple[Row, ...]
    libraries: tuple[Row, ...]
    commands: tuple[Row, ...]
    caches: tuple[Row, ...]


def found_version(name: str) -> str:
    """Version of a library, "there" if it has none; "" if the library is missing."""
    from importlib.util import find_spec

    try:
        return version(name)
    except PackageNotFoundError:  # Debian's gmsh has no version
        module = name.replace("-", "_").removeprefix("fenics_")
        return "there" if find_spec(module) is not None else ""


def examine() -> Diagnosis:
    """Collect what is known about this machine and installation."""
    from modeharvest.util import version as own_version
    from modeharvest.util.machine import available_bytes

    machine = (
        ("modeharvest", own_version(), str(Path(__file__).parents[1])),
        ("Python", platform.python_version(), sys.executable),
        ("system", platform.platform(terse=True), platform.machine()),
        ("cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity")
                      else os.cpu_count()), ""),
        ("free memory", f"{available_bytes() / 1e9:.1f} GB", ""),
    )  # fmt: skip
    own = [(name, found_version(name) or "missing", "pip install " + name) for name in _required()]
    libraries = [(name, there, "" if there != "missing" else how) for name, there, how in own]
    extra = {name: found_version(name) for name in OPTIONAL}
    libraries += [(n, v or "missing", "" if v else OPTIONAL[n]) for n, v in extra.items()]
    commands = []
    for name, needed in NEEDS.items():
        missing = [n for n in needed if not extra[n]]
        commands.append((name, "needs " + ", ".join(missing) if missing else "ready",
                         REMARKS.get(name, "")))  # fmt: skip
    return Diagnosis(machine, tuple(libraries), tuple(commands), tuple(caches()))


def _required() -> list[str]:
    """Names of the dependencies that pip installs."""
    first = "numpy scipy h5py meshio scikit-image tifffile pillow numba finufft pydantic"
    return f"{first} typer rich matplotlib jinja2 distributed pandas psutil".split()


def caches() -> Iterator[Row]:
    """Rows about caches that are kept between runs: content, folder, and how to remove it."""
    from modeharvest.imaging.mapping.rasterise import rasterise
    from modeharvest.runs.precompile import stamps
    from modeharvest.util.compiled import cached_in, is_cached

    folder = cached_in(rasterise)
    if folder is None or not is_cached():
        yield "kernels", "not kept", "compiled every time, about 20 s; set NUMBA_CACHE_DIR"
    else:
        package = Path(__file__).resolve().parents[1]
        where = Path(os.environ["NUMBA_CACHE_DIR"]) if "NUMBA_CACHE_DIR" in os.environ else (
            package if folder.name == "__pycache__" else folder.parent
        )  # fmt: skip
        found = f"find -L {quote(str(where))} -name '*.nb[ic]'"
        yield "kernels", str(where), f"to remove: {found} -delete"
        for stage, seconds in stamps().items():
            took = f"took {seconds:.0f} s to compile ahead" if seconds else "compiled when needed"
            yield f"  of {stage}", took, ""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    own = user / "modeharvest"
    if own.is_dir():
        yield "scripts/env", str(own), f"environments; to remove: rm -r {quote(str(own))}"
    if (fenics := user / "fenics").is_dir():
        yield "dolfinx", str(fenics), f"compiled forms; to remove: rm -r {quote(str(fenics))}"


def doctor() -> None:
    """Check the installation: libraries, needs of each command, locations of caches."""
    found = examine()
    for title, rows in (("This machine", found.machine), ("Libraries", found.libraries),
                        ("Commands", found.commands), ("Caches", found.caches)):  # fmt: skip
        widths = [max(len(row[k]) for row in rows) for k in (0, 1)]
        print(title)
        for name, value, remark in rows:
            print(f"  {name:{widths[0]}}  {value:{widths[1]}}  {remark}".rstrip())
        print()
