"""A testing machine's log: its columns recognised, and joined to photographs by time.

A log is text with one row per moment, separated by ``;``, ``,``, tabs or blanks, with decimal
points or commas. Any lines may precede the heads; units are in the heads or in a line below them.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.files import encoding_of, reading

_NAMES = {
    "time": r"^(test|total|elapsed|laufende?|pr[uü]f)?[ _-]*(time|zeit|temps|tiempo|tempo|t"
    r"|datetime|timestamp|time ?stamp|zeitpunkt|zeitstempel|date[ _/&-]*time|datum[ _/&-]*zeit"
    r"|clock|uhrzeit)$",
    "force": r"^(axial|standard|pr[uü]f|max\.?)?[ _-]*(force|load|kraft|last|fuerza|carga|forza"
    r"|f|fz|load ?cell|kraftmessdose)([ _-]*\d)?$",
    "crosshead": r"(crosshead|traverse|position|displacement|extension|stroke|standardweg|^weg$|"
    r"traversenweg|d[eé]placement|desplazamiento|corsa|^disp$|^s$|^x$|compression)",
    "date": r"^(date|datum|fecha|data)$",
}
"""Recognised heads of columns, in lower case and without units."""
_UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "": 1.0},
    "force": {"n": 1.0, "kn": 1e3, "mn": 1e-3, "cn": 1e-2, "lbf": 4.4482216, "gf": 9.80665e-3,
              "kgf": 9.80665, "": 1.0},
    "crosshead": {"mm": 1.0, "µm": 1e-3, "um": 1e-3, "μm": 1e-3, "cm": 10.0, "m": 1e3, "in": 25.4,
                  "\"": 25.4, "": 1.0},
}  # fmt: skip
"""Units in s, N or mm. "MN" would be read as millinewtons, but no laboratory uses meganewtons."""
_HEAD = re.compile(
    r"^(.*?)[\s_]*(?:[\[(<]\s*([^\])>]*)\s*[\])>]|/\s*([a-zA-Zµμ]+)|\bin ([a-z]+))?$"
)
_THOUSANDS = r"[-+]?\d{{1,3}}(?:{0}\d{{3}})+(?:[.,]\d*)?"
"""A number with separators of thousands, which are to be put in."""
_EPOCH = 1e8
"""Numbers from this on are dates, in seconds since 1970 [s]."""
_ZONE, _HOUR, _DAY = 900.0, 3600.0, 86400.0
"""Time zones differ by multiples of the first, mostly of the second; what a clock begins anew at
[s]. Times like 01:00:00 are a clock's from an hour on, and count from the log's beginning before.
"""
_MOST = 0.5
"""Share of the photographs that must have been taken while the log was written."""


@dataclass(frozen=True)
class LogTable:
    """Table ``[log]``: the log of the testing machine."""

    file: str = ""
    """Text file of the log, relative to the TOML file; no log if empty."""
    time: str = ""
    force: str = ""
    crosshead: str = ""
    """Heads of the columns, if they aren't recognised automatically."""
    offset_s: float | None = None
    """Time of the log's clock minus that of the camera [s]; found if they differ by a time zone."""
    length: float | None = None
    """Length that the crosshead compresses [mm], to compute nominal strains from its position."""

    def __post_init__(self) -> None:
        others = (self.time, self.force, self.crosshead, self.offset_s, self.length)
        if not self.file and any(others):
            raise InputError("log: expected a file with its columns or offset, got none")
        if self.length is not None:
            require_within("log: expected a length [mm]", self.length, 0, above=True)


@dataclass(frozen=True, eq=False)
class MachineLog:
    """The recorded data of a testing machine."""

    time: FloatArray
    """(n,) times [s], ascending, since 1970 or since the log began."""
    force: FloatArray | None
    """(n,) forces [N]; None if not recorded."""
    crosshead: FloatArray | None
    """(n,) crosshead positions [mm]; None if not recorded."""
    text: tuple[str, ...]
    """How the log was read, as text for the report."""
    is_clock: bool = False
    """Whether its times are those of a day, without a date."""

    @property
    def is_dated(self) -> bool:
        """Whether its times are dates."""
        return bool(self.time[0] > _EPOCH)

    def at(self, times: FloatArray) -> dict[str, FloatArray]:
        """Force [N] and crosshead [mm] at times (k,) [s] of the log's clock; NaN outside it."""
        reach = float(np.median(np.diff(self.time)))
        outside = (times < self.time[0] - reach) | (times > self.time[-1] + reach)
        columns = {"force_N": self.force, "crosshead_mm": self.crosshead}
        return {
            name: np.where(outside, np.nan, np.interp(times, self.time, column))
            for name, column in columns.items() if column is not None
        }  # fmt: skip


