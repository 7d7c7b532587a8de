"""A small benchmark whose truth is a formula, shared by the tests of scores; no dolfinx."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from perforated import PITCH, SQUARE, holed_cell

from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.runs.benchmark import make_benchmark
from modeharvest.validation.scoring.benchmark import BenchmarkTruth

FloatArray = NDArray[np.float64]

STRAIN, PIXEL = 0.05, 0.04
SPECIMEN = Specimen(holes_x=2, holes_y=3, bulk_x=0.0, bulk_y=0.0)
CASE = f"""
[experiment]
strains = [{STRAIN}]
[experiment.specimen]
holes_x = 2
holes_y = 3
bulk_x = 0.0
bulk_y = 0.0
[imaging]
pixel_size = {PIXEL}
margin_px = 6
"""


def wavy(x: ArrayLike, y: ArrayLike) -> FloatArray:
    """(n, 2) compression along x and a pattern without any symmetry [mm]."""
    x, y = np.asarray(x), np.asarray(y)
    u = -0.05 * x + 0.08 * np.sin(1.3 * x + 1.7 * y + 0.4)
    v = 0.02 * y + 0.03 * x + 0.06 * np.cos(1.1 * x - 1.6 * y + 0.2) + 0.05
    return np.stack([u, v], axis=-1)


def affine(x: ArrayLike, y: ArrayLike) -> FloatArray:
    """(n, 2) that every isoparametric element holds exactly [mm]."""
    x, y = np.asarray(x), np.asarray(y)
    return np.stack([0.01 - 0.05 * x + 0.03 * y, -0.02 + 0.04 * x + 0.02 * y], axis=-1)


def solution(field: Any = wavy, divisions: int = 8) -> Solution:
    """The specimen, displaced by a formula at its nodes."""
    centre = (-0.5 * PITCH, -PITCH)
    mesh = holed_cell(SQUARE, divisions, (2, 3), radius=0.75, centre=centre)
    return Solution(mesh, (Snapshot(STRAIN, field(*mesh.nodes.T)),))


def make(folder: Path) -> tuple[Path, Path]:
    """Public folder and truth of the wavy specimen."""
    case, file = folder / "case.toml", folder / "solution.h5"
    case.write_text(CASE, "utf-8")
    solution().write(file)
    make_benchmark(case, folder / "set", solution=file)
    return folder / "set", folder / "set-truth"


def points(truth: BenchmarkTruth, step: int = 2) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x, y (n,) on the material, every ``step`` px, and u (n, 2), the truth there [mm]."""
    row, col = np.mgrid[1 : truth.grid.rows : step, 0 : truth.grid.cols : step]
    x, y = truth.grid.to_mm(row[truth.mask[row, col]], col[truth.mask[row, col]])
    return x, y, truth.displacement(STRAIN, x, y)
