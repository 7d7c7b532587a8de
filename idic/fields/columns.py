"""Which column of a DIC code's file is what: names, units and axes as the codes write them.

Known: x, y, u, v with or without a unit, the lower and upper case of VIC-2D and VIC-3D (pixels and
millimetres), DICe's COORDINATE_X and DISPLACEMENT_X, pyvale's subset_x and disp_u, GOM's and
ZEISS's dx or displacement x.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from modeharvest.errors import InputError

ROLES = ("x", "y", "u", "v")
ALL_ROLES = (*ROLES, "sd_u", "sd_v", "sigma", "valid")

_BASES: dict[str, set[str]] = {
    "x": {"x", "ss x", "subset x", "coordinate x", "coord x", "pos x", "position x", "x c", "xc",
          "x coordinate", "x pos", "subset coordinates x"},
    "u": {"u", "ux", "u x", "disp u", "disp x", "dx", "displacement x", "displacement u", "u c",
          "x displacement", "displacements u", "d x"},
    "sd_u": {"sd u", "sigma u", "std u", "u std", "u sd"},
}  # fmt: skip
_TURNED = {"y": "x", "v": "u", "sd_v": "sd_u"}
_ALONE = {"sigma": "sigma", "valid": "valid"}
_IMAGE_CODES = {"subset x", "ss x", "coordinate x", "subset coordinates x"}
"""Names of codes that always write pixels, y down: pyvale and DICe."""
_UNITS = {"px": "px", "pixel": "px", "pixels": "px", "pix": "px", "mm": "mm"}


@dataclass(frozen=True)
class Column:
    """What a column's name says.

    Parameters
    ----------
    name
        As in the file.
    role
        "x", "y", "u", "v", "sd_u", "sd_v", "sigma" or "valid"; None for any other.
    unit
        "px" or "mm", None if the name doesn't say.
    y_axis
        "up" or "down", None if the name doesn't say.
    of_image_code
        Whether only codes that measure everything in pixels use this name.
    """

    name: str
    role: str | None
    unit: str | None
    y_axis: str | None
    of_image_code: bool = False


def column(name: str) -> Column:
    """Read a column's name."""
    words = re.sub(r"[\[\](){}_.,:/]+", " ", re.sub(r"(?<=[a-z])(?=[XYUV]$)", " ", name))
    parts = words.strip().lower().split()
    unit = next((_UNITS[p] for p in parts if p in _UNITS), None)
    y_axis = next((p for p in parts if p in ("up", "down")), None)
    base = " ".join(p for p in parts if p not in _UNITS and p not in ("up", "down"))
    role = _role(base)
    if _as_x(base) in _IMAGE_CODES and unit is None:
        return Column(name, role, "px", "down", of_image_code=True)
    return Column(name, role, unit, y_axis)


def _role(base: str) -> str | None:
    for role, bases in _BASES.items():
        if base in bases:
            return role
    for role, like in _TURNED.items():
        if _as_x(base) in _BASES[like] and _as_x(base) != base:
            return role
    return _ALONE.get(base)


def _as_x(base: str) -> str:
    """The name that the x component would have."""
    turn = {"y": "x", "v": "u", "uy": "ux", "dy": "dx", "yc": "xc"}
    return " ".join(turn.get(word, word) for word in base.split())


def choose(
    names: list[str], given: Mapping[str, str | int], units: str | None, where: str
) -> dict[str, Column]:
    """Decide which column plays which role.

    Parameters
    ----------
    names
        All columns of the file.
    given
        Names, or numbers from 1, of roles that the user knows.
    units
        "px" or "mm", to choose between a field in pixels and one in millimetres; or None.
    where
        The file, for messages.

    Raises
    ------
    InputError
        If a column is missing, or several could be meant.
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
                f"say which in columns, or give units"
            )
        chosen[role] = best[0]
    missing = [role for role in ROLES if role not in chosen]
    if missing:
        raise InputError(
            f"{where}: expected columns for {', '.join(missing)}, got {_listed(names)}; "
            "name them in columns"
        )
    return chosen


def _narrowed(candidates: list[Column], units: str | None) -> list[Column]:
    """Drop what is in another unit; VIC writes pixels in lower and millimetres in upper case."""
    if len(candidates) == 1 or units is None:
        return candidates
    fitting = [c for c in candidates if c.unit in (units, None)] or candidates
    named = [c for c in fitting if c.unit == units]
    if len(named) == 1:
        return named
    cased = [c for c in fitting if c.name[:1].isupper() == (units == "mm")]
    return cased if len(cased) == 1 else fitting


def _listed(names: list[str]) -> str:
    shown = ", ".join(repr(n) for n in names[:12])
    return shown + (f" and {len(names) - 12} more" if len(names) > 12 else "")
