"""Coverage of 95 % intervals of the whole displacement, its strains and the refitted ansatz.

A small specimen (3 x 4 holes, d/l 0.79, 13 %, 0.02 mm/px), each seed with its own speckle and
noise; 8-bit images and images with 1 and 2 % of noise. Over all pixels of the material, and within
10 px of its edges: rms error and rms standard deviation of u and of the Green-Lagrange strain, and
the share of components in their intervals (mean and standard deviation over the seeds, least of any
seed). Every measurement starts at the best fit of the ansatz. The true strain is that of the
truth's finite elements, a fifth as long as those of the measurement, averaged around their nodes.
Intervals of v0, v1 and phi1's parameters, of the ansatz refitted to u, are compared with the best
fit to the truth. Seeds are distributed among processes and kept: a run continues where it was
stopped, or with more seeds. Tables: docs/explanation/whole_field_intervals.md.

Run: scripts/env python benchmarks/whole_coverage.py [--seeds 30] [--noise 0 0.01 0.02]
     [--workers 2] [--folder out/whole_coverage]
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cutoff import SPECIMENS
from numpy.typing import NDArray
from whole_field import Regions, noisy

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.fields import field_of, nodal_gradient
from modeharvest.idic.finite_element.measure import measure_displacement
from modeharvest.idic.finite_element.result import refitted
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.mapping.isoparametric import interpolate, locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import Workers

FloatArray = NDArray[np.float64]

FUNCTION = "whole_coverage:one_seed"
NAME, PIXEL = "square, d/l 0.79", 0.02
STRAINS = "xx", "yy", "xy"
NORMAL_95 = 1.959964
POINTS = 15
"""Points along each side of the cellular part at which v0 and v1 are compared."""


@dataclass(frozen=True)
class Row:
    """Results of one seed, for u and for each strain: over all pixels, and at edges."""

    noise: float
    seed: int
    cutoff_px: float
    covered: dict[str, tuple[float, float]]
    """Shares in 95 % intervals."""
    error: dict[str, tuple[float, float]]
    deviation: dict[str, tuple[float, float]]
    """Rms error and rms standard deviation: of u [px], of strains [-]."""
    refit: dict[str, tuple[float, float]]
    """Of the refitted ansatz against the best fit: shares in 95 % intervals, and the rms error over
    the standard deviation."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out/whole_coverage"))
    given = parser.parse_args()
    here = str(Path(__file__).parent)  # where workers find FUNCTION
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    given.folder.mkdir(parents=True, exist_ok=True)
    specimen, strain = SPECIMENS[NAME]
    path = given.folder / "solution.h5"
    if not path.exists():
        simulate(Experiment(specimen, strains=(strain,), mesh_size=0.1)).write(path)
    cases = grid({"noise": list(given.noise), "seed": 0}, seed=range(given.seeds))
    campaign = Campaign(FUNCTION, cases, given.folder.resolve())
    done = campaign.run(Workers(given.workers), lambda d, n, what: print(f"{d}/{n}", end="\r"))
    print(f"{len(done)} seeds, {int((done['error'] != '').sum())} failed")
    found = [Row(**row) for rows in done["rows"].dropna() for row in rows]
    table(found)
    refit_table(found)


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Rows of one seed at every noise, from the solution in the folder."""
    (specimen, strain), seed = SPECIMENS[NAME], case["seed"]
    solution = Solution.read(folder / "solution.h5")
    rows = []
    with tempfile.TemporaryDirectory() as own:
        make_images(solution, ImagingSpec(pixel_size=PIXEL, speckle=SpeckleSpec(seed=seed)), own)
        images = ImageSet.read(Path(own))
        true = true_strain(solution, images.grid)
        for noise in case["noise"]:
            pair = noisy(images, strain, noise, seed)
            rows.append(asdict(measured(pair, specimen, true, noise, seed)))
    return {"rows": rows}


def true_strain(solution: Solution, grid: PixelGrid) -> FloatArray:
    """(rows, cols, 2, 2) Green-Lagrange strain at the pixels [-]; NaN off the material."""
    (snapshot,), mesh = solution.snapshots, solution.mesh
    F = np.eye(2) + nodal_gradient(mesh, snapshot.displacement)
    located = locate(mesh.nodes, mesh.cells, mesh.element, grid)
    at = np.moveaxis(interpolate(located, mesh.cells, mesh.element, F.reshape(-1, 4)), 0, -1)
    E = field_of("green_lagrange", at.reshape(-1, 2, 2))
    return np.asarray(E.reshape(*grid.shape, 2, 2))


def measured(pair: ImagePair, specimen: Specimen, true: FloatArray, noise: float, seed: int) -> Row:
    """Measure, and compare u and strains with the truth."""
    assert pair.truth is not None
    ansatz = Ansatz.of_specimen(specimen, options=AnsatzOptions(4, 3))
    guess = ansatz.initial_guess(pair.strain)
    start = fit_displacement(pair.truth.displacement, pair.grid, ansatz, guess, pair.mask)
    found, grid, px = measure_displacement(pair, start), pair.grid, pair.grid.pixel_size
    places = Regions.of(pair, specimen)
    both = places.all & np.isfinite(true[..., 0, 0]), places.edges & np.isfinite(true[..., 0, 0])
    errors = {"u": (found.displacement_on() - pair.truth.displacement) / px}
    bars = {"u": found.standard_deviation_on() / px}
    E, sd = found.field("green_lagrange", grid), found.field_deviation("green_lagrange", grid)
    for name in STRAINS:
        i, j = map("xy".index, name)
        errors[name], bars[name] = (E - true)[..., i, j], sd[..., i, j]

    def of(name: str, there: NDArray[np.bool_]) -> tuple[float, float, float]:
        e, s = errors[name][there], bars[name][there]
        covered = float(np.mean(np.abs(e) < NORMAL_95 * s))
        return covered, float(np.sqrt(np.mean(e**2))), float(np.sqrt(np.mean(s**2)))

    each = {name: [*zip(*map(partial(of, name), both), strict=True)] for name in errors}
    parts = ({name: values[k] for name, values in each.items()} for k in range(3))
    refit = refitted_against(start, refitted(found, ansatz, start.unknowns, pair.masks[0]))
    covered, error, deviation = parts
    return Row(noise, seed, found.cutoff_px, covered, error, deviation, refit)


def refitted_against(best: Result, refit: Result) -> dict[str, tuple[float, float]]:
    """Share of v0, v1 and phi1 in 95 % intervals, and their rms error over its sd."""
    known, box = refit.ansatz, refit.ansatz.modes[0].taper.cellular
    x, y = np.linspace(box.x_min, box.x_max, POINTS), np.linspace(box.y_min, box.y_max, POINTS)
    sd, own = field_errors(refit, x, y, refit.covariance()), known.phi_slice(0)
    off = refit.unknowns - best.unknowns
    ratios = {
        "v0": (known.v0(refit.unknowns, x, y) - known.v0(best.unknowns, x, y)) / sd.v0,
        "v1": (known.v(0, refit.unknowns, x, y) - known.v(0, best.unknowns, x, y)) / sd.v[0],
        "phi1": off[own] / refit.standard_errors()[own],
    }
    return {
        name: (float(np.mean(np.abs(z) < NORMAL_95)), float(np.sqrt(np.mean(z**2))))
        for name, z in ratios.items()
    }


def table(rows: list[Row]) -> None:
    """Print the table of displacements and strains."""
    print(
        "| images | of | rms error, all / edges | rms standard deviation, all / edges "
        "| 95 % intervals hold, all | at edges |"
    )
    print("|---" * 6 + "|")
    for noise in sorted({row.noise for row in rows}):
        own = [row for row in rows if row.noise == noise]
        for name in own[0].covered:
            covered = np.array([row.covered[name] for row in own])
            error, bar = (
                np.sqrt(np.mean(np.square([getattr(row, what)[name] for row in own]), axis=0))
                for what in ("error", "deviation")
            )
            unit, scale = (" px", 1.0) if name == "u" else (" ‰", 1e3)
            sd = covered.std(axis=0, ddof=min(1, len(own) - 1))
            shares = [
                f"{100 * m:.1f} ± {100 * s:.1f} % (≥ {100 * least:.1f} %)"
                for m, s, least in zip(covered.mean(axis=0), sd, covered.min(axis=0), strict=True)
            ]
            sizes = (" / ".join(f"{scale * v:.3g}" for v in pair) for pair in (error, bar))
            cells = [f"{100 * noise:g} %" if noise else "8 bit",
                     name if name == "u" else f"E_{name}",
                     *(text + unit for text in sizes), *shares]  # fmt: skip
            print(f"| {' | '.join(cells)} |")


def refit_table(rows: list[Row]) -> None:
    """Print the table of the refitted ansatz."""
    print("\n| images | of the refitted ansatz | 95 % intervals hold "
          "| rms error over standard deviation |")  # fmt: skip
    print("|---" * 4 + "|")
    for noise in sorted({row.noise for row in rows}):
        for name in rows[0].refit:
            share, ratio = np.array([row.refit[name] for row in rows if row.noise == noise]).T
            of, rms = f"{100 * noise:g} %" if noise else "8 bit", np.sqrt(np.mean(ratio**2))
            print(f"| {of} | {name} | {100 * share.mean():.1f} % | {rms:.2f} |")


if __name__ == "__main__":
    main()
