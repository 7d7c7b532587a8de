"""Effect of resampling noisy images once before their correlation.

Monte Carlo over noise: images of an exactly known motion, with a perfect lens, or seen through a
lens and resampled (`undistorted`), are correlated with an ansatz that holds the motion. Printed are
the mean error of the displacement, its scatter, and the prediction from the camera's noise (rms
over the image [px]), and the residual's variance over that of the noise in both images; then the
same with both images blurred by 0.7 px. Table: docs/decisions/0006-distortion.md.

Run: scripts/env python benchmarks/undistortion_noise.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.pyramid import Level
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.imaging.distortion.fit import sampled_correlations
from modeharvest.imaging.distortion.lens import CameraDistortion, undistorted
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]

SEEDS = 100
GRID = PixelGrid.centred(200, 240, 0.01)
ANSATZ = Ansatz(Box.centred(2.4, 2.0), v0_degree=3)
LENS = CameraDistortion(300.0, 300.0, 118.0, 103.0, k1=-0.1, p1=2e-3)  # S up to 9 px
INNER = slice(15, -15)
MARGIN = 50


def moved_back(unknowns: FloatArray, row: FloatArray, col: FloatArray) -> tuple[FloatArray, ...]:
    """The points that the motion brings to (row, col) [px], by fixed-point iteration."""
    at_row, at_col = row, col
    for _ in range(60):
        x, y = GRID.to_mm(at_row, at_col)
        u = ANSATZ.displacement_at(unknowns, np.stack([x, y], -1)) / GRID.pixel_size
        at_row, at_col = row + u[..., 1], col - u[..., 0]
    return at_row, at_col


def exact_pair(unknowns: FloatArray, lens: CameraDistortion | None) -> tuple[FloatArray, ...]:
    """Reference and deformed image without noise."""
    speckle = Speckle(SpeckleSpec(seed=3), (GRID.rows + 2 * MARGIN, GRID.cols + 2 * MARGIN))
    seen = np.indices(GRID.shape, dtype=np.float64)
    ideal = seen if lens is None else lens.ideal(*seen)
    back = moved_back(unknowns, *ideal)
    return tuple(speckle(row + MARGIN, col + MARGIN) for row, col in (ideal, back))


def trial(lens: CameraDistortion | None, noise: float, blur: float, size_mm: float) -> str:
    """Repeat a measurement with other noise; returns a row of the table."""
    unknowns = np.random.default_rng(1).normal(0.0, size_mm, ANSATZ.size)
    images = exact_pair(unknowns, lens)
    mask = np.zeros(GRID.shape, dtype=np.bool_)
    mask[INNER, INNER] = True
    options = CorrelationOptions(levels=(Level(1, 0.0),))
    found, residual = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(100 + seed)
        noisy = [image + noise * rng.normal(size=GRID.shape) for image in images]
        if lens is not None:
            noisy = [undistorted(image, lens) for image in noisy]
        if blur > 0.0:
            noisy = [ndimage.gaussian_filter(image, blur) for image in noisy]
        f, g = noisy
        result = correlate(ImagePair(f, g, GRID, mask), ANSATZ, guess=unknowns, options=options)
        found.append(result.unknowns)
        residual.append(result.residual_rms**2 / (2 * noise**2))
    x, y = GRID.x[INNER][::5], GRID.y[INNER][::5]
    fields = np.array([ANSATZ.displacement(a, x, y) for a in found]) / GRID.pixel_size
    truth = ANSATZ.displacement(unknowns, x, y) / GRID.pixel_size
    mean_error = np.sqrt(np.mean((fields.mean(axis=0) - truth) ** 2))
    scatter = np.sqrt(np.mean(fields.var(axis=0, ddof=1)))
    # The prediction is for white noise; blurred noise isn't.
    sd = field_errors(result, x, y, result.covariance(noise)).displacement
    predicted = np.sqrt(np.mean(sd**2)) / GRID.pixel_size
    words = "" if blur > 0.0 else f"{predicted:.4f}"
    name = "lens" if lens else "perfect"
    return (
        f"| {name} | {100 * noise:g} % | {abs(truth).max():.1f} | {blur:g} "
        f"| {mean_error:.4f} | {scatter:.4f} | {words} | {np.mean(residual):.3f} |"
    )


def undistorted_noise(order: int = 5) -> tuple[float, float]:
    """Variance of white noise of variance 1 in an undistorted image, and after sampling that again.

    The residual of two undistorted images has the first in f and the second in g: its variance is
    their sum times that of the camera's noise. The unknowns depend on longer waves, of which no
    noise is lost: their covariance is that of the camera's noise itself.

    Parameters
    ----------
    order
        Of both splines, 3 or 5.
    """
    _, correlations = sampled_correlations(0.0, order, 1.0)
    once = float(correlations.max())
    # Noise with correlations R, sampled at any phase: sum over lags of R R.
    return once**2, float((correlations**2).sum()) ** 2


def noise_free(lens: CameraDistortion | None) -> float:
    """Rms error of the displacement without noise [px]."""
    unknowns = np.random.default_rng(1).normal(0.0, 0.004, ANSATZ.size)
    images = exact_pair(unknowns, lens)
    if lens is not None:
        images = tuple(undistorted(image, lens) for image in images)
    mask = np.zeros(GRID.shape, dtype=np.bool_)
    mask[INNER, INNER] = True
    options = CorrelationOptions(levels=(Level(1, 0.0),))
    f, g = images
    result = correlate(ImagePair(f, g, GRID, mask), ANSATZ, guess=unknowns, options=options)
    off = ANSATZ.displacement(result.unknowns - unknowns, GRID.x[INNER], GRID.y[INNER])
    return float(np.sqrt(np.mean(off**2)) / GRID.pixel_size)


def main() -> None:
    print(f"without noise: perfect {noise_free(None):.0e} px, lens {noise_free(LENS):.0e} px")
    once, twice = undistorted_noise()
    print(f"predicted residual: perfect {0.5 * (1 + once):.3f}, lens {0.5 * (once + twice):.3f}\n")
    print("| lens | noise | motion | blur | mean error | scatter | predicted | residual |")
    print("|---|---|---|---|---|---|---|---|")
    for blur in (0.0, 0.7):
        for noise, size in ((0.01, 0.004), (0.01, 0.04), (0.03, 0.004)):
            for lens in (None, LENS):
                print(trial(lens, noise, blur, size), flush=True)


if __name__ == "__main__":
    main()
