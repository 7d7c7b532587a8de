"""The tables of docs/how-to/scoring.md, as ``compare.py`` writes them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from modeharvest.validation.scoring.score import REGIONS, Grading, Score

NOT_APPLICABLE, NONE = "–", "none"
COUNTED, MEAN = "cases that count", "geometric mean over them"


def comparison(grading: Grading) -> list[str]:
    """Errors [px] of codes on one image, as Markdown; the best first."""
    scores, of = grading.scores, grading.common
    shared = f"{100 * grading.common_share:.0f} % that all cover"
    rows: dict[str, Callable[[Score], str]] = {
        "rms": lambda s: two_digits(s.everywhere.rms_px),
        "50 % err by less than": lambda s: two_digits(s.everywhere.percentiles_px[0]),
        "95 % err by less than": lambda s: two_digits(s.everywhere.percentiles_px[2]),
        "largest": lambda s: two_digits(s.everywhere.max_px),
        **{f"rms, {name}": lambda s, name=name: two_digits(s.by_region[name].rms_px)  # type: ignore[misc]
           for name in REGIONS},
        "points": lambda s: f"{s.everywhere.points:,}".replace(",", " "),
        "returned": lambda s: f"{100 * s.everywhere.returned:.3g} %",
        "material covered": lambda s: f"{100 * s.covered:.0f} %",
        f"rms on the {shared}": lambda s: two_digits(of[s.source].rms_px),
        "largest there": lambda s: two_digits(of[s.source].max_px),
    }  # fmt: skip
    return markdown("errors in px", {s.source: {k: f(s) for k, f in rows.items()} for s in scores})


def standard(
    board: Mapping[str, Any], cases: Iterable[str], skipped: Callable[[str, str], bool],
    earlier: list[str],
) -> list[str]:  # fmt: skip
    """Rms errors [px] of the standard set as Markdown, with the covered share if not all is.

    ``skipped``: whether a code (first) isn't applicable to a case. ``earlier``: lines of such a
    table; if it is of the same set, columns of codes that the board doesn't have are kept.
    """
    corner = f"rms [px], set {board['set']}"
    found = read(earlier) if earlier and earlier[0].startswith(f"| {corner} |") else {}
    for row in board["codes"]:
        code, errors = row["code"], row["cases"]
        cells = {case: NOT_APPLICABLE if skipped(code, case) else NONE for case in cases}
        for case, one in errors.items():
            share = 100 * one["covered"]
            part = f" ({share:.0f} %)" if share < 99.5 else ""
            cells[case] = two_digits(one["rms_px"]) + part
        mean = two_digits(row["rms_px"])
        found[code] = {**cells, COUNTED: str(row["counted"]), MEAN: mean}
    ranked = sorted(found.items(), key=lambda c: (-int(c[1][COUNTED]), float(c[1][MEAN])))
    return markdown(corner, dict(ranked))


def two_digits(value: float) -> str:
    """The number with two significant digits; a dash for NaN."""
    return f"{value:#.2g}".rstrip(".") if value == value else NOT_APPLICABLE


def markdown(corner: str, columns: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Lines of a table from its columns by heading, each with its cells by row."""
    lines = [f"| {corner} | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for row in next(iter(columns.values()), {}):
        lines.append(f"| {row} | " + " | ".join(cells[row] for cells in columns.values()) + " |")
    return lines


def read(lines: list[str]) -> dict[str, dict[str, str]]:
    """The columns of a table: the inverse of :func:`markdown`."""
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    if not rows:
        return {}
    (_, *heads), _, *body = rows
    return {head: {row[0]: row[k] for row in body} for k, head in enumerate(heads, 1)}


def lines_of(page: Path, name: str) -> list[str]:
    """The lines between a page's comments that name a table; see ``peers/document.py``."""
    pattern = rf"<!-- peers: {name} -->\n(.*?)\n?<!-- end -->"
    (text,) = re.findall(pattern, page.read_text("utf-8"), re.DOTALL)
    return str(text).splitlines()
