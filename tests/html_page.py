"""A page and a report's tables as their tests see them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html.parser import HTMLParser

import pandas as pd

from modeharvest.report.model.content import ReportTable

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """The ids, links and balance of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: Counter[str] = Counter()
        self.links: list[str] = []
        self.sources: list[str] = []
        self.tags: Counter[str] = Counter()
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        if tag not in VOID:
            self.open.append(tag)
        self._note(tag, dict(attrs))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self._note(tag, dict(attrs))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def _note(self, tag: str, attributes: dict[str, str | None]) -> None:
        if attributes.get("id"):
            self.ids[str(attributes["id"])] += 1
        for name in ("src", "href", "srcset", "data", "poster", "action"):
            value = attributes.get(name)
            if value is not None:
                (self.links if tag in ("a", "use") else self.sources).append(value)


def frame(tables: Sequence[ReportTable], title: str) -> pd.DataFrame:
    """The rows of the table of that title."""
    (table,) = (table for table in tables if table.title == title)
    return pd.DataFrame(table.rows, columns=list(table.columns))
