"""Commands of a virtual experiment: the whole of it, and its stages one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from modeharvest.cli.arguments import CaseName, OutFolder, SolutionFile
from modeharvest.cli.messages import bars, warn
from modeharvest.errors import InputError

# What the commands need is imported where they need it, so that --help is quick.
if TYPE_CHECKING:
    from modeharvest.case import TwinCase
    from modeharvest.pipeline import Run


def run(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Run a whole case: simulate, image, correlate, validate.

    Leaves solution, images with truth, results, report.html and summary.json in DIR. Run the
    same command again after an interruption: finished stages are not repeated. The twin of a real
    experiment is photographed, harvested from its photographs alone, and set against its truth.
    """
    from modeharvest.case import TwinCase, read_case
    from modeharvest.terminal import print_experiment

    checked = read_case(case)
    if isinstance(checked, TwinCase):
        _run_twin(checked, out, solution)
        return
    with _stages(case, out, solution) as stages:
        summary = stages.all()
    print_experiment(summary, out)


def fem(case: CaseName, out: OutFolder) -> None:
    """Simulate the compression test (needs dolfinx): DIR/solution.h5 and .vtu.

    Finds the critical strain, proves stability by the tangent's inertia, follows the buckled
    branch. Under mpirun it runs in parallel.
    """
    from modeharvest.terminal import critical_line

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


def correlate(case: CaseName, out: OutFolder) -> None:
    """Measure the images by micromorphic IDIC: DIR/correlation."""
    with _stages(case, out) as stages:
        results = stages.correlate()
    for strain, result in results.items():
        print(f"{100 * strain:6.2f} %  {result.outcome.name.lower()}: {result.outcome.value}")


def validate(case: CaseName, out: OutFolder, solution: SolutionFile = None) -> None:
    """Compare what was measured with the truth: DIR/report.html and DIR/summary.json."""
    from modeharvest.terminal import print_experiment

    with _stages(case, out, solution) as stages:
        summary = stages.validate()
    print_experiment(summary, out)


@contextmanager
def _stages(case: str, out: Path, solution: Path | None = None) -> Iterator[Run]:
    """The stages of a case, under progress bars."""
    from modeharvest.case import read_case

    checked = read_case(case)  # before the heavy imports, so that a typo is told at once
    from modeharvest.pipeline import Run

    with bars() as progress:
        yield Run(checked, out, progress, solution)


def _run_twin(case: TwinCase, out: Path, solution: Path | None) -> None:
    """Make a twin's photographs, harvest them, and compare with the truth."""
    from modeharvest.harvest.terminal import print_harvest
    from modeharvest.harvest.twin_run import TwinRun

    with bars() as progress:
        summary = TwinRun(case, out, progress, solution).all()
    print_harvest(summary, out / "harvest")
