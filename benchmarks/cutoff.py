"""Cut-off wavelength of the whole displacement: the one found from images, and the best one.

Specimens of three kinds, two pixel sizes, 8-bit images and images with 1 and 2 % of noise, speckles
of 4, 8 and 12 px: the rms error with the cut-off wavelength that is found, the least error of any
tried (steps of 1.4, until it rises on both sides), and their ratio. The start is the best fit of
the ansatz, not a correlation. Table: docs/explanation/whole_field_speckle.md.

Run: scripts/env python benchmarks/cutoff.py [--noise 0 0.01 0.02] [--speckle 4 8 12]
     [--pixel 0.01 0.02] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np
from whole_field import noisy

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.measure import FiniteElementOptions, measure_displacement
from modeharvest.idic.finite_element.mesh import mesh_of_mask
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec

SPECIMENS = {
    "square, d/l 0.79": (Specimen(3, 4, bulk_x=0.6, bulk_y=0.4), 0.13),
    "square, d/l 0.68": (Specimen(3, 4, diameter=1.3, bulk_x=0.6, bulk_y=0.4), 0.16),
    "triangular, d/l 0.89": (
        Specimen(3, 5, diameter=1.7, stacking="triangular", bulk_x=0.6, bulk_y=0.4), 0.08,
    ),
}  # fmt: skip
STEP = 1.4


@dataclass(frozen=True)
class Row:
    """Numbers of one case; errors are rms per component over all material [px]."""

    specimen: str
    pixel_mm: float
    speckle_px: float
    noise: float
    cutoff_px: float
    error: float
    best_cutoff_px: float
    best_error: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02])
    parser.add_argument("--speckle", type=float, nargs="+", default=[4.0, 8.0, 12.0])
    parser.add_argument("--pixel", type=float, nargs="+", default=[0.01, 0.02])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    print("specimen, pixel [mm], speckle [px], noise: cut-off [px], error; the best; ratio")
    rows = []
    for name, _, width, noise, pair in cases(given.pixel, given.speckle, given.noise):
        rows.append(found(pair, SPECIMENS[name][0], name, noise, width))
        show(rows[-1])
    ratios = np.array([row.error / row.best_error for row in rows])
    print(f"{len(rows)} cases: ratio at most {ratios.max():.2f}, median {np.median(ratios):.2f}, "
          f"above 1.25 in {int((ratios > 1.25).sum())}")  # fmt: skip
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1), "utf-8")


def cases(
    pixels: Sequence[float], speckles: Sequence[float], noises: Sequence[float]
) -> Iterator[tuple[str, float, float, float, ImagePair]]:
    """Name of the specimen, pixel [mm], size of the speckle [px], noise [of full scale], images."""
    for name, (specimen, strain) in SPECIMENS.items():
        solution = simulate(Experiment(specimen, strains=(strain,), mesh_size=0.25))
        for pixel, width in product(pixels, speckles):
            speckle = SpeckleSpec(0.05 * 12.0 / width, blur_px=3.0 * width / 12.0)
            with tempfile.TemporaryDirectory() as folder:
                make_images(solution, ImagingSpec(pixel_size=pixel, speckle=speckle), folder)
                images = ImageSet.read(Path(folder))
                for noise in noises:
                    yield name, pixel, width, noise, noisy(images, strain, noise, 0)


def found(pair: ImagePair, specimen: Specimen, name: str, noise: float, width: float) -> Row:
    """Measure with the cut-off wavelength that is found, then with others."""
    assert pair.truth is not None
    px = pair.grid.pixel_size
    ansatz = Ansatz.of_specimen(specimen, options=AnsatzOptions(4, 3))
    guess = ansatz.initial_guess(pair.strain)
    start = fit_displacement(pair.truth.displacement, pair.grid, ansatz, guess, pair.mask)
    mesh = mesh_of_mask(pair.masks[0], pair.grid, 24.0, 12.0).mesh

    def measured(cutoff: float | None) -> tuple[float, float]:
        result = measure_displacement(
            pair, start, mesh, options=FiniteElementOptions(cutoff_px=cutoff)
        )
        assert pair.truth is not None
        error = (result.displacement_on() - pair.truth.displacement)[pair.masks[0]] / px
        return float(np.sqrt(np.mean(error**2))), result.cutoff_px

    own, cutoff = measured(None)
    tried = {0: own}
    while missing := [k for k in neighbours(tried) if k not in tried]:
        tried[missing[0]] = measured(cutoff * STEP ** missing[0])[0]
    best = min(tried, key=lambda k: tried[k])
    return Row(name, px, width, noise, cutoff, own, cutoff * STEP**best, tried[best])


def neighbours(tried: dict[int, float]) -> tuple[int, int]:
    """Exponents beside that of the least error, in steps of the cut-off wavelength."""
    best = min(tried, key=lambda k: tried[k])
    return best - 1, best + 1


def show(row: Row) -> None:
    """Print a line."""
    print(
        f"{row.specimen:22s} {row.pixel_mm:5.3f} {row.speckle_px:4.0f} {row.noise:6.3f}: "
        f"{row.cutoff_px:6.1f} {row.error:7.4f}; {row.best_cutoff_px:6.1f} {row.best_error:7.4f}; "
        f"{row.error / row.best_error:5.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
