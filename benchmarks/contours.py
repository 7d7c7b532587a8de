"""Errors and intervals of the displacement that contours give, of a specimen without speckle.

::

    scripts/env python benchmarks/contours.py [--pixel-size 0.03] [--only NAME ...] [--seeds N]
        [--picture docs/images/contours_part.png]

The shipped specimen, buckled at a nominal strain of 12.8 %, is photographed without speckle: pixels
average over their area, blur of 0.6 px, 8 bits. Each row changes one condition. The specimen's law
(Ogden, exponent 3) isn't the assumed one (neo-Hookean), except in rows that name a law. --seeds
prints instead how often 95 % intervals of u and of the refitted ansatz hold, over seeds of 1 %
noise and pixels up to a tenth larger, which shift edges. --picture draws the row "middle" instead.
Results: docs/explanation/contours.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.draw import polygon2mask
from whole_coverage import refitted_against

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.contours.measure import displacement_from_contours
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import NodalResult, refitted
from modeharvest.idic.photograph.plain.matching import matched_contours
from modeharvest.idic.photograph.plain.measure import displacement_of_plain
from modeharvest.idic.photograph.plain.surface import plain_surface
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import Sensor, quantise
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.arrays import FloatArray, FloatImage

mpl.use("Agg")
SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
STRAINS = (0.078, 0.128)
HEADS = (
    "what is changed", "u off, rms [px]", "longest [px]", "in 95 % intervals [%]",
    "off the contours, rms [px]", "v1 phi1 off the best fit [%]", "waves off it [%]",
)  # fmt: skip
MARGIN_PX = 40
FINE = 8


@dataclass(frozen=True)
class Row:
    """Conditions of one row of the table; ``noise`` is a standard deviation [of full scale]."""

    name: str
    noise: float = 0.01
    strain: float = 0.128
    reference: Callable[[FloatImage], FloatImage] = np.asarray
    deformed: Callable[[FloatImage], FloatImage] = np.asarray
    turn_deg: float = 0.0
    law: Material | None = None
    rows: tuple[float, float] = (0.0, 1.0)
    cols: tuple[float, float] = (0.0, 1.0)
    """Part of the pictures in view, as fractions of their height and width [-]."""
    dots: float = 0.0
    """Diameter of dots painted between any four holes [mm]; 0 for none."""

    @property
    def is_part(self) -> bool:
        """Whether only a part of the pictures is in view."""
        return (self.rows, self.cols) != ((0.0, 1.0), (0.0, 1.0))

    def window(self, shape: tuple[int, ...]) -> tuple[slice, ...]:
        """Slices of the rows and columns in view, of pictures of ``shape`` (rows, cols)."""
        parts = zip((self.rows, self.cols), shape, strict=True)
        return tuple(slice(round(a * n), round(b * n)) for (a, b), n in parts)


def light(image: FloatImage) -> FloatImage:
    """Uneven light: up to 25 % brighter at the right edge, 20 % darker at the lower one."""
    x, y = (np.linspace(-1.0, 1.0, n) for n in image.shape[::-1])
    return np.asarray(image * (1.0 + 0.25 * x - 0.2 * y[:, None]), dtype=np.float32)


def negative(image: FloatImage) -> FloatImage:
    """Dark material on a bright background."""
    return np.float32(0.85) - image


def thresholded(image: FloatImage) -> FloatImage:
    """Pixels thresholded to two grey levels."""
    return np.where(image > 0.43, np.float32(0.7), np.float32(0.15))


def weaker(image: FloatImage) -> FloatImage:
    """Contrast lowered to 0.8."""
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
    Row("cut across", cols=(0.0, 0.6)), Row("cut along", rows=(0.0, 0.5)),
    Row("middle", rows=(0.2, 0.8), cols=(0.2, 0.8)),
    Row("two grey levels", 0.0, reference=thresholded, deformed=thresholded),
    Row("middle, two grey levels", 0.0, reference=thresholded, deformed=thresholded,
        rows=(0.2, 0.8), cols=(0.2, 0.8)),
    Row("dots", dots=0.36), Row("dots before buckling", strain=0.078, dots=0.36),
)  # fmt: skip


def turned(image: FloatImage, turn: float) -> FloatImage:
    """An image rotated anticlockwise about its centre by ``turn`` [rad]."""
    middle = (np.array(image.shape) - 1.0) / 2.0
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    at = (np.indices(image.shape).reshape(2, -1).T - middle) @ R + middle
    return np.asarray(map_coordinates(image, at.T, order=3, mode="nearest").reshape(image.shape))


def painted(
    image: FloatImage, edges: Sequence[FloatArray], grey: float = 0.15, psf_px: float = 0.6
) -> FloatImage:
    """Paint polygons (n, 2) of (row, col) [px] on an image, each pixel averaged over its area.

    Polygons are those of the state in the image; dots of each state are rendered separately.
    """
    share = np.zeros(image.shape)
    for points in edges:
        low = np.floor(points.min(axis=0)).astype(int) - 1
        rows, cols = np.ceil(points.max(axis=0)).astype(int) + 2 - low
        fine = polygon2mask((FINE * rows, FINE * cols), (points - low + 0.5) * FINE - 0.5)
        mean = fine.reshape(rows, FINE, cols, FINE).mean(axis=(1, 3))
        there = np.s_[low[0] : low[0] + rows, low[1] : low[1] + cols]
        share[there] = np.maximum(share[there], mean)
    share = gaussian_filter(share, psf_px)
    return np.asarray(image + share * (grey - image), dtype=np.float32)


def dots(pair: ImagePair, diameter: float) -> tuple[list[FloatArray], list[FloatArray]]:
    """Edges of dots between any four holes, in both images of a pair: (n, 2) of (row, col) [px]."""
    specimen = Solution.read(SHIPPED).specimen
    assert specimen
    assert pair.truth
    u = np.nan_to_num(np.asarray(pair.truth.displacement))
    places = specimen.hole_centres + 0.5 * specimen.pitch
    inside = (places < specimen.hole_centres.max(axis=0)).all(axis=1)
    turn = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    found: tuple[list[FloatArray], list[FloatArray]] = [], []
    for place in places[inside]:
        X = place + 0.5 * diameter * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        at = np.stack(pair.grid.to_px(*X.T))
        moved = X + np.stack([map_coordinates(u[..., k], at, order=1) for k in (0, 1)], axis=1)
        found[0].append(at.T)
        found[1].append(np.stack(pair.grid.to_px(*moved.T), axis=1))
    return found


def photographs(
    folder: Path, row: Row, seed: int, pair: ImagePair | None = None
) -> tuple[FloatImage, FloatImage]:
    """The two 8-bit pictures of a row [0 ... 255]; ``pair`` is needed for rows with dots."""
    rng, tag = np.random.default_rng(seed), f"deformed_{round(1e4 * row.strain):04d}"
    f, g = (read_image(folder / f"{name}.tif") for name in ("reference", tag))
    if row.dots and pair:
        f, g = (painted(*one) for one in zip((f, g), dots(pair, row.dots), strict=True))
    pictures = row.reference(f), row.deformed(turned(g, np.deg2rad(row.turn_deg)))
    noisy = (p + row.noise * rng.standard_normal(p.shape, dtype=np.float32) for p in pictures)
    first, second = (quantise(p, 8).astype(np.float32)[row.window(p.shape)] for p in noisy)
    return first, second


def truth(u: FloatArray, grid: PixelGrid, turn: float) -> FloatArray:
    """(rows, cols, 2) displacement [mm]: u, then a rotation by ``turn`` [rad] about the centre."""
    middle = np.array([0.5 * (grid.x[0] + grid.x[-1]), 0.5 * (grid.y[0] + grid.y[-1])])
    X = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray((X + u - middle) @ R.T + middle - X)


def measured(
    folder: Path, grid: PixelGrid, row: Row, seed: int, pair: ImagePair | None = None
) -> NodalResult:
    """Measure the displacement in a row's pictures by their contours."""
    f, g = photographs(folder, row, seed, pair)
    seen = [plain_surface(image) for image in (f, g)]
    assert seen[0]
    assert seen[1]
    body = FiniteElementOptions().body(seen[0].mask, grid)
    if row.law is None:
        return displacement_of_plain(seen[0], g, grid, body)[0]
    contours = matched_contours(seen[0], seen[1], grid)
    start = contours.start(body.mesh.nodes)
    return displacement_from_contours(contours.seen, body, grid, start, row.law)


