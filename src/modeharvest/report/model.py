"""The report model: key numbers, figures, tables and text, for a page, CSV files and the terminal.

Each kind of run has one function that makes its :class:`Report`; everything a reader sees of the
run follows from that. Figures are functions, drawn one after the other while the page is written.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from math import isfinite
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from modeharvest.fem.materials import Ogden
from modeharvest.util.files import atomic, write_csv
from modeharvest.util.progress import Progress, counted, silent

if TYPE_CHECKING:
    import jinja2
    import pandas as pd
    from matplotlib.figure import Figure

NBSP = "\N{NO-BREAK SPACE}"


@cache
def _captions() -> dict[str, dict[str, Any]]:
    source = resources.files(__package__).joinpath("captions.toml")
    return tomllib.loads(source.read_text("utf-8"))


def caption(name: str, **values: object) -> dict[str, Any]:
    """Title, caption, lead … of that name in ``captions.toml``, with values filled in."""
    words = _captions()[name].items()
    return {k: Markup(v).format(**values) if isinstance(v, str) else v for k, v in words}


@dataclass(frozen=True)
class _Readable:
    """A value that is filled in as a function writes it, with so many digits if some are given."""

    written: Callable[..., str]
    value: Any

    def __format__(self, digits: str) -> str:
        return self.written(self.value, *map(int, digits.split()))


class _Template(Formatter):
    """Fills values into plain text: ``{x!n:3}`` as :func:`number`, ``{x!p}`` as :func:`percent`."""

    def convert_field(self, value: Any, conversion: Any) -> Any:
        """A field's value as its conversion says."""
        ways: dict[str, Callable[..., str]] = {"n": number, "p": percent}
        ways["z"] = lambda x: f"{x:#.4g}" if 1e-3 <= abs(x) < 1e3 else number(x)  # 1.530
        if conversion in ways:
            return _Readable(ways[conversion], value)
        return super().convert_field(value, conversion)


def text_of(name: str, /, **values: object) -> str:
    """The text of that name in ``captions.toml``, plain text, with values filled in."""
    return _Template().vformat(_captions()["text"][name], (), values)


@dataclass(frozen=True)
class Mark:
    """A word in a coloured pill: green if good, red if not."""

    text: str
    good: bool


@dataclass(frozen=True)
class Measured:
    """A value with its standard errors, of which None is not known and infinity is no limit."""

    value: float
    errors: tuple[float | None, ...] = ()
    decimals: int = 5

    def __str__(self) -> str:
        return " ".join([fixed(self.value, self.decimals), *self.error_texts])

    @property
    def error_texts(self) -> list[str]:
        """Each standard error: "± 0.00020", "< 0.00001" where it is less than is written."""
        least = 0.5 * 10.0**-self.decimals
        return [
            "± –" if error is None or error != error
            else "± ∞" if not isfinite(error)
            else f"± {error:.{self.decimals}f}" if error >= least or error == 0.0
            else f"< {2 * least:.{self.decimals}f}"
            for error in self.errors
        ]  # fmt: skip


Cell = str | float | int | None | Mark | Measured


@dataclass(frozen=True)
class KeyNumber:
    """One of the up to six numbers at the top of a page."""

    name: str
    value: str | float | None
    unit: str = ""
    remark: str = ""
    """What to compare it with."""

    @classmethod
    def of(cls, name: str, value: str | float | None = None, /, **values: object) -> KeyNumber:
        """The one of that name in ``captions.toml``, with values filled in.

        Its own ``value`` is given where it is not among the words.
        """
        words = _captions()["key"][name].items()
        filled: dict[str, Any] = {k: _Template().vformat(v, (), values) for k, v in words}
        return cls(**{"value": value, **filled})


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """A figure, drawn when the page is written."""

    name: str
    """Its anchor, unique in the page."""
    label: str
    """Written above it; may be empty."""
    draw: Callable[[], Figure]
    """Draws it, in the style of :mod:`modeharvest.report.figures.style`."""
    numbers: str = ""
    """One line of numbers below it."""
    wide: bool = False
    """Whether it takes the whole width of its card."""
    exact: bool = False
    """Whether every pixel is kept: for fields as fine as the pixels."""
    late: bool = False
    """Whether it is drawn after the others, as what it shows may still be computed."""


