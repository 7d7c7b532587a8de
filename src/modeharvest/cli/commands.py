"""Commands that run a case: virtual experiments, infinite lattices, photographs, studies.

Commands import the modules they need when they are called, so that ``--help`` is fast.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modeharvest.cli.messages import CaseName, OutFolder, SolutionFile, bars, folder_option, warn
from modeharvest.util.errors import InputError

if TYPE_CHECKING:
    from modeharvest.runs.experiment import Run


def cases(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Print this case's TOML file.")
    ] = None,
) -> None:
    """List the shipped cases and their commands, or print one to start your own from.

    For example: modeharvest cases paper-virtual > mine.toml
    """
    from modeharvest.runs.case import case_text, shipped_cases

    if name is not None:
        print(case_text(name), end="")
        return
    commands = {"experiment": "run", "lattice": "bloch, modes", "homogenization": "homogenize"}
    commands |= {"unknowns": "identify", "images": "harvest", "study": "study"}
    for kind, command in commands.items():
        for shipped, title in shipped_cases(kind).items():
            print(f"{shipped:18}{command:14}{title}")


WholeField = Annotated[
    bool | None,
    typer.Option(help="Measure the whole displacement on a mesh, up to every edge (or not)."),
]


def run(
    case: CaseName, out: OutFolder, solution: SolutionFile = None, whole_field: WholeField = None
) -> None:
    """Run a virtual experiment: simulate, make images, correlate, validate.

    Writes solution, images with truth, results, report.html and summary.json to DIR. After an
    interruption run the same command again: finished stages are not repeated. A case with a table
    "calibration" is the twin of a real experiment, and is measured from its photographs alone.
    """
    from modeharvest.report.experiment import experiment_report
    from modeharvest.report.model.output import print_report
    from modeharvest.report.photographs import photographs_report

    with _stages(case, out, solution, whole_field=whole_field) as stages:
        if stages.case.calibration is None:
            report = experiment_report(stages.all())
        else:
            from modeharvest.runs.photographs.twin import TwinRun

            twin = TwinRun(stages.case, out, stages.progress, solution)
            report, out = photographs_report(twin.all()), out / "harvest"
    print_report(report, out)


def fem(case: CaseName, out: OutFolder) -> None:
    """Simulate the compression test (needs dolfinx): DIR/solution.h5 and .vtu.

    Finds the critical strain, proves stability by the inertia of the tangent stiffness, and
    follows the buckled branch. Runs in parallel under mpirun.
    """
    from modeharvest.report.experiment import critical_line

    with _stages(case, out) as stages:
        solution = stages.fem()
    critical = solution.info.get("critical")
    material = solution.info["material"]
    print(critical_line(None if critical is None else critical["strain"], material))
    for s in solution.snapshots:
        print(f"{100 * s.nominal_strain:6.2f} %  {s.branch:9}  negative pivots {s.negative_pivots}")
    for warning in solution.info.get("warnings", []):
        warn(warning)
    outcome = str(solution.info.get("outcome", "complete"))
    if outcome != "complete":
        raise InputError(f"simulation {outcome}; what was reached is in {out / 'solution.h5'}")


def image(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Make speckle images and their truth from a solution: DIR/images."""
    with _stages(case, out, solution) as stages:
        images = stages.image()
    rows, cols = images.grid.shape
    print(f"{len(images.strains) + 1} images of {rows} x {cols} px in {images.folder}")
    print(f"largest residual of the inverse mapping {images.max_residual_px:.1e} px")
    for warning in images.info.get("warnings", []):
        warn(warning)


def correlate(case: CaseName, out: OutFolder, whole_field: WholeField = None) -> None:
    """Measure the images by micromorphic IDIC: DIR/correlation (and DIR/whole_field)."""
    with _stages(case, out, whole_field=whole_field) as stages:
        stages.correlate()
        wholes = stages.measure()
        results = stages.correlate()  # failed ones are repeated from the measured displacement
    for strain, result in results.items():
        print(f"{100 * strain:6.2f} %  {result.outcome.name.lower()}: {result.outcome.value}")
    for strain, whole in wholes.items():
        at = f"{100 * strain:6.2f} %  whole displacement"
        print(f"{at}: {whole.unknowns} unknowns, cut-off wavelength {whole.cutoff_px:.3g} px")


