"""Accuracy of 'modeharvest measure' on images of many kinds, with its own initial guess.

Its input is a user's: 8-bit images and the reference's mask, no lattice, no mode, no mask of the
deformed images. For the last image of each case: cut-off wavelength [px], rms error per component,
95 and 99.9 % quantiles and largest length of the error vector [px], coverage of 95 % intervals,
share of the material that is measured, and seconds. Table: docs/how-to/measure.md.

Run: scripts/env python benchmarks/measure_alone.py [--only CASE ...] [--out out/measure_alone]
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image
from scipy.ndimage import convolve, gaussian_filter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from large_strain import PHOTOGRAPHED
from large_strain import truth as stretched

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.files import read_result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.measure import measure
from modeharvest.validation.scoring.star import Star, exact_images, fine_speckle
from modeharvest.validation.truth import rms

BLUR = "modeharvest.idic.finite_element.correlation.well_sampled"
LENS = {"fill_factor": 1.0, "psf_px": 0.7}
"""Sensor that shows means over its pixels' area, behind a lens with that point spread."""
Images = tuple[list[np.ndarray], np.ndarray, np.ndarray]
"""Reference and deformed images [0 ... 1], mask, u of the last one (rows, cols, 2), y up [px]."""


def specimen(
    folder: Path,
    case: str = "paper-virtual",
    strain: float = 0.128,
    size: float = 1.0,
    light: float = 0.0,
    **imaging: Any,
) -> Images:
    """Images of a state of a shipped solution, with finer speckle, noise, or changed light.

    ``light``: relative increase of the deformed image's brightness at its right end, decrease at
    its left.
    """
    spec, solution = Case.read(case).imaging, shipped_solution(case)
    speckle = replace(
        spec.speckle, standard_deviation=spec.speckle.standard_deviation / size,
        blur_px=max(0.8, spec.speckle.blur_px * size),
    )  # fmt: skip
    sensor = replace(spec.sensor, **imaging.pop("sensor", {}))
    imaging = {"pixel_size": 0.02, "distortion": None, "shape": None} | imaging
    spec = replace(spec, speckle=speckle, sensor=sensor, background=0.06, **imaging)
    return imaged(Solution.read(solution), spec, folder, strain, light)


def plate(folder: Path) -> Images:
    """Images of a plate of 20 x 16 mm with a hole of 6 mm, at 6 %."""
    from modeharvest.fem.simulate import simulate

    body = Specimen(1, 1, diameter=6.0, pitch=12.0, bulk_x=4.0, bulk_y=2.0)
    solution = simulate(Experiment(body, strains=(0.06,), mesh_size=0.25))
    spec = replace(Case.read("paper-virtual").imaging, pixel_size=0.02, background=0.06)
    return imaged(solution, spec, folder, 0.06, 0.0)


def imaged(solution: Solution, spec: Any, folder: Path, strain: float, light: float) -> Images:
    """Images of a state, and its truth."""
    images = make_images(solution, spec, folder / "set", [strain])
    pair = images.pair(strain, camera=True)
    slope = 1.0 + light * np.linspace(-1.0, 1.0, pair.grid.cols)
    u = images.truth(strain).displacement / pair.grid.pixel_size
    return [pair.reference, slope * pair.deformed], pair.masks[0], u


def star(folder: Path, noise: float = 0.0) -> Images:
    """The star images of docs/explanation/resolution.md: periods of 10 to 300 px, 0.5 px high."""
    shape = Star()
    f, g, _ = exact_images(shape, fine_speckle())
    random = np.random.default_rng(0)
    f, g = (image + noise * random.standard_normal(image.shape) for image in (f, g))
    x, y = np.meshgrid(shape.grid.x, shape.grid.y)
    return [f, g], np.ones(shape.grid.shape, bool), shape.displacement(x, y)


def filled(folder: Path, shift: tuple[float, float], turn_deg: float, noise: float) -> Images:
    """Images of a surface that fills the picture, moved as a rigid body."""
    return rigid(folder, shift, turn_deg, noise, sides=(1e6, 1e6))


def reflecting(images: Images, rows: slice, cols: slice) -> Images:
    """The same images with the reflection of a lamp, at the same place in all of them."""
    for image in images[0]:
        image[rows, cols] = 1.0
    return images


