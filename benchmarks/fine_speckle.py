"""Harvests of photographs with fine speckle and large w, with and without whole displacement.

The paper's virtual specimen is photographed at 10 µm/px with the camera's noise and a speckle made
finer by the factors given (1: 12 px wide), and harvested twice. Printed are the outcome of the
correlation, its distance from the best fit of its ansatz and, with the whole displacement, the
distances of the refitted ansatz from the best fit and of the whole displacement from the truth, in
px rms per component, and where it started. Table: docs/explanation/whole_field_speckle.md.

Run: scripts/env python benchmarks/fine_speckle.py [--size 1 0.7 0.5 0.33] [--noise 0.01]
     [--strains 0.078 0.128] [--pixel 0.01] [--out out/fine_speckle]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.whole_field import WholeFieldOptions
from modeharvest.util.files import copy_whole
from modeharvest.validation.truth import rms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=float, nargs="+", default=[1.0, 0.7, 0.5, 0.33])
    parser.add_argument("--noise", type=float, default=0.01, help="of full scale")
    parser.add_argument("--strains", type=float, nargs="+", default=[0.078, 0.128])
    parser.add_argument("--pixel", type=float, default=0.01, help="mm")
    parser.add_argument("--out", type=Path, default=Path("out/fine_speckle"))
    given = parser.parse_args()
    print("speckle  strain  whole field   outcome        ansatz − best fit   refit   u − truth")
    for size in given.size:
        folder = given.out / f"{size:g}_{given.noise:g}_{given.pixel:g}"
        images = photographed(folder, size, given.noise, given.pixel, given.strains)
        width = speckle_size(images.reference(), images.mask())
        for measure in (False, True):
            compare(images, folder, width, measure)


def photographed(
    folder: Path, size: float, noise: float, pixel: float, strains: Sequence[float]
) -> ImageSet:
    """Make images with speckle ``size`` times as wide; a user's files in ``folder/experiment``."""
    case = Case.read("paper-virtual")
    speckle, shipped = case.imaging.speckle, shipped_solution("paper-virtual")
    fine = replace(
        speckle, standard_deviation=speckle.standard_deviation / size,
        blur_px=max(0.8, speckle.blur_px * size),
    )  # fmt: skip
    sensor = replace(case.imaging.sensor, read_noise=noise)
    spec = replace(case.imaging, pixel_size=pixel, speckle=fine, sensor=sensor, background=0.06)
    images = make_images(Solution.read(shipped), spec, folder / "images", strains)
    experiment = folder / "experiment"
    experiment.mkdir(exist_ok=True)
    for entry in (images.info["reference"], *images.info["snapshots"]):
        name = Path(entry["image"]).name
        copy_whole(images.folder / entry["camera_image"], experiment / name)
    (experiment / "experiment.toml").write_text(
        f'[images]\nreference = "reference.tif"\ndeformed = ["deformed_*.tif"]\n'
        f"[scale]\npixel_size = {pixel}\n"
        f"[specimen]\ncell_size = {case.experiment.specimen.pitch}\n",
        "utf-8",
    )
    return images


def compare(images: ImageSet, folder: Path, width: float, measure: bool) -> None:
    """Harvest the photographs, and compare the results with the truth."""
    case = PhotographCase.read(folder / "experiment/experiment.toml")
    case = case.model_copy(update={"whole_field": WholeFieldOptions(measure)})
    run = HarvestRun(case, folder / ("whole" if measure else "plain"))
    strains = {Path(e["image"]).stem: s for e, s in
               zip(images.info["snapshots"], images.strains, strict=True)}  # fmt: skip
    for name, found in run.results().items():
        true = images.truth(strains[name]).displacement
        inside = np.isfinite(true).all(axis=-1)
        px, result = images.grid.pixel_size, found.result
        best = fit_displacement(true, result.grid, result.ansatz, result.unknowns, inside)
        off = rms((result.displacement() - best.displacement())[inside]) / px
        more = ""
        if found.whole:
            refit = rms((found.whole.refit.displacement() - best.displacement())[inside]) / px
            error = found.whole.measured.displacement_on() - true
            left = rms(error[np.isfinite(error)]) / px
            more = f"{refit:8.4f} {left:8.4f} from {found.whole.start}, "
            more += f"{100 * np.isfinite(error[inside]).mean():.1f} %"
        modes = " and ".join(mode.family.name for mode in result.ansatz.modes) or "no mode"
        print(f"{width:7.1f} {strains[name]:7.3f}  {measure!s:5}  {result.outcome.value:14} "
              f"{off:8.3f} {more}, {modes}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
