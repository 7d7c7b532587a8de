"""The twin of a real experiment: photographs as a user has them, harvested, set against the truth.

::

    twin/experiment/        what a user would have, and nothing else
        experiment.toml     files, pixel size, cell size
        reference.tif  reference_2.tif  deformed_0820.tif ...    as the camera stores them
        calibration_00.tif ...                                   a target that a stage shifts
    twin/truth/
        solution.h5         what the finite elements found
        images/             noise-free images, masks and truth (modeharvest.imaging.imageset)
        distortion.json     of the lens
        twin.json           where the stage really went
    harvest/                all that a harvest leaves; its report also shows the truth

:func:`one_seed` photographs a twin again: a 95 % interval of a field, 1.96 standard deviations by
noise about what one photograph shows, should hold the noise-free result in 95 of 100 of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.photograph.measure import (
    MeasuredPhotograph,
    covariances,
    noise_of,
    prepared_pair,
)
from modeharvest.idic.result import Result
from modeharvest.idic.slow_fields import Box
from modeharvest.idic.solver.final_smoothing import blurred_pair
from modeharvest.idic.uncertainty.covariance import FieldErrors, field_errors
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion, write_distortion
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.distortion.target import photograph_target
from modeharvest.imaging.distortion.undistort import seen_points, undistorted
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import write_image
from modeharvest.runs.case import TwinCase
from modeharvest.runs.experiment import Run
from modeharvest.runs.photographs.case import read_photograph_case
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.photographs.results import FrameTruth, HarvestTruth, TruthRow
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, copy_whole, read_json, write_json
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import Stages, exclusive, stage_key
from modeharvest.util.typed import plain

_SIDECAR = "twin.json"


@dataclass(frozen=True)
class Twin:
    """A finished twin on disk.

    Parameters
    ----------
    folder
        Where it is.
    """

    folder: Path

    @property
    def experiment(self) -> Path:
        """The file that a harvest starts from."""
        return self.folder / "experiment" / "experiment.toml"

    @property
    def solution(self) -> Solution:
        """The true displacements, on the mesh."""
        return Solution.read(self.folder / "truth" / "solution.h5")

    @property
    def images(self) -> ImageSet:
        """Noise-free images through the lens, and the truth on the ideal grid."""
        return ImageSet.read(self.folder / "truth" / "images")

    @property
    def distortion(self) -> AnyDistortion:
        """The lens."""
        return read_distortion(self.folder / "truth" / "distortion.json")

    @property
    def shifts(self) -> FloatArray:
        """(m, 2) where the stage was at the calibration, along (rows, columns) [px]."""
        return np.array(self.info["stage_shifts_row_col_px"], dtype=np.float64)

    @property
    def info(self) -> dict[str, Any]:
        """The content of ``twin.json``."""
        found: dict[str, Any] = read_json(self.folder / "truth" / _SIDECAR)
        return found


def make_twin(
    case: TwinCase, solution: Solution, folder: Path | str, progress: Progress = silent
) -> Twin:
    """Make (or find finished) the photographs of a twin, and its truth.

    Parameters
    ----------
    case
        Of a twin, such as the shipped "paper-real-twin".
    solution
        Of the case's experiment.
    folder
        Where; made if it doesn't exist.
    progress
        Listener.

    Raises
    ------
    InputError
        If the case has no distortion, an image doesn't fit, or the disk refuses.
    """
    twin, spec, strains = Twin(Path(folder)), case.imaging, case.experiment.strains
    if spec.distortion is None:
        raise InputError("twin: expected an [imaging.distortion] to calibrate, got none")
    truth, photographs = twin.folder / "truth", twin.experiment.parent
    key = stage_key([image_key(solution, spec, strains), plain(case.calibration), case.title])

    def work() -> list[Path]:
        solution.write(truth / "solution.h5")
        images = make_images(solution, spec, truth / "images", strains, progress)
        taken = _copy_photographs(images, photographs)
        lens = spec.lens(images.grid.shape)
        assert lens is not None
        write_distortion(truth / "distortion.json", lens)
        target, seen = case.calibration, seen_points(lens, images.grid.shape)
        shots = photograph_target(target, spec.speckle, seen, spec.sensor, spec.bits)
        for k, (name, levels) in enumerate(shots):
            progress(k, len(target.shifts_px), "images: calibration")
            taken.append(photographs / f"{name}.tif")
            write_image(taken[-1], levels)
        with atomic(twin.experiment) as temporary:
            temporary.write_text(_experiment_text(case, images), "utf-8")
        shifts = {"stage_shifts_row_col_px": target.true_shifts.tolist()}
        write_json(truth / _SIDECAR, shifts)
        own = (truth / name for name in ("solution.h5", "distortion.json", _SIDECAR))
        return [*images.files, *taken, *own, twin.experiment]

    Stages(twin.folder).do("twin", key, work)
    return twin


def _copy_photographs(images: ImageSet, folder: Path) -> list[Path]:
    """Leave the exposures, and a second one of the reference, from which noise is measured."""
    paths = []
    for name, source in _exposures(images):
        paths.append(folder / f"{name}.tif")
        copy_whole(images.folder / source, paths[-1])
    spec, again = images.spec, "reference_2"
    sensor = spec.sensor
    light = sensor.light(again) / sensor.light("reference")
    irradiance = light * (images.reference() - sensor.offset) / sensor.gain
    levels = sensor.expose(irradiance.astype(np.float32), spec.bits, again)
    write_image(folder / f"{again}.tif", levels)
    return [*paths, folder / f"{again}.tif"]


def _exposures(images: ImageSet) -> Iterator[tuple[str, str]]:
    for entry in (images.info["reference"], *images.info["snapshots"]):
        yield Path(entry["image"]).stem, entry["camera_image"]


def _experiment_text(case: TwinCase, images: ImageSet) -> str:
    """The TOML file that a user would write."""
    deformed = ", ".join(f'"{name}.tif"' for name, _ in _exposures(images) if name != "reference")
    about = ", ".join(f"({col:g}, {row:g})" for col, row in case.calibration.shifts_px)
    return f"""\