def validate(
    case: CaseName, out: OutFolder, solution: SolutionFile = None, whole_field: WholeField = None
) -> None:
    """Compare the measurement with the truth: DIR/report.html and DIR/summary.json."""
    from modeharvest.report.experiment import experiment_report
    from modeharvest.report.model.output import print_report

    with _stages(case, out, solution, whole_field) as stages:
        summary = stages.validate()
    print_report(experiment_report(summary), out)


@contextmanager
def _stages(
    case: str, out: Path, solution: Path | None = None, whole_field: bool | None = None
) -> Iterator[Run]:
    """Stages of a case, with progress bars; ``whole_field`` overrides the case if not None."""
    from modeharvest.runs.case import Case

    checked = Case.read(case)
    from modeharvest.runs.experiment import Run
    from modeharvest.runs.whole_field import change_of

    checked = checked.model_copy(update=change_of(checked.whole_field, whole_field))

    with bars() as progress:
        yield Run(checked, out, progress, solution)


def bloch(case: CaseName, out: OutFolder) -> None:
    """Find the first instability of an infinite lattice, over all waves (needs dolfinx).

    The lattice is square, hexagonal or chiral, or with kind = "file" your own mesh or geometry (see
    docs/how-to/own_cell.md). Writes the first critical load and waves with their proof, eigenvalues
    over the wave vector (dispersion.csv, dispersion.h5), report.html and summary.json.
    """
    _analyse(case, out, whole=False)


def modes(case: CaseName, out: OutFolder) -> None:
    """Find an infinite lattice's modes, buckled branches and mode families (needs dolfinx).

    Runs 'bloch' unless its results exist, and then finds real modes on the smallest periodic cell,
    buckled branches with their energies, spectra, and the Fourier mode families in the spectra.
    """
    _analyse(case, out, whole=True)


def _analyse(case: str, out: Path, whole: bool) -> None:
    """Analyse a lattice under progress bars, and print its report."""
    from modeharvest.report.lattice import lattice_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.lattice.case import LatticeCase

    checked = LatticeCase.read(case)
    from modeharvest.runs.lattice.pipeline import LatticeAnalysis

    with bars() as progress:
        analysis = LatticeAnalysis(checked, out, progress, case)
        summary = analysis.all() if whole else analysis.bloch()
    print_report(lattice_report(summary), out)


_EXAMPLE = "Print a commented EXPERIMENT.toml with every option, and stop."


def _example(wanted: bool) -> None:
    if wanted:
        from modeharvest.runs.case import case_text

        print(case_text("photographs"), end="")
        raise typer.Exit


def harvest(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT.toml", help="Photographs, scale and specimen.")
    ],
    out: OutFolder,
    example: Annotated[
        bool, typer.Option("--example", callback=_example, is_eager=True, help=_EXAMPLE)
    ] = False,
    whole_field: WholeField = None,
    contours: Annotated[
        bool | None,
        typer.Option(help="Measure modes also by the material's contours, not only by speckle."),
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Follow a running test: where its photographs arrive."),
    ] = None,
    until_still: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Stop watching this long after the last photograph."),
    ] = None,
) -> None:
    """Measure modes in photographs of a test: v0, v1 and phi1 with error bars.

    The TOML file names the reference and the deformed images, the pixel size and the cell size;
    all else is detected or has a default. Begin with 'modeharvest harvest --example >
    experiment.toml'. Writes results/, report.html and summary.json to DIR. After an interruption
    run the same command again: finished photographs are not measured again.

    With --watch, photographs are measured quickly as they arrive, and DIR/watch.html predicts the
    strain at which the specimen will buckle. Watching ends with Ctrl-C or by --until-still. Run
    the command again without --watch to measure all photographs in full.
    """
    if watch is not None:
        return _watch(experiment, out, watch, until_still)
    if until_still is not None:
        raise InputError("expected --watch FOLDER beside --until-still, got none")
    from modeharvest.report.model.output import print_report
    from modeharvest.report.photographs import photographs_report
    from modeharvest.runs.photographs.pipeline import harvest as harvest_photographs

    with bars() as progress:
        summary = harvest_photographs(experiment, out, progress, whole_field, contours)
    print_report(photographs_report(summary), out)


