"""The report of a study: one page, sentences first, each figure with what made it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from modeharvest.files import atomic
from modeharvest.validation.page import render
from modeharvest.validation.report import Picture
from modeharvest.validation.studies.study import Findings, Plot
from modeharvest.validation.style import to_svg

TEMPLATE = "study.html"


@dataclass(frozen=True, eq=False)
class StudyRun:
    """A finished study, and what its report says around the findings.

    Parameters
    ----------
    title, question
        What it is called, and what it asks in a sentence or two.
    findings
        What its table tells.
    command, seeds
        What makes it again.
    case
        Its options and subject, as plain values.
    notes
        What to keep in mind: failures, results of other versions.
    files
        What lies beside the report, and what each holds.
    versions
        Of libraries.
    """

    title: str
    question: str
    findings: Findings
    command: str
    seeds: str
    case: Mapping[str, Any]
    notes: tuple[str, ...]
    files: Mapping[str, str]
    versions: Mapping[str, str]


def write_study_report(path: Path | str, run: StudyRun) -> None:
    """Write the report of a study, atomically.

    Parameters
    ----------
    path
        The HTML file.
    run
        What it shows.
    """
    pictures = [_picture(plot, run) for plot in run.findings.plots]
    tables = [
        {"id": f"table-{slug(title)}", "title": title, "file": f"{slug(title)}.csv",
         "columns": list(table.columns), "numbers": _numbers(table),
         "rows": table.astype(object).values.tolist()}
        for title, table in run.findings.tables.items()
    ]  # fmt: skip
    sentences = [_together(sentence) for sentence in run.findings.sentences]
    page = render(
        TEMPLATE, title=run.title, run=run, sentences=sentences, pictures=pictures, tables=tables
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")


def _numbers(table: pd.DataFrame) -> list[str]:
    """The columns of numbers, as such or in words that begin with one; not the first."""
    others = [str(name) for name in table.columns[1:]]
    return [name for name in others if table[name].map(_is_number).all()]


def _is_number(cell: object) -> bool:
    return not isinstance(cell, str) or cell[:1].isdigit()


def slug(title: str) -> str:
    """A title as the name of a file."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _picture(plot: Plot, run: StudyRun) -> dict[str, Any]:
    svg = to_svg(plot.drawn, plot.name, plot.title)
    made = Picture(plot.name, plot.title, svg, f"{run.command} · {run.seeds}")
    return {"plot": plot, "picture": made, "caption": _together(plot.caption)}


def _together(words: str) -> str:
    """No line ends between a number and its unit or error."""
    return re.sub(r" (?=(?:%|px|mm|±)(?!\w))|(?<=±) ", "\N{NO-BREAK SPACE}", words)
