"""Which keys of a summary a page of the documentation does not name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOT_OURS = ("case", "experiment", "files", "versions")
"""Tables whose keys are a user's or a library's."""


def keys(content: Any) -> Iterator[str]:
    """Every key of nested tables."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield name
            if name not in NOT_OURS:
                yield from keys(value)
    elif isinstance(content, list):
        for value in content:
            yield from keys(value)


def undocumented(summary: dict[str, Any], page: str) -> set[str]:
    """Keys that the page's tables do not have."""
    (path,) = DOCS.rglob(page)
    lines = path.read_text("utf-8").splitlines()
    known = "".join(line for line in lines if line.startswith("|"))
    return {name for name in keys(summary) if f"`{name}`" not in known}
