"""Optical distortion at the paper's image size: calibration, recovery from a pair, removal.

The true lens is known: an analytic speckle is seen through the exact inverse of a distortion S of
up to 15 px, with 8 bits and noise of 1 % of full scale. One lens is a polynomial, the other
OpenCV's camera, which no polynomial matches exactly. Tables: docs/how-to/distortion.md.

Run: scripts/env python benchmarks/distortion.py
     scripts/env python benchmarks/distortion.py LENS_PAIR_FOLDER
with a folder that holds cal.xml, left_undist.png and left_dist.png (github dicengine/dice, tests).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from affine_aside import affine_aside
from lens_pair import recover_camera
from numpy.typing import NDArray

from modeharvest.imaging.distortion.calibrate import Calibration, CalibrationOptions, calibrate
from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.distortion.lens import (
    CameraDistortion,
    Distortion,
    PolynomialDistortion,
    undistorted,
    undistorted_mask,
)
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import quantise
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.photographs.prepare import calibration_text

FloatArray = NDArray[np.float64]

SHAPE = (2207, 2751)
NOISE = 0.01
SHIFTS = np.array([[0, 0], [3, 251], [247, -6], [-252, 8], [-4, -249], [180, 176]]) + 0.37
TURNS_RAD = np.array([0.0, 1e-4, -2e-4, 0.0, 1e-4, 0.0])


def polynomial_lens(size_px: float) -> PolynomialDistortion:
    """A random polynomial of degree 5 without affine part; the largest S is ``size_px``."""
    rng = np.random.default_rng(0)
    i, j = np.array(PolynomialDistortion.orders(5)).T
    c = rng.uniform(-1, 1, (2, i.size)) / (1 + i**2 + j**2)
    c[:, :3] = 0.0
    largest = np.hypot(*PolynomialDistortion(SHAPE, c).shift(*lines(60))).max()
    return PolynomialDistortion(SHAPE, c * size_px / largest)


def camera_lens(size_px: float) -> CameraDistortion:
    """A camera with barrel and tangential distortion, off centre; the largest S is ``size_px``."""

    def lens(scale: float) -> CameraDistortion:
        return CameraDistortion(
            8000, 8000, 1390, 1085, -0.2 * scale, 0.3 * scale, 1e-3 * scale, -2e-3 * scale
        )

    return lens(size_px / np.hypot(*lens(1.0).shift(*lines(60))).max())


def lines(n: int) -> tuple[FloatArray, FloatArray]:
    """Rows (n, 1) and columns (1, n) of a grid over the image [px]."""
    rows, cols = (np.linspace(0.0, size - 1.0, n) for size in SHAPE)
    return rows[:, None], cols[None, :]


def photographs(lens: Distortion) -> list[NDArray[np.float32]]:
    """Photographs of a target that is shifted and turned, 8 bits, as [0 ... 1]."""
    margin = 320
    target = Speckle(SpeckleSpec(seed=5), (SHAPE[0] + 2 * margin, SHAPE[1] + 2 * margin))
    ideal = lens.ideal(*np.indices(SHAPE, dtype=np.float64))
    centre, rng, images = 0.5 * (np.array(SHAPE) - 1), np.random.default_rng(6), []
    for shift, turn in zip(SHIFTS - SHIFTS[0], TURNS_RAD, strict=True):
        row, col = (a - c - s for a, c, s in zip(ideal, centre, shift, strict=True))
        cos, sin = np.cos(turn), np.sin(turn)
        back = cos * row + sin * col + centre[0], cos * col - sin * row + centre[1]
        grey = target(back[0] + margin, back[1] + margin) * 0.9
        images.append(np.float32(quantise(grey + NOISE * rng.normal(size=SHAPE), 8)) / 255)
    return images


def report_calibration(name: str, lens: Distortion) -> Calibration:
    images = photographs(lens)
    begin = time.perf_counter()
    found = calibrate(images, options=CalibrationOptions())
    seconds = time.perf_counter() - begin
    aside = affine_aside(found.distortion, lens, SHAPE)
    largest = np.hypot(*lens.shift(*lines(60))).max()
    print(f"\n{name}, S up to {largest:.1f} px, {len(images)} photographs, {seconds:.0f} s")
    print("| degree | residual | BIC | change of S [px] | sd of S [px] |\n|---|---|---|---|---|")
    for t in found.trials:
        print(
            f"| {t.degree} | {t.residual_rms:.5f} | {t.bic:.0f} | {t.change_px:.4f} "
            f"| {t.sd_px:.5f} |"
        )
    print(f"error, affine part aside: {aside.rms_px:.5f} px rms, {aside.largest_px:.4f} at most")
    print(f"noise found {found.noise_sd:.5f}, made {np.hypot(NOISE, 1 / 255 / 12**0.5):.5f}")
    print(*calibration_text(found), sep="\n")
    return found


def report_undistorting(lens: Distortion) -> None:
    image = np.random.default_rng(0).uniform(size=SHAPE).astype(np.float32)
    undistorted(image[:64, :64], lens)
    laps: dict[str, list[float]] = {"image": [], "mask": [], "exact inverse": []}
    work = {
        "image": lambda: undistorted(image, lens),
        "mask": lambda: undistorted_mask(image > 0.5, lens),
        "exact inverse": lambda: lens.ideal(*np.indices(SHAPE, dtype=np.float64)),
    }
    for _ in range(3):
        for name, do in work.items():
            begin = time.perf_counter()
            do()
            laps[name].append(time.perf_counter() - begin)
    print(f"\n{type(lens).__name__}, {image.size / 1e6:.1f} Mpx: ", end="")
    print(", ".join(f"{name} {np.median(times):.2f} s" for name, times in laps.items()))


def report_pair(folder: Path) -> None:
    lens = read_distortion(folder / "cal.xml")
    images = [read_image(folder / f"left_{name}.png") for name in ("undist", "dist")]
    rows, cols = images[0].shape
    at = np.linspace(0, rows - 1.0, 60)[:, None], np.linspace(0, cols - 1.0, 100)[None, :]
    shift = np.stack(lens.shift(*at))
    print(f"\nlens pair, S up to {np.hypot(*shift).max():.1f} px")
    for points in (50_000, 200_000, 600_000):
        found = recover_camera(*images, points=points)
        d = np.stack(found.distortion.shift(*at)) - shift
        sd = np.sqrt(np.mean(np.square(found.sd(*at))))
        print(
            f"{points} pixels: error {np.sqrt(np.mean(d**2)):.4f} px rms, {np.abs(d).max():.3f} at "
            f"most; predicted sd {sd:.4f}; residual like a noise of {255 * found.noise_sd:.2f}/255"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, help="of a pair of images, see above")
    folder = parser.parse_args().folder
    if folder is not None:
        report_pair(folder)
        return
    found = report_calibration("Polynomial of degree 5", polynomial_lens(15.0))
    report_calibration("OpenCV camera", camera_lens(15.0))
    report_undistorting(found.distortion)
    report_undistorting(camera_lens(15.0))


if __name__ == "__main__":
    main()