@dataclass(frozen=True, eq=False)
class ReportTable:
    """A table."""

    title: str
    columns: Sequence[str]
    """Headings with their units; the first column names the rows."""
    rows: Sequence[Sequence[Cell]]
    """As many cells each as there are columns."""
    name: str = ""
    """Its anchor; none if empty."""
    file: str = ""
    """A CSV file beside the page that holds the same."""
    folded: bool = False
    """Whether the reader has to unfold it."""
    on_terminal: bool = False

    @classmethod
    def of(
        cls, name: str, records: Iterable[Mapping[str, Any]], /, **values: object
    ) -> ReportTable:
        """The table named ``table-name`` in ``captions.toml``: its columns of these records."""
        words = _captions()[f"table-{name}"]
        heads, title = words["columns"], words["title"].format(**values)
        rows = [[record.get(key) for key in heads] for record in records]
        return cls(**{**words, "title": title, "columns": list(heads.values()), "rows": rows})

    @classmethod
    def of_states(
        cls,
        name: str,
        states: Sequence[tuple[str, Mapping[str, Any]]],
        heads: Mapping[str, str] | None = None,
    ) -> ReportTable:
        """A column for each of some labelled states, a row for each quantity that one has.

        The table is named as for :meth:`of`; ``heads``: headings of the quantities by their keys,
        by default its columns.
        """
        words = dict(_captions()[f"table-{name}"])
        every = (words.pop("columns") if heads is None else heads).items()
        rows = [[head, *(state.get(key) for _, state in states)] for key, head in every]
        rows = [row for row in rows if any(value is not None for value in row[1:])]
        columns = [words.pop("corner"), *(label for label, _ in states)]
        return cls(columns=columns, rows=rows, **words)

    @classmethod
    def of_frame(cls, title: str, table: pd.DataFrame) -> ReportTable:
        """A data frame as it is, with a CSV file."""
        rows = table.astype(object).values.tolist()
        columns = [str(column) for column in table]
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        return cls(title, columns, rows, f"table-{name}", f"{name}.csv")

    @property
    def numeric(self) -> list[bool]:
        """Which columns hold numbers, as such or in words that begin with one; not the first."""
        others = [all(map(_is_number, column)) for column in zip(*self.rows, strict=True)][1:]
        return [False, *others]


@dataclass(frozen=True, eq=False)
class Card:
    """What belongs together on a page: figures side by side, tables, text."""

    title: str
    figures: Sequence[ReportFigure] = ()
    tables: Sequence[ReportTable] = ()
    """The same quantity at several states, for example; in this order."""
    text: Sequence[str] | Mapping[str, Sequence[str]] = ()
    """Statements, as a list; by headings, side by side, where it is a mapping."""
    caption: str = ""
    name: str = ""
    """Its anchor; none if empty."""
    symbol: str = ""
    paper: str = ""
    """Beside the heading: of the quantity, and its figure in the paper."""
    wide: bool = False
    """Whether it takes the whole width of the page."""

    @classmethod
    def captioned(cls, name: str, draw: Callable[[], Figure], **values: object) -> Card:
        """One figure over the whole width, with the words of its name."""
        return cls(**caption(name, **values), figures=[ReportFigure(name, "", draw, wide=True)])

    @classmethod
    def tabular(cls, table: ReportTable, **more: Any) -> list[Card]:
        """One table under its own title; no card where it has no rows."""
        return [cls(table.title, tables=[table], **more)] if table.rows else []


@dataclass(frozen=True, eq=False)
class Section:
    """A part of a page: its anchor, heading, a paragraph, and cards."""

    name: str
    title: str
    cards: Sequence[Card]
    lead: str = ""

    @classmethod
    def of(cls, name: str, cards: Sequence[Card], text: str = "", /, **values: object) -> Section:
        """With the title and the lead named ``text``, or as the section."""
        return cls(name, cards=cards, **caption(f"section-{text or name}", **values))


