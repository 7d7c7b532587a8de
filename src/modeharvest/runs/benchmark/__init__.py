"""Benchmarks for DIC codes: a public set of images, and grades for the fields measured on it.

::

    DIR/         reference.tif … benchmark.json README.md      benchmark make
    DIR-truth/   solution.h5 images/ benchmark.json
    graded/      report.html scores.json scores.csv            score
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.tables import ALL_ROLES
from modeharvest.runs.case import Case
from modeharvest.runs.experiment import Run
from modeharvest.util.errors import InputError
from modeharvest.util.files import copy_whole, require_writable
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import exclusive
from modeharvest.validation.scoring import score as scoring
from modeharvest.validation.scoring.benchmark import (
    SOLUTION,
    BenchmarkTruth,
    Declared,
    publish,
    read_measured,
    require_apart,
    require_no_lens,
)
from modeharvest.validation.scoring.conventions import check_conventions
from modeharvest.validation.scoring.score import Grading
from modeharvest.validation.scoring.star import StarSet
from modeharvest.validation.scoring.star_grades import StarGrade, StarGrading, ranked_grades

REACH_CELLS = 0.25
"""Reach of a field's point [cells]: an eighth of the pattern's wavelength of two cells."""

T = TypeVar("T")


def grade_star(
    fields: Mapping[Path, Declared],
    stills: Mapping[Path, Declared],
    folder: Path | str,
    out: Path | str,
    progress: Progress = silent,
) -> StarGrading:
    """Grade fields measured on a star set; writes a report, JSON and CSV to ``out``.

    ``fields``: files for the deformed image, with what the files don't declare; ``stills``: files
    for the image without motion, one per field in the same order, or none; ``folder``: the star
    set. Fields that can't be read, are of another set, in millimetres or don't contain the wave are
    in the result's ``refused``, each with the reason. Raises InputError if no field can be graded,
    or two have the same name.
    """
    if stills and len(stills) != len(fields):
        raise InputError(
            f"expected a --still for each of {len(fields)} fields, or none, got {len(stills)}"
        )
    from modeharvest.report.grades import write_grading

    star_set = StarSet.read(folder)
    require_writable(out)
    still_of = dict(zip(fields, stills.items(), strict=bool(stills)))

    def grade(path: Path, declared: Declared) -> StarGrade:
        moved = _read_star_field(path, declared, star_set)
        still = _read_star_field(*still_of[path], star_set) if stills else None
        return StarGrade(star_set.spec.star, moved, still)

    grades, refused = _graded(fields, grade, progress, "resolution")
    grading = StarGrading(star_set, tuple(ranked_grades(grades)), refused)
    write_grading(out, grading)
    progress(1, 1, "resolution")
    return grading


def _read_star_field(path: Path, declared: Declared, star_set: StarSet) -> LocalField:
    """A field in px on the star's grid; InputError if it is in another unit."""
    if "mm" in (declared.units, declared.displacement_units):
        raise InputError(f"{path}: expected a field in px, got mm; a star has no millimetres")
    declared = replace(declared, units=declared.units or "px")
    return read_measured(path, star_set.spec.star.grid, star_set.id, declared)


