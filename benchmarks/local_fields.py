"""Errors of local displacement fields, and of the initial guesses that are made from them.

    scripts/env python benchmarks/local_fields.py [--pixel-size 0.02] [--subset 21] [--filling 1]

The paper's specimen before and after buckling, 8-bit images. Fields: the optical flow used without
local DIC, and pyvale's subsets if MODEHARVEST_PYVALE names its Python (docs/how-to/fields.md).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from functools import partial

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.subsets import SubsetOptions, pyvale_python, subset_field
from modeharvest.idic.photograph.initial_guess import InitialGuess, initial_guess
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import shipped_solution
from modeharvest.util.errors import MissingDependencyError

CELL, CELLULAR = 1.9, Box.centred(11.4, 19.0)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def local(images: ImageSet, strain: float, subsets: SubsetOptions) -> LocalField | None:
    """Measure pyvale's field; None without pyvale."""
    try:
        pyvale_python()
    except MissingDependencyError as missing:
        print(f"no subsets: {missing}")
        return None
    begin = time.perf_counter()
    field = subset_field(images.pair(strain, camera=True), subsets)
    print(f"{field.source}: {time.perf_counter() - begin:.0f} s")
    return field


def tell(
    images: ImageSet, strain: float, field: LocalField, start: InitialGuess, found: Result
) -> None:
    """Print the errors of a field and of the guess from it, in px per component."""
    truth, grid, mask = images.truth(strain).displacement, images.grid, images.mask()
    x, y, u = field.valid_points()
    row, col = (np.rint(i).astype(int) for i in grid.to_px(x, y))
    error = (u - truth[row, col])[mask[row, col]] / grid.pixel_size
    size = np.abs(error)
    print(f"strain {strain}, {field.source}: {field.x.size} points, {field.valid_share:.1%} valid")
    print(f"  error: rms {rms(error):.3f}, median {np.median(size):.3f}, "
          f"95 % {np.quantile(size, 0.95):.2f}, largest {size.max():.1f} px")  # fmt: skip
    off = (start.ansatz.displacement(start.unknowns, grid.x, grid.y) - truth)[mask]
    w = (found.displacement() - truth)[mask]
    print(f"  start: {start.family}, off by {rms(off) / grid.pixel_size:.2f} px; "
          f"{found.outcome.name.lower()} in {len(found.history)} steps, "
          f"w {rms(w) / grid.pixel_size:.4f} px")  # fmt: skip
    if field.sd is None:
        return
    sd = field.sd[field.good] / grid.pixel_size
    inside = np.mean(size < 1.96 * sd[mask[row, col]])
    left = field.less(partial(start.ansatz.displacement_at, found.unknowns))
    at = truth[row, col] - start.ansatz.displacement_at(found.unknowns, np.column_stack([x, y]))
    print(f"  predicted sd: rms {rms(sd):.3f} px; {inside:.1%} of errors within 1.96 of them")
    print(f"  w at the points: measured {left.rms / grid.pixel_size:.3f}, beyond its sd "
          f"{left.rms_beyond_noise / grid.pixel_size:.3f}, "
          f"true {rms(at[mask[row, col]]) / grid.pixel_size:.3f} px")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.02, help="[mm/px]")
    parser.add_argument("--strains", type=float, nargs="+", default=[0.078, 0.128])
    parser.add_argument("--subset", type=int, default=21, help="edge of a subset [px]")
    parser.add_argument("--filling", type=float, default=1.0, help="least share of material [-]")
    options = parser.parse_args()
    subsets = SubsetOptions(subset_px=options.subset, filling=options.filling, threads=1)
    solution = Solution.read(shipped_solution("paper-virtual"))
    with tempfile.TemporaryDirectory() as folder:
        spec = ImagingSpec(pixel_size=options.pixel_size)
        images = make_images(solution, spec, folder, options.strains)
        for strain in images.strains:
            pair = images.pair(strain, camera=True)
            measured = local(images, strain, subsets)
            for field in (None,) if measured is None else (None, measured):
                start = initial_guess(pair, CELL, CELLULAR, local=field)
                found = correlate(pair, start.ansatz, guess=start.unknowns)
                tell(images, strain, start.local, start, found)


if __name__ == "__main__":
    main()
