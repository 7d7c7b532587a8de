"""Conventions of DIC codes: recognises which code wrote a file, and what its numbers mean.

A file is recognised by the names in it or by its first line. The documentation's page about fields
says what was seen in files of the codes, and what is known from descriptions only.
"""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.local.tables import TEXTS, Table, read_mat, read_table
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import encoding_of, open_hdf5

_LENGTHS = {"px": "px", "pixel": "px", "mm": "mm"}  # in files of DaVis
_CSV_PX = {"x": "column", "y": "row", "u": "u [px]", "v": "v up [px]", "sd_u": "sd_u [px]",
           "sd_v": "sd_v [px]"}  # fmt: skip
_MAT_PX, _MAT_MM = (
    {
        "x": "column",
        "y": "row",
        "u": f"u_{unit}",
        "v": f"v_up_{unit}",
        "sd_u": f"sd_u_{unit}",
        "sd_v": f"sd_v_{unit}",
    }
    for unit in ("px", "mm")
)
_DISPLACEMENTS, _INFO = "data_dic_save/displacements", "data_dic_save/dispinfo/"


@dataclass(frozen=True)
class Convention:
    """Convention in which a code writes displacements: units, y axis, failed points."""

    code: str
    units: str
    displacement_units: str
    """Units of positions and of displacements, "px" or "mm"."""
    y_axis: str
    """"up" or "down": where y grows and v is positive."""
    failed: str = ""
    """Which points don't count, in words."""

    def __str__(self) -> str:
        both = {self.units, self.displacement_units}
        units = f"in {self.units}"
        if len(both) > 1:
            units = f"positions in {self.units}, displacements in {self.displacement_units}"
        first = ", first pixel 0" if self.units == "px" else ""
        failed = f", failed: {self.failed}" if self.failed else ""
        return f"{self.code}: {units}, y {self.y_axis}{first}{failed}"


def recognised(
    path: Path, units: str | None = None, y_axis: str | None = None, frame: int | None = None
) -> tuple[Table, Convention | None]:
    """Read a file's numbers, named x, y, u, v, sigma, valid, ... if its code is recognised.

    ``units``: "px" or "mm", to choose where a file holds both; ``y_axis``: "up" or "down", if it is
    declared; ``frame``: number from 1 in a file of several. InputError as for ``read_table``, or if
    a file has several frames and none is chosen.
    """
    if path.suffix.lower() == ".mat" and (found := _ncorr(path, frame)) is not None:
        return found
    table = read_table(path)
    if frame not in (None, 1):
        raise InputError(f"{path}: expected frame 1 of a file of one, got {frame}")
    for of_code in (_davis, _by_names, _matchid, _vic, _own):
        known = of_code(path, table, units, y_axis)
        if known is not None and units in (None, known[1].units):
            return known
    return table, None


Known = tuple[Table, Convention] | None


def frames_of(path: Path) -> int:
    """How many displacement fields a file holds: several in those of Ncorr, else one."""
    return max(1, len(_ncorr_frames(path)[0])) if path.suffix.lower() == ".mat" else 1


@cache
def layouts() -> dict[str, Any]:
    """The names of columns by code, from ``formats.toml``."""
    text = resources.files(__package__).joinpath("formats.toml").read_text("utf-8")
    return tomllib.loads(text.replace("MM", r"( ?[\\[(]mm[\\])])?"))


def _by_names(path: Path, table: Table, units: str | None, y_axis: str | None) -> Known:
    for layout in layouts()["named"]:
        if (found := _named(table, layout["columns"])) is not None:
            unit, more = layout["unit"], _named(table, layout["more"]) or {}
            axis = "down" if unit == "px" else "up"
            own = {role: found[role] for role in "xyuv"} | more
            return own, Convention(layout["code"], unit, unit, axis, layout["failed"])
    return None


def _named(table: Table, patterns: Mapping[str, str]) -> Table | None:
    """Columns whose names match the patterns as a whole; None if one is missing."""
    found = {}
    for role, pattern in patterns.items():
        names = [n for n in table if re.fullmatch(pattern, n.strip(), re.IGNORECASE)]
        if not names:
            return None
        found[role] = table[names[0]]
    return found


