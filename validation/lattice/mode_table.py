"""The rows of a mode study, and their table: CSV with the unit in every column's head."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

from modeharvest.errors import InputError
from modeharvest.files import atomic

Wave = tuple[float, float]
Key = tuple[str, str, float, float, int]


@dataclass(frozen=True)
class ModeRow:
    """The pattern of one lattice under one loading.

    Parameters
    ----------
    material, loading
        Their names.
    pitch, ratio
        Unit cell size l [mm], and hole diameter over it d/l [-].
    divisions
        Elements along l.
    found
        Whether the lattice has a critical point in the range of loads.
    first
        Its first critical load; without one, the largest load at which it was stable [-].
    kind
        What is critical first: "pattern" for (π, π) alone, "long waves", "other waves"; "none" up
        to the largest load asked for; "path ends" where no equilibrium was found beyond.
    pattern
        First load at which (π, π) is critical, whatever else is; NaN if none in the range [-].
    state
        Load of the state that the mode belongs to: the first critical one, or the last [-].
    eigenvalue
        Lowest at (π, π) in that state [N/mm^4].
    overlap
        |<numerical, analytic>| of the lowest mode at (π, π) with Eq. (mode), both of unit norm
        over the material [-].
    captured, waves
        Share of its energy that the automatically found family holds [-], and how many waves
        that has.
    likeness
        |<mode, mode of the reference>| of unit norm, on the same mesh but for its size [-]; NaN
        where it wasn't compared.
    """

    material: str
    loading: str
    pitch: float
    ratio: float
    divisions: int
    found: bool
    first: float
    kind: str
    pattern: float
    state: float
    eigenvalue: float
    overlap: float
    captured: float
    waves: int
    likeness: float = math.nan

    @property
    def key(self) -> Key:
        """What was computed, apart from what came out."""
        return (self.material, self.loading, self.pitch, self.ratio, self.divisions)

    @property
    def is_first(self) -> bool:
        """Whether the pattern is what buckles first."""
        return self.kind == "pattern"


_HEADS = {
    "material": "material",
    "loading": "loading",
    "pitch": "l [mm]",
    "ratio": "d/l [-]",
    "divisions": "elements per l [-]",
    "found": "critical point found",
    "first": "first critical or largest strain [-]",
    "kind": "first critical waves",
    "pattern": "critical strain of (pi, pi) [-]",
    "state": "strain of the mode's state [-]",
    "eigenvalue": "eigenvalue at (pi, pi) [N/mm^4]",
    "overlap": "overlap with Eq. (mode) [-]",
    "captured": "energy captured by the automatic family [-]",
    "waves": "its waves [-]",
    "likeness": "overlap with the reference's mode [-]",
}


def write_rows(path: Path | str, rows: Iterable[ModeRow]) -> None:
    """Write the table, atomically; numbers with all their digits."""
    names = [f.name for f in fields(ModeRow)]
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([_HEADS[name] for name in names])
        writer.writerows([getattr(row, name) for name in names] for row in rows)


def read_rows(path: Path | str) -> tuple[ModeRow, ...]:
    """Read a table that :func:`write_rows` wrote; empty where there is no file.

    Raises
    ------
    InputError
        If the file is not such a table.
    """
    path = Path(path)
    if not path.exists():
        return ()
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.reader(file))
    if not table or table[0] != list(_HEADS.values()):
        raise InputError(
            f"mode study: expected a table with the heads of this version at {path}, got "
            f"{table[0] if table else 'nothing'}; remove it to begin anew"
        )
    try:
        return tuple(_parsed(line) for line in table[1:])
    except (ValueError, KeyError) as error:
        raise InputError(
            f"mode study: expected {len(_HEADS)} values in each row of {path}, got: {error}; "
            "remove it to begin anew"
        ) from error


def _parsed(line: list[str]) -> ModeRow:
    a = dict(zip(_HEADS, line, strict=True))
    return ModeRow(
        a["material"], a["loading"], float(a["pitch"]), float(a["ratio"]), int(a["divisions"]),
        {"True": True, "False": False}[a["found"]], float(a["first"]), a["kind"],
        float(a["pattern"]), float(a["state"]), float(a["eigenvalue"]), float(a["overlap"]),
        float(a["captured"]), int(a["waves"]), float(a["likeness"]),
    )  # fmt: skip
