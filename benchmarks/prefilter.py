"""The spline's prefilter compared with SciPy's: time and difference, for three orders.

An image of random grey levels at the paper's size, float32, all threads. SciPy filters in float64,
on one thread. Times are medians of alternate rounds. Table: docs/decisions/0013-prefilter.md.

Run: scripts/env python benchmarks/prefilter.py
"""

from __future__ import annotations

import statistics
import time

import numpy as np
from scipy import ndimage, signal

from modeharvest.imaging.spline import poles, spline_coefficients

SHAPE = (2207, 2751)
ROUNDS = 3


def by_scipy(image: np.ndarray, order: int) -> np.ndarray:
    """Coefficients by ``scipy.ndimage``; of orders above 5 by ``scipy.signal``, pole by pole."""
    if order <= 5:
        return ndimage.spline_filter(image, order, np.float64, "mirror")
    found = image.astype(np.float64)
    for axis in (0, 1):
        found = np.moveaxis(found, axis, -1)
        n = found.shape[-1]
        found = np.concatenate([found, found[..., -2:0:-1]], axis=-1)  # one period
        for z in poles(order):
            gain = (1.0 - z) * (1.0 - 1.0 / z)
            for _ in (0, 1):  # a period to settle, both ways
                twice = np.concatenate([found, found], axis=-1)
                found = signal.lfilter([1.0], [1.0, -z], twice)[..., found.shape[-1] :][..., ::-1]
            found = -z * gain * found
        found = np.moveaxis(found[..., :n], -1, axis)
    return found


def main() -> None:
    image = np.random.default_rng(0).random(SHAPE, dtype=np.float32)
    print("| order | ours [s] | SciPy [s] | ours ÷ SciPy | largest difference in float64 |")
    print("|---|---|---|---|---|")
    for order in (3, 5, 11):
        laps: tuple[list[float], list[float]] = ([], [])
        for _ in range(ROUNDS + 1):
            begin = time.perf_counter()
            spline_coefficients(image, order, 0)
            middle = time.perf_counter()
            by_scipy(image, order)
            laps[0].append(middle - begin)
            laps[1].append(time.perf_counter() - middle)
        ours, theirs = (statistics.median(times[1:]) for times in laps)  # the first one compiles
        small = image[:300, :340].astype(np.float64)
        off = np.abs(spline_coefficients(small, order, 0) - by_scipy(small, order)).max()
        print(f"| {order} | {ours:.3f} | {theirs:.3f} | {ours / theirs:.2f} | {off:.1e} |")


if __name__ == "__main__":
    main()
