"""Harvest of a sequence of photographs with large strains, in both formulations.

A specimen of 4 x 4 holes is stretched step by step, with a pattern and a w that grow with the
strain. Photographs are those of the tests (``tests/synthetic_photographs.py``), 8 bit, noise of 1 %
of their contrast. Printed for every state are the largest stretch of the material less 1, the
outcome, rms distances per component [px] of the result and of the refitted ansatz from the best fit
of the ansatz, and errors of the whole displacement. Table: docs/explanation/whole_field_speckle.md.

Run: scripts/env python benchmarks/large_strain.py [--step 0.1] [--last 0.7]
     [--out out/large_strain]
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from synthetic_photographs import FloatArray, Photographed, lattice_points

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.modes import square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.validation.truth import rms

PITCH, PIXEL = 1.9, 0.03
CELLULAR, DOMAIN = Box.centred(4 * PITCH, 4 * PITCH), Box.centred(4 * PITCH + 1.6, 4 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, PITCH / 2))
ANSATZ = Ansatz.on(DOMAIN, [(square_family("junction"), CELLULAR)], PITCH)
PHOTOGRAPHED = Photographed(PixelGrid.centred(360, 640, PIXEL), DOMAIN, HOLES, 1.3)
W_PX, PATTERN = 1.5, 3.0
"""Amplitudes of w [px] and of v1 [mm] at a strain of 1."""


def truth(strain: float, points: FloatArray) -> FloatArray:
    """(..., 2) displacement at points (..., 2) [mm]: longer along x, narrower along y, v1, w."""
    a = ANSATZ.initial_guess(0.0, strain * PATTERN)
    pattern = ANSATZ.displacement_at(a, points.reshape(-1, 2)).reshape(points.shape)
    x, y = np.moveaxis(2.0 * np.pi * points / PITCH, -1, 0)
    w = strain * W_PX * PIXEL * np.stack([np.sin(y), np.sin(x)], axis=-1)
    return np.asarray(strain * np.array([1.0, -0.3]) * points + pattern + w)


def largest_strain(strain: float) -> float:
    """Largest stretch of the reference's material less 1 [-]."""
    points, h = PHOTOGRAPHED.points[PHOTOGRAPHED.mask], 1e-4
    along = [(truth(strain, points + d) - truth(strain, points - d)) / (2 * h)
             for d in h * np.eye(2)]  # fmt: skip
    F = np.eye(2) + np.stack(along, axis=-1)
    return float(np.linalg.svd(F, compute_uv=False).max() - 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--step", type=float, default=0.1)
    parser.add_argument("--last", type=float, default=0.7)
    parser.add_argument("--out", type=Path, default=Path("out/large_strain"))
    given = parser.parse_args()
    strains = np.arange(1, round(given.last / given.step) + 1) * given.step
    states = {f"frame_{100 * e:03.0f}": float(e) for e in strains}
    shutil.rmtree(given.out, ignore_errors=True)
    given.out.mkdir(parents=True)
    PHOTOGRAPHED.save(given.out, {n: lambda p, e=e: truth(e, p) for n, e in states.items()})
    print(
        "formulation  strain  largest  outcome        ansatz   refit  whole: rms  longest  covered"
    )
    for formulation in ("total", "updated"):
        path = given.out / f"{formulation}.toml"
        path.write_text(
            '[images]\nreference = "reference.tif"\ndeformed = ["frame*.tif"]\n'
            f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
            f'[correlation]\nv0_degree = 2\nv_degree = 1\nformulation = "{formulation}"\n'
            "[whole_field]\nmeasure = true\n",
            "utf-8",
        )
        run = HarvestRun(PhotographCase.read(path), given.out / formulation)
        found, failed = run.results(), dict(run.failures())
        for name, strain in states.items():
            head = f"{formulation:11}  {strain:6.2f}  {largest_strain(strain):7.2f}"
            if name not in found:
                print(f"{head}  {failed[name]}")
                continue
            result, whole, mask = found[name].result, found[name].whole, PHOTOGRAPHED.mask
            true = truth(strain, PHOTOGRAPHED.points)
            best = fit_displacement(true, PHOTOGRAPHED.grid, result.ansatz, result.unknowns, mask)
            off = rms((result.displacement() - best.displacement())[mask]) / PIXEL
            line = f"{head}  {result.outcome.value:13} {off:7.3f}"
            if whole is not None:
                refit = rms((whole.refit.displacement() - best.displacement())[mask]) / PIXEL
                error = (whole.measured.displacement_on() - true)[mask] / PIXEL
                there = error[np.isfinite(error[:, 0])]
                longest = np.linalg.norm(there, axis=1).max()
                share = 100.0 * len(there) / len(error)
                line += f" {refit:7.3f} {rms(there):10.3f} {longest:8.2f} {share:7.1f} %"
                line += f"  from {whole.start}"
            print(line, *(w[:90] for w in found[name].warnings[-1:]), flush=True)


if __name__ == "__main__":
    main()
