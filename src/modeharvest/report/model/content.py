"""The content of a report: key numbers, figures, tables and text, in sections and cards.

One function for each kind of run makes its :class:`Report`, from which the page, the CSV files and
the terminal output are written. Figures are functions, called one by one as the page is written.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from modeharvest.report.model.text import Cell, Mark, Template, caption, captions, text_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


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
        words = captions()["key"][name].items()
        filled: dict[str, Any] = {k: Template().vformat(v, (), values) for k, v in words}
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
        words = captions()[f"table-{name}"]
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
        words = dict(captions()[f"table-{name}"])
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
        """Whether columns have only numbers, or texts that begin like them; not the first one."""
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
    explore: Callable[[float], str] | None = None
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


def _is_number(cell: Cell) -> bool:
    text = cell.lstrip("+-−").replace("–", "0", 1) if isinstance(cell, str) else "0"
    return not isinstance(cell, Mark) and text[:1].isdigit()
