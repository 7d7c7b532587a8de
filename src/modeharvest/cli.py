"""The command line: ``modeharvest run CASE --out DIR``, and its stages one by one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from modeharvest import __version__
from modeharvest.case import TwinCase, case_text, read_case, shipped_cases
from modeharvest.case_file import lattice_cases
from modeharvest.console import ProgressBars, compilation_announced
from modeharvest.errors import InputError, MissingDependencyError
from modeharvest.lattice.terminal import print_lattice
from modeharvest.ranks import is_first

app = typer.Typer(
    help=(
        "A virtual laboratory for integrated digital image correlation (IDIC) on mechanical "
        "metamaterials: buckle a cellular elastomer, make speckle images whose truth is known at "
        "every pixel, measure them, and see how wrong the measurement was, and why.\n\n"
        "Start with: [bold]modeharvest run paper-virtual --out out/demo[/bold], or, for the modes "
        "of an infinite lattice, [bold]modeharvest modes square-lattice --out out/square[/bold]"
    ),
    epilog="Exit codes: 0 done, 2 the input can't be used (one line says why), 130 interrupted.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
benchmark_app = typer.Typer(
    help="Image sets for any DIC code, whose truth is kept apart.", no_args_is_help=True
)
app.add_typer(benchmark_app, name="benchmark")
_errors = Console(stderr=True)

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


def _version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
) -> None:
    pass


@app.command()
def run(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Run a whole case: simulate, image, correlate, validate.

    Leaves solution, images with truth, results, report.html and summary.json in DIR. Run the
    same command again after an interruption: finished stages are not repeated. The twin of a real
    experiment is photographed, harvested from its photographs alone, and set against its truth.
    """
    checked = read_case(case)
    if isinstance(checked, TwinCase):
        _run_twin(checked, out, solution)
        return
    summary = _with_bars(case, out, solution, lambda stages: stages.all())
    _print_summary(summary, out)


@app.command()
def bloch(case: CaseName, out: OutFolder) -> None:
    """Analyse an infinite lattice: what makes it buckle first, of all waves (needs dolfinx).

    Leaves the first critical load and waves with their proof, the lowest eigenvalues against the
    wave vector at several loads (dispersion.csv, dispersion.h5), report.html and summary.json.
    """
    print_lattice(_of_lattice(case, out, lambda analysis: analysis.bloch()), out)


@app.command()
def modes(case: CaseName, out: OutFolder) -> None:
    """Find an infinite lattice's modes, buckled branches and mode families (needs dolfinx).

    Does what 'bloch' does, unless that is there already, and goes on: real modes on the smallest
    cell, branches with their energies, spectra, and the Fourier mode families found in them.
    """
    print_lattice(_of_lattice(case, out, lambda analysis: analysis.all()), out)


def _example(wanted: bool) -> None:
    if wanted:
        from modeharvest.harvest.example import EXAMPLE

        print(EXAMPLE, end="")
        raise typer.Exit


@app.command()
def harvest(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT.toml", help="What there are photographs of.")
    ],
    out: OutFolder,
    example: Annotated[
        bool,
        typer.Option(
            "--example",
            callback=_example,
            is_eager=True,
            help="Print a commented EXPERIMENT.toml with every option, and stop.",
        ),
    ] = False,
) -> None:
    """Harvest modes from photographs of a test: v0, v1 and phi1 with error bars.

    The TOML file names the reference and the deformed images, the pixel size and the cell size;
    all else is found or has a default. Begin with 'modeharvest harvest --example >
    experiment.toml'. Leaves results/, report.html and summary.json in DIR. Run the same command
    again after an interruption: finished photographs are not measured again.
    """
    from modeharvest.harvest import pipeline, terminal

    with _bars() as bars:
        summary = pipeline.harvest(experiment, out, bars)
    terminal.print_harvest(summary, out)