def dusty(images: Images, count: int = 40) -> Images:
    """The same images with dark specks, 4 to 8 px wide and elsewhere in each of them."""
    random, shown = np.random.default_rng(0), [image.copy() for image in images[0]]
    for image in shown:
        row, col = (random.uniform(0, n, count) for n in image.shape)
        y, x = np.indices(image.shape)
        for n, radius in enumerate(random.uniform(2.0, 4.0, count)):
            image[np.hypot(y - row[n], x - col[n]) < radius] = 0.1
    return shown, *images[1:]


Camera = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]
"""Photographs a surface (rows, cols) [0 ... 1], with noise of some standard deviation."""


def white(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """A camera with white noise."""
    return np.asarray(image + noise * random.standard_normal(image.shape))


def blurring(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """A lens with a point spread of 0.7 px, and white noise."""
    return white(gaussian_filter(image, LENS["psf_px"]), noise, random)


def smoothing(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """A camera whose noise neighbouring pixels share: white noise blurred by 0.7 px."""
    grain = gaussian_filter(random.standard_normal(image.shape), 0.7)
    return np.asarray(image + noise * grain / grain.std())


def colour(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """The luminance of a camera of colours: white noise in a Bayer pattern, interpolated."""
    raw, (row, col) = white(image, noise, random), np.indices(image.shape) % 2
    cross, square = np.array([[[0, 1, 0], [1, 4, 1], [0, 1, 0]], [[1, 2, 1], [2, 4, 2], [1, 2, 1]]])
    kinds = ((0.299, row < col, square), (0.587, row == col, cross), (0.114, row > col, square))
    return np.asarray(sum(w * convolve(np.where(on, raw, 0.0), k / 4.0) for w, on, k in kinds))


def compressed(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """White noise, compressed to a JPEG of quality 80."""
    grey = np.clip(np.rint(255.0 * white(image, noise, random)), 0, 255).astype(np.uint8)
    Image.fromarray(grey).save(file := BytesIO(), "JPEG", quality=80)
    return np.asarray(Image.open(file), dtype=float) / 255.0


def photographed(images: Images, camera: Camera, noise: float) -> Images:
    """The same images as a camera shows them."""
    random = np.random.default_rng(0)
    return [camera(image, noise, random) for image in images[0]], *images[1:]


def rigid(
    folder: Path, shift: tuple[float, float], turn_deg: float, noise: float = 0.0,
    size: float = 1.0, camera: Camera = white, sides: tuple[float, float] = (220.0, 180.0),
) -> Images:  # fmt: skip
    """Images of a plate that shifts and turns as a rigid body, before a dark background."""
    grid, random, spec = PixelGrid.centred(500, 600, 1.0), np.random.default_rng(0), fine_speckle()
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    spec = replace(spec, standard_deviation=spec.standard_deviation / size,
                   blur_px=spec.blur_px * size)  # fmt: skip
    F, speckle = np.array([[c, -s], [s, c]]), Speckle(spec, grid.shape)
    points = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)

    def image(at: np.ndarray) -> np.ndarray:
        shown = 0.2 + 0.6 * speckle(*grid.to_px(at[..., 0], at[..., 1]))
        inside = _inside(at, sides)
        return camera(np.where(inside, shown, 0.06), noise, random)

    u = points @ (F - np.eye(2)).T + np.array(shift)
    return [image(points), image((points - np.array(shift)) @ F)], _inside(points, sides), u


def painted(folder: Path, shift: tuple[float, float], size: float) -> Images:
    """Images of black and white paint with edges sharper than a pixel, which shifts.

    ``size``: about that of its speckles [px]. Pixels show the mean of 8 x 8 points of themselves.
    """
    grid, spec = PixelGrid.centred(300, 400, 1.0), fine_speckle()
    factor = size / 5.0
    spec = replace(spec, standard_deviation=spec.standard_deviation / factor,
                   blur_px=spec.blur_px * factor)  # fmt: skip
    speckle, part = Speckle(spec, grid.shape), (np.arange(8) - 3.5) / 8.0
    x, y = np.meshgrid(grid.x, grid.y)

    def image(u: float, v: float) -> np.ndarray:
        points = ((x + dx - u, y + dy - v) for dx in part for dy in part)
        return np.mean([0.2 + 0.6 * (speckle(*grid.to_px(*at)) > 0.5) for at in points], axis=0)

    return [image(0.0, 0.0), image(*shift)], np.ones(x.shape, bool), np.full((*x.shape, 2), shift)


def _inside(points: np.ndarray, sides: tuple[float, float]) -> np.ndarray:
    return np.asarray((abs(points) < sides).all(axis=-1))


def stretch(folder: Path, strains: Sequence[float]) -> Images:
    """Images of a specimen with 4 x 4 holes, stretched, with pattern and w (large_strain.py)."""
    images = [PHOTOGRAPHED.image(None) / 255.0]
    for n, strain in enumerate(strains):
        images.append(PHOTOGRAPHED.image(lambda p, e=strain: stretched(e, p), n + 1) / 255.0)
    u = stretched(strains[-1], PHOTOGRAPHED.points) / PHOTOGRAPHED.grid.pixel_size
    return images, PHOTOGRAPHED.mask, u


CASES: dict[str, Callable[[Path], Images]] = {
    "paper's specimen, 12.8 %": specimen,
    "7.8 %, before buckling": lambda folder: specimen(folder, strain=0.078),
    "12.8 %, noise of 1 %": lambda folder: photographed(specimen(folder), white, 0.01),
    "12.8 %, noise of 2 %": lambda folder: specimen(folder, sensor={"read_noise": 0.02}),
    "12.8 %, pixels show means": lambda f: specimen(f, sensor={"fill_factor": 1.0}),
    "12.8 %, pixels show means, noise of 1 %": lambda folder: photographed(
        specimen(folder, sensor={"fill_factor": 1.0}), white, 0.01
    ),
    "12.8 %, lens of 0.7 px": lambda folder: specimen(folder, sensor=LENS),
    "12.8 %, lens of 0.7 px, noise of 1 %": lambda folder: photographed(
        specimen(folder, sensor=LENS), white, 0.01
    ),
    "12.8 %, noise of 1 %, JPEG": lambda folder: photographed(specimen(folder), compressed, 0.01),
    "12.8 %, noise of 1 %, camera of colours": lambda folder: photographed(
        specimen(folder), colour, 0.01
    ),
    "12.8 %, noise of 1 %, a reflection": lambda folder: reflecting(
        photographed(specimen(folder), white, 0.01), slice(400, 460), slice(300, 380)
    ),
    "12.8 %, noise of 1 %, dust": lambda folder: photographed(dusty(specimen(folder)), white, 0.01),
    "12.8 %, speckle of 6 px": lambda folder: specimen(folder, size=0.5),
    "12.8 %, speckle of 4 px": lambda folder: specimen(folder, size=0.33),
    "12.8 %, 0.01 mm/px, 4 px": lambda folder: specimen(folder, size=0.33, pixel_size=0.01),
    "twin, 12.7 %, 0.02 mm/px": lambda folder: specimen(folder, "paper-real-twin", 0.127),
    "twin, 12.7 %, 0.01 mm/px": lambda f: specimen(f, "paper-real-twin", 0.127, pixel_size=0.01),
    "12.8 %, light ± 5 %": lambda folder: specimen(folder, light=0.05),
    "12.8 %, light ± 5 %, --brightness none": lambda folder: specimen(folder, light=0.05),
    "plate with a hole": plate,
    "star": star,
    "star, noise of 2 %": lambda folder: star(folder, 0.02),
    "shift by 40 px": lambda folder: rigid(folder, (31.3, 25.7), 0.0),
    "picture filled, shift by 3 px": lambda folder: filled(folder, (2.4, -1.7), 0.0, 0.0),
    "picture filled, turn by 3°": lambda folder: filled(folder, (2.4, -1.7), 3.0, 0.0),
    "picture filled, turn by 3°, a reflection": lambda folder: reflecting(
        filled(folder, (2.4, -1.7), 3.0, 0.0), slice(200, 260), slice(300, 380)
    ),
    "turn by 10°": lambda folder: rigid(folder, (5.3, -8.6), 10.0),
    "turn by 10°, lens of 0.7 px, speckle of 12 px": lambda folder: rigid(
        folder, (5.3, -8.6), 10.0, 0.0, 2.5, blurring
    ),
    "shift by 0.6 px, noise of 1 %": lambda folder: rigid(folder, (0.37, -0.41), 0.0, 0.01),
    "turn by 10°, noise of 1 %": lambda folder: rigid(folder, (5.3, -8.6), 10.0, 0.01),
    "the same, speckle of 12 px": lambda folder: rigid(folder, (5.3, -8.6), 10.0, 0.01, 2.5),
    "turn by 10°, noise of 1 %, dust": lambda folder: photographed(
        dusty(rigid(folder, (5.3, -8.6), 10.0)), white, 0.01
    ),
    "turn by 10°, noise of 1 %, correlated": lambda folder: rigid(
        folder, (5.3, -8.6), 10.0, 0.01, camera=smoothing
    ),
    "turn by 10°, noise of 1 %, camera of colours": lambda folder: rigid(
        folder, (5.3, -8.6), 10.0, 0.01, camera=colour
    ),
    "the same, speckle of 12 px, noise of 2 %": lambda folder: rigid(
        folder, (5.3, -8.6), 10.0, 0.02, 2.5, camera=colour
    ),
    "turn by 3°, speckle of 24 px, noise of 5 %": lambda folder: rigid(
        folder, (5.3, -8.6), 3.0, 0.05, 4.8
    ),
    "turn by 5°, speckle of 36 px, noise of 2 %": lambda folder: rigid(
        folder, (5.3, -8.6), 5.0, 0.02, 7.2
    ),
    "turn by 10°, noise of 1 %, JPEG": lambda folder: rigid(
        folder, (5.3, -8.6), 10.0, 0.01, camera=compressed
    ),
    "paint of 4 px, sharp edges, shift by 0.3 px": lambda f: painted(f, (0.3, 0.1), 4.0),
    "paint of 8 px, sharp edges, shift by 0.3 px": lambda f: painted(f, (0.3, 0.1), 8.0),
    "paint of 12 px, sharp edges, shift by 0.3 px": lambda f: painted(f, (0.3, 0.1), 12.0),
    "paint of 8 px, sharp edges, not blurred": lambda f: painted(f, (0.3, 0.1), 8.0),
    "paint of 12 px, sharp edges, not blurred": lambda f: painted(f, (0.3, 0.1), 12.0),
    "paint of 12 px, sharp edges, noise of 2 %": lambda folder: photographed(
        painted(folder, (0.3, 0.1), 12.0), white, 0.02
    ),
    "stretched by 30 % in one step": lambda folder: stretch(folder, [0.3]),
    "stretched by 50 % in 5 steps": lambda folder: stretch(folder, [0.1, 0.2, 0.3, 0.4, 0.5]),
    "stretched by 100 % in 10 steps": lambda f: stretch(f, [0.1 * k for k in range(1, 11)]),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path("out/measure_alone"))
    given = parser.parse_args()
    print("| images | ℓ | rms | 95 % | 99.9 % | largest | in intervals | measured | s |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in given.only:
        folder = given.out / "".join(c if c.isalnum() else "_" for c in name)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            degree = "none" if "--brightness none" in name else 1
            with patch(BLUR, lambda pair, _: pair) if "not blurred" in name else nullcontext():
                print(f"| {name} | {row(CASES[name], folder, degree)} |", flush=True)
        except Exception as error:  # the other cases follow
            print(f"| {name} | {type(error).__name__}: {error} |", flush=True)


def row(make: Callable[[Path], Images], folder: Path, brightness: int | str = 1) -> str:
    """Measure a case, gain and offset of degree ``brightness``; returns the columns of its row."""
    images, mask, truth = make(folder)
    files = [folder / f"image_{n:02d}.tif" for n in range(len(images))]
    for file, image in zip(files, images, strict=True):
        write_image(file, np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8))
    write_image(folder / "mask.tif", mask)
    summary = measure(
        files[0], files[1:], folder / "out", mask=folder / "mask.tif", brightness=brightness
    )
    last = summary["images"][-1]
    took = json.loads((folder / "out/timings.json").read_text())[f"image {last['name']}"]
    found = read_result(folder / f"out/results/{last['name']}.h5")
    seen = mask & np.isfinite(truth).all(axis=-1)
    error, sd = (found.displacement_on() - truth)[seen], found.standard_deviation_on()[seen]
    there = error[np.isfinite(error).all(axis=-1)]
    length = np.linalg.norm(there, axis=1)
    return " | ".join(
        [f"{last['cutoff_px']:.0f}", f"{rms(there):.3f}"]
        + [f"{np.quantile(length, q):.2f}" for q in (0.95, 0.999, 1.0)]
        + [f"{100 * np.mean((np.abs(error) < 1.96 * sd)[np.isfinite(error)]):.0f} %"]
        + [f"{100 * last['coverage']:.1f} %", f"{took:.0f}"]
    )


if __name__ == "__main__":
    main()
