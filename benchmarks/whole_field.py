"""Errors of the whole displacement by finite-element DIC, up to the edges of the holes.

On the images of a virtual experiment (``modeharvest run paper-virtual --out FOLDER``), at every
noise (0: 8-bit images, below 0: exact ones): the rms error per component over all material, within
10 px of edges, in ligaments and in the bulk; the longest error; the rms distance of the refitted
ansatz from the best fit; coverage of 95 % intervals; the cut-off wavelength that is found, and the
errors with --others times that. Tables: docs/explanation/whole_field_accuracy.md.

Run: scripts/env python benchmarks/whole_field.py FOLDER [--strain 0.128] [--noise 0 0.01 0.02]
     [--seeds 1] [--mesh mask|specimen] [--law right …] [--element 24 12] [--others 0.7 1.4 2]
     [--window 880 1400 560 840] [--no-free-edges] [--json FILE]

--window measures a part alone (first and last row, first and last column), as if the rest of the
body were unknown, in seconds; errors are counted 15 px inside. --no-free-edges doesn't use the
conditions of free edges.

--law uses the truth's own law or wrong ones (docs/explanation/whole_field_laws.md). Printed is the
share of components at nodes of free edges that contradict it, with * if a warning is given.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.fem.materials import Ogden, functions_of, material_of
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import best_fit, fit_displacement
from modeharvest.idic.finite_element.measure import FiniteElementOptions, Law, measure_displacement
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.pair import ImagePair, Truth

EDGE_PX = 10
MARGIN_PX, INSIDE_PX = 90, 15
"""Margin around a window, and from its border to where errors are counted [px]."""


@dataclass(frozen=True)
class NeoHookean:
    """W = mu/2 (I1 - 2 - 2 ln J) + lambda/2 (ln J)^2 [MPa]."""

    shear: float
    first: float

    def energy(self, F: Any) -> Any:
        """W(F) [MPa]."""
        ufl = functions_of(F)
        log = ufl.ln(ufl.det(F))
        return 0.5 * self.shear * (ufl.inner(F, F) - 2.0 - 2.0 * log) + 0.5 * self.first * log**2


def _softer(nu: float, mu: float) -> float:
    return 2.0 * nu * mu / (1.0 - 2.0 * nu)


LAWS: dict[str, Callable[[Ogden], Any]] = {
    "right": lambda own: own,
    "half-kappa": lambda own: replace(own, kappa=0.5 * own.kappa),
    "double-kappa": lambda own: replace(own, kappa=2.0 * own.kappa),
    "exponent": lambda own: replace(own, exponents=(-2.0,)),
    "neo-Hookean": lambda own: NeoHookean(0.5 * own.moduli[0], own.kappa),
    "nu-20%": lambda own: replace(own, kappa=_softer(0.36, 0.5 * own.moduli[0])),
}
"""Laws made from the truth's own, which has nu = 0.45."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions where errors are counted, each (rows, cols)."""

    all: NDArray[np.bool_]
    edges: NDArray[np.bool_]
    ligaments: NDArray[np.bool_]
    bulk: NDArray[np.bool_]

    @classmethod
    def of(cls, pair: ImagePair, specimen: Specimen) -> Regions:
        """Regions of a specimen that is centred at the origin."""
        mask = pair.masks[0]
        edges = mask & (ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] <= EDGE_PX)
        if pair.truth is not None:  # known in a part alone, with a window
            mask = mask & np.isfinite(pair.truth.displacement[..., 0])
            edges &= mask
        a, b = specimen.cellular_half_size
        outside = (abs(pair.grid.x)[None] > a) | (abs(pair.grid.y)[:, None] > b)
        return cls(mask, edges, mask & ~edges & ~outside, mask & ~edges & outside)


@dataclass(frozen=True)
class Row:
    """Errors of one measurement [px]; rms per component, ``longest`` of vectors."""

    noise: float
    seed: int
    cutoff_px: float
    all: float
    edges: float
    ligaments: float
    bulk: float
    longest: float
    refit: float
    covered: dict[str, float] = field(default_factory=dict)
    law: str = ""
    contradicted: float | None = None
    noticed: bool = False
    unknowns: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    gigabytes: float = 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--strain", type=float, default=0.128)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--mesh", choices=["mask", "specimen"], default="mask")
    parser.add_argument("--others", type=float, nargs="*", default=[])
    parser.add_argument("--law", nargs="+", choices=LAWS, default=[], help="to regularise with")
    parser.add_argument("--element", type=float, nargs=2, default=[24.0, 12.0], metavar="PX")
    parser.add_argument("--window", type=int, nargs=4, metavar="PX")
    parser.add_argument("--no-free-edges", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    images = ImageSet.read(given.folder / "images")
    start = Result.read(given.folder / f"correlation/result_{round(1e4 * given.strain):04d}.json")
    specimen = specimen_of(images)
    truth = images.pair(given.strain).truth
    assert truth is not None
    best = None if given.window else best_fit(truth, start)
    rows, head = [], "noise seed  cut-off     all   edges  ligam.    bulk longest   refit"
    print(f"{head}  covered (all, edges)  seconds (CPU)   GB  unknowns")
    for noise in given.noise:
        for seed, law in product(range(given.seeds), given.law or [""]):
            pair = noisy(images, given.strain, noise, seed)
            if given.window:
                pair = windowed(pair, *given.window)
            options = FiniteElementOptions(
                *given.element, law=law_of(images, law) if law else None,
                free_edges=not given.no_free_edges,
            )  # fmt: skip
            row = measured(pair, start, best, specimen, noise, seed, given.mesh, options)
            rows.append(replace(row, law=law))
            show(rows[-1])
            for share in given.others:
                other = replace(options, cutoff_px=share * row.cutoff_px)
                show(measured(pair, start, best, specimen, noise, seed, given.mesh, other))
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1), "utf-8")


