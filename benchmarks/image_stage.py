"""How fast images are made, and how exact they are beside interpolating the reference image.

The shipped solution of the paper's specimen (T6) at full size, on one thread in one process:
the inverse mapping of every pixel, then the speckle at the mapped points by a non-uniform FFT,
and what is often done instead, a spline through the reference image (prefilter included). The
truth of the errors is the trigonometric polynomial itself, summed term by term at some points.

Run: scripts/env python benchmarks/image_stage.py
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from modeharvest.case import shipped_solution
from modeharvest.fem.field import Solution
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import SplineImage
from modeharvest.imaging.isoparametric import interpolate, locate
from modeharvest.imaging.speckle import Speckle, SpeckleSpec

STRAIN = 0.128
REPEATS = 5
POINTS = 400
FloatArray = NDArray[np.float64]
T = TypeVar("T")


def median(work: Callable[[], T]) -> tuple[T, float]:
    """What the work gives, and the median seconds of some runs after one that compiles."""
    result, laps = work(), []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        result = work()
        laps.append(time.perf_counter() - begin)
    return result, statistics.median(laps)


def term_by_term(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """Fourier sum of the blurred pattern, from its samples at whole pixels alone."""
    rows, cols = speckle.period
    whole = Speckle(speckle.spec, speckle.period).image()
    coefficients = np.fft.fft2(whole) / whole.size
    k_row, k_col = np.fft.fftfreq(rows, 1 / rows), np.fft.fftfreq(cols, 1 / cols)
    along_row = np.exp(2j * np.pi * row[:, None] * k_row / rows)
    along_col = np.exp(2j * np.pi * col[:, None] * k_col / cols)
    return np.asarray(((along_row @ coefficients) * along_col).sum(axis=1).real)


def main() -> None:
    numba.set_num_threads(1)
    path = shipped_solution("paper-virtual")
    assert path is not None, "the case ships its solution"
    solution = Solution.read(path)
    mesh, u = solution.mesh, solution.at(STRAIN).displacement
    grid = PixelGrid.centred(2207, 1651, 0.01)
    speckle = Speckle(SpeckleSpec(), grid.shape)
    image = speckle.image()

    located, mapping = median(lambda: locate(mesh.nodes + u, mesh.cells, mesh.element, grid))
    mask = located.mask
    point = interpolate(located, mesh.cells, mesh.element, mesh.nodes)
    row, col = grid.to_px(point[0][mask], point[1][mask])
    ways: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
        "non-uniform FFT, eps 1e-12 (default)": speckle,
        "non-uniform FFT, eps 1e-6": lambda r, c: speckle(r, c, eps=1e-6),
        "quintic spline of the reference image": lambda r, c: SplineImage.of(image).sample(r, c)[0],
        "cubic spline of the reference image": lambda r, c: SplineImage.of(image, 3).sample(r, c)[
            0
        ],
    }
    some = np.random.default_rng(0).choice(row.size, POINTS, replace=False)
    truth = term_by_term(speckle, row[some], col[some])
    megapixels = row.size / 1e6
    print(f"{grid.rows} x {grid.cols} px, {megapixels:.2f} Mpx of them material, ", end="")
    print(f"{len(mesh.cells)} {mesh.element} cells at a strain of {100 * STRAIN:.1f} %\n")
    print("| one thread | Mpx/s | largest error |\n|---|---|---|")
    residual = f"{located.max_residual_px:.1e} px"
    print(f"| inverse mapping, {mesh.element} | {megapixels / mapping:.1f} | {residual} |")
    for name, way in ways.items():
        value, seconds = median(lambda way=way: way(row, col))
        error = abs(value[some] - truth).max()
        print(f"| {name} | {megapixels / seconds:.1f} | {error:.1e} of full scale |")


if __name__ == "__main__":
    main()
