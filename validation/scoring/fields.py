"""Displacement fields of any DIC code: read from file, with the id of the benchmark they claim."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from modeharvest.fem.field import read_any_mesh
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.idic.local.tables import read_mat
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError
from modeharvest.util.files import open_hdf5, reading

_VTK = {".vtk", ".vtu", ".vtp"}
_TEXT = {".csv", ".txt", ".dat", ".tsv"}
_KINDS = {*_TEXT, ".npz", ".h5", ".hdf5", ".mat", *_VTK}
_OPTIONS = {
    "give units='px' or 'mm'": "give --unit px or mm",
    "give y_axis='up' or 'down'": "give --y-axis up or down",
    "name them in columns": "say which of them by --column, as u=disp_x",
}
_VECTORS = ("u", "displacement", "disp", "displacements")
_ID = re.compile(r"benchmark\W+([0-9a-f]{12})\b", re.IGNORECASE)


@dataclass(frozen=True)
class Declared:
    """What is declared of a field's file that it doesn't state itself.

    What has no words is as for :func:`modeharvest.idic.local.field.read_field`.
    """

    name: str | None = None
    """Of the code, for tables; the file's by default."""
    units: str | None = None
    displacement_units: str | None = None
    y_axis: str | None = None
    first_pixel: int = 0
    columns: Mapping[str, str | int] | None = None


def read_measured(
    path: Path | str, grid: PixelGrid, benchmark: str, declared: Declared | None = None
) -> LocalField:
    """Read a field to be graded.

    ``path``: CSV, NPZ, HDF5, MAT; VTK or VTU with a vector named u or displacement at its points;
    ``grid``, ``benchmark``: the benchmark's pixels, and its id. InputError if it can't be read, or
    says that it is of another benchmark.
    """
    path, how = Path(path), asdict(declared or Declared())
    name = how.pop("name") or path.stem
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise InputError(f"expected a displacement field in {path}, found {found}")
    if path.suffix.lower() not in _KINDS:
        known, got = ", ".join(sorted(_KINDS)), path.suffix
        raise InputError(f"{path}: expected one of {known}, got {got!r}; save the field as CSV")
    claimed = claimed_benchmark(path)
    if claimed not in (None, benchmark):
        raise InputError(
            f"{path}: expected a field of benchmark {benchmark}, but it says that it is of "
            f"{claimed}; take the truth of that one"
        )
    read = _read_vtk if path.suffix.lower() in _VTK else read_field
    try:
        return replace(read(path, grid, **how), source=name)
    except InputError as error:
        message = str(error)
        for argument, option in _OPTIONS.items():
            message = message.replace(argument, option)
        raise InputError(message) from error


def claimed_benchmark(path: Path) -> str | None:
    """The id that a file itself says it belongs to; None if it says none or can't be read."""
    suffix, text, what = path.suffix.lower(), "", "a displacement field"
    with suppress(InputError), reading(path, what):  # who reads the field says what is wrong
        if suffix in _TEXT:
            with path.open(encoding="utf-8", errors="replace") as file:
                text = "".join(line for line in islice(file, 50) if line[0] in "#%")
        elif suffix == ".npz":
            with path.open("rb") as stream:
                text = f"benchmark {np.load(stream, allow_pickle=False)['benchmark']}"
        elif h5py.is_hdf5(path):
            with open_hdf5(path, what) as file:
                text = f"benchmark {file.attrs['benchmark']}"
        elif suffix == ".mat":
            text = f"benchmark {read_mat(path)['benchmark'].ravel()[0]}"
    found = _ID.search(text)
    return found.group(1).lower() if found else None


def _read_vtk(path: Path, grid: PixelGrid, **how: Any) -> LocalField:
    """By way of a table of columns, so that units and axes are declared as for any file."""
    with reading(path, f"a displacement field ({path.suffix})", "save it as CSV"):
        mesh = read_any_mesh(path)
        vectors = {
            name: np.asarray(values, dtype=np.float64)
            for name, values in mesh.point_data.items()
            if np.ndim(values) == 2 and np.shape(values)[1] in (2, 3)
        }
    named = [name for name in vectors if name.lower() in _VECTORS] or list(vectors)
    if len(named) != 1:
        raise InputError(
            f"{path}: expected one vector at the points, named u or displacement, got "
            f"{', '.join(map(repr, mesh.point_data)) or 'none'}"
        )
    (x, y), (u, v) = mesh.points[:, :2].T, vectors[named[0]][:, :2].T
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / f"{path.stem}.npz"
        np.savez(table, x=x, y=y, u=u, v=v)
        try:
            return read_field(table, grid, **how)
        except InputError as error:
            raise InputError(str(error).replace(str(table), str(path))) from error