def _matchid(path: Path, table: Table, units: str | None, y_axis: str | None) -> Known:
    px = _named(table, {c: rf"(.*\.)?Image {c} ?\[Pixel\]|{c}_pic" for c in "xy"})
    if px is None:
        return None
    mm = _named(table, {c: rf"(.*\.)?{c} ?\[mm\]" for c in "xy"})
    of, names = r"(.*\.)?{}(:| Displacement:?) {} ?\[{}\]", {"u": "Horizontal", "v": "Vertical"}
    motion_of = {
        unit: motion for unit, written in (("px", "Pixel"), ("mm", "mm")) if (motion := _named(
            table, {c: of.format(name, c, written) for c, name in names.items()}))
    }  # fmt: skip
    if not motion_of:
        return None
    if units == "mm" and mm is not None and "mm" in motion_of:
        axis = "up" if _runs_against(mm["y"], px["y"]) else "down"
        return mm | motion_of["mm"], Convention("MatchID", "mm", "mm", axis, "NaN")
    unit = "px" if "px" in motion_of else "mm"
    found = px | motion_of[unit]
    if unit == "mm" and mm is not None and y_axis is None and _runs_against(mm["y"], px["y"]):
        found["v"] = -found["v"]
    return found, Convention("MatchID", "px", unit, "down", "NaN")


def _runs_against(y: FloatArray, row: FloatArray) -> bool:
    """Whether y grows where rows decrease: the file itself shows the direction of its y axis."""
    y, row = np.ravel(y), np.ravel(row)
    good = np.isfinite(y) & np.isfinite(row)
    return bool(good.sum() > 1 and np.cov(y[good], row[good])[0, 1] < 0.0)


def _vic(path: Path, table: Table, units: str | None, y_axis: str | None) -> Known:
    """Lower-case names are in pixels; in millimetres VIC-3D uses capitals, VIC-2D x_c."""
    sigma = _named(table, {"sigma": r"sigma( \[pixel\])?"})
    if sigma is None:
        return None
    px = _cased(table, ("{}", "xyuv"), ("{} [pixel]", "xyuv"))
    mm = _cased(table, ("{} [mm]", "XYUV"), ("{}", "XYUV"), ("{}_c", "xyuv"), ("{}_c [mm]", "xyuv"))
    if px is not None and units != "mm":
        return px | sigma, Convention("VIC-2D", "px", "px", "down", "sigma < 0")
    if mm is None:
        return None
    against = px is None or _runs_against(mm["y"], px["y"])
    sigma["valid"] = (sigma.pop("sigma") >= 0.0).astype(float)  # in px, of the match
    return mm | sigma, Convention("VIC", "mm", "mm", "up" if against else "down", "sigma < 0")


def _cased(table: Table, *patterns: tuple[str, str]) -> Table | None:
    for pattern, letters in patterns:
        names = [pattern.format(letter) for letter in letters]
        if set(names) <= set(table):
            return {role: table[name] for role, name in zip("xyuv", names, strict=True)}
    return None


def _own(path: Path, table: Table, units: str | None, y_axis: str | None) -> Known:
    """Displacements that modeharvest measured at the nodes of a mesh."""
    for heads in (_CSV_PX, _MAT_PX):
        if set(heads.values()) <= set(table):  # x and y [px] count from the middle of the image
            own = {role: table[name] for role, name in heads.items()}
            return own | {"v": -own["v"]}, Convention("modeharvest", "px", "px", "down")
    if set(_MAT_MM.values()) <= set(table):
        own = {role: table[name] for role, name in _MAT_MM.items()}
        return own | {"v": -own["v"]}, Convention("modeharvest", "px", "mm", "down")
    if not {"nodes", "cells", "displacement", "standard_deviation"} <= set(table):
        return None
    with open_hdf5(path, "a measured displacement (HDF5)", "measure again") as file:
        unit, grid = str(file.attrs["unit"]), json.loads(file.attrs["info"])["grid"]
    (x, y), (u, v), (sd_u, sd_v) = (
        table[name].T for name in ("nodes", "displacement", "standard_deviation")
    )
    if unit == "px":  # from the middle of the image, y up
        x, y, v = x - grid["x0"], grid["y0"] - y, -v
    found = {"x": x, "y": y, "u": u, "v": v, "sd_u": sd_u, "sd_v": sd_v}
    return found, Convention("modeharvest", unit, unit, "down" if unit == "px" else "up")