def _watch(experiment: Path, out: Path, folder: Path, until_still: float | None) -> None:
    from modeharvest.report.figures.sequence import watch_text
    from modeharvest.runs.photographs.watch import watch

    print(watch_text(watch(experiment, out, folder, until_still=until_still,
                           show=lambda line: print(line, flush=True))))  # fmt: skip
    command = shlex.join(["modeharvest", "harvest", str(experiment), "--out", str(out)])
    print(f"measure them in full by: {command}")


def measure(
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="Undeformed image.")],
    deformed: Annotated[
        list[str], typer.Argument(metavar="DEFORMED...", help="Images, in the order of the test.")
    ],
    out: Annotated[Path, folder_option("--out", "Folder for all results.")],
    mask: Annotated[
        Path | None, typer.Option(help="Image, black outside the material; found by default.")
    ] = None,
    pixel_size: Annotated[
        float | None, typer.Option(help="Edge of a pixel in mm; without it, lengths are in px.")
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="Plane mesh: origin in the image's middle, y up.")
    ] = None,
    brightness: Annotated[
        str, typer.Option(help="Degree of gain and offset over x, y: 0 to 6, or none.", metavar="N")
    ] = "1",
    every: Annotated[int, typer.Option(help="Measure only every N-th image.", metavar="N")] = 1,
    log: Annotated[
        Path | None, typer.Option(help="Log file of the testing machine, joined to images by time.")
    ] = None,
    gauges: Annotated[
        Path | None,
        typer.Option(metavar="GAUGES.toml", help="Points, lines and areas to read in the fields."),
    ] = None,
    angle: Annotated[
        float, typer.Option(help="Of the specimen's axis to x, degrees; strains are along it.")
    ] = 0.0,
) -> None:
    """Measure the whole displacement of any speckled surface, up to the edges of its material.

    Images are TIFF, PNG, JPEG or BMP files of one size, folders, or videos. Specimens without
    speckle are measured by their contours if they are fully visible. Writes displacement, standard
    deviations and strains (HDF5, VTU, CSV, TIFF), report.html and summary.json to DIR. After an
    interruption run the same command again: it continues.

    For example: modeharvest measure ref.tif def_*.tif --mask mask.png --out out/plate
    """
    from modeharvest.report.measure import measure_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.measure import measure as measure_images
    from modeharvest.runs.photographs.machine_log import LogTable
    from modeharvest.runs.photographs.sequence import FrameChoice

    light = int(brightness) if brightness.isdecimal() else brightness
    with bars() as progress:
        summary = measure_images(
            reference, deformed, out, mask=mask, pixel_size=pixel_size, mesh=mesh,
            brightness=light, choice=FrameChoice(every=every),
            log=None if log is None else LogTable(str(log)), gauges=gauges, angle=angle,
            progress=progress,
        )  # fmt: skip
    print_report(measure_report(summary), out)


def study(
    name: Annotated[
        str,
        typer.Argument(
            metavar="STUDY",
            help="robustness, noise, systematic, modes or resolution; or a TOML file of your own.",
        ),
    ],
    out: Annotated[Path, folder_option("--out", "Folder for all results.")],
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; 2 by default.", metavar="N")
    ] = None,
    memory: Annotated[
        str, typer.Option(help="Memory that each process may take at most.", metavar="BYTES")
    ] = "4GiB",
    scheduler: Annotated[
        str | None,
        typer.Option(help="A dask scheduler instead, as tcp://host:8786.", metavar="ADDRESS"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer cases, larger pixels: a first look.")
    ] = False,
    solution: SolutionFile = None,
) -> None:
    """Study the accuracy of the measurement: many cases, run by several processes.

    Writes table.csv, report.html and summary.json to DIR. After an interruption run the same
    command again: finished cases are not repeated.
    """
    if scheduler is not None and workers is not None:
        raise InputError(
            "expected --workers or --scheduler, got both: a scheduler has workers of its own"
        )
    from modeharvest.report.model.content import study_report
    from modeharvest.report.model.output import print_report
    from modeharvest.runs.study import StudyAnalysis, StudyCase
    from modeharvest.validation.workers import Workers

    checked = StudyCase.read(name)
    crew = Workers(2 if workers is None else workers, memory, scheduler)
    command = f"modeharvest study {name} --out DIR"
    command += " --quick" * quick + " --solution FILE" * (solution is not None)
    with bars() as progress:
        case = checked.quick() if quick else checked
        summary = StudyAnalysis(case, out, progress, crew, solution, command).all()
    print_report(study_report(summary), out)
