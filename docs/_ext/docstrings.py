"""Conversion of the project's docstrings to reStructuredText: arguments, bars, underscores."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

ARGUMENT = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*) : (\S.*)$")
VALIDATED = re.compile(r"~?typing\.Annotated\[(.+?), ~?pydantic[\w.]+Validator\(.*?\)\]")
LITERAL = re.compile(r"(``.*?``|:\w+:`[^`]*`)")


def escaped(line: str) -> str:
    """The line with bars (absolute values) and underscores at the end of words escaped."""
    parts = LITERAL.split(line)
    for k in range(0, len(parts), 2):
        parts[k] = re.sub(r"\|", r"\\|", parts[k])
        parts[k] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", parts[k])
    return "".join(parts)


def with_fields(paragraph: list[str]) -> list[str]:
    """A list of arguments, ``name : meaning`` with indented lines, as fields; others unchanged."""
    if not paragraph or not ARGUMENT.match(paragraph[0]):
        return paragraph
    if not all(ARGUMENT.match(line) or line.startswith("    ") for line in paragraph):
        return paragraph
    found: list[str] = []
    texts: list[tuple[list[str], list[str]]] = []
    for line in paragraph:
        if match := ARGUMENT.match(line):
            texts.append(([name.lstrip("*") for name in match[1].split(", ")], [match[2]]))
        else:
            texts[-1][1].append(line.strip())
    for names, text in texts:
        found += [f":param {name}: {' '.join(text)}" for name in names]
    return found


def paragraphs(lines: Iterable[str]) -> list[list[str]]:
    """Groups of lines that are separated by blank lines."""
    found: list[list[str]] = [[]]
    for line in lines:
        if line.strip():
            found[-1].append(line)
        else:
            found.append([])
    return found


def process(_app: Any, what: str, _name: str, _thing: Any, _how: Any, lines: list[str]) -> None:
    """Convert a docstring's lines in place, except indented literal blocks."""
    numpy_style = any(re.fullmatch(r"\s*-{4,}", line) for line in lines)
    out: list[str] = []
    verbatim = False
    for paragraph in paragraphs(lines):
        if paragraph and not paragraph[0].startswith(" "):
            verbatim = False
        if verbatim:
            out += [*paragraph, ""]
            continue
        text = paragraph if numpy_style else with_fields(paragraph)
        out += [*map(escaped, text), ""]
        verbatim = (bool(paragraph) and paragraph[-1].rstrip().endswith("::")) or (
            verbatim and not paragraph
        )
        if not paragraph and len(out) > 1 and out[-2:] == ["", ""]:
            out.pop()
    lines[:] = out


def restore(_app: Any, what: str, _name: str, _thing: Any, _how: Any, lines: list[str]) -> None:
    """Undo napoleon's reading of the text before a colon as an attribute's type."""
    if what in ("attribute", "data", "property"):
        for k, line in enumerate(lines):
            if line.startswith(":type: "):
                lines[:] = [f"{line.removeprefix(':type: ')}: {lines[0]}", *lines[1:k]]
                return


def parsable(_app: Any, _what: str, _name: str, _thing: Any, _how: Any, signature: str | None,
             returned: str | None) -> tuple[str | None, str | None]:  # fmt: skip
    """A signature that Python can parse, without which Sphinx links no type in it."""
    if signature is not None:
        signature = VALIDATED.sub(r"\1", signature)
        signature = re.sub(r"<function (\w+)[^<>]*>", r"\1", signature)
        signature = re.sub(r"<[^<>]*>", "...", signature)  # <factory> of a default
    return signature, returned


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the functions before and after napoleon, whose priority is 500."""
    # In unions Sphinx writes the repr of an alias.
    TypeAliasForwardRef.__repr__ = lambda alias: alias.name  # type: ignore[method-assign]
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-docstring", restore, priority=600)
    app.connect("autodoc-process-signature", parsable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
