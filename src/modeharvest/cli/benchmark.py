"""Commands of a benchmark for any DIC code: make its images, grade the measured fields."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.messages import CaseName, OutFolder, SolutionFile, bars, folder_option, refuse

CodeNames = Annotated[
    list[str] | None, typer.Option("--name", help="Name of the code; once for each FIELD.")
]
YAxes = Annotated[
    list[str] | None,
    typer.Option("--y-axis", help="Direction of positive y and v: down, up or 'file'."),
]
FirstPixels = Annotated[
    list[int] | None, typer.Option("--first-pixel", help="Number of the first pixel: 0 or 1.")
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--column", help="As u=NAME or u=7; also x, y, v, valid.", metavar="ROLE=NAME"),
]


def make(
    case: CaseName,
    out: Annotated[Path, folder_option("--out", "The public folder.")],
    truth: Annotated[
        Path | None, folder_option("--truth", "Folder for the truth [DIR-truth].")
    ] = None,
    solution: SolutionFile = None,
) -> None:
    """Make a public set of images, and in a separate folder the truth for grading fields.

    The public folder holds reference.tif, deformed_*.tif, mask.tif, benchmark.json and README.md,
    and nothing that reveals the displacements.
    """
    from modeharvest.runs.case import Case

    checked = Case.read(case)
    from modeharvest.runs.benchmark import make_benchmark, truth_folder

    with bars() as progress:
        info = make_benchmark(checked, out, truth, solution, progress)
    print(f"benchmark {info['id']}: {len(info['deformed'])} deformed images in {out}")
    print(f"truth, not to be given away: {truth or truth_folder(out)}")


def score(
    fields: Annotated[
        list[Path],
        typer.Argument(metavar="FIELD...", help="CSV, NPZ, HDF5, MAT or VTK files of any code."),
    ],
    truth: Annotated[Path, typer.Option("--truth", help="The truth's folder.", metavar="DIR")],
    strain: Annotated[float, typer.Option("--strain", help="Nominal strain of the image.")],
    out: OutFolder,
    name: CodeNames = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", help="px or mm; 'file': as the columns' names say.", metavar="UNIT"),
    ] = None,
    y_axis: YAxes = None,
    first_pixel: FirstPixels = None,
    column: Columns = None,
) -> None:
    """Grade displacement fields of any DIC code against the truth of a benchmark, and rank them.

    --unit, --y-axis and --first-pixel apply to all fields, or are given once for each, in order.
    Writes report.html, scores.json and scores.csv to DIR. Fields that can't be graded are named at
    the end, and the exit code is then 2.
    """
    from modeharvest.report.grades import grading_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.benchmark import declarations
    from modeharvest.runs.benchmark import score as score_fields
    from modeharvest.util.stages import exclusive

    declared = declarations(fields, name, unit, y_axis, first_pixel, column)
    with bars() as progress, exclusive(out):
        done = score_fields(declared, truth, strain, out, progress=progress)
    print_report(grading_report(done), out)
    refuse(done.refused)


def star(
    out: Annotated[Path, folder_option("--out", "Folder for the set.")],
    noise: Annotated[
        list[float] | None,
        typer.Option("--noise", help="Sd, share of full scale [0.01]; once for each level."),
    ] = None,
    bits: Annotated[int, typer.Option("--bits", help="Bits of the noisy images.")] = 8,
    seed: Annotated[int, typer.Option("--seed", help="Seed of speckle and noise.")] = 0,
    rows: Annotated[int, typer.Option("--rows", help="Rows of the images, odd.")] = 501,
    cols: Annotated[int, typer.Option("--cols", help="Columns of the images.")] = 4000,
) -> None:
    """Make the star images of DIC Challenge 2.0: a wave whose period grows along the image.

    Writes exact images, and for each noise level three camera images: the reference, a second one
    without motion, and the deformed one. README.md and star.json give the displacement's formula.
    """
    from modeharvest.validation.scoring.star import Star, StarSpec, fine_speckle, make_star_set

    levels = tuple(noise) if noise else (0.01,)
    spec = StarSpec(Star(rows, cols), fine_speckle(seed), levels, bits, seed)
    with bars() as progress:
        made = make_star_set(spec, out, progress)
    residual = made.info["law"]["residual_of_inversion_px"]
    print(f"star {made.id}: {len(made.info['files'])} images of {rows} x {cols} px in {out}")
    print(f"largest residual of the inverse mapping {residual:.1e} px")


def resolution(
    fields: Annotated[
        list[Path],
        typer.Argument(metavar="FIELD...", help="Measured on the deformed image, by any code."),
    ],
    folder: Annotated[Path, typer.Option("--set", help="The star's folder.", metavar="DIR")],
    out: OutFolder,
    still: Annotated[
        list[Path] | None,
        typer.Option("--still", help="Measured without motion; once for each FIELD, in order."),
    ] = None,
    name: CodeNames = None,
    y_axis: YAxes = None,
    first_pixel: FirstPixels = None,
    column: Columns = None,
) -> None:
    """Grade fields measured on the star: finest period, noise floor, metrological efficiency.

    Fields are in px. --y-axis and --first-pixel apply to all, or are given once for each FIELD
    and its --still. Writes report.html, resolution.json and resolution.csv to DIR.
    """
    from modeharvest.report.grades import star_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.benchmark import declarations, grade_star
    from modeharvest.util.stages import exclusive

    declared = declarations(fields, name, None, y_axis, first_pixel, column)
    quiet = declarations(still, name, None, y_axis, first_pixel, column) if still else {}
    with bars() as progress, exclusive(out):
        done = grade_star(declared, quiet, folder, out, progress)
    print_report(star_report(done), out)
    refuse(done.refused)