@app.command()
def study(
    name: Annotated[
        str,
        typer.Argument(
            metavar="STUDY", help="robustness, noise or systematic; or a TOML file of your own."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for everything the study leaves.", metavar="DIR")
    ],
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; 2 by default.", metavar="N")
    ] = None,
    memory: Annotated[
        str, typer.Option(help="Most that each of them may take.", metavar="BYTES")
    ] = "4GiB",
    scheduler: Annotated[
        str | None,
        typer.Option(help="A dask scheduler instead, e.g. tcp://host:8786.", metavar="ADDRESS"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer cases, larger pixels: a first look.")
    ] = False,
    solution: SolutionFile = None,
) -> None:
    """Study how good the measurement is: many cases, run by several processes.

    Leaves table.csv, report.html and summary.json in DIR. Run the same command again after an
    interruption: finished cases are not repeated.
    """
    from modeharvest.studies import terminal

    with _bars() as bars:
        summary = terminal.run(name, out, workers, memory, scheduler, quick, solution, bars)
    terminal.print_study(summary, out)


@app.command()
def fem(case: CaseName, out: OutFolder) -> None:
    """Simulate the compression test (needs dolfinx): DIR/solution.h5 and .vtu.

    Finds the critical strain, proves stability by the tangent's inertia, follows the buckled
    branch. Under mpirun it runs in parallel.
    """
    solution = _with_bars(case, out, None, lambda stages: stages.fem())
    critical = solution.info.get("critical")
    print(_critical_line(None if critical is None else critical["strain"]))
    for s in solution.snapshots:
        print(f"{100 * s.nominal_strain:6.2f} %  {s.branch:9}  negative pivots {s.negative_pivots}")
    for warning in solution.info.get("warnings", []):
        _errors.print(f"[yellow]warning:[/yellow] {escape(warning)}", highlight=False)
    outcome = str(solution.info.get("outcome", "complete"))
    if outcome != "complete":
        raise InputError(f"simulation {outcome}; what was reached is in {out / 'solution.h5'}")


@app.command()
def image(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Make speckle images and their truth from a solution: DIR/images."""
    images = _with_bars(case, out, solution, lambda stages: stages.image())
    rows, cols = images.grid.shape
    print(f"{len(images.strains) + 1} images of {rows} x {cols} px in {images.folder}")
    print(f"largest residual of the inverse mapping {images.max_residual_px:.1e} px")
    for warning in images.info.get("warnings", []):
        _errors.print(f"[yellow]warning:[/yellow] {escape(warning)}", highlight=False)


@app.command()
def correlate(case: CaseName, out: OutFolder) -> None:
    """Measure the images by micromorphic IDIC: DIR/correlation."""
    for strain, result in _with_bars(case, out, None, lambda s: s.correlate()).items():
        print(f"{100 * strain:6.2f} %  {result.outcome.name.lower()}: {result.outcome.value}")


@app.command()
def validate(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Compare what was measured with the truth: DIR/report.html and DIR/summary.json."""
    _print_summary(_with_bars(case, out, solution, lambda stages: stages.validate()), out)


@benchmark_app.command("make")
def benchmark_make(
    case: CaseName,
    out: Annotated[Path, typer.Option("--out", help="The public folder.", metavar="DIR")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Folder for the truth [DIR-truth].", metavar="DIR"),
    ] = None,
    solution: SolutionFile = None,
) -> None:
    """Make a public set of images, and apart from it the truth to score fields with.

    The public folder holds reference.tif, deformed_*.tif, mask.tif, benchmark.json and README.md,
    and nothing that gives the displacements away.
    """
    checked = read_case(case)
    from modeharvest.scoring import make_benchmark, truth_folder

    with _bars() as bars:
        info = make_benchmark(checked, out, truth, solution, bars)
    print(f"benchmark {info['id']}: {len(info['deformed'])} deformed images in {out}")
    print(f"truth, not to be given away: {truth or truth_folder(out)}")


@app.command("score")
def score_fields(
    fields: Annotated[
        list[Path],
        typer.Argument(metavar="FIELD...", help="CSV, NPZ, HDF5, MAT or VTK files of any code."),
    ],
    truth: Annotated[Path, typer.Option("--truth", help="The truth's folder.", metavar="DIR")],
    strain: Annotated[float, typer.Option("--strain", help="Of the image that was measured.")],
    out: OutFolder,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Of the code; once for each FIELD.")
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", help="px or mm; 'file': as its columns' names say.", metavar="UNIT"),
    ] = None,
    y_axis: Annotated[
        list[str] | None,
        typer.Option("--y-axis", help="Where y grows and v is positive: down, up or 'file'."),
    ] = None,
    first_pixel: Annotated[
        list[int] | None, typer.Option("--first-pixel", help="Number of the first pixel: 0 or 1.")
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option("--column", help="u=NAME or u=7; also x, y, v, valid.", metavar="ROLE=NAME"),
    ] = None,
) -> None:
    """Grade displacement fields of any DIC code against the truth of a benchmark, and rank them.

    --unit, --y-axis and --first-pixel count for all fields, or are given once for each, in order.
    Leaves report.html, scores.json and scores.csv in DIR.
    """
    from modeharvest import scoring

    declared = scoring.declarations(fields, name, unit, y_axis, first_pixel, column)
    with _bars() as bars:
        done = scoring.grade(declared, truth, strain, out, progress=bars)
    scoring.print_grading(done, out)


@app.command()
def cases(
    name: Annotated[str | None, typer.Argument(help="Print this case's TOML file.")] = None,
) -> None:
    """List the shipped cases and their commands, or print one as a start for your own.

    For example: modeharvest cases paper-virtual > mine.toml
    """
    if name is not None:
        print(case_text(name), end="")
        return
    lattices = lattice_cases()
    for shipped, title in shipped_cases().items():
        commands = "bloch, modes" if shipped in lattices else "run"
        print(f"{shipped:18}{commands:14}{title}")


def _with_bars(case: str, out: Path, solution: Path | None, work: Callable[[Any], Any]) -> Any:
    """Read the case, then run a stage of it under progress bars."""
    checked = read_case(case)  # before the heavy imports, so that a typo is told at once
    from modeharvest.pipeline import Run

    with _bars() as bars:
        return work(Run(checked, out, bars, solution))


def _of_lattice(case: str, out: Path, work: Callable[[Any], Any]) -> Any:
    """Read a lattice's case, then do some of its analysis under progress bars."""
    from modeharvest.lattice.case import read_lattice_case

    checked = read_lattice_case(case)
    from modeharvest.lattice.pipeline import LatticeAnalysis

    with _bars() as bars:
        return work(LatticeAnalysis(checked, out, bars, case))


def _run_twin(case: TwinCase, out: Path, solution: Path | None) -> None:
    """Make a twin's photographs, harvest them, and compare with the truth."""
    from modeharvest.harvest.terminal import print_harvest
    from modeharvest.harvest.twin_run import TwinRun

    with _bars() as bars:
        summary = TwinRun(case, out, bars, solution).all()
    print_harvest(summary, out / "harvest")


@contextmanager
def _bars() -> Iterator[ProgressBars]:
    try:
        with ProgressBars(_errors) as bars, compilation_announced(_errors):
            yield bars
    except KeyboardInterrupt as error:
        raise _InterruptedError from error


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    table = Table(title=str(summary.get("title", "")), title_justify="left")
    table.add_column("quantity")
    for s in summary["snapshots"]:
        table.add_column(f"{100 * s['nominal_strain']:.2f} %", justify="right")
    rows = {
        "negative pivots of the tangent": "negative_pivots",
        "pattern amplitude [px]": "pattern_amplitude_px",
        "w = truth - IDIC, rms [px]": "rms_w_px",
        "best possible fit, rms [px]": "rms_best_fit_px",
        "IDIC - best fit, rms [px]": "rms_idic_to_best_fit_px",
        "grey-level residual, rms": "rms_residual",
        "iterations": "iterations",
        "outcome": "outcome",
    }
    for label, key in rows.items():
        table.add_row(escape(label), *(_cell(s.get(key)) for s in summary["snapshots"]))
    console = Console(highlight=False)
    console.print(table)
    console.print("rms: per component, over all material pixels")
    console.print(_critical_line(summary["critical_strain"]))
    missed = [row["quantity"] for row in summary["expected"] if not row["ok"]]
    for warning in summary["warnings"]:
        console.print(f"[yellow]warning:[/yellow] {escape(warning)}", highlight=False)
    if summary["expected"]:
        console.print(f"expected values missed: {', '.join(missed) or 'none'}")
    console.print(f"report: {out / 'report.html'}")


def _critical_line(strain: float | None) -> str:
    if strain is None:
        return "no bifurcation on the path (stable, imperfect, or odd numbers of holes both ways)"
    return f"critical strain {100 * strain:.4f} %"


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


class _InterruptedError(Exception):
    """Ctrl-C, under a name that the command-line library does not take for its own."""


def main() -> None:
    """Entry point of the ``modeharvest`` command."""
    if is_first():
        _run()
    else:  # under mpirun one speaks for all
        _errors.quiet = True
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            _run()


def _run() -> None:
    try:
        app()
    except (InputError, MissingDependencyError) as error:
        message = " ".join(str(error).split())
        _errors.print(f"[red]error:[/red] {escape(message)}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except _InterruptedError:
        _errors.print("interrupted; run the same command again to continue where it stopped")
        sys.exit(130)
