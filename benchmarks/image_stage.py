"""Speed and accuracy of making images, compared with interpolation of the reference image.

The shipped solution of the paper's specimen (T6) at full size, on one thread: inverse mapping of
every pixel, the points of the undeformed specimen that they show, the speckle there, and for
comparison splines through the reference image (prefilter included). All run alternately in one
process, so that other load affects all alike; times are medians. Errors are against the
trigonometric polynomial, summed term by term at some points (docs/explanation/idic.md).

Then, or with --growth alone, whole images of 1 to 50 Mpx on all threads: time and memory per pixel.
The pattern's period is 2048 px there, so that the memory is that of making images alone.

Run: scripts/env python benchmarks/image_stage.py [--growth]
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import interpolate, locate
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.imaging.spline import SplineImage
from modeharvest.runs.case import shipped_solution

STRAIN = 0.128
ROUNDS = 7
POINTS = 400
SIZES_MPX = (1, 3, 6, 12, 25, 50)
FloatArray = NDArray[np.float64]
Work = Callable[[], Any]


def in_turn(contestants: dict[str, Work]) -> dict[str, tuple[Any, float]]:
    """Results, and their median times [s] over alternate rounds after one that compiles."""
    results = {name: work() for name, work in contestants.items()}
    laps: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(ROUNDS):
        for name, work in contestants.items():
            begin = time.perf_counter()
            results[name] = work()
            laps[name].append(time.perf_counter() - begin)
    return {name: (results[name], statistics.median(laps[name])) for name in contestants}


def term_by_term(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """Fourier sum of the blurred pattern, from its samples at whole pixels alone."""
    rows, cols = speckle.period
    whole = Speckle(speckle.spec, speckle.period).image()
    coefficients = np.fft.fft2(whole) / whole.size
    k_row, k_col = np.fft.fftfreq(rows, 1 / rows), np.fft.fftfreq(cols, 1 / cols)
    along_row = np.exp(2j * np.pi * row[:, None] * k_row / rows)
    along_col = np.exp(2j * np.pi * col[:, None] * k_col / cols)
    return np.asarray(((along_row @ coefficients) * along_col).sum(axis=1).real)


def render(mesh: Mesh, u: FloatArray, grid: PixelGrid, speckle: Speckle) -> NDArray[np.float32]:
    """Image of a deformed state at pixel centres, on a black background [0 ... 1]."""
    located = locate(mesh.nodes + u, mesh.cells, mesh.element, grid, nodal=mesh.nodes)
    (x, y), mask = located.values, located.mask
    image = np.zeros(grid.shape, np.float32)
    image[mask] = speckle(*grid.to_px(x[mask], y[mask]))
    return image


def growth(mesh: Mesh, u: FloatArray) -> None:
    """Print seconds and peak memory of images of growing size.

    Memory is printed where it exceeds that of making the pattern.
    """
    speckle = Speckle(SpeckleSpec(), (2048, 2048))
    render(mesh, u, PixelGrid.centred(300, 250, 0.08), speckle)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print("| Mpx, image | Mpx, material | seconds | ns a pixel | peak memory ÷ float32 image |")
    print("|---|---|---|---|---|")
    for size in SIZES_MPX:
        rows = round((size * 1e6 * 2751 / 2207) ** 0.5)
        grid = PixelGrid.centred(rows, round(rows * 2207 / 2751), 21.8 / rows)
        seconds = []
        shown = None
        for _ in range(3):
            del shown  # or two images would be in memory
            begin = time.perf_counter()
            shown = render(mesh, u, grid, speckle)
            seconds.append(time.perf_counter() - begin)
        peak = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        pixels, least = shown.size, min(seconds)
        print(f"| {pixels / 1e6:.1f} | {(shown > 0.0).sum() / 1e6:.1f} | {least:.2f} ", end="")
        memory = f"{peak / shown.nbytes:.2f}" if peak else "-"
        print(f"| {1e9 * least / pixels:.1f} | {memory} |", flush=True)


def main() -> None:
    path = shipped_solution("paper-virtual")
    solution = Solution.read(path)
    mesh, u = solution.mesh, solution.at(STRAIN).displacement
    if "--growth" not in sys.argv:
        stages(mesh, u)
    growth(mesh, u)


def stages(mesh: Mesh, u: FloatArray) -> None:
    """Print the cost of the stages of an image, and of interpolating the reference image."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    grid = PixelGrid.centred(2207, 1651, 0.01)
    speckle = Speckle(SpeckleSpec(), grid.shape)
    image = speckle.image()

    located = locate(mesh.nodes + u, mesh.cells, mesh.element, grid)
    mask = located.mask
    x, y = interpolate(located, mesh.cells, mesh.element, mesh.nodes)
    row, col = grid.to_px(x[mask], y[mask])
    mapping: dict[str, Work] = {
        "inverse mapping": lambda: locate(mesh.nodes + u, mesh.cells, mesh.element, grid),
        "two nodal fields": lambda: interpolate(located, mesh.cells, mesh.element, mesh.nodes),
        "both at once": lambda: locate(
            mesh.nodes + u, mesh.cells, mesh.element, grid, nodal=mesh.nodes
        ),
    }
    speckles: dict[str, Work] = {
        "speckle, spline of its waves (default)": lambda: speckle(row, col),
        "speckle, non-uniform FFT to 1e-12": lambda: speckle.exact(row, col),
        "speckle, non-uniform FFT to 1e-8": lambda: speckle.exact(row, col, eps=1e-8),
        "quintic spline of the reference image": lambda: SplineImage.of(image).sample(row, col)[0],
        "cubic spline of the reference image": lambda: SplineImage.of(image, 3).sample(row, col)[0],
    }
    whole: dict[str, Work] = {
        "whole image, mapping and speckle": lambda: render(mesh, u, grid, speckle)
    }
    found = in_turn(mapping | speckles | whole)
    some = np.random.default_rng(0).choice(row.size, POINTS, replace=False)
    truth = term_by_term(speckle, row[some], col[some])
    errors = {
        "inverse mapping": f"{located.max_residual_px:.1e} px",
        "two nodal fields": "-",
        "both at once": "-",
    }
    for name in speckles:
        errors[name] = f"{abs(found[name][0][some] - truth).max():.1e} of full scale"
    (name,) = whole
    shown = found[name][0][mask][some]
    errors[name] = f"{abs(shown - truth).max():.1e} of full scale (float32)"
    print(f"{grid.rows} x {grid.cols} px, {row.size / 1e6:.2f} Mpx of them material, ", end="")
    print(f"{len(mesh.cells)} {mesh.element} cells at a strain of {100 * STRAIN:.1f} %")
    print(f"proved bound of the default's error: {speckle.spline.bound:.1e} of full scale\n")
    print("| one thread | Mpx/s | cubic spline = 1 | largest error |\n|---|---|---|---|")
    cubic = found["cubic spline of the reference image"][1]
    for name, (_, seconds) in found.items():
        print(f"| {name} | {row.size / seconds / 1e6:.1f} ", end="")
        print(f"| {cubic / seconds:.2f} | {errors[name]} |")
    print()
    numba.set_num_threads(threads)


if __name__ == "__main__":
    main()
