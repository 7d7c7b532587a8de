"""Output of reports: pages as HTML, tables as CSV, and a summary on the terminal."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from modeharvest.report.model.content import Report, ReportFigure, ReportTable
from modeharvest.report.model.text import Cell, Mark, Measured, fixed, number, typeset
from modeharvest.util.files import atomic, write_csv
from modeharvest.util.progress import Progress, counted, silent

if TYPE_CHECKING:
    import jinja2

MOST_BYTES = 7_900_000
"""Bytes of a page's pictures and interactive display, if the latter can be made that small."""


def draw_figures(figures: Iterable[ReportFigure], progress: Progress = silent) -> dict[str, str]:
    """Draw figures one by one, those marked ``late`` last; returns their SVG by name."""
    from modeharvest.report.figures.style import style, to_svg

    pictures = {}
    for f in counted(sorted(figures, key=lambda f: f.late), progress, "report"):
        with style():
            drawn = f.draw()
        pictures[f.name] = to_svg(drawn, f.name, f.label or f.name, exact=f.exact)
    return pictures


def write_page(
    report: Report,
    path: Path | str,
    progress: Progress = silent,
    pictures: Mapping[str, str] | None = None,
) -> None:
    """Write a report as one self-contained HTML file, atomically.

    ``path``: the HTML file. ``progress``: listener. ``pictures``: SVG of the report's figures from
    :func:`draw_figures`; without it, the figures are drawn.
    """
    if pictures is None:
        pictures = draw_figures(report.figures, progress)
    explored = _explored(report, MOST_BYTES - sum(map(len, pictures.values())))
    page = page_template().render(report=report, pictures=pictures, explored=explored)
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")


def _explored(report: Report, most: int) -> str:
    """The interactive display, at most twice as coarse as it may be to have ``most`` bytes."""
    if report.explore is None:
        return ""
    finest = report.explore(1.0)
    if not 0.25 * len(finest) < most < len(finest):  # small enough, or never so
        return finest
    others = map(report.explore, (1.25, 1.5, 1.75, 2.0))
    return next((text for text in others if len(text) <= most), finest)


@cache
def page_template(name: str = "page.html") -> jinja2.Template:
    """Read and compile the template of the page, or of a part of it, once per process."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(str(resources.files("modeharvest.report"))), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": number, "fixed": fixed, "typeset": typeset}
    shown = partial(json.dumps, indent=2, sort_keys=True, ensure_ascii=False)
    environment.filters["json"] = shown  # tojson writes an apostrophe as \\u0027
    environment.tests |= {
        "mark": lambda cell: isinstance(cell, Mark),
        "measured": lambda cell: isinstance(cell, Measured),
    }
    return environment.get_template(name)


def write_tables(tables: Sequence[ReportTable], folder: Path) -> None:
    """Write every table that has a file name to ``folder`` as CSV, with all digits, atomically."""
    for table in tables:
        if table.file:
            rows = [[cell if cell == cell else None for cell in row] for row in table.rows]
            write_csv(folder / table.file, table.columns, rows)


def print_report(report: Report, out: Path) -> None:
    """Print findings, tables, warnings, and the path of the page in the folder ``out``."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    console.print(f"[bold]{escape(report.title)}[/bold]", soft_wrap=True)
    for text in report.findings:
        console.print(f"- {escape(text)}", soft_wrap=True)
    brief = [report.brief] if report.brief else []
    for table in (*brief, *(table for table in report.tables if table.on_terminal)):
        lines: list[Sequence[Cell]] = [table.columns, *table.rows]
        is_wide = len(lines) < len(lines[0])  # few long rows are transposed to fit
        columns = lines if is_wide else list(zip(*lines, strict=True))
        texts = [[number(cell) for cell in column] for column in columns]
        for k, part in enumerate(_fitting(texts, console.width)):
            console.print()
            title = None if k else escape(table.title)
            shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD,
                          show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))  # fmt: skip
            for n, column in enumerate(part):
                shown.add_column(escape(column[0]), justify="right" if n else "left",
                                 overflow="fold")  # fmt: skip
            for row in zip(*(column[1:] for column in part), strict=True):
                shown.add_row(*map(escape, row))
            console.print(shown)
    console.print()
    for warning in report.warnings:
        console.print(f"[yellow]warning:[/yellow] {escape(warning)}", soft_wrap=True)
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)


def _fitting(columns: Sequence[list[str]], width: int) -> Iterator[list[list[str]]]:
    """Columns in parts whose words fit into ``width`` characters; each begins with the first."""
    first, *others = columns
    part = [first]
    for column in others:
        if len(part) > 1 and sum(map(_least_width, [*part, column])) > width:
            yield part
            part = [first]
        part.append(column)
    yield part


def _least_width(column: Sequence[str]) -> int:
    """Of a column none of whose words is cut, and of the space beside it [characters]."""
    return 2 + max(len(word) for cell in column for word in ["", *cell.split(" ")])
