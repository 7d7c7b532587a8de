"""Equations as MathML, which browsers draw without a script, a font, or the network."""

from __future__ import annotations

import re
from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError


def _mathml(latex: str, display: str) -> str:
    try:
        found = convert(latex, display=display)
    except Exception as error:
        raise ExtensionError(f"an equation can't be converted: {latex!r}: {error}") from error
    if unknown := re.search(r">\\(\w+)<", found):
        raise ExtensionError(f"an equation can't be converted: {latex!r}: \\{unknown[1]}")
    # Without the class, browsers use letters of mathematical italics, which few fonts have.
    found = re.sub(r"<mi>(\w|&#x0*3[0-9A-Fa-f]{2};)</mi>", r'<mi class="letter">\1</mi>', found)
    # Fonts without a table of mathematics lower subscripts below the depth of their base alone.
    base = r"<msub>(<m[io][^>]*>[^<]*</m[io]>)"
    return re.sub(base, r'<msub><mpadded depth="0.25em">\1</mpadded>', found)


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    number = node.get("number")
    label = f'<span class="eqno">({number})</span>' if number else ""
    name = f' id="{escape(node["ids"][0])}"' if node.get("ids") else ""
    equation = _mathml(node.astext(), "block")
    self.body.append(f'<div class="math equation"{name}>{equation}{label}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer of equations."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
