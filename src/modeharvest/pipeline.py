"""A case from beginning to end in one folder, in stages that can be run apart and resumed.

::

    solution.h5 solution.vtu    fem        what the finite elements found
    images/                     image      speckle images, masks, truth
    correlation/                correlate  one result for each image
    report.html summary.json    validate   how wrong it was, and why
    stages.json                            which stages are finished, and what they took

A stage whose inputs have not changed is not run again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modeharvest import __version__
from modeharvest.case import Case, read_case, shipped_cases, shipped_solution
from modeharvest.errors import InputError, MissingDependencyError
from modeharvest.fem.field import Solution
from modeharvest.files import read_json
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.precompile import precompiling
from modeharvest.progress import Progress, silent
from modeharvest.ranks import is_first
from modeharvest.stages import Stages, digest
from modeharvest.validation.study import Measured, validate

STAGES = ("fem", "image", "correlate", "validate")
_NO_DOLFINX = (
    "the finite-element stage needs dolfinx >= 0.9, petsc4py and gmsh: install them with 'conda "
    "install -c conda-forge fenics-dolfinx petsc4py python-gmsh' or, on Debian 13, 'apt install "
    "python3-dolfinx python3-petsc4py python3-gmsh python3-h5py-mpi'; or take a solution "
    "made elsewhere: --solution FILE"
)


@dataclass(frozen=True)
class Run:
    """A case, the folder it leaves its files in, and who listens to its progress.

    Parameters
    ----------
    case
        What to do.
    folder
        Where; made if it does not exist.
    progress
        Listener.
    solution
        A solution file to use instead of the folder's own.
    """

    case: Case
    folder: Path
    progress: Progress = silent
    solution: Path | None = None

    @property
    def stages(self) -> Stages:
        """What is finished in the folder."""
        return Stages(self.folder)

    def fem(self) -> Solution:
        """Simulate the test; leaves ``solution.h5`` and, for ParaView, ``solution.vtu``.

        Without dolfinx, a shipped case's own solution is taken instead.

        Raises
        ------
        MissingDependencyError
            If dolfinx is not there and no solution of this case is shipped.
        """
        path = self.folder / "solution.h5"

        def work() -> None:
            solution = self._simulate()
            if is_first():
                solution.write(path)
                solution.write_vtu(path.with_suffix(".vtu"))

        key = digest([self.case.plain()["experiment"], __version__])
        self.stages.do("fem", key, work, path, collective=True)
        return Solution.read(path)

    def image(self) -> ImageSet:
        """Make images and truth of the solution's snapshots in ``images/``."""
        solution, folder = self._solution(), self.folder / "images"
        strains = self._strains(solution)
        spec = self.case.imaging
        key = image_key(solution, strains, spec)
        self.stages.do(
            "image",
            key,
            lambda: make_images(solution, strains, spec, folder, self.progress),
            folder / "images.json",
        )
        return ImageSet.read(folder)

    def correlate(self) -> dict[float, Result]:
        """Correlate every deformed image with the reference; leaves ``correlation/``.

        Raises
        ------
        InputError
            If the images were made with other options than this case's.
        """
        images = self._images()
        paths = {strain: self._result_path(strain) for strain in images.strains}

        def work() -> None:
            for strain, path in paths.items():
                self._correlate_one(images, strain).write(path)

        self.stages.do("correlate", self._correlate_key(images), work, *paths.values())
        return {strain: Result.read(path) for strain, path in paths.items()}

    def validate(self) -> dict[str, Any]:
        """Compare the results with the truth; leaves ``report.html`` and ``summary.json``.

        Raises
        ------
        InputError
            If the results are not of these images and this case.
        """
        images = self._images()
        key = self._correlate_key(images)
        if self.stages.finished("correlate").get("key") != key:
            raise InputError(
                f"expected results of this case in {self.folder / 'correlation'}, found none that "
                "are finished; make them with 'modeharvest correlate'"
            )
        results = {strain: Result.read(self._result_path(strain)) for strain in images.strains}
        path = self.folder / "summary.json"

        def work() -> None:
            case = self.case
            experiment, how = case.experiment, case.correlation
            measured = Measured(experiment, how, self._solution(), images, results)
            taken = {stage: self.stages.finished(stage).get("seconds") for stage in STAGES[:-1]}
            validate(measured, case.plain(), taken, self.folder, self.progress)

        key = digest([key, self.case.title, __version__])
        self.stages.do("validate", key, work, path, self.folder / "report.html")
        summary: dict[str, Any] = read_json(path)
        return summary

    def all(self) -> dict[str, Any]:
        """Run every stage that is not finished; returns the content of ``summary.json``.

        Raises
        ------
        InputError
            At the end, if the simulation did not reach all strains asked for: what it did
            reach is reported.
        """
        ahead = [stage for stage in ("image", "correlate") if not self.stages.finished(stage)]
        with precompiling(ahead) as kernels:
            solution = self.fem() if self.solution is None else self._solution()
            kernels.wait("image", self.progress)
            self.image()
            kernels.wait("correlate", self.progress)
            self.correlate()
        summary = self.validate()
        outcome = str(solution.info.get("outcome", "complete"))
        if outcome != "complete":
            raise InputError(f"simulation {outcome}; what was reached is in {self.folder}")
        return summary

    # -- parts --------------------------------------------------------------------------

    def _images(self) -> ImageSet:
        images = ImageSet.read(self.folder / "images")
        if images.spec != self.case.imaging:
            raise InputError(
                f"expected images made with this case's options in {images.folder}, found others; "
                "make them again with 'modeharvest image'"
            )
        return images

    def _correlate_key(self, images: ImageSet) -> str:
        return digest([images.info["key"], self.case.plain()["correlation"], __version__])

    def _simulate(self) -> Solution:
        try:
            from modeharvest.fem.simulate import simulate
        except ImportError as error:
            shipped = self._shipped()
            if shipped is None:
                raise MissingDependencyError(_NO_DOLFINX) from error
            return shipped
        return simulate(self.case.experiment, self.progress)

    def _shipped(self) -> Solution | None:
        """The solution that comes with the package, if it is of this very experiment."""
        for name in shipped_cases():
            path = shipped_solution(name)
            if path is not None and read_case(name).experiment == self.case.experiment:
                return Solution.read(path)
        return None

    def _solution(self) -> Solution:
        return Solution.read(self.solution or self.folder / "solution.h5")

    def _strains(self, solution: Solution) -> list[float]:
        """The strains asked for that the solution has."""
        reached = {round(s.nominal_strain, 9) for s in solution.snapshots}
        strains = [e for e in self.case.experiment.strains if round(e, 9) in reached]
        if not strains:
            raise InputError(
                f"expected snapshots at strains {list(self.case.experiment.strains)} in the "
                f"solution, got {sorted(reached)}; simulation {solution.info.get('outcome', '')}"
            )
        return strains

    def _result_path(self, strain: float) -> Path:
        return self.folder / "correlation" / f"result_{round(1e4 * strain):04d}.json"

    def _correlate_one(self, images: ImageSet, strain: float) -> Result:
        how, specimen = self.case.correlation, self.case.experiment.specimen
        ansatz = how.ansatz(specimen)
        return correlate(
            images.reference(camera=how.camera),
            images.deformed(strain, camera=how.camera),
            images.grid,
            ansatz,
            how.start(ansatz, strain),
            images.mask(),
            images.deformed_mask(strain),
            how.options(),
            self.progress,
        )


def run(case: str | Path | Case, folder: Path | str, progress: Progress = silent) -> dict[str, Any]:
    """Run a case from simulation to report; what ``modeharvest run`` does.

    Parameters
    ----------
    case
        A shipped case's name, the path of a TOML file, or a Case.
    folder
        Where to leave the files.
    progress
        Listener.

    Returns
    -------
    dict
        The content of ``summary.json``.
    """
    case = case if isinstance(case, Case) else read_case(case)
    return Run(case, Path(folder), progress).all()
