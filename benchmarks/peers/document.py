"""Tables in a Markdown page, between comments that name them."""

from __future__ import annotations

from pathlib import Path

from modeharvest.util.files import atomic

END = "<!-- end -->"


def write(page: Path, tables: dict[str, list[str]]) -> None:
    """Replace the text between ``<!-- peers: name -->`` and ``END`` for each table."""
    text = page.read_text()
    for name, lines in tables.items():
        begin = f"<!-- peers: {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(END)
        if not (found and closed):
            raise SystemExit(f"expected '{begin} ... {END}' in {page}")
        text = before + "\n".join([begin, *lines, END]) + after
    with atomic(page) as part:
        part.write_text(text)
