"""Marks cells of tables that hold a sentence, which stylesheets give a least width."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

LONG = 30
"""Characters of a cell that would fill several lines of a narrow column."""


def mark(app: Sphinx, doctree: nodes.document) -> None:
    """Give the class ``long`` to cells with more than ``LONG`` characters."""
    for cell in doctree.findall(nodes.entry):
        if len(cell.astext()) > LONG:
            cell["classes"].append("long")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension: cells are marked when a page has been read."""
    app.connect("doctree-read", mark)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
