"""The report model: key numbers, figures, tables and text of a page, its template, numbers for readers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from math import isfinite
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from matplotlib.figure import Figure

from modeharvest.fem.materials import Ogden
from modeharvest.report.figures.style import to_svg
from modeharvest.util.files import atomic


@dataclass(frozen=True)
class Picture:
    """A picture in the page.

    Parameters
    ----------
    id
        Its anchor: the panel's key and the strain in hundredths of a percent.
    label
        What is written above it.
    svg
        The picture itself.
    fact
        One line of numbers below it.
    """

    id: str
    label: str
    svg: str
    fact: str = ""


@dataclass(frozen=True, eq=False)
class Plot:
    """A picture of a study.

    Parameters
    ----------
    name, title
        A short name for files and links, and what it is called.
    drawn
        The figure, in the style of :mod:`modeharvest.report.figures.style`.
    caption
        What is to be seen.
    wide
        Whether it needs the whole width of the page.
    """

    name: str
    title: str
    drawn: Figure
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class KeyNumber:
    """One of the few numbers that a study is about.

    Parameters
    ----------
    name, value, unit
        What it is, its value as a reader wants it, and its unit (may be empty).
    remark
        What to compare it with.
    """

    name: str
    value: str
    unit: str
    remark: str


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study's table tells.

    Parameters
    ----------
    numbers
        The study's results as plain values, with their units in the names.
    sentences
        The same in words, the most important first.
    keys
        Up to six numbers to begin with.
    plots
        Pictures.
    tables
        Tables by their titles.
    attachments
        Tables that are too long for the page: files only; or, by the title of a table that is
        written to be read, the same in numbers, which its file then holds.
    """

    numbers: Mapping[str, Any]
    sentences: tuple[str, ...]
    keys: tuple[KeyNumber, ...] = ()
    plots: tuple[Plot, ...] = ()
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    attachments: Mapping[str, pd.DataFrame] = field(default_factory=dict)


def render(template: str, **content: Any) -> str:
    """Fill one of the templates; a value that it needs and does not get is an error."""
    folder = str(resources.files(__package__) / "templates")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"short": short, "fixed": fixed}
    return environment.get_template(template).render(**content)


def short(value: Any) -> str:
    """A number as a reader wants it: three or four digits, a true minus, powers of ten raised."""
    if value is None:
        return "–"
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return str(value)
    if not isfinite(value):
        return "∞" if value > 0 else "–"
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.4g}".replace("-", "−")
    digits, power = f"{value:.1e}".split("e")
    raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{digits} · 10{raised}".replace("-", "−")


def fixed(value: float) -> str:
    """Five decimals with a true minus, and no minus before a zero."""
    return f"{round(value, 5) + 0.0:.5f}".replace("-", "−")


STUDY_TEMPLATE = "study.html"


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
    pictures = [_study_picture(plot, run) for plot in run.findings.plots]
    tables = [
        {"id": f"table-{slug(title)}", "title": title, "file": f"{slug(title)}.csv",
         "columns": list(table.columns), "numbers": _number_columns(table),
         "rows": table.astype(object).values.tolist()}
        for title, table in run.findings.tables.items()
    ]  # fmt: skip
    sentences = [_together(sentence) for sentence in run.findings.sentences]
    page = render(
        STUDY_TEMPLATE,
        title=run.title,
        run=run,
        sentences=sentences,
        pictures=pictures,
        tables=tables,
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")


def _number_columns(table: pd.DataFrame) -> list[str]:
    """The columns of numbers, as such or in words that begin with one; not the first."""
    others = [str(name) for name in table.columns[1:]]
    return [name for name in others if table[name].map(_is_number).all()]


def _is_number(cell: object) -> bool:
    return not isinstance(cell, str) or cell[:1].isdigit()


def slug(title: str) -> str:
    """A title as the name of a file."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _study_picture(plot: Plot, run: StudyRun) -> dict[str, Any]:
    svg = to_svg(plot.drawn, plot.name, plot.title)
    made = Picture(plot.name, plot.title, svg, f"{run.command} · {run.seeds}")
    return {"plot": plot, "picture": made, "caption": _together(plot.caption)}


def _together(words: str) -> str:
    """No line ends between a number and its unit or error."""
    return re.sub(r" (?=(?:%|px|mm|±)(?!\w))|(?<=±) ", "\N{NO-BREAK SPACE}", words)


def material_text(table: Mapping[str, Any]) -> str:
    """A material's kind and constants, and whether they are this project's default.

    Parameters
    ----------
    table
        ``kind`` and the constants, as in a case or in a solution's ``info``.
    """
    constants = {name: value for name, value in table.items() if name != "kind"}
    values = ", ".join(f"{name} {_plain_number(value)}" for name, value in constants.items())
    usual = {name: _plain_number(value) for name, value in vars(Ogden()).items()}
    is_usual = {name: _plain_number(value) for name, value in constants.items()} == usual
    return f"{'default ' * is_usual}material {table['kind']}: {values} (moduli in MPa)"


def _plain_number(value: Any) -> str:
    return ", ".join(f"{v:g}" for v in value) if isinstance(value, list | tuple) else f"{value:g}"
