"""Named columns of CSV, NPZ, HDF5, MAT and VTK files, and the meaning of the names of DIC codes."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import h5py
import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import read_any_mesh
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import encoding_of, open_hdf5, read_in_child, reading, require_plausible
from modeharvest.util.machine import require_memory

Table = dict[str, FloatArray]

TEXTS = (".csv", ".txt", ".dat", ".tsv")
_VECTORS = ("u", "displacement", "disp", "displacements")
_MISSING = {"", "-", "--", "---", "na", "n/a", "nan", "null", "none"}
_WHAT, _REMEDY = "a displacement field", "export it again, best as CSV"
_BYTES_OF_TEXT = 10.0
"""Most bytes in memory for a character of a table of numbers."""
_HEAD = 1000
"""Lines of a text in which the first line of numbers is searched."""
_BENCHMARK = re.compile(r"benchmark\W+([0-9a-f]{12})\b", re.IGNORECASE)
_LOGICAL = {"true": 1.0, "false": 0.0}


def read_table(path: Path | str) -> Table:
    """Read all the numeric variables of a file, each under its name.

    ``.csv``, ``.txt``, ``.dat`` or ``.tsv`` with columns; ``.npz``; ``.h5`` or ``.hdf5``; ``.mat``
    of any version; ``.vtk``, ``.vtu`` or ``.vtp`` with a vector named u or displacement at its
    points. Variables in groups or structures are found by their last name. Raises InputError if the
    file is missing, not of its kind, or holds no numbers.
    """
    path = Path(path)
    with reading(path, f"{_WHAT} ({path.suffix})", _REMEDY):
        reader = READERS.get(path.suffix.lower())
        if reader is None:
            raise InputError(
                f"{path}: expected one of {', '.join(sorted(READERS))}, got {path.suffix!r}; "
                "save the field as CSV"
            )
        table = reader(path)
        if not table:
            raise InputError(f"{path}: expected numeric variables, found none")
        return table


def _read_text(path: Path) -> Table:
    """Read columns under a line of names; lines before it are skipped, '#' may precede it."""
    require_memory(_BYTES_OF_TEXT * path.stat().st_size, f"the table {path}", "thin it out")
    numbered = _numbered(path)
    first = next((i for i, (_, line) in enumerate(numbered) if _looks_numeric(line)), None)
    if first is None:
        raise InputError(f"{path}: expected lines of numbers, found none")
    separator, decimal = _dialect(*(line for _, line in numbered[first:]))
    names = _split(numbered[first - 1][1], separator) if first else []
    while names and not names[-1]:
        names.pop()  # due to a separator at the end of the line
    row = _split(numbered[first][1], separator)
    if len(names) != len(row) - (not row[-1]) and len(names) != len(row):
        names = [str(k + 1) for k in range(len(row))]  # to be called by their number
    values = _numbers_at_once(path, numbered[first][0], separator)
    if values is None or values.shape[1] != len(names):
        values = _numbers_by_line(path, numbered[first][0], separator, decimal, len(names))
    return {name: values[:, k] for k, name in enumerate(names)}


def _numbered(path: Path, begin: int = 1, end: int | None = _HEAD) -> list[tuple[int, str]]:
    """Numbers and contents of the lines that aren't empty, from ``begin`` to ``end``."""
    with path.open(encoding=encoding_of(path), errors="replace") as file:
        lines = islice(enumerate(file, start=1), begin - 1, end)
        stripped = ((k, line.strip().lstrip("#%").strip()) for k, line in lines)
        return [(k, line) for k, line in stripped if line]


def _numbers_at_once(path: Path, begin: int, separator: str | None) -> FloatArray | None:
    """(n, m) values of a table of nothing but numbers, fast; None if there is anything else."""
    try:
        return np.loadtxt(
            path, delimiter=separator, comments=None, skiprows=begin - 1, ndmin=2,
            encoding=encoding_of(path),
        )  # fmt: skip
    except ValueError:  # words, gaps, decimal commas, or lines of different lengths
        return None


def _numbers_by_line(
    path: Path, begin: int, separator: str | None, decimal: str, width: int
) -> FloatArray:
    """(n, width) values, read line by line to name a line that holds anything else."""
    rows = [(k, _split(line, separator)) for k, line in _numbered(path, begin, None)]
    for k, row in rows:
        if len(row) - width not in (0, 1) or any(row[width:]):
            raise InputError(f"{path}, line {k}: expected {width} values, got {len(row)}")
    return np.array([[_number(v, decimal, path, k) for v in row[:width]] for k, row in rows])


def _looks_numeric(line: str) -> bool:
    """Whether at least two fields are there, and all are numbers or missing."""
    separator, decimal = _dialect(line)
    fields = _split(line, separator)
    numbers = sum(_is_number(f, decimal) for f in fields)
    others = _MISSING | set(_LOGICAL)
    return numbers >= 2 and all(_is_number(f, decimal) or f.lower() in others for f in fields)


