"""Accuracy by the gradient that weights the residual, with model error and noise.

The paper's case after buckling, 12.8 %, at 0.04 mm/px: rms length of the distance of the
correlation from the best fit of its ansatz to the truth [px], by the noise in both images and by
the gradient. Half a minute of processor time. Table: docs/explanation/metrology.md.

Run: scripts/env python benchmarks/gradient_choice.py [--seeds 3]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.pyramid import FULL, eroded
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.case import Case, shipped_solution

STRAIN, PIXEL = 0.128, 0.04
NOISES = (0.0, 0.01, 0.02, 0.04, 0.08)
WEIGHTED = {
    "least squares": {"gradient": "deformed", "gradient_blur_px": 0.0},
    "as by default": {},
    "deformed, blurred by 1 px": {"gradient": "deformed", "gradient_blur_px": 1.0},
    "reference": {"gradient": "reference"},
    "reference, blurred by 1 px": {"gradient": "reference", "gradient_blur_px": 1.0},
}


def images(folder: Path) -> ImageSet:
    """Make the pair of images."""
    path = shipped_solution("paper-virtual")
    spec = replace(Case.read("paper-virtual").imaging, pixel_size=PIXEL)
    make_images(Solution.read(path), spec, folder, [STRAIN])
    return ImageSet.read(folder)


def distances(pair: ImageSet, seeds: int) -> Iterator[tuple[float, str, float]]:
    """Noise, name of the gradient, mean rms length of the distance from the best fit [px]."""
    case = Case.read("paper-virtual")
    ansatz = case.correlation.ansatz(case.experiment.specimen)
    start, grid = ansatz.initial_guess(STRAIN, case.correlation.start_amplitude), pair.grid
    f, g = pair.reference(), pair.deformed(STRAIN)
    masks = pair.mask(), pair.deformed_mask(STRAIN)
    used = eroded(masks[0], 2)
    best = fit_displacement(pair.truth(STRAIN).displacement, grid, ansatz, start, used)
    for sd in NOISES:
        found: dict[str, list[float]] = {name: [] for name in WEIGHTED}
        for seed in range(seeds):
            noise = sd * np.random.default_rng([seed, 1]).normal(size=(2, *grid.shape))
            noisy = f + noise[0], g + noise[1]
            first = correlate(ImagePair(*noisy, grid, *masks), ansatz, guess=start)
            for name, how in WEIGHTED.items():
                options = CorrelationOptions((FULL,), **how)  # type: ignore[arg-type]
                result = correlate(
                    ImagePair(*noisy, grid, *masks), ansatz, guess=first.unknowns, options=options
                )
                off = (result.displacement() - best.displacement())[used]
                found[name].append(np.sqrt((off**2).sum(axis=-1).mean()) / grid.pixel_size)
        for name, values in found.items():
            yield sd, name, float(np.mean(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=3, help="realisations of the noise")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows: dict[float, list[str]] = {}
        for sd, _, px in distances(images(Path(folder) / "images"), options.seeds):
            rows.setdefault(sd, []).append(f"{px:.4f}")
    print(f"| from the best fit [px], noise | {' | '.join(WEIGHTED)} |")
    print(f"|---|{'---|' * len(WEIGHTED)}")
    for sd, cells in rows.items():
        print(f"| {100 * sd:.0f} % | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
