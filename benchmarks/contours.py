"""How well contours alone give the displacement of a specimen without speckle.

::

    scripts/env python benchmarks/contours.py [--pixel-size 0.03] [--only NAME ...]

The shipped specimen, buckled at a nominal strain of 12.8 %, is photographed without speckle: pixels
that average, a lens of 0.6 px, 8 bits. A row changes one thing. The specimen's law, Ogden of
exponent 3, isn't the one that is assumed, except where the row says so.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.contours import displacement_from_contours
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import refitted
from modeharvest.idic.photograph.plain import matched_contours, plain_surface
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import Sensor, quantise
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.arrays import FloatArray, FloatImage

SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
STRAINS = (0.078, 0.128)
MARGIN_PX = 40


@dataclass(frozen=True)
class Row:
    """What is changed."""

    name: str
    noise: float = 0.01
    strain: float = 0.128
    reference: Callable[[FloatImage], FloatImage] = np.asarray
    deformed: Callable[[FloatImage], FloatImage] = np.asarray
    turn_deg: float = 0.0
    law: Material | None = None


def light(image: FloatImage) -> FloatImage:
    """A quarter brighter on one side, a fifth darker below."""
    x, y = (np.linspace(-1.0, 1.0, n) for n in image.shape[::-1])
    return np.asarray(image * (1.0 + 0.25 * x - 0.2 * y[:, None]), dtype=np.float32)


def negative(image: FloatImage) -> FloatImage:
    """Dark material on bright."""
    return np.float32(0.85) - image


def weaker(image: FloatImage) -> FloatImage:
    """Less contrast."""
    return np.float32(0.8) * image + np.float32(0.05)


ROWS = (
    Row("8 bit", 0.0), Row("1 % noise"), Row("4 % noise", 0.04),
    Row("before buckling", strain=0.078),
    Row("negative", reference=negative, deformed=negative),
    Row("uneven light", reference=light, deformed=light),
    Row("uneven, then even", reference=light, deformed=weaker),
    Row("turned by 3 degrees", turn_deg=3.0), Row("the specimen's own law", law=Ogden()),
    Row("Poisson's ratio 0.35", law=Ogden((2.0,), (2.0,), 7.0 / 3.0)),
    Row("two-term I1 law", law=TwoTermI1()),
)  # fmt: skip


def turned(image: FloatImage, turn: float) -> FloatImage:
    """An image turned anticlockwise about its middle [rad]."""
    middle = (np.array(image.shape) - 1.0) / 2.0
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    at = (np.indices(image.shape).reshape(2, -1).T - middle) @ R + middle
    return np.asarray(map_coordinates(image, at.T, order=3, mode="nearest").reshape(image.shape))


def photographs(folder: Path, row: Row, seed: int) -> tuple[FloatImage, FloatImage]:
    """The two pictures of a row, 8 bit."""
    rng, tag = np.random.default_rng(seed), f"deformed_{round(1e4 * row.strain):04d}"
    f, g = (read_image(folder / f"{name}.tif") for name in ("reference", tag))
    pictures = row.reference(f), row.deformed(turned(g, np.deg2rad(row.turn_deg)))
    noisy = (p + row.noise * rng.standard_normal(p.shape, dtype=np.float32) for p in pictures)
    first, second = (quantise(p, 8).astype(np.float32) for p in noisy)
    return first, second


def truth(u: FloatArray, grid: PixelGrid, turn: float) -> FloatArray:
    """(rows, cols, 2) displacement u [mm], and then a turn about the image's middle."""
    middle = np.array([0.5 * (grid.x[0] + grid.x[-1]), 0.5 * (grid.y[0] + grid.y[-1])])
    X = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray((X + u - middle) @ R.T + middle - X)


def rows(pixel_size: float, only: list[str]) -> Iterator[str]:
    """Lines of the table."""
    solution = Solution.read(SHIPPED)
    spec = ImagingSpec(
        pixel_size, MARGIN_PX, background=0.15, speckle=SpeckleSpec(dark=0.7, bright=0.7),
        sensor=Sensor(fill_factor=1.0, psf_px=0.6), bits=8,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = {p.strain: p for p in make_images(solution, spec, folder, STRAINS)}
        for row in (r for r in ROWS if not only or r.name in only):
            pair = pairs[row.strain]
            grid, px = pair.grid, pair.grid.pixel_size
            f, g = photographs(folder, row, 0)
            begin = time.perf_counter()
            seen = [plain_surface(image) for image in (f, g)]
            assert seen[0]
            assert seen[1]
            body = FiniteElementOptions().body(seen[0].mask, grid)
            contours = matched_contours(seen[0], seen[1], grid)
            start = contours.start(body.mesh.nodes)
            found = displacement_from_contours(contours.seen, body, grid, start, row.law)
            seconds = time.perf_counter() - begin
            u, measured = pair.truth.displacement, found.displacement_on()
            u = truth(u, grid, np.deg2rad(row.turn_deg))
            there = np.isfinite(u[..., 0]) & np.isfinite(measured[..., 0])
            off = (measured - u)[there] / px
            sd = found.standard_deviation_on()[there] / px
            covered = np.mean(np.abs(off) < 1.96 * sd)
            line = [
                np.sqrt(np.mean(off**2)), np.linalg.norm(off, axis=1).max(), 100.0 * covered,
                found.residual_rms, *against_best_fit(solution, found, u, there, row), seconds,
            ]  # fmt: skip
            yield (
                f"| {row.name} | "
                + " | ".join("–" if np.isnan(v) else f"{v:.3g}" for v in line)
                + " |"
            )


def against_best_fit(
    solution: Solution, found: object, u: FloatArray, there: FloatArray, row: Row
) -> tuple[float, float]:
    """v1 phi1 over that of the best fit, less 1 [%]; largest difference of the wave vectors [%]."""
    if row.turn_deg or row.strain < 0.1:  # another frame; no pattern
        return float("nan"), float("nan")
    grid, ansatz = found.grid, Ansatz.square(solution.specimen)  # type: ignore[attr-defined]
    guess = ansatz.initial_guess(row.strain)
    best = fit_displacement(u, grid, ansatz, guess, there)
    own = refitted(found, ansatz, best.unknowns, there)  # type: ignore[arg-type]
    x, y = (axis[np.nonzero(there)[k]][::97, None] for k, axis in ((1, grid.x), (0, grid.y)))
    a, b = (ansatz.fluctuation(0, fit.unknowns, x, y) for fit in (own, best))
    waves = [fit.unknowns[ansatz.phi_slice(0)][1:5] for fit in (own, best)]
    return (
        100.0 * (float((a * b).sum() / (b * b).sum()) - 1.0),
        100.0 * float(np.abs(waves[0] / waves[1] - 1.0).max()),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm]")
    parser.add_argument("--only", nargs="*", default=[], help="names of rows")
    given = parser.parse_args()
    print(f"{given.pixel_size:g} mm/px\n")
    print("| what is changed | u off, rms [px] | longest [px] | in 95 % intervals [%] "
          "| off the contours, rms [px] | v1 phi1 off the best fit [%] | waves off it [%] "
          "| s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for line in rows(given.pixel_size, given.only):
        print(line, flush=True)


if __name__ == "__main__":
    main()
