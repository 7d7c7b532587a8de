"""A virtual experiment from simulation to report, in stages that run separately and can be resumed.

::

    solution.h5 solution.vtu    fem        the finite element solution
    images/                     image      speckle images, masks, true displacements
    correlation/                correlate  one result for each deformed image
    whole_field/                measure    whole displacement of each image, on a mesh
    report.html summary.json    validate   size and causes of the errors
    stages.json timings.json               which stages are finished, and their durations

A stage is not run again if its inputs, options, code and files have not changed. Two runs of a
case write identical files, except for ``timings.json``, for ``seconds`` of the whole displacement
in ``summary.json``, and for the digest of that file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import correlate
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import SIDECAR, ImageSet, image_key, make_images
from modeharvest.runs.case import Case, shipped_solutions
from modeharvest.runs.precompile import precompiling
from modeharvest.runs.whole_field import WholeFields, name_of
from modeharvest.util.errors import InputError, MissingDependencyError, dolfinx_missing
from modeharvest.util.files import read_json, write_json
from modeharvest.util.machine import on_first
from modeharvest.util.stages import StagedRun, exclusive, stage_key
from modeharvest.validation.summary import (
    MeasuredExperiment,
    compare_snapshot,
    displacement_spectrum,
    experiment_summary,
    snapshot_summary,
)

_COMPLETE = "complete"
T = TypeVar("T")


@dataclass(frozen=True)
class Run(StagedRun[Case]):
    """The stages of a virtual experiment."""

    solution: Path | None = None
    """A solution file (HDF5) to use instead of simulating."""

    def fem(self) -> Solution:
        """Simulate the test; writes ``solution.h5`` and, for ParaView, ``solution.vtu``.

        Without dolfinx, the solution shipped with the case is used instead; raises
        MissingDependencyError if no solution of this case is shipped.
        """
        path, vtu = self.folder / "solution.h5", self.folder / "solution.vtu"

        def work() -> tuple[Path, ...]:
            solution = self._simulate()
            on_first(lambda: solution.write(path))
            on_first(lambda: solution.write_vtu(vtu))
            return path, vtu

        self.do("fem", stage_key(self.case.plain()["experiment"], "fem"), work, collective=True)
        return Solution.read(path)

    def solved(self) -> Solution:
        """The given solution, or else the simulated one.

        Raises InputError if a given solution is of another experiment, or lacks one of its strains.
        """
        return self.fem() if self.solution is None else self._solution()

    def image(self) -> ImageSet:
        """Write images and true displacements of the solution's snapshots to ``images/``.

        Raises InputError if the solution is of another experiment, or lacks one of its strains
        although its simulation did not end early.
        """
        solution, folder = self._solution(), self.folder / "images"
        strains, spec = self._strains(solution), self.case.imaging

        def work() -> tuple[Path, ...]:
            return make_images(solution, spec, folder, strains, self.progress).files

        self.do("image", image_key(solution, spec, strains), work)
        return ImageSet.read(folder)

    def correlate(self) -> dict[float, Result]:
        """Correlate every deformed image with the reference; writes ``correlation/``.

        Raises InputError if the images were made from another experiment or with other options
        than those of this case.
        """
        images = self._images()

        def work() -> list[Path]:
            how, paths = self.case.correlation, []
            ansatz = how.ansatz(self.case.experiment.specimen)
            for strain in images.strains:
                pair = images.pair(strain, camera=how.camera)
                guess = ansatz.initial_guess(strain, how.start_amplitude)
                result = correlate(
                    pair, ansatz, guess=guess, options=how.options(), progress=self.progress
                )
                paths.append(self._result_path(strain))
                result.write(paths[-1])
            return paths

        self.do("correlate", self._correlate_key(images), work)
        return self._results(images)

    def measure(self) -> dict[float, NodalResult]:
        """Measure the whole displacement of every deformed image; writes ``whole_field/``.

        Does nothing if the case does not ask for it. Raises InputError if images or results do
        not belong to this case.
        """
        options = self.case.whole_field
        if not options.measure:
            return {}
        images, correlated = self._correlated()

        def work() -> list[Path]:
            results = {e: Result.read(self._result_path(e)) for e in images.strains}
            how = options, self.case.correlation, self.case.experiment
            return self._whole_fields.of_images(images, results, *how, self.progress)

        self.do("measure", self._measure_key(correlated), work)
        return {strain: self._whole_fields.read(name_of(strain)) for strain in images.strains}

    def validate(self) -> dict[str, Any]:
        """Compare the results with the truth; writes ``report.html`` and ``summary.json``.

        Raises InputError if the results do not belong to these images and this case.
        """
        images, correlated = self._correlated()
        measured = self._measure_key(correlated)
        if self.case.whole_field.measure and not self.is_finished("measure", measured):
            raise InputError(
                f"expected whole displacements of this case in {self._whole_fields.folder}, got "
                "none; make them with 'modeharvest correlate --whole-field'"
            )
        path, page = self.folder / "summary.json", self.folder / "report.html"

        def work() -> tuple[Path, Path]:
            write_json(path, self._report(images, page))
            return path, page

        self.do("validate", stage_key([measured, self.case.title]), work)
        return dict(read_json(path))

    def all(self) -> dict[str, Any]:
        """Run every stage that is not finished; returns the content of ``summary.json``.

        Raises InputError at once if another process works in the folder. Also raises it at the end,
        after the report of the strains reached, if the simulation did not reach all strains.
        """
        with exclusive(self.folder):
            stages = ("image", "correlate", *("measure",) * self.case.whole_field.measure)
            ahead = [stage for stage in stages if stage not in self.timings]
            with precompiling(ahead) as kernels:
                solution = self.solved()
                import_module("modeharvest.report.experiment")  # while kernels compile
                import_module("modeharvest.report.model.output").page_template()
                kernels.wait("image", self.progress)
                self.image()
                kernels.wait("correlate", self.progress)
                self.correlate()
            self.measure()
            summary = self.validate()
        outcome = _outcome(solution.info)
        if outcome != _COMPLETE:
            raise InputError(f"simulation {outcome}; what was reached is in {self.folder}")
        return summary

    # -- parts --------------------------------------------------------------------------

    @property
    def _whole_fields(self) -> WholeFields:
        return WholeFields(self.folder / "whole_field")

    def _measure_key(self, correlated: str) -> str:
        if not self.case.whole_field.measure:
            return correlated
        return stage_key([correlated, asdict(self.case.whole_field)], "fem", "imaging", "idic")

    def _correlated(self) -> tuple[ImageSet, str]:
        """The images, and the key of their results; InputError if these are not finished."""
        images = self._images()
        correlated = self._correlate_key(images)
        if not self.is_finished("correlate", correlated):
            raise InputError(
                f"expected results of this case in {self.folder / 'correlation'}, found none that "
                "are finished and whole; make them with 'modeharvest correlate'"
            )
        return images, correlated

    def _report(self, images: ImageSet, page: Path) -> dict[str, Any]:
        """Compare results with the truth, write the report; returns the content of the summary."""
        from modeharvest.report.experiment import (
            ExperimentData,
            experiment_figures,
            experiment_report,
        )
        from modeharvest.report.model.output import draw_figures, write_page

        case, solution, results = self.case, self._solution(), self._results(images)
        is_whole = case.whole_field.measure
        measured = MeasuredExperiment(case.experiment, case.correlation, solution, images, results)
        strains = sorted(results)
        # Numbers are computed by numpy and numba, which release the GIL; drawing runs in Python and
        # takes one core. More states at a time than the other cores would only take memory.
        with _brief_turns(), ThreadPoolExecutor(max(1, (os.cpu_count() or 2) - 1)) as threads:

            def of_each(work: Callable[..., T], *earlier: Sequence[Any]) -> Sequence[T]:
                states = range(len(strains))
                return _Awaited([threads.submit(work, *earlier, k, measured) for k in states])

            comparisons = of_each(compare_snapshot)
            spectra = of_each(displacement_spectrum, comparisons)
            snapshots = of_each(snapshot_summary, comparisons, spectra)
            wholes = of_each(self._whole_fields.compared, comparisons) if is_whole else ()
            found, pitch = [results[strain] for strain in strains], measured.specimen.pitch
            data = ExperimentData(
                solution, images, strains, found, comparisons, spectra, pitch, wholes
            )
            pictures = draw_figures(experiment_figures(data), self.progress)
            numbers = list(snapshots)
            for k, whole in enumerate(wholes):
                errors = replace(whole[1], seconds=self.timings.get("measure"))
                numbers[k] = replace(numbers[k], whole_field=errors)
            summary = experiment_summary(measured, case.plain(), numbers).plain()
        write_page(experiment_report(summary, data), page, pictures=pictures)
        return summary

    def _images(self) -> ImageSet:
        advice = "make it again with 'modeharvest image'"
        self.require_whole(self.folder / "images" / SIDECAR, advice)
        images = ImageSet.read(self.folder / "images")
        where = f"in {images.folder}; make them again with 'modeharvest image'"
        if images.spec != self.case.imaging:
            raise InputError(f"expected images made with this case's options, got others {where}")
        info, where = images.info["solution"], f"images {where}"
        require_same_experiment(info, self.case.experiment, where)
        self._reached(info, images.strains, where)
        return images

    def _correlate_key(self, images: ImageSet) -> str:
        how = self.case.plain()["correlation"]
        return stage_key([images.info["key"], how], "fem", "imaging", "idic")

    def _simulate(self) -> Solution:
        try:
            from modeharvest.fem.simulate import simulate
        except ImportError as error:
            shipped = self.shipped()
            if shipped is None:
                raise MissingDependencyError(
                    f"{dolfinx_missing('the finite-element stage needs')}; or take a solution "
                    "made elsewhere: --solution FILE"
                ) from error
            return shipped
        return simulate(self.case.experiment, self.progress)

    def shipped(self) -> Solution | None:
        """The solution shipped with the package if it is of exactly this experiment, else None."""
        for name, path in shipped_solutions().items():
            if Case.read(name).experiment == self.case.experiment:
                return Solution.read(path)
        return None

    def _solution(self) -> Solution:
        """The given solution, or that in the folder; InputError if it isn't of this case."""
        if self.solution is None:
            advice = "make it again with 'modeharvest fem', or give it by --solution"
            self.require_whole(self._solution_path, advice)
        solution = Solution.read(self._solution_path)
        require_same_experiment(solution.info, self.case.experiment, self._solution_path)
        self._strains(solution)
        return solution

    @property
    def _solution_path(self) -> Path:
        return self.solution or self.folder / "solution.h5"

    def _strains(self, solution: Solution) -> list[float]:
        """The specified strains that the solution contains."""
        have = sorted({s.nominal_strain for s in solution.snapshots})
        reached = self._reached(solution.info, have, self._solution_path)
        for strain in reached:
            branch, wanted = solution.at(strain).branch, self.case.experiment.branches
            if branch not in ("primary", *wanted):
                raise InputError(
                    f"expected branch {' or '.join(wanted)} at strain {strain:g}, got {branch} in "
                    f"{self._solution_path}"
                )
        return reached

    def _reached(
        self, info: Mapping[str, Any], have: Sequence[float], where: object
    ) -> list[float]:
        """The specified strains available: all, or fewer if this run's simulation ended early."""
        wanted, outcome = self.case.experiment.strains, _outcome(info)
        found = [e for e in wanted if any(abs(e - other) < 1e-9 for other in have)]
        if len(found) == len(wanted) or (found and self.solution is None and outcome != _COMPLETE):
            return found
        why = f" (simulation {outcome})" if outcome != _COMPLETE else ""
        raise InputError(
            f"expected snapshots at strains {', '.join(f'{e:g}' for e in wanted)}, got "
            f"{', '.join(f'{e:g}' for e in have) or 'none'}{why} in {where}"
        )

    def _result_path(self, strain: float) -> Path:
        return self.folder / "correlation" / f"result_{round(1e4 * strain):04d}.json"

    def _results(self, images: ImageSet) -> dict[float, Result]:
        """Results by strain; of a repeated correlation where the whole displacement gave one."""
        paths, key = {e: self._result_path(e) for e in images.strains}, self._correlate_key(images)
        if self.case.whole_field.measure and self.is_finished("measure", self._measure_key(key)):
            again = {e: self._whole_fields.result_path(e) for e in images.strains}
            paths |= {e: path for e, path in again.items() if path.exists()}
        return {strain: Result.read(path) for strain, path in paths.items()}


