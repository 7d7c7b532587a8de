"""The files that an experiment names: found, counted, and missed before anything is computed."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from modeharvest.errors import InputError
from modeharvest.harvest.experiment import Experiment
from modeharvest.idic.fields.subsets import pyvale_python


def named_files(base: Path, names: Sequence[str], unique: bool = True) -> tuple[Path, ...]:
    """The files that names, or patterns with wildcards, stand for.

    ``unique``: no two may have the same stem, because results are named by it.

    Raises
    ------
    InputError
        If a pattern matches no file, or two files would leave results of the same name.
    """
    paths: list[Path] = []
    for name in names:
        if any(sign in name for sign in "*?["):
            found = sorted(p for p in map(Path, glob.glob(str(base / name))) if p.is_file())
            if not found:
                raise InputError(f"expected files that match {base / name}, found none")
            paths += found
        else:
            paths.append(base / name)
    stems = [path.stem for path in paths]
    twice = next((stem for stem in stems if stems.count(stem) > 1 or stem == "reference"), None)
    if unique and twice is not None and len(paths) > 1:
        raise InputError(
            f"expected images whose names differ, and none called 'reference', got {twice!r} "
            "again; rename it, or narrow the pattern"
        )
    return tuple(paths)


def of_each_photograph(
    experiment: Experiment, base: Path, names: Sequence[str], what: str
) -> dict[str, Path]:
    """The file that goes with each deformed photograph, by the photograph's name.

    Parameters
    ----------
    experiment, base
        What there is, and the folder its names are relative to.
    names
        Of the files, or patterns; none at all is all right.
    what
        They are, for the message.

    Raises
    ------
    InputError
        If there aren't as many as photographs.
    """
    files = named_files(base, names, unique=False)
    photographs = named_files(base, experiment.images.deformed)
    if files and len(files) != len(photographs):
        raise InputError(
            f"{what}: expected one file for each of {len(photographs)} deformed images, got "
            f"{len(files)}"
        )
    return {path.stem: file for path, file in zip(photographs, files, strict=False)}


def all_files(experiment: Experiment, base: Path) -> tuple[Path, ...]:
    """Every file that an experiment names, but fields of a local DIC."""
    images, table, lens = experiment.images, experiment.specimen, experiment.distortion
    names = [images.reference, *images.deformed, *images.repeats]
    names += [table.material, table.cells, *table.deformed_material]
    names += [lens.file, *lens.calibration]
    return named_files(base, [name for name in names if name], unique=False)


def require_inputs(experiment: Experiment, base: Path) -> None:
    """Raise in one line unless all that an experiment names is there.

    Raises
    ------
    InputError
        If a file is missing, or there aren't as many masks or fields as photographs.
    MissingDependencyError
        If pyvale is asked for and not installed.
    """
    local = experiment.local
    files = (*all_files(experiment, base), *named_files(base, local.files, unique=False))
    missing = [path for path in files if not path.is_file()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"expected the files that the experiment names, found no file {missing[0]}{more}"
        )
    masks = experiment.specimen.deformed_material
    of_each_photograph(experiment, base, masks, "specimen.deformed_material")
    of_each_photograph(experiment, base, local.files, "local.files")
    if local.code == "pyvale":
        pyvale_python()