def read_log(path: Path, table: LogTable) -> MachineLog:
    """Read a log; InputError if it has no column of time, or neither force nor crosshead."""
    with reading(path, "a testing machine's log", "export it as text with a line of heads"):
        above, body, decimal = _rows(_text(path))
        heads, units = _heads(above, len(body[0]))
        found = {
            role: _column(role, heads, str(getattr(table, role, "")), path)
            for role in ("time", "force", "crosshead", "date")
        }
        for roles in (("time",), ("force", "crosshead")):
            if all(found[role] is None for role in roles):
                raise InputError(
                    f"{path}: expected a column of {' or '.join(roles)}, got "
                    f"{', '.join(heads) or 'no heads'}; name it in [log], as in {roles[0]} = "
                    '"..."'
                )

        def numbers(role: str) -> FloatArray | None:
            if (i := found[role]) is None:
                return None
            scale = _UNITS[role].get(units[i], 1.0)
            return scale * np.array([_number(row[i], decimal) for row in body])

        at, date = found["time"] or 0, found["date"]
        stamps = [row[at] if date is None else f"{row[date]} {row[at]}" for row in body]
        time, is_clock = _times(stamps, decimal, _UNITS["time"].get(units[at], 1.0))
        columns = [numbers("force"), numbers("crosshead")]
        keep = np.isfinite([time, *(c for c in columns if c is not None)]).all(axis=0)
        if keep.sum() < 2:
            raise InputError(f"{path}: expected two rows of numbers at least, got {keep.sum()}")
    order = np.flatnonzero(keep)[np.argsort(time[keep], kind="stable")]
    named = [f"{role} “{heads[i]}”" for role, i in found.items() if i is not None]
    text = [f"{path.name}: {len(order)} rows; {', '.join(named)}."]
    if back := int((np.diff(time[keep]) < 0).sum()):
        text.append(f"{path.name}: time goes back {back} times; its rows were sorted.")
    if lost := len(body) - len(order):
        text.append(f"{path.name}: {lost} rows without numbers were left out.")
    force, crosshead = (None if c is None else c[order] for c in columns)
    return MachineLog(time[order], force, crosshead, tuple(text), is_clock)


def offset_between(
    log: MachineLog, times: FloatArray, given: float | None
) -> tuple[float, tuple[str, ...]]:
    """What to add to the photographs' times (n,) [s] to get the log's, and how it was found.

    The given offset, if any. Else, if both have dates, or the log times of the day, 0 if most
    photographs were taken while it was written, else the time zone with which they were. Else the
    log is taken to begin with the first photograph.
    """
    if given is not None:
        return given, (f"The log's clock is {given:+g} s ahead of the photographs', as given.",)
    dated, day = times[0] > _EPOCH, times[0] - times[0] % _DAY
    if dated and log.is_clock:
        zone, text = _zone(log.time + day, times)
        if not np.isnan(zone):
            note = (
                "The log has times without dates: they are taken for those of the photographs' day."
            )
            return zone - day, (note, *text)
    elif dated and log.is_dated:
        zone, text = _zone(log.time, times)
        return float(np.nan_to_num(zone)), text
    has_origin = dated or log.is_dated or log.is_clock
    begin = float(log.time[0] - times[0]) if has_origin else 0.0
    note = (
        "The log is taken to begin with the first photograph, as only one of both has dates; "
        "if that is wrong, give offset_s in [log]."
    )
    return begin, (note,) * bool(begin)


def _zone(log: FloatArray, times: FloatArray) -> tuple[float, tuple[str, ...]]:
    """Time zone of a log's times minus that of the photographs' [s], NaN if none fits, and a text.

    Photographs may have been taken before and after: the zones' order counts, not each one more.
    """
    zones = _ZONE * np.array(sorted(range(-56, 57), key=lambda k: (k * _ZONE % _HOUR > 0, abs(k))))
    first, last = log[[0, -1]] + (-1.0, 1.0)
    shares = [np.mean((times + zone >= first) & (times + zone <= last)) for zone in zones]
    if not max(shares):
        return np.nan, (
            "No photograph was taken while the log was written; give offset_s in [log].",
        )
    zone = float(zones[int(np.argmax(np.minimum(shares, _MOST)))])  # the first that will do
    text = (
        f"The log's clock is {abs(zone) / _HOUR:g} h {'ahead of' if zone > 0 else 'behind'} the "
        "photographs', as in another time zone; if that is wrong, give offset_s in [log]."
    )
    return zone, (text,) * bool(zone)


# -- text --------------------------------------------------------------------------------


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding_of(path))
    except UnicodeDecodeError:
        return path.read_text("latin-1")