title = "{case.title}"

[images]
reference = "reference.tif"
deformed = [{deformed}]
repeats = ["reference_2.tif"]      # the same state once more: tells the camera's noise

[scale]
pixel_size = {case.imaging.pixel_size:g}                  # [mm/px]

[specimen]
cell_size = {case.experiment.specimen.pitch:g}                    # [mm], from hole to hole

[distortion]
# The stage was moved by about
# {about} px
# (along columns, along rows), not exactly enough to be of use.
calibration = ["calibration_*.tif"]

[correlation]
gain_degree = 0                    # the light was not the same in all photographs
"""


_WAVES, _AMPLITUDE, _LENS_PX = 0.01, 0.03, 0.05
"""What must come out: wave vectors within 1 %, v1 within 3 % of the best fit's maximum, S within
0.05 px rms without its affine part."""


@dataclass(frozen=True)
class TwinRun:
    """A twin's case, the folder it leaves its files in, and who listens.

    Parameters
    ----------
    case
        Of the twin.
    folder
        Where.
    progress
        Listener.
    solution
        A solution file to use instead of simulating.
    """

    case: TwinCase
    folder: Path
    progress: Progress = silent
    solution: Path | None = None

    def twin(self) -> Twin:
        """Make the photographs and their truth, unless they are there."""
        solution = Run(self.case, self.folder, self.progress, self.solution).solved()
        return make_twin(self.case, solution, self.folder / "twin", self.progress)

    def harvesting(self, twin: Twin) -> HarvestRun:
        """The harvest of the photographs; knows nothing of the truth."""
        experiment = read_photograph_case(twin.experiment)
        folder = self.folder / "harvest"
        source = str(twin.experiment)
        return HarvestRun(experiment, twin.experiment.parent, folder, self.progress, source)

    def all(self) -> dict[str, Any]:
        """Make, harvest, compare; returns the content of the harvest's ``summary.json``."""
        with exclusive(self.folder):
            twin = self.twin()
            harvesting = self.harvesting(twin)
            results = harvesting.results()
            truth = compare(twin, harvesting, results, self.progress)
            return harvesting.all(truth)


