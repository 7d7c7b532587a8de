"""Headings and tables in reStructuredText for generated pages."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

FOLDER = "generated"
"""Folder of generated pages in the documentation's source; not under version control."""


def heading(title: str, mark: str = "=") -> str:
    """A title, underlined with ``mark``."""
    return f"{title}\n{mark * max(4, len(title))}\n\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], widths: str) -> str:
    """A table whose cells are reStructuredText; ``widths``: relative column widths."""
    lines = [f".. list-table::\n   :header-rows: 1\n   :widths: {widths}\n"]
    for row in (head, *rows):
        for mark, cell in zip("*" + " " * len(row), row, strict=False):
            text = textwrap.indent(cell.strip() or "–", " " * 7).strip()
            lines.append(f"   {mark} - {text}")
    return "\n".join(lines) + "\n\n"


def write(path: Path, text: str) -> None:
    """Write a page unless it exists unchanged, so that Sphinx doesn't read it again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")