def _dialect(line: str, *more: str) -> tuple[str | None, str]:
    """Separator (None: blanks) and decimal sign of lines of numbers; the first may have no sign."""
    separator = next((sign for sign in ";\t," if sign in line), None)
    if separator == "," and '"' not in line:
        return separator, "."
    for text in (line, *more) if separator else ():
        fields = "".join(_split(text, separator))
        if "," in fields or "." in fields:
            return separator, "." if "." in fields else ","
    return separator, "."


def _split(line: str, separator: str | None) -> list[str]:
    # Blanks separate, except before a unit: x [mm].
    if separator is None:
        fields = re.split(r"\s+(?!\[)", line)
    elif '"' in line:  # a quoted field may hold the separator: "0,5","1,5"
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    else:
        fields = line.split(separator)
    return [f.strip().strip("\"'").strip() for f in fields]


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.replace(decimal, "."))
    except ValueError:
        return False
    return True


def _number(text: str, decimal: str, path: Path, line: int) -> float:
    if text.lower() in _MISSING:
        return float("nan")
    if text.lower() in _LOGICAL:
        return _LOGICAL[text.lower()]
    if not _is_number(text, decimal):
        raise InputError(f"{path}, line {line}: expected a number, got {text!r}")
    return float(text.replace(decimal, "."))


def _read_npz(path: Path) -> Table:
    with path.open("rb") as stream:  # which numpy doesn't close if the archive is damaged
        with ZipFile(stream) as archive:
            require_plausible(path, float(sum(part.file_size for part in archive.infolist())))
        stream.seek(0)
        file = np.load(stream, allow_pickle=False)
        return _numeric({name: file[name] for name in file.files})


def _read_hdf5(path: Path) -> Table:
    found: dict[str, Any] = {}
    with open_hdf5(path, _WHAT, _REMEDY) as file:
        file.visititems(
            lambda n, o: found.update({n: o[()]}) if isinstance(o, h5py.Dataset) else None
        )
    return _numeric(_by_last_name(found))


def _read_mat(path: Path) -> Table:
    if h5py.is_hdf5(path):  # version 7.3, in which MATLAB's columns are HDF5's rows
        return {name: array.T for name, array in _read_hdf5(path).items()}
    return _numeric(_by_last_name(read_mat(path)))


def read_mat(path: Path) -> dict[str, NDArray[Any]]:
    """Numbers and texts of a MAT file before version 7.3, by their path in structures."""
    return read_in_child("mat", path, "a MAT file", _REMEDY)


def claimed_benchmark(path: Path) -> str | None:
    """Id of the benchmark that a file says it belongs to; None if it says none or can't be read."""
    suffix, text = path.suffix.lower(), ""
    with suppress(InputError), reading(path, _WHAT):  # who reads the field says what is wrong
        if suffix in TEXTS:
            with path.open(encoding="utf-8", errors="replace") as file:
                text = "".join(line for line in islice(file, 50) if line[0] in "#%")
        elif suffix == ".npz":
            with path.open("rb") as stream:
                text = f"benchmark {np.load(stream, allow_pickle=False)['benchmark']}"
        elif h5py.is_hdf5(path):
            with open_hdf5(path, _WHAT) as file:
                text = f"benchmark {file.attrs['benchmark']}"
        elif suffix == ".mat":
            text = f"benchmark {read_mat(path)['benchmark'].ravel()[0]}"
    found = _BENCHMARK.search(text)
    return found.group(1).lower() if found else None


def _read_vtk(path: Path) -> Table:
    """Positions x and y, and a vector at them as u and v, in mm and up if its name ends in _mm."""
    mesh = read_any_mesh(path)
    vectors = {n: v for n, v in mesh.point_data.items() if v.ndim == 2 and v.shape[1] in (2, 3)}
    named = [n for n in vectors if n.lower().removesuffix("_mm") in _VECTORS] or list(vectors)
    if "displacement_px" in vectors:
        raise InputError(
            f"{path}: expected lengths in mm, got a measurement in px; give the CSV or HDF5 file "
            "of the same name, or measure with --pixel-size"
        )
    if len(named) != 1:
        raise InputError(
            f"{path}: expected one vector at the points, named u or displacement, got "
            f"{', '.join(map(repr, mesh.point_data)) or 'none'}"
        )
    (x, y), (u, v) = mesh.points[:, :2].T, vectors[named[0]][:, :2].T
    heads = ("x", "y", "u", "v")
    if named[0].endswith("_mm"):
        heads = ("x [mm]", "y up [mm]", "u [mm]", "v up [mm]")
    return _numeric(dict(zip(heads, (x, y, u, v), strict=True)))


def _by_last_name(found: dict[str, Any]) -> dict[str, Any]:
    """Short names where they are unique; whole paths where they are not."""
    last = [path.rsplit("/", 1)[-1] for path in found]
    return {
        name if last.count(name) == 1 else path: value
        for (path, value), name in zip(found.items(), last, strict=True)
    }


def _numeric(found: dict[str, Any]) -> Table:
    """The arrays of numbers among them, as floats."""
    table = {}
    for name, value in found.items():
        array = np.asarray(value)
        if array.dtype.kind in "fiub":
            table[name] = array.astype(np.float64)
    return table