def _rows(text: str) -> tuple[list[list[str]], list[list[str]], str]:
    """Lines above the numbers; rows with numbers, all of one length; the decimal sign.

    Of all separators and decimal signs, those with which most lines are numeric are used.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    best: tuple[list[list[str]], list[bool], str] = ([], [], ".")
    for separator in (";", "\t", ",", None):
        rows = [_cells(line, separator) for line in lines]
        decimal = "." if separator == "," and '"' not in text else _decimal(rows)
        good = [len(row) > 1 and _is_numeric(row, decimal) for row in rows]
        if sum(good) > sum(best[1]):
            best = rows, good, decimal
    rows, good, decimal = best
    if sum(good) < 2:
        raise InputError("expected rows of two numbers at least, got none")
    count = Counter(len(row) for row, is_good in zip(rows, good, strict=True) if is_good)
    length = count.most_common(1)[0][0]
    first = next(i for i, row in enumerate(rows) if good[i] and len(row) == length)
    return rows[:first], [row for row in rows[first:] if len(row) == length], decimal


def _cells(line: str, separator: str | None) -> list[str]:
    if separator and '"' in line:  # a quoted cell may hold the separator
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    return [cell.strip().strip('"') for cell in line.split(separator)]


def _decimal(rows: Sequence[Sequence[str]]) -> str:
    """The decimal sign: of two signs the one that doesn't only separate thousands."""
    cells = {cell for row in rows for cell in row if re.fullmatch(r"[-+−]?[\d.,']+", cell)}
    points, commas = ({c for c in cells if np.isfinite(_number(c, s)) and s in c} for s in ".,")
    if not points or not commas:
        return "," if commas else "."
    return "." if all(re.fullmatch(_THOUSANDS.format(","), cell) for cell in commas) else ","


def _is_numeric(row: Sequence[str], decimal: str) -> bool:
    """Whether a row has a number, and no text but dates and times."""
    cells = [cell for cell in row if cell]
    numbers = [np.isfinite(_number(cell, decimal)) for cell in cells]
    return any(numbers) and all(
        is_number or re.fullmatch(r"[\d.,:/ TZ+-]+( ?[AP]M)?", cell)
        for is_number, cell in zip(numbers, cells, strict=True)
    )


def _number(cell: str, decimal: str) -> float:
    """The number in a cell, with or without thousands separators; NaN if it is none."""
    other = "," if decimal == "." else "."
    text = cell.replace("\u202f", "").replace("'", "").replace("−", "-")
    if re.fullmatch(_THOUSANDS.format(re.escape(other)), text):
        text = text.replace(other, "")
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return float("nan")


def _heads(above: Sequence[Sequence[str]], count: int) -> tuple[list[str], list[str]]:
    """Names and units of the columns, from the lines above the numbers."""
    lines = [list(row) for row in above if len(row) == count][-2:]
    if not lines:
        return [], [""] * count
    every = {unit for units in _UNITS.values() for unit in units}
    below = [cell.strip("[]()").strip().lower() for cell in lines[-1]]
    if len(lines) == 2 and all(cell in every for cell in below) and any(below):
        return lines[0], below
    split = [_HEAD.match(head) for head in lines[-1]]
    return lines[-1], [
        next((u for u in match.groups()[1:] if u), "").strip().lower() if match else ""
        for match in split
    ]


def _column(role: str, heads: Sequence[str], given: str, path: Path) -> int | None:
    if given:
        names = [head.lower() for head in heads]
        if given.lower() not in names:
            raise InputError(
                f"{path}: expected the column {given!r} of log.{role}, got {', '.join(heads)}"
            )
        return names.index(given.lower())
    for i, head in enumerate(heads):
        match = _HEAD.match(head)
        base = (match[1] if match else head).strip().lower()
        base = re.sub(r"[_\s]+(s|ms|min|h|n|kn|mm|um|m)$", "", base)
        if re.search(_NAMES[role], base):
            return i
    return None


def _times(stamps: Sequence[str], decimal: str, scale: float) -> tuple[FloatArray, bool]:
    """(n,) times [s] since 1970, or since the log or the day began, NaN for rows without one.

    Also whether they are times of a day; those after midnight belong to the next.
    """
    import pandas as pd

    numbers = np.array([_number(stamp, decimal) for stamp in stamps])
    if np.isfinite(numbers).mean() > 0.5:
        return np.asarray(scale * numbers), False
    # Times are local: a time zone that is written with them is ignored.
    plain = [re.sub(r"(:\d\d),", r"\1.", re.sub(r"(Z|[+-]\d\d:?\d\d)$", "", s)) for s in stamps]
    times = pd.to_timedelta(pd.Series(plain), errors="coerce").dt.total_seconds()
    halves = bool(re.search(r"[AP]M$", plain[0]))
    if times.isna().mean() > 0.5:
        iso = bool(re.match(r"\d{4}", plain[0]))
        # Where the day has two halves, months come first.
        how = {"format": "mixed", "dayfirst": not iso and not halves, "errors": "coerce"}
        has_date = len(re.findall(r"\d+", plain[0].partition(":")[0])) > 1
        dates = pd.to_datetime(plain if has_date else [f"1970-01-01 {s}" for s in plain], **how)
        times = pd.Series((dates - pd.Timestamp(0)).total_seconds())
    seconds = np.array(times, np.float64)
    known = np.isfinite(seconds)
    is_clock = bool(known.any()) and _HOUR < seconds[known][0] < _DAY
    if is_clock:
        seconds[known] = np.unwrap(seconds[known], period=_DAY)
    return seconds, is_clock
