"""Time and memory of grading a dense displacement field.

The truth of the paper's specimen at points --spacing px apart, with noise of 0.05 px, is written as
NPZ and graded as by 'modeharvest score', report included. Result: docs/how-to/scoring.md.

Run: scripts/env python benchmarks/score_speed.py [--pixel 0.01] [--spacing 0.65] [FOLDER]

FOLDER keeps the benchmark's images, which take longest to make, for the next run.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from modeharvest.runs.benchmark import make_benchmark, score, truth_folder
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.validation.scoring.benchmark import BenchmarkTruth

STRAIN, NOISE_PX = 0.128, 0.05


def dense_field(truth: BenchmarkTruth, spacing: float, path: Path) -> int:
    """Write the truth with noise at points ``spacing`` px apart; returns their number."""
    grid = truth.grid
    row, col = np.meshgrid(
        np.arange(0, grid.rows - 1, spacing), np.arange(0, grid.cols - 1, spacing), indexing="ij"
    )
    u = truth.displacement(STRAIN, *grid.to_mm(row.ravel(), col.ravel())) / grid.pixel_size
    there = np.isfinite(u).all(axis=1)
    u = u[there] + NOISE_PX * np.random.default_rng(0).normal(size=(there.sum(), 2))
    np.savez(path, **{"x [px]": col.ravel()[there], "y down [px]": row.ravel()[there],
                      "u [px]": u[:, 0], "v down [px]": -u[:, 1]})  # fmt: skip
    return len(u)


def measure(folder: Path, pixel: float, spacing: float) -> None:
    case = Case.read("paper-virtual")
    case = case.model_copy(update={"imaging": replace(case.imaging, pixel_size=pixel)})
    make_benchmark(case, folder / "set", solution=shipped_solution("paper-virtual"))
    truth = BenchmarkTruth.read(truth_folder(folder / "set"))
    field = folder / "dense.npz"
    points = dense_field(truth, spacing, field)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    wall, cpu = time.perf_counter(), time.process_time()
    (found,) = score([field], truth.folder, STRAIN, folder / "graded").scores
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{points} points on {truth.grid.rows} x {truth.grid.cols} px: {wall:.1f} s, of them "
          f"{cpu:.1f} s on the processor; memory {after:.2f} GB at most, {before:.2f} GB before; "
          f"rms {found.everywhere.rms_px:.4f} px")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", nargs="?", type=Path, help="for the images")
    parser.add_argument("--pixel", type=float, default=0.01, help="of the images [mm]")
    parser.add_argument("--spacing", type=float, default=0.65, help="of the points [px]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure(options.folder or Path(folder), options.pixel, options.spacing)


if __name__ == "__main__":
    main()
