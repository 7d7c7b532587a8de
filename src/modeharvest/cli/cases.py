"""The command that lists the shipped cases."""

from __future__ import annotations

from typing import Annotated

import typer


def cases(
    name: Annotated[str | None, typer.Argument(help="Print this case's TOML file.")] = None,
) -> None:
    """List the shipped cases and their commands, or print one as a start for your own.

    For example: modeharvest cases paper-virtual > mine.toml
    """
    from modeharvest.case_file import case_text, lattice_cases, shipped_cases

    if name is not None:
        print(case_text(name), end="")
        return
    lattices = lattice_cases()
    for shipped, title in shipped_cases().items():
        commands = "bloch, modes" if shipped in lattices else "run"
        print(f"{shipped:18}{commands:14}{title}")
