#!/usr/bin/env python3
"""Draw the module tables of docs/architecture.md from the first lines of the code's docstrings.

    scripts/architecture.py [--check]

Everything below the mark is replaced; with --check nothing is written, and the exit code is 1 where
the page isn't what the code says.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
PAGE = PROJECT / "docs/architecture.md"
MARK = "<!-- From here on drawn from the code by scripts/architecture.py -->\n"
APPLICATION = PROJECT / "src/modeharvest"
FOLDERS = ("fem", "imaging", "idic", "validation")


def packages() -> Iterator[Path]:
    """Every folder of modules, the four of the science first, each before what it holds."""
    for name in FOLDERS:
        yield from sorted(path.parent for path in (PROJECT / name).rglob("__init__.py"))
    for path in sorted(path.parent for path in APPLICATION.rglob("__init__.py")):
        if path == APPLICATION or path.relative_to(APPLICATION).parts[0] not in FOLDERS:
            yield path


def first_line(module: Path) -> str:
    """What the module is, by the first line of its docstring; empty where it has none."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def tables() -> str:
    """A heading and a table for every package."""
    parts = []
    for package in packages():
        name = package.relative_to(PROJECT).as_posix()
        parts.append(f"\n## {name}\n\n{first_line(package / '__init__.py')}\n")
        modules = [m for m in sorted(package.glob("*.py")) if m.stem != "__init__"]
        if modules:
            parts.append("\n| module | what it is |\n|---|---|\n")
            parts += [f"| `{module.stem}` | {first_line(module)} |\n" for module in modules]
    return "".join(parts)


def main() -> int:
    """Write the page, or compare it with the code."""
    page = PAGE.read_text(encoding="utf-8")
    prose = page.partition(MARK)[0]
    drawn = prose + MARK + tables()
    if "--check" in sys.argv[1:]:
        return int(drawn != page)
    PAGE.write_text(drawn, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
