"""Modes of a speckled specimen measured by its contours: errors, and agreement with the speckle.

::

    scripts/env python benchmarks/contours_beside.py [--pixel-size 0.02] [--seeds 20]
        [--in-view 0.8]

The shipped specimen at nominal strains of 7.8 % and 12.8 % is photographed with the paper's speckle
on a dark background: pixels average over their area, blur of 0.6 px, 8 bits, noise of 1 %; each
seed has its own speckle and noise. Each harvest measures by speckle and by contours. Both are
compared with the best fit of the ansatz to the true displacement, and with each other. --in-view
keeps this middle part of the picture's height and width; both are then compared farther than a cell
from the border, where contours measure. Tables: docs/explanation/contours_beside.md.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile

from modeharvest.fem.field import Solution
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.photograph.geometry import box_of
from modeharvest.idic.photograph.plain.surface import away_from_cuts
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.photographs.results import harvest_summary
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.whole_field import waves_percent

SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
STRAINS, POINTS = (0.078, 0.128), 101
CASE = """
[images]
reference = "reference_8bit.tif"
deformed = ["deformed_*_8bit.tif"]
[scale]
pixel_size = {pixel_size}
[specimen]
cell_size = 1.9
[contours]
measure = true
"""


def z_by_part(found: Result, best: Result) -> dict[str, FloatArray]:
    """Errors of the unknowns of v0, v1 and phi1 over their standard deviations by model error."""
    assert found.errors
    covariance = found.errors.by_model_error
    assert covariance is not None
    sd, a = np.sqrt(np.diag(covariance)), found.ansatz
    z = (found.unknowns - best.unknowns[: found.unknowns.size])[: sd.size] / sd
    parts = {"v0": slice(0, a.v_slice(0).start), "v1": a.v_slice(0), "phi1": a.phi_slice(0)}
    return {name: z[part][np.isfinite(z[part])] for name, part in parts.items()}


def v_percent_in(box: Box, found: Result, best: Result) -> tuple[float, float]:
    """Difference of v1 from the best fit's in the cellular part of a box [%].

    The largest over the best fit's largest value, and the rms over its rms.
    """
    own = best.ansatz.modes[0].taper.cellular
    x = np.linspace(max(box.x_min, own.x_min), min(box.x_max, own.x_max), POINTS)
    y = np.linspace(max(box.y_min, own.y_min), min(box.y_max, own.y_max), POINTS)
    v, at_best = (r.ansatz.v(0, r.unknowns, x, y) for r in (found, best))
    off, of = ((np.abs(f).max(), np.sqrt(np.mean(f**2))) for f in (v - at_best, at_best))
    return 100.0 * float(off[0] / of[0]), 100.0 * float(off[1] / of[1])


def photographed(folder: Path, pixel_size: float, seed: int) -> ImageSet:
    """Make photographs with a seed's own speckle and noise, and their truth."""
    speckle = SpeckleSpec(standard_deviation=0.08, blur_px=1.5, seed=seed)
    sensor = Sensor(fill_factor=1.0, psf_px=0.6, read_noise=0.01, read_seed=seed)
    spec = ImagingSpec(pixel_size, 40, background=0.06, speckle=speckle, sensor=sensor, bits=8)
    return make_images(Solution.read(SHIPPED), spec, folder, STRAINS)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.02, help="[mm]")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--in-view", type=float, default=1.0, help="share of height and width")
    given = parser.parse_args()
    shares: dict[str, list[FloatArray]] = {}
    for seed in range(given.seeds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            images = photographed(folder, given.pixel_size, seed)
            cut = [round(0.5 * (1.0 - given.in_view) * n) for n in images.grid.shape]
            rows, cols = (slice(c, n - c) for c, n in zip(cut, images.grid.shape, strict=True))
            for path in folder.glob("*_8bit.tif"):
                write_image(path, tifffile.imread(path)[rows, cols])
            (folder / "test.toml").write_text(CASE.format(pixel_size=given.pixel_size))
            run = HarvestRun(PhotographCase.read(folder / "test.toml"), folder / "out")
            run.results()
            begin = time.perf_counter()
            harvest = run.harvest()
            took = time.perf_counter() - begin
            numbers = {frame["name"]: frame for frame in harvest_summary(harvest)["frames"]}
            for frame, strain in zip(harvest.frames, STRAINS, strict=True):
                assert frame.contours, numbers[frame.name]["warnings"]
                true = images.truth(strain).displacement[rows, cols]
                speckle = frame.contours.speckle
                inside = away_from_cuts(harvest.mask, harvest.grid, harvest.pitch)
                inside &= np.isfinite(true).all(axis=-1)
                grid, a = speckle.grid, speckle.ansatz
                best = fit_displacement(true, grid, a, speckle.unknowns, inside)
                box = box_of(inside, grid)
                off = [v_percent_in(box, r, best) for r in (speckle, frame.contours.result)]
                beside = numbers[frame.name]["contours"]
                waves = [
                    waves_percent(r, best) if a.modes[0].family.size else float("nan")
                    for r in (speckle, frame.contours.result)
                ]
                between = np.array([row["difference_sd"] for row in beside["compared"]], float)
                print(
                    f"{seed} {strain:.1%}: v1 off {off[0][0]:.2f} by speckle, {off[1][0]:.2f} % by "
                    f"contours; rms {off[0][1]:.2f}, {off[1][1]:.2f} %; "
                    f"waves {waves[0]:.3f}, {waves[1]:.3f} %; edges "
                    f"{beside['edge_sd_px']:.2f} px; differences "
                    f"{np.sqrt(np.mean(between**2)):.2f} sd; {took:.0f} s",
                    flush=True,
                )
                parts = z_by_part(frame.contours.result, best) | {"difference": between}
                for what, z in parts.items():
                    shares.setdefault(f"{strain:.1%}, {what}", []).append(z)
                for what, value in (("v1 [%]", off[1][0]), ("waves [%]", waves[1])):
                    shares.setdefault(f"{strain:.1%}, {what}", []).append(np.array([value]))
    shares = {what: z for what, z in shares.items() if np.isfinite(np.concatenate(z)).any()}
    print("| of | in 95 % intervals [%] | error over its sd, rms |\n|---|---|---|")
    for what, found in shares.items():
        z = np.concatenate(found)
        if "[%]" in what:
            print(f"{what}: largest {z.max():.3f}, median {np.median(z):.3f}")
        else:
            share, rms = 100 * np.mean(np.abs(z) < 1.96), np.sqrt(np.mean(z**2))
            print(f"| {what} | {share:.1f} | {rms:.2f} |")


if __name__ == "__main__":
    main()
