"""Kernels compiled ahead of time, and anew when one that they call has changed.

Guards: no stale kernel after a change of a callee; children only where kernels are missing, none
under mpirun, none left behind.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from modeharvest.runs import precompile
from modeharvest.runs.precompile import precompiling
from modeharvest.util import compiled

CALLEE = """
from modeharvest.util.compiled import compiled

@compiled()
def callee(x: float) -> float:
    return {factor} * x
"""
CALLER = """
from modeharvest.util.compiled import compiled
from modeharvest.imaging.callee_of_test import callee

@compiled()
def caller(x: float) -> float:
    return callee(x)
"""


def loaded(name: str, path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module from a file, as if it were the package's."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def test_a_kept_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_PACKAGE", tmp_path)
    (tmp_path / "imaging").mkdir()
    caller_file = tmp_path / "imaging" / "caller_of_test.py"
    callee_file = tmp_path / "imaging" / "callee_of_test.py"
    caller_file.write_text(CALLER)
    hits = []
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python compares whole seconds
    for factor in (2.0, 2.0, 3.0):  # the second time nothing has changed
        callee_file.write_text(CALLEE.format(factor=factor))
        for remembered in (compiled._read_by, compiled._has_kernels, compiled._digest):
            remembered.cache_clear()
        loaded("modeharvest.imaging.callee_of_test", callee_file, monkeypatch)
        module = loaded("modeharvest.imaging.caller_of_test", caller_file, monkeypatch)
        assert module.caller(1.0) == factor
        hits.append(sum(module.caller.stats.cache_hits.values()))
    assert hits == [0, 1, 0]


class Child:
    """Stands for a child that compiles for ever."""

    def __init__(self, command: list[str], **_: Any) -> None:
        self.command, self.finished = command, False

    def poll(self) -> int | None:
        return -9 if self.finished else None

    def kill(self) -> None:
        self.finished = True

    def wait(self) -> int:
        assert self.finished
        return -9


@pytest.fixture
def children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Child]:
    """The children that are started; the kernels of one stage of the two are there."""
    started: list[Child] = []

    def start(command: list[str], **options: Any) -> Child:
        started.append(Child(command, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(precompile.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(precompile, "cached_in", lambda kernel: tmp_path / kernel.__name__)
    there = precompile._stamp("correlate")
    assert there is not None
    there.parent.mkdir()
    there.touch()
    return started


def test_only_what_is_missing_is_compiled_and_no_child_is_left(children: list[Child]) -> None:
    with precompiling(("image", "correlate")) as kernels:
        kernels.wait("correlate")  # at once: nobody compiles it
        assert [child.command[-1] for child in children] == ["image"]
    assert children[0].finished


def test_what_is_measured_with_is_compiled_after_what_it_calls(children: list[Child]) -> None:
    stamps = {stage: precompile._stamp(stage) for stage in ("correlate", "measure")}
    there = stamps["correlate"]
    assert there is not None
    there.unlink()
    with precompiling(stamps) as kernels:
        (child,) = children
        assert child.command[-2:] == ["correlate", "measure"]
        there.touch()
        kernels.wait("correlate")  # no longer than that, though the child goes on
        assert not child.finished


def test_ranks_of_mpirun_start_no_children(
    children: list[Child], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "is_alone", lambda: False)
    with precompiling(("image", "correlate")):
        pass
    assert not children


def test_kernels_that_are_not_kept_are_not_compiled_ahead(
    children: list[Child], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "cached_in", lambda kernel: None)
    with precompiling(("image", "correlate")):
        pass
    assert not children
