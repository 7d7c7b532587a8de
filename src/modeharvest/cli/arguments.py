"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from modeharvest.errors import InputError

CaseName = Annotated[
    str,
    typer.Argument(
        metavar="CASE", help="A shipped case ('modeharvest cases' lists them) or a TOML file."
    ),
]


def _folder(text: str | None) -> Path | None:
    """What stands for a folder that will be written to; InputError if it can't be one."""
    if text is None:
        return None
    if not text:
        raise InputError("expected a folder, got an empty name; '.' is the current one")
    from modeharvest.files import require_no_file  # here, so that --help is quick

    require_no_file(Path(text))
    return Path(text)


def folder_option(name: str, about: str) -> Any:
    """An option that names a folder to write to, checked before any work begins."""
    return typer.Option(name, help=about, metavar="DIR", parser=str, callback=_folder)


OutFolder = Annotated[Path, folder_option("--out", "Folder for everything this case leaves.")]
SolutionFile = Annotated[
    Path | None,
    typer.Option(
        "--solution", help="Use this solution (HDF5) instead of DIR/solution.h5.", metavar="FILE"
    ),
]
