"""The content of a report: key numbers, figures, tables and text, for HTML, CSV and the terminal.

One function for each kind of run makes its :class:`Report`, from which the page, the CSV files and
the terminal output are written. Figures are functions, called one by one as the page is written.
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
    """Title, caption, lead etc. in table ``name`` of ``captions.toml``, with values filled in."""
    words = _captions()[name].items()
    return {k: Markup(v).format(**values) if isinstance(v, str) else v for k, v in words}


@dataclass(frozen=True)
class _Readable:
    """A value formatted by a function; a format specification is its number of digits."""

    written: Callable[..., str]
    value: Any

    def __format__(self, digits: str) -> str:
        return self.written(self.value, *map(int, digits.split()))


class _Template(Formatter):
    """Fills values into plain text: ``{x!n:3}`` by :func:`number`, ``{x!p}`` by :func:`percent`."""

    def convert_field(self, value: Any, conversion: Any) -> Any:
        """Apply the conversions n, p and z (four digits, keeping zeros at the end)."""
        ways: dict[str, Callable[..., str]] = {"n": number, "p": percent}
        ways["z"] = lambda x: f"{x:#.4g}" if 1e-3 <= abs(x) < 1e3 else number(x)  # 1.530
        if conversion in ways:
            return _Readable(ways[conversion], value)
        return super().convert_field(value, conversion)


def text_of(name: str, /, **values: object) -> str:
    """Plain text ``name`` in table ``text`` of ``captions.toml``, with values filled in."""
    return _Template().vformat(_captions()["text"][name], (), values)


@dataclass(frozen=True)
class Mark:
    """A word on a coloured label: green if good, red if not."""

    text: str
    good: bool


@dataclass(frozen=True)
class Measured:
    """A value with its standard errors: None if not known, infinite if not determined."""

    value: float
    errors: tuple[float | None, ...] = ()
    decimals: int = 5

    def __str__(self) -> str:
        return " ".join([fixed(self.value, self.decimals), *self.error_texts])

    @property
    def error_texts(self) -> list[str]:
        """Each standard error as text: "± 0.00020", or "< 0.00001" if it would be rounded to 0."""
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
    """A number at the top of a page, which has up to seven."""

    name: str
    value: str | float | None
    unit: str = ""
    remark: str = ""
    """Text below the number, for example a value to compare it with."""

    @classmethod
    def of(cls, name: str, value: str | float | None = None, /, **values: object) -> KeyNumber:
        """Make the key number ``name`` of ``captions.toml``, with values filled in.

        ``value`` is used if ``captions.toml`` has no value for this name.
        """
        words = _captions()["key"][name].items()
        filled: dict[str, Any] = {k: _Template().vformat(v, (), values) for k, v in words}
        return cls(**{"value": value, **filled})


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """A figure, drawn when the page is written."""

    name: str
    """HTML anchor, unique on the page."""
    label: str
    """Text above the figure; may be empty."""
    draw: Callable[[], Figure]
    """Draws the figure in the style of :mod:`modeharvest.report.figures.style`."""
    numbers: str = ""
    """Line of numbers below the figure."""
    wide: bool = False
    """Whether the figure takes the full width of its card."""
    exact: bool = False
    """Whether pixels are stored without loss, for fields as fine as the pixels."""
    late: bool = False
    """Whether the figure is drawn after the others, because its data may not be ready earlier."""


@dataclass(frozen=True, eq=False)
class ReportTable:
    """A table."""

    title: str
    columns: Sequence[str]
    """Headings with units; the first column names the rows."""
    rows: Sequence[Sequence[Cell]]
    """Rows, each with one cell per column."""
    name: str = ""
    """HTML anchor; none if empty."""
    file: str = ""
    """Name of a CSV file with the same content, beside the page; none if empty."""
    folded: bool = False
    on_terminal: bool = False
    """Whether the table is folded on the page, and whether it is also printed on the terminal."""

    @classmethod
    def of(
        cls, name: str, records: Iterable[Mapping[str, Any]], /, **values: object
    ) -> ReportTable:
        """Make ``table-NAME`` of ``captions.toml`` with its columns of these records as rows."""
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
        """Make a table with a column for each labelled state and a row for each quantity.

        Quantities that no state has are left out. ``name``: as for :meth:`of`; ``heads``: headings
        of the quantities by key, by default the table's columns in ``captions.toml``.
        """
        words = dict(_captions()[f"table-{name}"])
        every = (words.pop("columns") if heads is None else heads).items()
        rows = [[head, *(state.get(key) for _, state in states)] for key, head in every]
        rows = [row for row in rows if any(value is not None for value in row[1:])]
        columns = [words.pop("corner"), *(label for label, _ in states)]
        return cls(columns=columns, rows=rows, **words)

    @classmethod
    def of_frame(cls, title: str, table: pd.DataFrame) -> ReportTable:
        """Make a table of all columns of a data frame, with a CSV file."""
        rows = table.astype(object).values.tolist()
        columns = [str(column) for column in table]
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        return cls(title, columns, rows, f"table-{name}", f"{name}.csv")

    @property
    def numeric(self) -> list[bool]:
        """Whether each column has only numbers, or texts that begin with a digit; not the first."""
        others = [all(map(_is_number, column)) for column in zip(*self.rows, strict=True)][1:]
        return [False, *others]


@dataclass(frozen=True, eq=False)
class Card:
    """A box on a page: figures side by side, tables and text on one subject."""

    title: str
    figures: Sequence[ReportFigure] = ()
    tables: Sequence[ReportTable] = ()
    """Tables in the order shown, for example one quantity at several states."""
    text: Sequence[str] | Mapping[str, Sequence[str]] = ()
    """Sentences shown as a list; a mapping is shown as one column of sentences per heading."""
    caption: str = ""
    name: str = ""
    """HTML anchor; none if empty."""
    symbol: str = ""
    paper: str = ""
    """Symbol of the quantity, and its figure in the paper, shown beside the heading."""
    wide: bool = False
    """Whether the card takes the full width of the page."""

    @classmethod
    def captioned(cls, name: str, draw: Callable[[], Figure], **values: object) -> Card:
        """Make a card with one figure of full width and the texts ``name`` of ``captions.toml``."""
        return cls(**caption(name, **values), figures=[ReportFigure(name, "", draw, wide=True)])

    @classmethod
    def tabular(cls, table: ReportTable, **more: Any) -> list[Card]:
        """Make a list of one card, titled as its table; empty if the table has no rows."""
        return [cls(table.title, tables=[table], **more)] if table.rows else []


@dataclass(frozen=True, eq=False)
class Section:
    """A part of a page: HTML anchor, heading, cards, and an introductory paragraph."""

    name: str
    title: str
    cards: Sequence[Card]
    lead: str = ""

    @classmethod
    def of(cls, name: str, cards: Sequence[Card], text: str = "", /, **values: object) -> Section:
        """Make a section with the title and lead ``section-TEXT``, or else ``section-NAME``."""
        return cls(name, cards=cards, **caption(f"section-{text or name}", **values))


@dataclass(frozen=True, eq=False)
class Report:
    """Content of the report of one run."""

    kind: str
    title: str
    lead: str = ""
    """Introductory paragraph."""
    findings: Sequence[str] = ()
    """Results in sentences, the most important first; also printed on the terminal."""
    keys: Sequence[KeyNumber] = ()
    """Up to seven numbers at the top of the page."""
    sections: Sequence[Section] = ()
    """Sections with figures and tables; those without cards are left out."""
    warnings: Sequence[str] = ()
    """Warnings; also printed on the terminal."""
    notes: Sequence[str] = ()
    """Assumptions and limitations of the numbers."""
    command: str = ""
    remark: str = ""
    """Command that makes the page again, and a remark on it."""
    case: Mapping[str, Any] = field(default_factory=dict)
    toml: str = ""
    """Input of the run, as plain values or as TOML text."""
    files: Mapping[str, str] = field(default_factory=dict)
    costs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    """Contents of files beside the page, costs of the run, and versions of software, by name."""
    hero: ReportFigure | None = None
    hero_caption: str = ""
    """Figure at the top of the page, and its caption."""
    brief: ReportTable | None = None
    """Table that is printed on the terminal only."""
    explore: Callable[[], str] | None = None
    """Makes the HTML of the interactive display of fields, when the page is written."""

    @property
    def cards(self) -> Iterator[Card]:
        """Cards of all sections."""
        return (card for section in self.sections for card in section.cards)

    @property
    def figures(self) -> Iterator[ReportFigure]:
        """Figures of all cards, and the one at the top."""
        yield from (figure for card in self.cards for figure in card.figures)
        if self.hero is not None:
            yield self.hero

    @property
    def tables(self) -> Iterator[ReportTable]:
        """Tables of all cards."""
        return (table for card in self.cards for table in card.tables)


@dataclass(frozen=True, eq=False)
class Findings:
    """Results of a study, obtained from its table of cases."""

    numbers: Mapping[str, Any]
    """Results as plain values, with units in their names."""
    text: Sequence[str]
    """Results in sentences, the most important first."""
    keys: Sequence[KeyNumber] = ()
    """Up to seven numbers at the top of the page."""
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    words: Mapping[str, object] = field(default_factory=dict)
    """Figures by name, and values filled into their captions, which are named KIND-FIGURE."""
    tables: Sequence[ReportTable] = ()
    """Tables on the page."""
    attachments: Sequence[ReportTable] = ()
    """Tables written to files only: those too long for the page, and numbers behind its tables."""


def study_report(
    summary: Mapping[str, Any],
    findings: Findings | None = None,
    files: Mapping[str, str] | None = None,
) -> Report:
    """Make the report of a study.

    ``summary``: content of ``summary.json``. ``findings``: figures and tables; without them, the
    report has text only, for the terminal. ``files``: contents of the files beside the page, by
    file name.
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
    """Notes on results that were not included, on failed cases, and on virtual experiments."""
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
    with atomic(path) as temporary:
        temporary.write_text(page_template().render(report=report, pictures=pictures), "utf-8")


