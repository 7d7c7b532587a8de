"""The programs in ``benchmarks`` find what they use: a change of the code must not break them."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

PROGRAMS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.py"))


@pytest.mark.dolfinx
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_a_benchmark_finds_what_it_imports(program: Path) -> None:
    importlib.import_module(program.stem)