@dataclass(frozen=True, eq=False)
class Report:
    """All that a reader sees of a run."""

    kind: str
    title: str
    lead: str = ""
    """A paragraph on what the page is about."""
    findings: Sequence[str] = ()
    """What was found, in sentences, the most important first; also on the terminal."""
    keys: Sequence[KeyNumber] = ()
    """Up to six numbers to begin with."""
    sections: Sequence[Section] = ()
    """Figures and tables; empty ones are left out."""
    warnings: Sequence[str] = ()
    """What to beware of; also on the terminal."""
    notes: Sequence[str] = ()
    """What to know before trusting the numbers."""
    command: str = ""
    remark: str = ""
    """What makes the page again, and a word on that."""
    case: Mapping[str, Any] = field(default_factory=dict)
    toml: str = ""
    """What was run: plain values, or TOML text."""
    files: Mapping[str, str] = field(default_factory=dict)
    """What lies beside the page, and what each file holds."""
    costs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    hero: ReportFigure | None = None
    hero_caption: str = ""
    """A figure at the top, and its caption."""
    brief: ReportTable | None = None
    """A table for the terminal alone."""
    explore: Callable[[], str] | None = None
    """Makes the HTML of its fields to explore, when the page is written."""

    @property
    def cards(self) -> Iterator[Card]:
        """Those of all sections."""
        return (card for section in self.sections for card in section.cards)

    @property
    def figures(self) -> Iterator[ReportFigure]:
        """Those of all cards, and the one at the top."""
        yield from (figure for card in self.cards for figure in card.figures)
        if self.hero is not None:
            yield self.hero

    @property
    def tables(self) -> Iterator[ReportTable]:
        """Those of all cards."""
        return (table for card in self.cards for table in card.tables)


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study's table of cases shows."""

    numbers: Mapping[str, Any]
    """The study's results as plain values, with their units in the names."""
    text: Sequence[str]
    """The same in sentences, the most important first."""
    keys: Sequence[KeyNumber] = ()
    """Up to six numbers to begin with."""
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    words: Mapping[str, object] = field(default_factory=dict)
    """By their names; values in their captions, which are named by study and figure."""
    tables: Sequence[ReportTable] = ()
    """Of the page."""
    attachments: Sequence[ReportTable] = ()
    """Tables that are files only: too long for the page, or one of its tables in numbers."""


def study_report(
    summary: Mapping[str, Any],
    findings: Findings | None = None,
    files: Mapping[str, str] | None = None,
) -> Report:
    """The report of a study.

    ``summary``: the content of ``summary.json``. ``findings``: its figures and tables; without, the
    report is sentences only, as for the terminal. ``files``: what lies beside the page, and what
    each file holds.
    """
    found = findings or Findings({}, ())
    made = f"{summary['command']} · {summary['seeds']}"
    figures = [
        Card(figures=[ReportFigure(name, "", draw, made, wide=True)],
             **caption(f"{summary['kind']}-{name}", **found.words))
        for name, draw in found.figures.items()
    ]  # fmt: skip
    return Report(
        kind="study",
        title=summary["title"],
        lead=summary["question"],
        findings=summary["text"],
        keys=found.keys,
        sections=[
            Section.of("figures", figures),
            Section.of("tables", [c for t in found.tables for c in Card.tabular(t, wide=True)]),
        ],
        warnings=[f"case {case['file']} failed: {case['error']}" for case in summary["failed"]],
        notes=_study_notes(summary),
        command=summary["command"],
        remark=text_of("study-again", seeds=summary["seeds"].capitalize()),
        case=summary["case"],
        files=files or {},
        versions=summary["versions"],
    )  # fmt: skip


def _study_notes(summary: Mapping[str, Any]) -> list[str]:
    """What to keep in mind of how the study went."""
    own = summary["versions"]["modeharvest"]
    notes = [
        f"{count} stored results of {'other options' if label == own else f'modeharvest {label}'} "
        "are not included."
        for label, count in summary["other_results_by_version"].items()
    ]
    if summary["failed"]:
        notes.append(text_of("study-failed", count=len(summary["failed"]), of=summary["cases"]))
    return [*notes, text_of("study-virtual")]