READERS: dict[str, Callable[[Path], Table]] = {
    **dict.fromkeys(TEXTS, _read_text),
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
    ".npz": _read_npz,
    ".mat": _read_mat,
    **dict.fromkeys((".vtk", ".vtu", ".vtp"), _read_vtk),
}
"""Readers by the ending of a file's name."""

ROLES = ("x", "y", "u", "v")
ALL_ROLES = (*ROLES, "sd_u", "sd_v", "sigma", "valid")

_BASES: dict[str, set[str]] = {
    "x": {"x", "ss x", "subset x", "coordinate x", "coord x", "pos x", "position x", "x c", "xc",
          "x coordinate", "x pos", "subset coordinates x"},
    "u": {"u", "ux", "u x", "disp u", "disp x", "dx", "displacement x", "displacement u", "u c",
          "x displacement", "displacements u", "d x"},
    "sd_u": {"sd u", "sigma u", "std u", "u std", "u sd"},
}  # fmt: skip
_TURNED = {"x": "y", "u": "v", "sd_u": "sd_v"}
_ALONE = ("sigma", "valid")
_IMAGE_CODES = {"subset x", "ss x", "coordinate x", "subset coordinates x"}
"""Names of codes that always write pixels, y down: pyvale and DICe."""
_UNITS = {"px": "px", "pixel": "px", "pixels": "px", "pix": "px", "mm": "mm"}


@dataclass(frozen=True)
class Column:
    """The meaning of a column's name."""

    name: str
    role: str | None
    """One of :data:`ALL_ROLES`; None for any other."""
    unit: str | None
    """Stated by the name, "px" or "mm"; else None."""
    y_axis: str | None
    """Stated by the name, "up" or "down"; else None."""


def column(name: str) -> Column:
    """Read a column's name."""
    words = re.sub(r"[\[\](){}_.,:/]+", " ", re.sub(r"(?<=[a-z])(?=[XYUV]$)", " ", name))
    parts = words.strip().lower().split()
    unit = next((_UNITS[p] for p in parts if p in _UNITS), None)
    y_axis = next((p for p in parts if p in ("up", "down")), None)
    base = " ".join(p for p in parts if p not in _UNITS and p not in ("up", "down"))
    role = _role(base)
    if _as_x(base) in _IMAGE_CODES and unit is None:
        return Column(name, role, "px", "down")
    return Column(name, role, unit, y_axis)


def _role(base: str) -> str | None:
    as_x = _as_x(base)
    role = next((role for role, bases in _BASES.items() if as_x in bases), None)
    if role is None:
        return base if base in _ALONE else None
    return role if as_x == base else _TURNED[role]


def _as_x(base: str) -> str:
    """The name that the x component would have."""
    turn = {"y": "x", "v": "u", "uy": "ux", "dy": "dx", "yc": "xc"}
    return " ".join(turn.get(word, word) for word in base.split())


def choose(
    names: list[str], given: Mapping[str, str | int], units: str | None, where: str
) -> dict[str, Column]:
    """Decide which of a file's columns plays which role.

    InputError if a column is missing, or several could be meant.

    given : Names, or numbers from 1, of roles that the user knows.
    units : "px" or "mm", to choose between a field in pixels and one in millimetres; or None.
    where : The file, for messages.
    """
    columns = [column(name) for name in names]
    chosen: dict[str, Column] = {}
    for role, key in given.items():
        if role not in ALL_ROLES:
            raise InputError(
                f"{where}: expected columns to be given for {', '.join(ALL_ROLES)}, got {role!r}"
            )
        name = names[key - 1] if isinstance(key, int) and 0 < key <= len(names) else str(key)
        if name not in names:
            raise InputError(f"{where}: expected a column {key!r} for {role}, got {_listed(names)}")
        chosen[role] = column(name)
    for role in ALL_ROLES:
        candidates = [c for c in columns if c.role == role]
        if role in chosen or not candidates:
            continue
        best = _narrowed(candidates, units)
        if len(best) > 1:
            raise InputError(
                f"{where}: expected one column for {role}, got {_listed([c.name for c in best])}; "
                f"name one in columns, or give units"
            )
        chosen[role] = best[0]
    missing = [role for role in ROLES if role not in chosen]
    if missing:
        raise InputError(
            f"{where}: expected columns for {', '.join(missing)}, got {_listed(names)}; "
            "call them x, y, u and v in the file, or name them in columns"
        )
    return chosen


def _narrowed(candidates: list[Column], units: str | None) -> list[Column]:
    """Drop columns in another unit."""
    if len(candidates) == 1 or units is None:
        return candidates
    fitting = [c for c in candidates if c.unit in (units, None)] or candidates
    named = [c for c in fitting if c.unit == units]
    return named if len(named) == 1 else fitting


def _listed(names: list[str]) -> str:
    shown = ", ".join(repr(n) for n in names[:12])
    return shown + (f" and {len(names) - 12} more" if len(names) > 12 else "")