def _davis(path: Path, table: Table, units: str | None, y_axis: str | None) -> Known:
    """A first line #DaVis 8.4.0 2D-vector STEP ROWS COLS "" "UNIT" "" "UNIT" "NAME" "UNIT"."""
    if path.suffix.lower() not in TEXTS or len(table) < 4:
        return None
    with path.open(encoding=encoding_of(path), errors="replace") as file:
        line = file.readline().strip()
    if not re.match(r"#\w+ [\w.]+ 2D-vector ", line):
        return None
    words = shlex.split(line.lstrip("#"))
    if len(words) < 12 or not {words[7], words[11]} <= set(_LENGTHS):
        raise InputError(
            f"{path}: expected a unit of length for positions and displacements in the first line "
            f"of a DaVis file, got {line!r}; export displacements in pixel or mm"
        )
    found = dict(zip("xyuv", table.values(), strict=False))
    found["valid"] = ((found["u"] != 0.0) | (found["v"] != 0.0)).astype(float)
    place, motion = _LENGTHS[words[7]], _LENGTHS[words[11]]
    axis = "down" if place == "px" else "up"
    return found, Convention("DaVis", place, motion, axis, "u = v = 0")


def _ncorr(path: Path, frame: int | None) -> Known:
    """Read one displacement field of a file saved by Ncorr; None for other files."""
    frames, info = _ncorr_frames(path)
    if not frames:
        return None
    if frame is None and len(frames) > 1:
        raise InputError(
            f"{path}: expected one displacement field, got Ncorr's {len(frames)}; say which frame"
        )
    if not 0 < (number := frame or 1) <= len(frames):
        raise InputError(f"{path}: expected a frame from 1 to {len(frames)}, got {frame}")
    grids, scale = frames[number - 1], float(info.get("pixtounits", np.ones(1)).ravel()[0])
    u, v = (grids.get(f"plot_{c}_ref_formatted", np.zeros(0)) / scale for c in "uv")
    if u.size < 2:  # it was not formatted: in pixels
        u, v = (grids.get(f"plot_{c}_dic", np.zeros(0)) for c in "uv")
    if u.ndim != 2 or u.shape != v.shape:
        raise InputError(f"{path}: expected grids of u and v in Ncorr's frame {number}, got none")
    step = 1 + int(info.get("spacing", np.zeros(1)).ravel()[0])
    col, row = (step * a.astype(float) for a in np.meshgrid(*map(np.arange, u.shape[::-1])))
    valid = (u != 0.0) | (v != 0.0)
    if (match := grids.get("plot_corrcoef_dic", u)).shape == u.shape:
        valid &= match != 0.0
    table = {"x": col, "y": row, "u": u, "v": v, "valid": valid.astype(float)}
    return table, Convention("Ncorr", "px", "px", "down", "off the region, u = v = 0")


def _ncorr_frames(path: Path) -> tuple[list[Table], Table]:
    """Ncorr's grids, frame by frame, and numbers of its ``dispinfo``; no frames in other files."""
    values = _in_version_73(path) if h5py.is_hdf5(path) else read_mat(path)
    frames: dict[int, Table] = {}
    for name, array in values.items():
        place = re.fullmatch(rf"{_DISPLACEMENTS}(/\d+)?/(\w+)", name)  # deeper are regions' parts
        if place and array.dtype.kind in "fiub":
            number, last = int((place[1] or "/0")[1:]), place[2]
            frames.setdefault(number, {})[last] = np.asarray(array, dtype=np.float64)
    info = {n.removeprefix(_INFO): a for n, a in values.items() if n.startswith(_INFO)}
    return [frames[k] for k in sorted(frames)], info


def _in_version_73(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays by their path, as in older versions; references to several frames are followed."""
    found = {}
    with open_hdf5(path, "a displacement field of Ncorr", "save it again") as file:
        for group in (_DISPLACEMENTS, _INFO):
            for name, data in file.get(group, {}).items():
                if isinstance(data, h5py.Dataset) and data.dtype.kind != "O":
                    found[f"{group.rstrip('/')}/{name}"] = data[()].T
                elif isinstance(data, h5py.Dataset) and name.startswith("plot_"):
                    for k, to in enumerate(data[()].ravel()):
                        found[f"{group}/{k}/{name}"] = file[to][()].T
    return found
