"""Pixels left out along edges of holes, and accuracy: ``python benchmarks/edge_pixels.py``.

On the paper's case after buckling (shipped solution), for each ``edge_px``: pixels used, and rms
distance of IDIC from the best fit of its ansatz to the truth (docs/decisions/0003-errors.md).
"""

from __future__ import annotations

import tempfile

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.case import Case, shipped_solution

STRAIN = 0.128


def main() -> None:
    """Print the table."""
    case, path = Case(), shipped_solution("paper-virtual")
    ansatz = case.correlation.ansatz(case.experiment.specimen)
    start = ansatz.initial_guess(STRAIN, case.correlation.start_amplitude)
    with tempfile.TemporaryDirectory() as folder:
        images = make_images(Solution.read(path), case.imaging, folder, (STRAIN,))
        grid, mask, f, g = images.grid, images.mask(), images.reference(), images.deformed(STRAIN)
        g_mask, truth = images.deformed_mask(STRAIN), images.truth(STRAIN).displacement
    best = fit_displacement(truth, grid, ansatz, start, mask).displacement()
    print("edge_px [px]  pixels   IDIC - best fit, rms per component [px]  of the length [px]")
    for edge_px in (0, 1, 2, 3, 5):
        options = CorrelationOptions(edge_px=edge_px)
        result = correlate(
            ImagePair(f, g, grid, mask, g_mask), ansatz, guess=start, options=options
        )
        off = (result.displacement() - best)[mask] / grid.pixel_size
        rms = float(np.sqrt(np.mean(off**2)))
        print(f"{edge_px:12d}  {result.pixels:7d}  {rms:39.3f}  {rms * 2**0.5:18.3f}")


if __name__ == "__main__":
    main()