def make_benchmark(
    case: str | Path | Case,
    public: Path | str,
    truth: Path | str | None = None,
    solution: Path | str | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Simulate a case, make images, and separate them from their truth; can be resumed.

    ``case``: a shipped case's name, the path of a TOML file, or a Case; ``public``: folder of what
    is published; ``truth``: folder of the truth, by default that name with "-truth" appended;
    ``solution``: use this (HDF5) instead of simulating. Returns the content of the public
    ``benchmark.json``. Raises InputError if the case's images are distorted, the truth would be in
    the public folder, the solution is of another case, or another process works in a folder.
    """
    case, public = Case.of(case), Path(public)
    require_no_lens(case.imaging)
    truth = truth_folder(public) if truth is None else Path(truth)
    require_apart(public, truth)
    with exclusive(public), exclusive(truth):
        require_writable(public)
        run = Run(case, truth, progress, None if solution is None else Path(solution))
        run.solved()
        if solution is not None:
            copy_whole(solution, truth / SOLUTION)
        return publish(run.image(), case.experiment.specimen, public, truth)


def truth_folder(public: Path) -> Path:
    """The default folder of the truth of a public folder."""
    named = public if public.name not in ("", "..") else public.resolve()
    return named.with_name(f"{named.name}-truth")


def score(
    fields: Mapping[Path, Declared] | Sequence[Path | str],
    truth: Path | str,
    strain: float,
    out: Path | str,
    edge_px: int = scoring.EDGE_PX,
    progress: Progress = silent,
) -> Grading:
    """Grade displacement fields and write ``report.html``, ``scores.json`` and ``scores.csv``.

    Fields that can't be read, are of another benchmark or in another unit than declared are in
    ``refused``, each with the reason. InputError if none can be graded, or two have the same name.

    fields : files of the fields, with what the files don't declare.
    truth, out : folder of the truth, and folder for the report.
    strain : nominal strain of the image that they were measured on [-].
    edge_px : material closer than this to a hole or to the outside counts as edge [px].
    progress : receives the progress.
    """
    from modeharvest.report.grades import write_grading

    every = fields if isinstance(fields, Mapping) else {Path(f): Declared() for f in fields}
    known = BenchmarkTruth.read(truth)
    require_writable(out)
    grid, true = known.grid, partial(known.displacement, strain)
    labels = scoring.regions(known.mask, grid, known.specimen, edge_px)
    reach_px = REACH_CELLS * known.specimen.pitch / grid.pixel_size

    def grade(path: Path, declared: Declared) -> tuple[scoring.Score, tuple[str, ...]]:
        field = read_measured(path, grid, known.id, declared)
        graded = scoring.score(field, true(field.x, field.y), labels, grid, reach_px)
        notes = check_conventions(field, true, grid)[1]
        return graded, (field.read_as, *notes) if field.convention else notes

    graded, refused = _graded(every, grade, progress, "score")
    best_first = tuple(scoring.ranked([one for one, _ in graded]))
    remarks = tuple(note for _, notes in graded for note in notes)
    spectra = {one.source: scoring.error_spectrum(one, grid) for one in best_first}
    done = Grading(known, strain, edge_px, labels, best_first, spectra, remarks, refused)
    write_grading(out, done)
    progress(1, 1, "score")
    return done


def _graded(
    fields: Mapping[Path, Declared],
    grade: Callable[[Path, Declared], T],
    progress: Progress,
    what: str,
) -> tuple[list[T], dict[str, str]]:
    """The grades of the fields, and the reasons for the fields that can't be graded.

    Raises InputError if there is no field, two have the same name, or none can be graded.
    """
    if not fields:
        raise InputError("expected fields to score, got none")
    names = [declared.name or path.stem for path, declared in fields.items()]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"expected fields of different names, got {', '.join(twice)} twice; give each a --name"
        )
    grades: list[T] = []
    refused: dict[str, str] = {}
    for n, (path, declared) in enumerate(fields.items()):
        progress(n, len(fields) + 1, f"{what}: {path.name}")
        try:
            grades.append(grade(path, declared))
        except InputError as error:
            refused[str(path)] = str(error)
    if not grades:
        raise InputError("; ".join(refused.values()))
    progress(len(fields), len(fields) + 1, f"{what}: report")
    return grades, refused


def declarations(
    paths: Sequence[Path],
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    y_axes: Sequence[str] | None = None,
    first_pixels: Sequence[int] | None = None,
    columns: Sequence[str] | None = None,
) -> dict[Path, Declared]:
    """The conventions that a command line declares for each file.

    ``units``, ``y_axes`` and ``first_pixels``: one for all files, or one for each; "file" if the
    names of the columns state it. ``columns``: "u=NAME" or "u=7", for all files. InputError if the
    number of these is neither one nor that of the files, or ``names`` aren't one for each.
    """
    if len(set(paths)) < len(paths):
        raise InputError(f"expected different files to score, got {', '.join(map(str, paths))}")
    if names and len(names) != len(paths):
        raise InputError(f"expected a --name for each of {len(paths)} files, got {len(names)}")
    first = _each(first_pixels, paths, "--first-pixel")
    if not set(first) <= {None, 0, 1}:
        raise InputError(f"expected --first-pixel 0 or 1, got {', '.join(map(str, first))}")
    roles = dict(map(_column, columns or ()))
    options = ((names, "--name"), (units, "--unit"), (y_axes, "--y-axis"))
    each = zip(paths, *(_each(given, paths, name) for given, name in options), first, strict=True)
    return {
        path: Declared(
            name=name,
            units=None if unit == "file" else unit,
            y_axis=None if y_axis == "file" else y_axis,
            first_pixel=pixel,
            columns=roles,
        )
        for path, name, unit, y_axis, pixel in each
    }


def _each(given: Sequence[T] | None, paths: Sequence[Path], option: str) -> Sequence[T | None]:
    """One value for each file, from none, one, or as many values as files."""
    if not given:
        return [None] * len(paths)
    if len(given) == 1:
        return [given[0]] * len(paths)
    if len(given) != len(paths):
        raise InputError(
            f"expected {option} once, or once for each of {len(paths)} files, got {len(given)}"
        )
    return given


def _column(text: str) -> tuple[str, str | int]:
    role, sign, name = text.partition("=")
    if not sign or not name:
        raise InputError(f"expected --column ROLE=NAME, as u=disp_x or u=3, got {text!r}")
    if role not in ALL_ROLES:
        raise InputError(
            f"expected --column for one of {', '.join(ALL_ROLES)}, got {role!r} in {text!r}"
        )
    return role, int(name) if name.isdigit() else name
