"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CaseName = Annotated[
    str,
    typer.Argument(
        metavar="CASE", help="A shipped case ('modeharvest cases' lists them) or a TOML file."
    ),
]
OutFolder = Annotated[
    Path, typer.Option("--out", help="Folder for everything this case leaves.", metavar="DIR")
]
SolutionFile = Annotated[
    Path | None,
    typer.Option(
        "--solution", help="Use this solution (HDF5) instead of DIR/solution.h5.", metavar="FILE"
    ),
]
