#!/usr/bin/env python3
"""Make the figure and the module tables of docs/architecture.md from the code.

    scripts/architecture.py [--check]

The tables have the first lines of docstrings; they replace everything below the mark in the page.
The figure shows the layers, their packages and the number of modules in each. With --check nothing
is written, and the exit code is 1 if page or figure differ from the code.
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
FIGURE = PROJECT / "docs/images/architecture.svg"
LAYERS = (("util",), *((name,) for name in FOLDERS), ("runs", "report"), ("cli",))
"""Layers from left to right; each may import those to its left."""
WIDTH, GAP, LINE, TOP = 122, 18, 17, 34
"""Width of a layer, gap between layers, height of a line of text and of a heading [px]."""


def packages() -> Iterator[Path]:
    """Folders of all packages, those in ``FOLDERS`` first, each before its subpackages."""
    for name in FOLDERS:
        yield from sorted(path.parent for path in (PROJECT / name).rglob("__init__.py"))
    for path in sorted(path.parent for path in APPLICATION.rglob("__init__.py")):
        if path == APPLICATION or path.relative_to(APPLICATION).parts[0] not in FOLDERS:
            yield path


def first_line(module: Path) -> str:
    """First line of a module's docstring; empty if it has none."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def tables() -> str:
    """Headings and tables of all packages, as Markdown."""
    parts = []
    for package in packages():
        name = package.relative_to(PROJECT).as_posix()
        parts.append(f"\n## {name}\n\n{first_line(package / '__init__.py')}\n")
        modules = [m for m in sorted(package.glob("*.py")) if m.stem != "__init__"]
        if modules:
            parts.append("\n| module | what it is |\n|---|---|\n")
            parts += [f"| `{module.stem}` | {first_line(module)} |\n" for module in modules]
    return "".join(parts)


def counted(name: str) -> list[tuple[str, int]]:
    """Packages of a layer and their numbers of modules; the layer's top package comes first."""
    root = (PROJECT if name in FOLDERS else APPLICATION) / name
    inner = sorted(path.parent for path in root.rglob("__init__.py"))
    return [
        (path.relative_to(root).as_posix(), sum(m.stem != "__init__" for m in path.glob("*.py")))
        for path in inner
    ]


def box(name: str, x: int, y: int) -> tuple[list[str], int]:
    """SVG elements of a layer's box at (x, y) [px], and y of its lower edge [px]."""
    rows = counted(name)
    height = TOP + LINE * (len(rows) - 1) + 10
    total = sum(count for _, count in rows)
    parts = [
        f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{height}" rx="6"/>',
        f'<text class="head" x="{x + 10}" y="{y + 21}">{name}</text>',
        f'<text class="count" x="{x + WIDTH - 10}" y="{y + 21}">{total}</text>',
    ]
    for k, (inner, count) in enumerate(rows[1:]):
        at = y + TOP + LINE * k + 12
        parts.append(f'<text x="{x + 10}" y="{at}">{inner.removeprefix("lattice/")}</text>')
        parts.append(f'<text class="count" x="{x + WIDTH - 10}" y="{at}">{count}</text>')
    return parts, y + height


def figure() -> str:
    """SVG of the layers from left to right, legible on light and on dark pages."""
    parts, lowest = [], 0
    for k, names in enumerate(LAYERS):
        x, y = k * (WIDTH + GAP) + 1, 1
        for name in names:
            drawn, y = box(name, x, y)
            parts += drawn
            lowest, y = max(lowest, y), y + 8
        if k:
            parts.append(f'<path d="M{x - GAP + 2} 18h{GAP - 7}m-5 -5l5 5l-5 5"/>')
    width = len(LAYERS) * (WIDTH + GAP) - GAP + 2
    style = (
        "text{font:12px system-ui,sans-serif;fill:#222}.head{font-weight:600;font-size:14px}"
        ".count{text-anchor:end;fill:#666}rect{fill:#f4f6f8;stroke:#8a96a3}"
        "path{fill:none;stroke:#8a96a3;stroke-width:1.6}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {lowest + 1}" '
        f'width="{width}" height="{lowest + 1}"><style>{style}</style>\n'
        + "\n".join(parts) + "\n</svg>\n"
    )  # fmt: skip


def main() -> int:
    """Write page and figure, or with --check compare them with the code; the exit code."""
    prose = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    drawn = {PAGE: prose + MARK + tables(), FIGURE: figure()}
    if "--check" in sys.argv[1:]:
        return int(any(not p.exists() or p.read_text("utf-8") != t for p, t in drawn.items()))
    for path, text in drawn.items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
