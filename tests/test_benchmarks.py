"""Programs of ``benchmarks`` and code in the documents find what they use, whatever changes."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path
from statistics import geometric_mean
from types import ModuleType

import pytest

from modeharvest.runs.benchmark.standard import standard_cases
from modeharvest.validation.scoring.score import ENOUGH_COVERED

ROOT = Path(__file__).parents[1]
SCORING = ROOT / "docs/how-to/scoring.md"
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


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """What writes the tables of the page on scoring."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks/score_codes"))
    return importlib.import_module("tables")


def test_the_table_of_the_standard_set_agrees_with_itself_and_the_set(tables: ModuleType) -> None:
    """Cells have two digits, so that a mean of them is known to 5 %."""
    lines = tables.lines_of(SCORING, "standard")
    columns = tables.read(lines)
    assert tables.markdown(lines[0].split(" | ")[0].strip("| "), columns) == lines
    for code, cells in columns.items():
        own = {case: cells[case].split() for case in standard_cases()}
        assert len(cells) == len(own) + 2, code
        counted = [float(rms) for rms, *share in own.values()
                   if rms not in (tables.NONE, tables.NOT_APPLICABLE)
                   and (not share or int(share[0].strip("(")) >= 100 * ENOUGH_COVERED)]  # fmt: skip
        assert int(cells[tables.COUNTED]) == len(counted), code
        assert float(cells[tables.MEAN]) == pytest.approx(geometric_mean(counted), rel=0.05), code
    order = [(-int(c[tables.COUNTED]), float(c[tables.MEAN])) for c in columns.values()]
    assert order == sorted(order)


@pytest.mark.parametrize("specimen", ["paper", "plate"])
def test_the_tables_of_other_codes_are_written_by_the_program(
    tables: ModuleType, specimen: str
) -> None:
    lines = tables.lines_of(SCORING, specimen)
    columns = tables.read(lines)
    assert tables.markdown("errors in px", columns) == lines
    rms = [float(cells["rms"]) for cells in columns.values()]
    assert rms == sorted(rms)


def test_codes_that_are_not_measured_again_keep_their_columns(tables: ModuleType) -> None:
    cases = {"a": {"rms_px": 0.0123, "covered": 1.0}, "b": {"rms_px": 0.4, "covered": 0.913}}
    mine = {"code": "mine", "counted": 2, "rms_px": 0.07, "cases": cases}
    board = {"set": "123", "codes": [mine]}
    earlier = ["| rms [px], set 123 | theirs | mine |", "|---|---|---|", "| a | 0.02 | 9 |",
               "| b | none | 9 |", "| cases that count | 1 | 2 |",
               "| geometric mean over them | 0.02 | 9 |"]  # fmt: skip
    never = lambda code, case: False  # noqa: E731
    assert tables.standard(board, cases, never, earlier) == [
        "| rms [px], set 123 | mine | theirs |", "|---|---|---|", "| a | 0.012 | 0.02 |",
        "| b | 0.40 (91 %) | none |", "| cases that count | 2 | 1 |",
        "| geometric mean over them | 0.070 | 0.02 |",
    ]  # fmt: skip
    other_set = {**board, "set": "124"}
    assert "theirs" not in "".join(tables.standard(other_set, cases, never, earlier))