def compare(
    twin: Twin,
    harvesting: HarvestRun,
    results: Mapping[str, MeasuredPhotograph],
    progress: Progress = silent,
) -> HarvestTruth:
    """Set a harvest against the truth of its twin."""
    images, geometry = twin.images, harvesting.geometry
    frames, rows = {}, []
    for k, (name, measured) in enumerate(results.items()):
        progress(k, len(results), "compare with the truth")
        strain = _strain_of(name, images.strains)
        true = images.truth(strain).displacement
        inside = np.asarray(
            np.isfinite(true).all(axis=-1)
        )  # the images' own masks are as the lens shows them
        result = measured.result
        best = fit_displacement(true, result.grid, result.ansatz, result.unknowns, inside)
        frames[name] = FrameTruth(true, best)
        rows += _frame_rows(name, result, best, true, inside, geometry.region.cellular)
    if harvesting.optics.distortion is not None:
        rows.append(_lens_row(harvesting.optics.distortion, twin.distortion, images.grid))
    return HarvestTruth(frames, twin.distortion, tuple(rows))


def _strain_of(name: str, strains: tuple[float, ...]) -> float:
    """The strain that a photograph's name tells in hundredths of a per cent."""
    number = int(name.rsplit("_", 1)[-1]) / 1e4
    return min(strains, key=lambda strain: abs(strain - number))


def _frame_rows(
    name: str,
    result: Result,
    best: Result,
    true: FloatArray,
    inside: NDArray[np.bool_],
    cellular: Box,
) -> list[TruthRow]:
    """What of one photograph was found, against the truth and the best fit of the ansatz."""
    px = result.grid.pixel_size
    found = result.displacement()
    left, lost = (_rms(field[inside]) / px for field in (true - found, best.displacement() - found))
    rows = [
        TruthRow(f"{name}: w = truth − IDIC, rms", left, "as measured", True, "px"),
        TruthRow(f"{name}: IDIC − best fit, rms", lost, "small against w", lost < left, "px"),
    ]
    if not result.ansatz.modes or not result.ansatz.modes[0].family.size:
        return rows
    if identifiability(result, inside).unobservable:
        words = f"{name}: wave vectors and v1"
        return [*rows, TruthRow(words, "no pattern is seen", "asked of one that is", True)]
    x, y = _over(cellular)
    v, at_best = (r.ansatz.v(0, r.unknowns, x, y) for r in (result, best))
    apart = float(np.abs(v - at_best).max() / np.abs(at_best).max())
    waves = result.ansatz.modes[0].family.waves(result.mode_parameters())[:, 2:4]
    off = float(np.abs(np.abs(waves) - 1.0).max())
    return [
        *rows,
        TruthRow(
            f"{name}: wave vectors, largest deviation from (±½, ±½)",
            100 * off, f"≤ {100 * _WAVES:g}", off <= _WAVES, "%",
        ),
        TruthRow(
            f"{name}: v1 − v1 of the best fit, largest over the cellular part, of its maximum",
            100 * apart, f"≤ {100 * _AMPLITUDE:g}", apart <= _AMPLITUDE, "%",
        ),
    ]  # fmt: skip


def _lens_row(found: Distortion, true: Distortion, grid: PixelGrid) -> TruthRow:
    """Rms difference of two distortions per component, without what is affine in it."""
    row, col = np.linspace(0, grid.rows - 1, 60), np.linspace(0, grid.cols - 1, 75)
    R, C = (axis.ravel() for axis in np.meshgrid(row, col, indexing="ij"))
    apart = np.stack(found.shift(R, C)) - np.stack(true.shift(R, C))
    design = np.column_stack([np.ones(R.size), R, C])
    affine = design @ np.linalg.lstsq(design, apart.T, rcond=None)[0]
    rms = _rms(apart.T - affine)
    words = "distortion of the lens: found − true without the affine part, rms per component"
    return TruthRow(words, rms, f"≤ {_LENS_PX:g}", rms <= _LENS_PX, "px")


def _over(box: Box) -> tuple[FloatArray, FloatArray]:
    return (
        np.linspace(box.x_min, box.x_max, 200, dtype=np.float64),
        np.linspace(box.y_min, box.y_max, 200, dtype=np.float64),
    )