def imaged(pixel_size: float, folder: Path) -> dict[float, ImagePair]:
    """Make images of the shipped specimen; returns pairs with truth, by nominal strain."""
    spec = ImagingSpec(
        pixel_size, MARGIN_PX, background=0.15, speckle=SpeckleSpec(dark=0.7, bright=0.7),
        sensor=Sensor(fill_factor=1.0, psf_px=0.6), bits=8,
    )  # fmt: skip
    pairs = make_images(Solution.read(SHIPPED), spec, folder, STRAINS)
    return {pair.strain: pair for pair in pairs}


def rows(pixel_size: float, only: list[str]) -> Iterator[str]:
    """Lines of the table."""
    specimen = Solution.read(SHIPPED).specimen
    assert specimen
    with tempfile.TemporaryDirectory() as name:
        pairs = imaged(pixel_size, Path(name))
        for row in (r for r in ROWS if not only or r.name in only):
            pair = pairs[row.strain]
            assert pair.truth
            u, px = pair.truth.displacement[row.window(pair.grid.shape)], pair.grid.pixel_size
            grid = PixelGrid.centred(u.shape[0], u.shape[1], px)
            found = measured(Path(name), grid, row, 0, pair)
            u = truth(u, grid, np.deg2rad(row.turn_deg))
            off, sd, there = compared(found, u)
            ratio = waves = float("nan")
            if not (row.turn_deg or row.is_part) and row.strain > 0.1:  # unrotated, whole, buckled
                ratio, waves = against_best_fit(*refits(specimen, found, u, there, row.strain))
            line = [
                np.sqrt(np.mean(off**2)) / px, np.linalg.norm(off, axis=1).max() / px,
                100.0 * np.mean(np.abs(off) < 1.96 * sd), found.residual_rms, ratio, waves,
            ]  # fmt: skip
            cells = ("–" if np.isnan(v) else f"{v:.3g}" for v in line)
            yield f"| {row.name} | {' | '.join(cells)} |"


