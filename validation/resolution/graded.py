"""From files of displacement fields to grades on the star: what the command does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from modeharvest.errors import InputError
from modeharvest.files import require_writable
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.progress import Progress, silent
from modeharvest.validation.page import short
from modeharvest.validation.resolution.grading import StarGrade, ranked
from modeharvest.validation.resolution.star_report import (
    COLUMNS,
    StarGrading,
    numbers,
    write_star_grading,
)
from modeharvest.validation.resolution.star_set import StarSet
from modeharvest.validation.scoring.fields import Declared, read_measured


def grade_star(
    fields: Mapping[Path, Declared],
    stills: Mapping[Path, Declared],
    folder: Path | str,
    out: Path | str,
    progress: Progress = silent,
) -> StarGrading:
    """Grade fields measured on a star set; leaves a report, JSON and CSV.

    Parameters
    ----------
    fields
        Files of the deformed image, with what they don't say themselves.
    stills
        Files of the image without motion, one for each field in the same order; or none.
    folder
        The star set.
    out
        Folder for the report.
    progress
        Listener.

    Returns
    -------
    StarGrading
        Of the fields that can be graded; those that can't be read, are of another set, in
        millimetres or don't hold the wave are in its ``refused``, each with the reason.

    Raises
    ------
    InputError
        If no field can be graded, or two have one name.
    """
    if stills and len(stills) != len(fields):
        raise InputError(
            f"expected a --still for each of {len(fields)} fields, or none, got {len(stills)}"
        )
    star_set = StarSet.read(folder)
    require_writable(out)
    still_of = dict(zip(fields, stills.items(), strict=bool(stills)))
    grades: list[StarGrade] = []
    refused: dict[str, str] = {}
    for n, (path, declared) in enumerate(fields.items()):
        progress(n, len(fields) + 1, f"resolution: {path.name}")
        try:
            moved = _read(path, declared, star_set)
            still = _read(*still_of[path], star_set) if stills else None
            grade = StarGrade(star_set.spec.star, moved, still)
        except InputError as error:
            refused[str(path)] = str(error)
            continue
        if any(grade.name == other.name for other in grades):
            raise InputError(
                f"expected fields of different names, got {grade.name} twice; give --name"
            )
        grades.append(grade)
    if not grades:
        raise InputError("; ".join(refused.values()))
    progress(len(fields), len(fields) + 1, "resolution: report")
    grading = StarGrading(star_set, tuple(ranked(grades)), refused)
    write_star_grading(out, grading)
    progress(1, 1, "resolution")
    return grading


def _read(path: Path, declared: Declared, star_set: StarSet) -> LocalField:
    """A field in px on the star's grid; InputError if it is in another unit."""
    if "mm" in (declared.units, declared.displacement_units):
        raise InputError(f"{path}: expected a field in px, got mm; a star has no millimetres")
    declared = replace(declared, units=declared.units or "px")
    return read_measured(path, star_set.spec.star.grid, star_set.id, declared)


def print_star_grading(grading: StarGrading, out: Path | str) -> None:
    """Print the ranked table, what is to be kept in mind, and where the report is."""
    console = Console(highlight=False)
    table = Table(title=f"star {grading.star_set.id}, the best first", title_justify="left")
    table.add_column("")
    rows = [numbers(grade) for grade in grading.grades]
    for rank, row in enumerate(rows, start=1):
        table.add_column(escape(f"{rank}. {row['name']}"), justify="right")
    for heading, key in COLUMNS.items():
        table.add_row(escape(heading), *(short(row[key]) for row in rows))
    console.print(table)
    for note in grading.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}", soft_wrap=True)
    console.print(f"report: {Path(out) / 'report.html'}", markup=False, soft_wrap=True)