@cache
def page_template(name: str = "page.html") -> jinja2.Template:
    """Read and compile the template of the page, or of a part of it, once per process."""
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
        console.print()
        shown = Table(title=escape(table.title), title_justify="left", box=SIMPLE_HEAD,
                        show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))  # fmt: skip
        lines: list[Sequence[Cell]] = [table.columns, *table.rows]
        is_wide = len(lines) < len(lines[0])  # few long rows are transposed to fit
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
    """Format a number: integers in full, others with four digits at most, or as 1.2 · 10⁻⁵.

    ``digits``: number of significant digits to which the number is rounded first.
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
    """Format a power of ten with a superscript exponent."""
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def fixed(value: float, decimals: int = 5) -> str:
    """Format with a fixed number of decimals and a typographic minus, but no minus before zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def percent(value: float | None, digits: int = 4) -> str:
    """Format a ratio or a strain [-] in percent, including the percent sign."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.{digits}g}{NBSP}%".replace("-", "−")


def material_text(table: Mapping[str, Any]) -> str:
    """Describe a material's kind and constants, and whether they are the default ones.

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
    """Replace spaces between a number and its unit or error by no-break spaces."""
    return type(text)(re.sub(r" (?=(?:%|px|mm|±)(?!\w))|(?<=±) ", NBSP, text))


def _is_number(cell: Cell) -> bool:
    return not isinstance(cell, Mark) and (not isinstance(cell, str) or cell[:1].isdigit())
