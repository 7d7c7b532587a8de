"""Cost of a Gauss-Newton iteration, in samplings of the same pixels; memory of a correlation.

An iteration samples value and gradient, assembles and solves the normal equations; here at the
paper's image size, with 77 unknowns, on one thread. The unit of time is one bicubic sampling of
value and gradient by this package, tap after tap; the bound is 3 units. All run alternately in one
process, and medians of processor times are compared, so that ratios hold on a busy machine. Memory
is in float32 images. Tables: docs/explanation/idic.md.

Run: scripts/env python benchmarks/gauss_newton_iteration.py
"""

from __future__ import annotations

import statistics
import time
import tracemalloc
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import square_family
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.assembly import Assembly
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage, sample_points
from modeharvest.util.scaled_eigen import ScaledEigen

REPEATS = 7
GRID = PixelGrid.centred(2207, 1651, 0.01)
Image = NDArray[np.float64]
Work = Callable[[], object]


def medians(contestants: dict[str, Work]) -> dict[str, float]:
    """Processor time of each [s]: the median of some alternate laps after one that compiles."""
    laps: dict[str, list[float]] = {name: [] for name in contestants}
    for repeat in range(REPEATS + 1):
        for name, work in contestants.items():
            begin = time.thread_time()
            work()
            if repeat > 0:
                laps[name].append(time.thread_time() - begin)
    return {name: statistics.median(seconds) for name, seconds in laps.items()}


def material() -> NDArray[np.bool_]:
    """(rows, cols) True on the material of the paper's specimen with 6 x 10 holes."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    holes = np.hypot(x % 1.9 - 0.95, y % 1.9 - 0.95) < 0.75
    cellular = (abs(x) < 5.7) & (abs(y) < 9.5)
    return (abs(x) < 7.6) & (abs(y) < 10.4) & ~(holes & cellular)


def contestants(
    ansatz: Ansatz, f: Image, g: Image, mask: NDArray[np.bool_]
) -> tuple[dict[str, Work], int]:
    """The calls that are compared, and the number of pixels that each samples."""
    a = ansatz.initial_guess(0.02)
    quintic, cubic = SplineImage.of(g, 5), SplineImage.of(g, 3)
    assembly = Assembly(ansatz, GRID, mask)
    u = ansatz.displacement(a, GRID.x, GRID.y)[mask] / GRID.pixel_size
    row, col = np.nonzero(mask)
    row, col = row - u[:, 1], col + u[:, 0]
    out = [np.empty(row.size) for _ in range(3)]
    filtered = ndimage.spline_filter(g, order=3, mode="mirror")
    slopes = [ndimage.spline_filter(d, order=3, mode="mirror") for d in np.gradient(g)]

    f = f.astype(np.float32)
    matrix = assembly.images(a, f, quintic).matrix

    def iterate(spline: SplineImage, with_matrix: bool) -> None:
        equations = assembly.images(a, f, spline, with_matrix)
        found = equations.matrix if with_matrix else matrix
        ScaledEigen.of(found).solve(equations.gradient)

    def sample(spline: SplineImage) -> None:
        sample_points(spline.coefficients, spline.order, row, col, row.size, *out)

    def scipy_three() -> None:
        for image in (filtered, *slopes):
            ndimage.map_coordinates(image, [row, col], order=3, mode="mirror", prefilter=False)

    found: dict[str, Work] = {
        "bicubic value and gradient": lambda: sample(cubic),
        "quintic value and gradient": lambda: sample(quintic),
        "scipy, order 3: value and two gradient images": scipy_three,
        "iteration with the matrix assembled, cubic": lambda: iterate(cubic, True),
        "iteration with the matrix assembled, quintic (default)": lambda: iterate(quintic, True),
        "iteration with secants, cubic": lambda: iterate(cubic, False),
        "iteration with secants, quintic (default)": lambda: iterate(quintic, False),
    }
    return found, int(row.size)


def peak_memory(ansatz: Ansatz, f: Image, g: Image, mask: NDArray[np.bool_]) -> float:
    """Peak memory of a whole correlation beside its input [float32 images of this size]."""
    # The memory doesn't depend on the number of iterations.
    options = CorrelationOptions(gauss_newton=GaussNewtonOptions(max_iterations=1))
    images = f.astype(np.float32), g.astype(np.float32)
    tracemalloc.start()
    correlate(
        ImagePair(*images, GRID, mask, mask),
        ansatz,
        guess=ansatz.initial_guess(0.001, 0.1),
        options=options,
    )
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak / images[0].nbytes


def main() -> None:
    numba.set_num_threads(1)
    mask = material()
    noise = np.random.default_rng(0).normal(size=(2, *GRID.shape))
    f, g = (ndimage.gaussian_filter(image, 3.0) for image in noise)
    ansatz = Ansatz.on(Box.centred(15.2, 20.8), [(square_family(), Box.centred(11.4, 19.0))], 1.9)
    to_compare, pixels = contestants(ansatz, f, g, mask)
    seconds = medians(to_compare)
    unit = seconds["bicubic value and gradient"]
    print(f"{GRID.rows} x {GRID.cols} px, {pixels} of them material; {ansatz.size} unknowns\n")
    print("| one thread | ns/px | bicubic samplings |\n|---|---|---|")
    for name, s in seconds.items():
        print(f"| {name} | {1e9 * s / pixels:.1f} | {s / unit:.2f} |")
    print("\nbound: 3 bicubic samplings")
    print(f"peak memory of a correlation: {peak_memory(ansatz, f, g, mask):.0f} float32 images")


if __name__ == "__main__":
    main()