@contextmanager
def _brief_turns() -> Iterator[None]:
    """Shorten the GIL's switch interval: at the default, each short kernel waits 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class _Awaited(Sequence[T]):
    """A sequence of results of threads; accessing one waits until it is computed."""

    def __init__(self, coming: Sequence[Future[T]]) -> None:
        self._coming = coming

    def __len__(self) -> int:
        return len(self._coming)

    def __getitem__(self, k: Any) -> Any:
        return self._coming[k].result()


def require_same_experiment(info: Mapping[str, Any], experiment: Experiment, where: object) -> None:
    """Raise InputError if a solution's ``info`` says that it is of another experiment.

    The solution of another solver, read from its mesh, has no such entry and is accepted.
    """
    usual = Experiment().described()
    usual["specimen"] = asdict(Specimen())
    for table, values in experiment.described().items():
        for name, value in {**usual[table], **values}.items() if table in info else ():
            # An option missing in an older solution did not exist then: its default applies.
            got = info[table].get(name, usual[table].get(name))
            if got != value:
                raise InputError(
                    f"expected this case's {table}, {name} = {value}, got {got} in {where}"
                )


def _outcome(info: Mapping[str, Any]) -> str:
    """How a simulation ended: "complete", or the reason why it ended early."""
    return str(info.get("outcome", _COMPLETE))