def compared(found: NodalResult, u: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """(p, 2) errors and standard deviations [mm], and the pixels (rows, cols) where both exist."""
    displacement = found.displacement_on()
    there = np.isfinite(u[..., 0]) & np.isfinite(displacement[..., 0])
    return (displacement - u)[there], found.standard_deviation_on()[there], there


def refits(
    specimen: Specimen, found: NodalResult, u: FloatArray, there: NDArray[np.bool_], strain: float
) -> tuple[Result, Result]:
    """The ansatz refitted to the measured displacement, and its best fit to the truth."""
    ansatz = Ansatz.square(specimen)
    best = fit_displacement(u, found.grid, ansatz, ansatz.initial_guess(strain), there)
    return refitted(found, ansatz, best.unknowns, there), best


def statistics(pixel_size: float, seeds: int) -> Iterator[str]:
    """Lines of the table of intervals."""
    specimen, row = Solution.read(SHIPPED).specimen, Row("1 % noise")
    assert specimen
    shares: dict[str, list[tuple[float, float]]] = {}
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as name:
            pair = imaged(pixel_size * (1.0 + 0.1 * seed / seeds), Path(name))[row.strain]
            found = measured(Path(name), pair.grid, row, seed)
            assert pair.truth
            u = pair.truth.displacement  # read before the folder is removed
        off, sd, there = compared(found, u)
        z = off / sd
        own, best = refits(specimen, found, u, there, row.strain)
        each = {"u": (float(np.mean(np.abs(z) < 1.96)), float(np.sqrt(np.mean(z**2))))}
        for what, value in (each | refitted_against(best, own)).items():
            shares.setdefault(what, []).append(value)
    for what, values in shares.items():
        share, ratio = np.array(values).T
        yield f"| {what} | {100 * share.mean():.1f} | {np.sqrt(np.mean(ratio**2)):.2f} |"


def against_best_fit(own: Result, best: Result) -> tuple[float, float]:
    """Relative errors against the best fit [%]: v1 phi1, and the largest of the wave vectors."""
    ansatz, box = own.ansatz, own.ansatz.modes[0].taper.cellular
    x, y = np.linspace(box.x_min, box.x_max, 200), np.linspace(box.y_min, box.y_max, 200)
    a, b = (ansatz.fluctuation(0, fit.unknowns, x[None], y[:, None]) for fit in (own, best))
    waves = [fit.unknowns[ansatz.phi_slice(0)][1:5] for fit in (own, best)]
    ratio = float((a * b).sum() / (b * b).sum()) - 1.0
    return 100.0 * ratio, 100.0 * float(np.abs(waves[0] / waves[1] - 1.0).max())


def draw(pixel_size: float, file: Path) -> None:
    """Draw both pictures of the row "middle", |u| and its error."""
    row = next(row for row in ROWS if row.name == "middle")
    with tempfile.TemporaryDirectory() as name:
        pair = imaged(pixel_size, Path(name))[row.strain]
        assert pair.truth
        u = pair.truth.displacement[row.window(pair.grid.shape)]
        grid = PixelGrid.centred(u.shape[0], u.shape[1], pixel_size)
        f, g = photographs(Path(name), row, 0)
        found = measured(Path(name), grid, row, 0)
    error = np.linalg.norm(found.displacement_on() - u, axis=-1) / pixel_size
    length = np.linalg.norm(found.displacement_on(), axis=-1)
    figure, axes = plt.subplots(1, 4, figsize=(10.0, 4.0), layout="constrained")
    shown = (
        (f, "reference", "gray", None), (g, "12.8 %", "gray", None),
        (length, "|u| [mm]", "viridis", None), (error, "|error| [px]", "magma", 0.3),
    )  # fmt: skip
    for axis, (image, title, colours, most) in zip(axes, shown, strict=True):
        drawn = axis.imshow(image, cmap=colours, vmin=None if most is None else 0.0, vmax=most)
        axis.set_title(title, fontsize=9)
        axis.axis("off")
        if colours != "gray":
            figure.colorbar(drawn, ax=axis, shrink=0.6)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm]")
    parser.add_argument("--only", nargs="*", default=[], help="names of rows")
    parser.add_argument("--seeds", type=int, default=0, help="statistics instead, of so many seeds")
    parser.add_argument("--picture", type=Path, help='a picture of "middle" instead')
    given = parser.parse_args()
    if given.picture:
        draw(given.pixel_size, given.picture)
        return
    print(f"{given.pixel_size:g} mm/px\n")
    if given.seeds:
        heads, lines = (
            ("of", "in 95 % intervals [%]", "error over its sd, rms"),
            statistics(given.pixel_size, given.seeds),
        )
    else:
        heads, lines = HEADS, rows(given.pixel_size, given.only)
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
