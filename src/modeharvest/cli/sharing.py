"""Commands to share data: folders as RO-Crates, the standard set, its leaderboard."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.messages import UNUSABLE, OutFolder, bars, folder_option, refuse

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a finished run or set.")]


def share(
    folder: Folder,
    licence: Annotated[
        str, typer.Option("--licence", help="CC-BY-4.0, CC0-1.0, or another's https:// address.")
    ] = "CC-BY-4.0",
    author: Annotated[
        str, typer.Option("--author", help="Who made it: 'Name <https://orcid.org/...>'.")
    ] = "",
    title: Annotated[str, typer.Option("--title", help="Title; by default the run's.")] = "",
) -> None:
    """Describe a finished folder for an archive: RO-Crate with licence, checksums, software, units.

    Writes ro-crate-metadata.json to FOLDER. 'modeharvest benchmark verify' checks it afterwards.
    """
    from modeharvest.runs.benchmark.crate import METADATA, write_crate

    content = write_crate(folder, licence, author, title)
    (root,) = (entity for entity in content["@graph"] if entity["@id"] == "./")
    print(f"{root['name']}: {len(root['hasPart'])} files in {folder / METADATA}")


def verify(folder: Folder) -> None:
    """Check a shared folder: all files are listed and unchanged, a set's id fits its images."""
    from modeharvest.runs.benchmark.crate import verify as faults_of

    faults = faults_of(folder)
    for fault in faults:
        print(fault)
    if faults:
        raise typer.Exit(UNUSABLE)
    print(f"{folder}: all files are there and unchanged")


def standard(
    out: Annotated[Path, folder_option("--out", "The public folder.")],
    truth: Annotated[
        Path | None, folder_option("--truth", "Folder for the truth [DIR-truth].")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="0: the open set. A large secret one: a blind set.")
    ] = 0,
) -> None:
    """Make the standard set: twelve cases that vary specimen, d/l, noise, speckle, pixels, lens."""
    from modeharvest.runs.benchmark.standard import make_standard

    with bars() as progress:
        made = make_standard(out, truth, seed, progress)
    print(f"standard set {made['id']}: {len(made['cases'])} cases in {out}")


def leaderboard(
    codes: Annotated[Path, typer.Argument(metavar="CODES", help="Folder of files CODE/CASE.csv.")],
    truth: Annotated[Path, typer.Option("--truth", help="The truth's folder.", metavar="DIR")],
    out: OutFolder,
) -> None:
    """Grade fields that codes measured on a standard set, and rank the codes on one page."""
    from modeharvest.runs.benchmark.standard import leaderboard as ranked

    with bars() as progress:
        board = ranked(codes, truth, out, progress)
    for n, row in enumerate(board["codes"], 1):
        of = f"rms {row['rms_px']:.3g} px, mean of {row['counted']} cases" if row["counted"] else ""
        print(f"{n}. {row['code']}: {of}" if of else f"   {row['code']}: no case that counts")
    print(f"report: {out / 'report.html'}")
    refuse(board["refused"])


COMMANDS = (verify, standard, leaderboard)