def _rms(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


INTERVAL = 1.96
"""Standard deviations of a 95 % interval."""
_POINTS = 25
"""Points along each side of the cellular part at which intervals are counted."""


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Photograph and measure once more; the share of intervals that hold the noise-free result.

    Parameters
    ----------
    case
        ``name`` of the deformed photograph and ``seed``.
    folder
        Of a finished twin run (``twin/`` and ``harvest/``).

    Returns
    -------
    dict
        For v0, v1 and v1 phi1 the share of points covered, and the rms of the deviation over its
        standard deviation, which should be 1.
    """
    scene = _scene(folder, case["name"])
    found = scene.measured(scene.photographs(case["seed"]))
    clean, sd = scene.clean, scene.errors
    ansatz, at = found.ansatz, (scene.x, scene.y)
    pairs = {
        "v0": (ansatz.v0(found.unknowns, *at) - ansatz.v0(clean.unknowns, *at), sd.v0),
        "v1": (ansatz.v(0, found.unknowns, *at) - ansatz.v(0, clean.unknowns, *at), sd.v[0]),
        "v1phi1": (
            ansatz.fluctuation(0, found.unknowns, *at) - ansatz.fluctuation(0, clean.unknowns, *at),
            sd.fluctuation[0],
        ),
    }
    told = {}
    for name, (deviation, error) in pairs.items():
        ratio = deviation[error > 0] / error[error > 0]
        told[f"covered {name}"] = float(np.mean(np.abs(ratio) <= INTERVAL))
        told[f"deviation {name}"] = float(np.sqrt(np.mean(ratio**2)))
    return told


@dataclass(frozen=True, eq=False)
class _Scene:
    """All that does not depend on the seed: what a worker keeps."""

    twin: Twin
    harvesting: HarvestRun
    pair: ImagePair
    name: str
    blur_px: float
    start: Result
    clean: Result
    errors: FieldErrors
    x: FloatArray
    y: FloatArray

    def photographs(self, seed: int | None) -> tuple[FloatImage, FloatImage]:
        """Reference and deformed photograph with the noise of a seed, or none; undistorted."""
        spec, images = self.twin.images.spec, self.twin.images
        strain = min(images.strains, key=lambda e: abs(e - int(self.name.rsplit("_", 1)[1]) / 1e4))
        white = 2**spec.bits - 1
        taken = []
        for grey, label in (
            (images.reference(), "reference"),
            (images.deformed(strain), "deformed"),
        ):
            levels: NDArray[Any] = white * grey
            if seed is not None:
                sensor = replace(spec.sensor, shot_seed=1000 + seed, read_seed=2000 + seed)
                irradiance = ((grey - sensor.offset) / sensor.gain).astype(np.float32)
                levels = sensor.expose(irradiance, spec.bits, label)
            distortion = self.harvesting.optics.distortion
            image = levels.astype(np.float32)
            taken.append(image if distortion is None else undistorted(image, distortion))
        return taken[0], taken[1]

    def measured(self, images: tuple[FloatImage, FloatImage]) -> Result:
        """Correlate as the harvest finished, from the harvest's result on."""
        masks = self.pair.masks
        if self.blur_px > 0.0:
            images = blurred_pair(*images, *masks, self.blur_px)
        options = self.harvesting.experiment.correlation.options()
        fine = replace(options, levels=options.levels[-1:])
        start = self.start
        return correlate(*images, start.grid, start.ansatz, start.unknowns, *masks, fine)


@lru_cache(maxsize=1)
def _scene(folder: Path, name: str) -> _Scene:
    twin = Twin(folder / "twin")
    experiment = read_photograph_case(twin.experiment)
    harvesting = HarvestRun(experiment, twin.experiment.parent, folder / "harvest")
    prepared, measured = harvesting.prepared(), harvesting.results()[name]
    pair = prepared_pair(prepared, name)
    box = harvesting.geometry.region.cellular
    x = np.linspace(box.x_min, box.x_max, _POINTS, dtype=np.float64)
    y = np.linspace(box.y_min, box.y_max, _POINTS, dtype=np.float64)
    noise, cell = noise_of(prepared, name), experiment.specimen.cell_size
    by_noise, _, _ = covariances(measured, pair, noise, cell)
    errors = field_errors(measured.result, x, y, by_noise)
    blank = measured.result
    scene = _Scene(
        twin, harvesting, pair, name, measured.blur_px, blank, blank, errors, x, y
    )  # fmt: skip
    return replace(scene, clean=scene.measured(scene.photographs(None)))
