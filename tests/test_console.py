"""What the terminal is told while a command works."""

from __future__ import annotations

import io

import numba
from rich.console import Console

from modeharvest.cli.messages import compilation_announced


def test_compilation_is_announced_once() -> None:
    message = io.StringIO()
    first, second = (numba.njit(lambda x, k=k: x + k) for k in (1, 2))
    with compilation_announced(Console(file=message, width=200)):
        assert first(1) == 2
        assert second(1) == 3
        assert first(1) == 2  # compiled already
    assert message.getvalue().count("compiling kernels") == 1
    third = numba.njit(lambda x: 2 * x)
    assert third(2) == 4
    assert message.getvalue().count("\n") == 1  # nobody listens any more


def test_nothing_is_reported_where_nothing_is_compiled() -> None:
    message = io.StringIO()
    known = numba.njit(lambda x: -x)
    known(1)
    with compilation_announced(Console(file=message)):
        known(2)
    assert message.getvalue() == ""
