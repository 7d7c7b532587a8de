"""The twin of a real experiment: simulated photographs, harvested and compared with the truth.

::

    twin/experiment/        only what a user of a real test would have
        experiment.toml     files, pixel size, cell size
        reference.tif  reference_2.tif  deformed_0820.tif ...    as stored by the camera
        calibration_00.tif ...                                   target, shifted by a stage
    twin/truth/
        solution.h5         the finite element solution
        images/             noise-free images, masks and truth (modeharvest.imaging.imageset)
        distortion.json     distortion of the lens
        twin.json           true shifts of the stage
    harvest/                files of the harvest; its report also shows the truth
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion, write_distortion
from modeharvest.imaging.distortion.lens import Distortion, apart_without_affine, ideal_points
from modeharvest.imaging.distortion.target import CalibrationTarget, photograph_target
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, image_key, make_images
from modeharvest.imaging.photographs.files import write_image
from modeharvest.runs.case import Case
from modeharvest.runs.experiment import Run
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.photographs.results import FrameTruth, HarvestTruth
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, copy_whole, write_json
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.stages import StagedRun, Stages, exclusive, stage_key
from modeharvest.util.typed import to_plain
from modeharvest.validation.summary import Expectation
from modeharvest.validation.truth import rms
from modeharvest.validation.whole_field import (
    WholeFieldSummary,
    compare_whole,
    v_percent,
    waves_percent,
)

_SIDECAR = "twin.json"
_EXPERIMENT = resources.files(__package__).joinpath("twin_experiment.txt").read_text("utf-8")
_WAVES, _AMPLITUDE, _LENS_PX = 1.0, 3.0, 0.05
"""Largest accepted errors: wave vectors 1 %, v1 3 % of the best fit's maximum, distortion S
0.05 px rms without its affine part."""
_REFIT_WAVES, _REFIT_AMPLITUDE = 0.05, 0.5
"""Largest accepted errors by the whole displacement [%], both against the best fit."""


@dataclass(frozen=True)
class Twin:
    """A finished twin on disk."""

    folder: Path

    @property
    def experiment(self) -> Path:
        """The TOML file of the case to harvest."""
        return self.folder / "experiment" / "experiment.toml"

    @property
    def truth(self) -> Path:
        """The folder of the truth, which a user of a real test would not have."""
        return self.folder / "truth"

    @property
    def images(self) -> ImageSet:
        """Noise-free images through the lens, and the truth on the ideal grid."""
        return ImageSet.read(self.truth / "images")

    @property
    def distortion(self) -> AnyDistortion:
        """The lens."""
        return read_distortion(self.truth / "distortion.json")


def make_twin(
    case: Case, solution: Solution, folder: Path | str, progress: Progress = silent
) -> Twin:
    """Make (or find finished) the photographs of a twin, and its truth.

    ``case``: of a twin, such as the shipped "paper-real-twin"; ``solution``: of its experiment.
    Raises InputError if the case has no distortion, an image doesn't fit, or writing fails.
    """
    twin, spec, strains = Twin(Path(folder)), case.imaging, case.experiment.strains
    target = _target(case)
    truth, photographs = twin.truth, twin.experiment.parent
    key = stage_key([image_key(solution, spec, strains), to_plain(target), case.title])

    def work() -> list[Path]:
        solution.write(truth / "solution.h5")
        images = make_images(solution, spec, truth / "images", strains, progress)
        taken = _copy_photographs(images, photographs)
        lens = spec.lens(images.grid.shape)
        assert lens is not None
        write_distortion(truth / "distortion.json", lens)
        observed = ideal_points(lens, images.grid.shape)
        shots = photograph_target(target, spec.speckle, observed, spec.sensor, spec.bits)
        for k, (name, levels) in enumerate(shots):
            progress(k, len(target.shifts_px), "images: calibration")
            taken.append(photographs / f"{name}.tif")
            write_image(taken[-1], levels)
        with atomic(twin.experiment) as temporary:
            temporary.write_text(_experiment_text(case, images), "utf-8")
        write_json(truth / _SIDECAR, {"stage_shifts_row_col_px": target.true_shifts.tolist()})
        own = (truth / name for name in ("solution.h5", "distortion.json", _SIDECAR))
        return [*images.files, *taken, *own, twin.experiment]

    Stages(twin.folder).do("twin", key, work)
    return twin


def _target(case: Case) -> CalibrationTarget:
    """The calibration target of the lens; InputError if there is no target or no lens."""
    if case.calibration is None or case.imaging.distortion is None:
        missing = "imaging.distortion" if case.calibration else "calibration"
        raise InputError(
            f"twin: expected an [imaging.distortion] to calibrate and a [calibration], "
            f"got no [{missing}]"
        )
    return case.calibration


def _copy_photographs(images: ImageSet, folder: Path) -> list[Path]:
    """Write the exposures, and a second one of the reference, to measure the noise from."""
    paths = []
    for name, source in _exposures(images):
        paths.append(folder / f"{name}.tif")
        copy_whole(images.folder / source, paths[-1])
    sensor, bits, again = images.spec.sensor, images.spec.bits, "reference_2"
    light = sensor.illumination(again) / sensor.illumination("reference")
    irradiance = light * (images.reference() - sensor.offset) / sensor.gain
    paths.append(folder / f"{again}.tif")
    write_image(paths[-1], sensor.expose(irradiance.astype(np.float32), bits, again))
    return paths


def _exposures(images: ImageSet) -> Iterator[tuple[str, str]]:
    for entry in (images.info["reference"], *images.info["snapshots"]):
        yield Path(entry["image"]).stem, entry["camera_image"]


def _experiment_text(case: Case, images: ImageSet) -> str:
    """The TOML file that a user would write."""
    deformed = ", ".join(f'"{name}.tif"' for name, _ in _exposures(images) if name != "reference")
    about = ", ".join(f"({col:g}, {row:g})" for col, row in _target(case).shifts_px)
    return _EXPERIMENT.format(
        title=case.title, deformed=deformed, about=about, pixel_size=case.imaging.pixel_size,
        cell_size=case.experiment.specimen.pitch,
    )  # fmt: skip


@dataclass(frozen=True)
class TwinRun(StagedRun[Case]):
    """The stages of a twin: those of its simulation, its photographs, those of their harvest."""

    solution: Path | None = None
    """A solution file to use instead of simulating."""

    def all(self) -> dict[str, Any]:
        """Make, harvest, compare; returns the content of the harvest's ``summary.json``.

        Raises InputError if ``whole_field`` uses exact images or the law of the material.
        """
        how = self.case.whole_field
        if how.material_law or not how.camera:
            raise InputError(
                "whole_field: expected camera = true and material_law = false of a twin, which is "
                f"measured from its photographs alone, got {how.camera} and {how.material_law}"
            )
        with exclusive(self.folder):
            solution = Run(self.case, self.folder, self.progress, self.solution).solved()
            twin = make_twin(self.case, solution, self.folder / "twin", self.progress)
            case, folder = PhotographCase.read(twin.experiment), self.folder / "harvest"
            case = case.model_copy(update={"whole_field": how.of_photographs})
            harvesting = HarvestRun(case, folder, self.progress, str(twin.experiment))
            return harvesting.all(self._compare(twin, harvesting))

    def _compare(self, twin: Twin, harvesting: HarvestRun) -> HarvestTruth:
        """Compare a harvest, which does not use the truth, with the truth of its twin."""
        images, results, specimen = twin.images, harvesting.results(), self.case.experiment.specimen
        names = [name for name, _ in _exposures(images) if name != "reference"]
        strains = dict(zip(names, images.strains, strict=True))
        frames, rows = {}, []
        for name in counted(tuple(results), self.progress, "compare with the truth"):
            true = images.truth(strains[name]).displacement
            # Not the masks of the images: these have the lens distortion.
            inside = np.asarray(np.isfinite(true).all(axis=-1))
            result, whole = results[name].result, results[name].whole
            # The ansatz doesn't describe w, so that the best fit depends on the pixels.
            used = inside & harvesting.geometry.mask
            best = fit_displacement(true, result.grid, result.ansatz, result.unknowns, used)
            rows += _frame_rows(name, result, best, true, inside)
            errors = None
            if whole:
                errors = compare_whole(whole, true, best, inside, specimen)
                rows += whole_checks(name, whole.refit, best, errors, inside)
            frames[name] = FrameTruth(true, best, errors)
        if harvesting.optics.distortion is not None:
            rows.append(_lens_row(harvesting.optics.distortion, twin.distortion, images.grid))
        return HarvestTruth(frames, twin.distortion, tuple(rows))


def _frame_rows(
    name: str, result: Result, best: Result, true: FloatArray, inside: BoolArray
) -> list[Expectation]:
    """Results of one photograph, compared with the truth and the best fit of the ansatz."""
    px, found = result.grid.pixel_size, result.displacement()
    left, lost = (rms(field[inside]) / px for field in (true - found, best.displacement() - found))
    rows = [
        Expectation(f"{name}: w = truth − IDIC, rms", left, "–", None, "px"),
        Expectation(f"{name}: IDIC − best fit, rms", lost, "small against w", lost < left, "px"),
    ]
    if not result.ansatz.modes or not result.ansatz.modes[0].family.size:
        return rows
    if identifiability(result, inside).unobservable:
        words = f"{name}: wave vectors and v1"
        return [*rows, Expectation(words, "not observable", "–", None)]
    waves = result.ansatz.modes[0].family.waves(result.mode_parameters())[:, 2:4]
    off = 100 * float(np.abs(np.abs(waves) - 1.0).max())
    words = f"{name}: wave vectors, largest deviation from (±½, ±½)"
    rows.append(Expectation.at_most(words, off, _WAVES, "%"))
    words = f"{name}: v1 − v1 of the best fit, largest over the cellular part, % of largest v1"
    return [*rows, Expectation.at_most(words, v_percent(result, best), _AMPLITUDE, "%")]


def whole_checks(
    name: str, refit: Result, best: Result, errors: WholeFieldSummary, inside: BoolArray
) -> list[Expectation]:
    """Results of one photograph's whole displacement, compared with the truth."""
    of, edges = f"{name}: whole displacement", errors.rms_edges_px
    rows = [
        Expectation(f"{of}: truth − measured, rms", errors.rms_px, "–", None, "px"),
        Expectation(f"{of}: … within 10 px of an edge", edges or 0.0, "–", None, "px"),
    ]
    has_pattern = best.ansatz.modes and best.ansatz.modes[0].family.size
    if not has_pattern or identifiability(best, inside).unobservable:
        return rows
    v, waves = v_percent(refit, best), waves_percent(refit, best)
    words = f"{of}: v1 of the refitted ansatz − of the best fit, largest, % of largest v1"
    return [
        *rows,
        Expectation.at_most(words, v, _REFIT_AMPLITUDE, "%"),
        Expectation.at_most(f"{of}: wave vectors, % of their length", waves, _REFIT_WAVES, "%"),
    ]


def _lens_row(found: Distortion, true: Distortion, grid: PixelGrid) -> Expectation:
    """Rms difference of two distortions per component [px], without its affine part."""
    row, col = np.linspace(0, grid.rows - 1, 60), np.linspace(0, grid.cols - 1, 75)
    found_rms = rms(apart_without_affine(found, true, row[:, None], col[None, :]))
    words = "distortion of the lens: found − true without the affine part, rms per component"
    return Expectation.at_most(words, found_rms, _LENS_PX, "px")
