"""How the cost of a correlation grows with the number of pixels and the degree of polynomials.

The paper's ansatz is correlated on images of 1 to 50 Mpx of the same specimen, with material
everywhere and a pattern of 10 px. f is sampled from the spline of g at the true displacement, and
noise is added to both. The start has the applied strain, as in the paper, and is some 3 px off.
Times include checks, pyramid, iterations and assessment; memory is the peak allocated beside the
input. Degrees of 3 to 12 are compared at 4 Mpx. Results: docs/explanation/idic.md.

Run: scripts/env python benchmarks/correlation_size.py [--quick] [--save FILE.json]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import square_family
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.assembly import Assembly, residual
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions
from modeharvest.idic.solver.pyramid import blurred
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage

HEIGHT_MM, ASPECT, STRAIN = 22.07, 0.8, 0.05
OFF_PX, NOISE, LAPS = 1.0, 0.5, 3
MPX, QUICK_MPX = (1, 2, 4, 8, 16, 32, 50), (0.1, 0.2, 0.4)
DEGREES = tuple(range(3, 13))
PAPER = Ansatz.on(Box.centred(17.7, 22.1), [(square_family(), Box.centred(11.4, 19.0))], 1.9)
Image = NDArray[np.float32]
Row = dict[str, Any]


class Pair:
    """Two images of ``mpx`` megapixels, with mask and initial guess."""

    def __init__(self, mpx: float, ansatz: Ansatz) -> None:
        rows = round(np.sqrt(1e6 * mpx / ASPECT))
        self.grid = PixelGrid.centred(rows, round(ASPECT * rows), HEIGHT_MM / rows)
        self.ansatz, self.start = ansatz, ansatz.initial_guess(STRAIN, 1.0)
        rng = np.random.default_rng(0)
        smooth = blurred(rng.standard_normal(self.grid.shape, dtype=np.float32), 3.0)
        g = 128.0 + 50.0 * smooth / smooth.std()
        everywhere = np.ones(self.grid.shape, dtype=np.bool_)
        assembly = Assembly(ansatz, self.grid, everywhere)
        f = -residual(assembly, self._truth(rng), np.zeros_like(g), SplineImage.of(g))
        self.mask = np.isfinite(f)
        self.f, self.g = np.nan_to_num(f, nan=128.0), g
        for image in (self.f, self.g):
            image += NOISE * rng.standard_normal(image.shape, dtype=np.float32)

    def _truth(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """True unknowns: the start with its low orders changed by about a pixel each."""
        a, step = self.start.copy(), OFF_PX * self.grid.pixel_size
        for c in (0, 1):
            a[self.ansatz.v0_slice(c)][:6] += step * rng.normal(size=6)
        a[self.ansatz.v_slice(0)][:6] += step / 0.02 * rng.normal(size=6)
        return a

    def correlate(self, options: CorrelationOptions | None = None) -> Result:
        """Correlate from the start to convergence."""
        return correlate(
            ImagePair(self.f, self.g, self.grid, self.mask),
            self.ansatz,
            guess=self.start,
            options=options,
        )

    def peak_images(self) -> float:
        """Peak memory that a correlation allocates [float32 images of this size]."""
        # The memory doesn't depend on the number of iterations.
        options = CorrelationOptions(gauss_newton=GaussNewtonOptions(max_iterations=1))
        tracemalloc.start()
        self.correlate(options)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak / self.f.nbytes


def median_s(work: Callable[[], object], laps: int = LAPS) -> float:
    """Median wall-clock time of some laps [s]."""
    seconds = []
    for _ in range(laps):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def measured(mpx: float, ansatz: Ansatz) -> Row:
    """Measure one row of either table."""
    pair = Pair(mpx, ansatz)
    result = pair.correlate()
    pixels = int(pair.mask.sum())
    assembly, spline = Assembly(ansatz, pair.grid, pair.mask), SplineImage.of(pair.g)

    def assembled(with_matrix: bool) -> float:
        seconds = median_s(lambda: assembly.images(result.unknowns, pair.f, spline, with_matrix))
        return 1e9 * seconds / pixels

    images = pair.peak_images()
    return {
        "mpx": pair.f.size / 1e6,
        "degree": ansatz.v_degree,
        "unknowns": ansatz.size,
        "outcome": result.outcome.value,
        "residual_rms": result.residual_rms,
        "steps": [sum(h.factor == k for h in result.history) for k in (8, 4, 2, 1)],
        "seconds": median_s(pair.correlate),
        "gradient_ns": assembled(False),
        "matrix_ns": assembled(True),
        "images": images,
        "mib": images * pair.f.nbytes / 2**20,
    }


def shown(rows: list[Row]) -> None:
    """Print a table."""
    print(
        "| Mpx | degree | unknowns | outcome | residual [grey levels] | steps, coarse to fine "
        "| start to end [s] | µs/px | gradient [ns/px] | and J'J [ns/px] "
        "| memory [float32 images] | [MiB] |"
    )
    print("|" + "---|" * 12)
    for r in rows:
        print(
            f"| {r['mpx']:.3g} | {r['degree']} | {r['unknowns']} | {r['outcome']} "
            f"| {r['residual_rms']:.3f} | {' '.join(map(str, r['steps']))} | {r['seconds']:.2f} "
            f"| {r['seconds'] / r['mpx']:.3f} | {r['gradient_ns']:.1f} | {r['matrix_ns']:.1f} "
            f"| {r['images']:.1f} | {r['mib']:.0f} |"
        )


def exponent(rows: list[Row], of: str, over: str) -> float:
    """Exponent of the power law between two columns: slope of their logarithms."""
    x, y = (np.log([r[key] for r in rows]) for key in (over, of))
    return float(np.polyfit(x, y, 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it works")
    parser.add_argument("--save", type=Path, help="the numbers as JSON")
    arguments = parser.parse_args()
    threads, load = numba.get_num_threads(), os.getloadavg()[0]
    print(f"{threads} threads; {load:.1f} processes were running before\n")
    by_pixels = [measured(mpx, PAPER) for mpx in (QUICK_MPX if arguments.quick else MPX)]
    shown(by_pixels)
    slope = exponent(by_pixels, "seconds", "mpx")
    print(f"\nseconds grow as the pixels to the power of {slope:.2f}\n")
    degrees = DEGREES[::3] if arguments.quick else DEGREES
    ansatzes = [replace(PAPER, v0_degree=d, v_degree=d) for d in degrees]
    by_degree = [measured(0.2 if arguments.quick else 4, ansatz) for ansatz in ansatzes]
    shown(by_degree)
    slope = exponent(by_degree, "seconds", "unknowns")
    print(f"\nseconds grow as the unknowns to the power of {slope:.2f}")
    if arguments.save:
        numbers = {"threads": threads, "load": load, "pixels": by_pixels, "degree": by_degree}
        arguments.save.write_text(json.dumps(numbers, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