def specimen_of(images: ImageSet) -> Specimen:
    """The specimen in the images."""
    table: dict[str, Any] = dict(images.info["solution"]["specimen"])
    return Specimen(**table)


def law_of(images: ImageSet, name: str) -> Law:
    """One of ``LAWS``, with loaded ends along x."""
    grid, mask = images.grid, images.mask()
    ends = grid.x[np.flatnonzero(mask.any(axis=0))[[0, -1]]] + [-0.5, 0.5] * np.array(
        grid.pixel_size
    )

    def loaded(points: NDArray[Any]) -> NDArray[np.bool_]:
        distance = np.abs(points[:, :1] - ends).min(axis=1)
        return np.asarray(distance < grid.pixel_size)

    own = material_of(images.info["solution"]["material"])
    assert isinstance(own, Ogden)
    return Law(LAWS[name](own), loaded)


def noisy(images: ImageSet, strain: float, noise: float, seed: int) -> ImagePair:
    """Images with white noise [of full scale]; 8-bit ones with noise = 0, exact ones below."""
    pair = images.pair(strain, camera=noise == 0.0)
    if noise <= 0.0:
        return pair
    random = np.random.default_rng(seed)
    f, g = (
        (image + noise * random.standard_normal(image.shape)).astype(np.float32)
        for image in (pair.reference, pair.deformed)
    )
    return pair.with_images(f, g)


def windowed(pair: ImagePair, top: int, bottom: int, left: int, right: int) -> ImagePair:
    """A part of the images around a window, with the mask of the window."""
    grid, truth, mask = pair.grid, pair.truth, np.zeros(pair.grid.shape, dtype=np.bool_)
    assert truth is not None
    mask[top:bottom, left:right] = pair.masks[0][top:bottom, left:right]
    counted = np.full(truth.displacement.shape, np.nan)
    inner = np.s_[top + INSIDE_PX : bottom - INSIDE_PX, left + INSIDE_PX : right - INSIDE_PX]
    counted[inner] = truth.displacement[inner]
    top, left = max(0, top - MARGIN_PX), max(0, left - MARGIN_PX)
    part = np.s_[top : bottom + MARGIN_PX, left : right + MARGIN_PX]
    x, y = map(float, grid.to_mm(top, left))
    rows, cols = mask[part].shape
    own = PixelGrid(rows, cols, grid.pixel_size, x, y)
    f, g, seen = (image[part] for image in (pair.reference, pair.deformed, pair.masks[1]))
    return ImagePair(f, g, own, mask[part], seen, Truth.of(displacement=counted[part]))


def measured(
    pair: ImagePair, start: Result, best: Result | None, specimen: Specimen, noise: float,
    seed: int, kind: str, options: FiniteElementOptions,
) -> Row:  # fmt: skip
    """Measure the whole displacement, and compare it with the truth."""
    px = pair.grid.pixel_size
    mesh = mesh_specimen(specimen, 16.0 * px) if kind == "specimen" else None
    wall, cpu = time.perf_counter(), time.process_time()
    result = measure_displacement(pair, start, mesh, options=options)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    assert pair.truth is not None
    u = result.displacement_on(pair.grid)
    error = (u - pair.truth.displacement) / px
    regions = Regions.of(pair, specimen)
    rms = {
        name: float(np.sqrt(np.mean(error[there] ** 2))) if there.any() else np.nan
        for name, there in vars(regions).items()
    }
    longest = float(np.linalg.norm(error[regions.all], axis=1).max())
    apart = np.full(1, np.nan)
    if best is not None:
        fit = fit_displacement(u, pair.grid, start.ansatz, start.unknowns, pair.mask)
        apart = (fit.displacement() - best.displacement())[regions.all] / px
    return Row(
        noise, seed, result.cutoff_px, **rms, longest=longest,
        refit=float(np.sqrt(np.mean(apart**2))), covered=covered(result, error, regions),
        unknowns=result.unknowns, seconds=wall, cpu_seconds=cpu, gigabytes=used,
        contradicted=result.contradicted,
        noticed=any("law" in text for text in result.warnings),
    )  # fmt: skip


def covered(result: NodalResult, error: NDArray[Any], regions: Regions) -> dict[str, float]:
    """Share of the components in their 95 % intervals."""
    sd = result.standard_deviation_on() / result.grid.pixel_size
    return {
        name: float(np.mean(np.abs(error[there]) < 1.96 * sd[there])) if there.any() else np.nan
        for name, there in vars(regions).items()
    }


def show(row: Row) -> None:
    """Print a line of the table."""
    share = "" if row.contradicted is None else f"{100 * row.contradicted:.1f} %"
    law = f"{row.law} {share}{'*' if row.noticed else ''}"
    print(
        f"{row.noise:5.3f} {row.seed:4d} {row.cutoff_px:8.1f} {row.all:7.4f} {row.edges:7.4f} "
        f"{row.ligaments:7.4f} {row.bulk:7.4f} {row.longest:7.3f} {row.refit:7.4f}  "
        f"{row.covered['all']:8.3f} {row.covered['edges']:8.3f}     "
        f"{row.seconds:6.1f} ({row.cpu_seconds:.1f}) {row.gigabytes:6.2f} {row.unknowns:8d} {law}",
        flush=True,
    )


if __name__ == "__main__":
    main()