def draw_figures(figures: Iterable[ReportFigure], progress: Progress = silent) -> dict[str, str]:
    """Draw figures one after the other, the late ones last; their SVG by their names."""
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

    ``report``: what to write. ``path``: the HTML file. ``progress``: listener. ``pictures``: what
    :func:`draw_figures` has made of its figures before; they are drawn without.
    """
    if pictures is None:
        pictures = draw_figures(report.figures, progress)
    with atomic(path) as temporary:
        temporary.write_text(page_template().render(report=report, pictures=pictures), "utf-8")


@cache
def page_template(name: str = "page.html") -> jinja2.Template:
    """Read and compile the page, or a part of it, once in a process."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(str(resources.files(__package__))), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": number, "fixed": fixed, "together": together}
    environment.tests |= {
        "mark": lambda cell: isinstance(cell, Mark),
        "measured": lambda cell: isinstance(cell, Measured),
    }
    return environment.get_template(name)


def write_tables(tables: Sequence[ReportTable], folder: Path) -> None:
    """Write every table that has a file as CSV, with all digits, atomically."""
    for table in tables:
        if table.file:
            rows = [[cell if cell == cell else None for cell in row] for row in table.rows]
            write_csv(folder / table.file, table.columns, rows)


def print_report(report: Report, out: Path) -> None:
    """Print findings, tables and warnings; where the page is, last."""
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
        console.print()
        shown = Table(title=escape(table.title), title_justify="left", box=SIMPLE_HEAD,
                        show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))  # fmt: skip
        lines: list[Sequence[Cell]] = [table.columns, *table.rows]
        is_wide = len(lines) < len(lines[0])  # few long rows: turned, so that they fit
        heads, *rows = zip(*lines, strict=True) if is_wide else lines
        for n, head in enumerate(map(number, heads)):
            shown.add_column(escape(head), justify="right" if n else "left", overflow="fold")
        for row in rows:
            shown.add_row(*(escape(number(cell)) for cell in row))
        console.print(shown)
    console.print()
    for warning in report.warnings:
        console.print(f"[yellow]warning:[/yellow] {escape(warning)}", soft_wrap=True)
    console.print(f"report: {out / 'report.html'}", markup=False, soft_wrap=True)


def number(value: Any, digits: int | None = None) -> str:
    """A number as a reader wants it: at most four digits, a true minus, powers of ten raised.

    With ``digits`` it is rounded to that many before.
    """
    if value is None:
        return "–"
    if isinstance(value, Mark):
        return value.text
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return str(value)
    if not isfinite(value):
        return "∞" if value > 0 else "–"
    if digits is not None:
        value = float(f"{value:.{digits}g}")
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.4g}".replace("-", "−")
    mantissa, power = f"{value:.1e}".split("e")
    return f"{mantissa} · {ten_to(int(power))}".replace("-", "−")


def ten_to(power: int) -> str:
    """A power of ten, raised."""
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def fixed(value: float, decimals: int = 5) -> str:
    """So many decimals, with a true minus and no minus before a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def percent(value: float | None, digits: int = 4) -> str:
    """A share or a strain [-] in percent, with its sign."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.{digits}g}{NBSP}%".replace("-", "−")


def material_text(table: Mapping[str, Any]) -> str:
    """A material's kind and constants, and whether they are this project's default.

    ``table``: ``kind`` and the constants, as in a case or in a solution's ``info``.
    """
    constants = {name: value for name, value in table.items() if name != "kind"}
    values = ", ".join(f"{name} {_plain_number(value)}" for name, value in constants.items())
    usual = {name: _plain_number(value) for name, value in vars(Ogden()).items()}
    is_usual = {name: _plain_number(value) for name, value in constants.items()} == usual
    return f"{'default ' * is_usual}material {table['kind']}: {values} (moduli in MPa)"


def _plain_number(value: Any) -> str:
    return ", ".join(f"{v:g}" for v in value) if isinstance(value, list | tuple) else f"{value:g}"


def together(text: str) -> str:
    """No line ends between a number and its unit or error."""
    return type(text)(re.sub(r" (?=(?:%|px|mm|±)(?!\w))|(?<=±) ", NBSP, text))


def _is_number(cell: Cell) -> bool:
    return not isinstance(cell, Mark) and (not isinstance(cell, str) or cell[:1].isdigit())
