"""Programs of ``benchmarks`` and code in the documents find what they use, whatever changes."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROGRAMS = sorted((ROOT / "benchmarks").glob("*.py"))
PAGES = [
    path for path in sorted((ROOT / "docs").rglob("*.md")) if "```python" in path.read_text("utf-8")
]


@pytest.mark.dolfinx
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_a_benchmark_finds_what_it_imports(program: Path) -> None:
    importlib.import_module(program.stem)


@pytest.mark.dolfinx
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_in_a_document_finds_what_it_imports(page: Path) -> None:
    for block in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                exec(ast.unparse(node), {})
