"""What a Gauss-Newton iteration costs, in bicubic samplings of the same pixels.

Both run on one thread in one process, so that the ratio means something on a busy machine; the
bound of the design is 5. An iteration samples value and gradient by a quintic spline, assembles
and solves the normal equations of 77 unknowns.

Run: python benchmarks/gauss_newton_iteration.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numba
import numpy as np
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.gauss_newton import ScaledEigen
from modeharvest.idic.normal_equations import Assembly
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.interpolation import SplineImage, sample_points

REPEATS = 7


def fastest(work: Callable[[], object]) -> float:
    """Seconds of the fastest of several runs, after one that compiles."""
    work()
    laps = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        laps.append(time.perf_counter() - begin)
    return min(laps)


def material(grid: PixelGrid) -> np.ndarray:
    """The paper's 6 x 10 holes."""
    x, y = np.meshgrid(grid.x, grid.y)
    holes = np.hypot(x % 1.9 - 0.95, y % 1.9 - 0.95) < 0.75
    cellular = (abs(x) < 5.7) & (abs(y) < 9.5)
    return (abs(x) < 7.6) & (abs(y) < 10.4) & ~(holes & cellular)


def main() -> None:
    numba.set_num_threads(1)
    grid = PixelGrid.centred(2207, 1651, 0.01)
    mask = material(grid)
    noise = np.random.default_rng(0).normal(size=(2, *grid.shape))
    f, g = (ndimage.gaussian_filter(image, 3.0) for image in noise)
    ansatz = Ansatz.square(Box.centred(15.2, 20.8), Box.centred(11.4, 19.0), 1.9)
    a, quintic, cubic = ansatz.start(0.02), SplineImage.of(g, 5), SplineImage.of(g, 3)
    assembly = Assembly(ansatz, grid, mask)

    def iteration() -> None:
        equations = assembly.images(a, f, quintic)
        ScaledEigen.of(equations.matrix).solve(equations.gradient)

    u = ansatz.displacement(a, grid.x, grid.y)[mask] / grid.pixel_size
    row, col = np.nonzero(mask)
    row, col = row - u[:, 1], col + u[:, 0]
    out = [np.empty(row.size) for _ in range(3)]

    def sampling(spline: SplineImage) -> None:
        sample_points(spline.coefficients, spline.order, row, col, row.size, *out)

    ns = 1e9 / row.size
    bicubic = ns * fastest(lambda: sampling(cubic))
    biquintic = ns * fastest(lambda: sampling(quintic))
    whole = ns * fastest(iteration)
    print(f"pixels of material            {row.size}")
    print(f"bicubic value and gradient    {bicubic:6.1f} ns/px")
    print(f"quintic value and gradient    {biquintic:6.1f} ns/px")
    print(f"Gauss-Newton iteration        {whole:6.1f} ns/px")
    print(f"ratio to bicubic              {whole / bicubic:6.2f}  (bound: 5)")


if __name__ == "__main__":
    main()
