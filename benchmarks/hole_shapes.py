"""Displacement from contours, for holes of various shapes.

::

    scripts/env python benchmarks/hole_shapes.py [--pixel-size 0.03] [--strain 0.06] [--seeds N]

A plate with 3 x 3 holes (Ogden law, exponent 3), clamped left and right and compressed; holes are
round, elliptical (along x and y in turn), dimpled (four dents), notched (two slits) or of three
sizes. Photographs as in contours.py, 1 % noise. --seeds prints instead how often 95 % intervals of
u hold if everything that they count is drawn at random for each plate: noise, Poisson's ratio
(triangular from 0.35 over 0.45 to 0.49, neo-Hookean), the share of free sliding with which loaded
edges widen (from 0 to 1), and the position of pixels. Tables: docs/explanation/contours.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import Material, Ogden
from modeharvest.fem.sparse_factor import factorise
from modeharvest.idic.finite_element.equations.system import Imbalance
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.mesh import mesh_of_mask
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.photograph.plain.measure import displacement_of_plain
from modeharvest.idic.photograph.plain.surface import plain_surface
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.arrays import BoolArray, FloatArray

PITCH, HALF, FINE = 1.9, 3.4, 0.01
"""Pitch of the holes, half the plate's side, pixel of the mask that is meshed [mm]."""
Hole = Callable[[FloatArray, FloatArray, int], BoolArray]
"""Whether points (x, y) from a hole's centre [mm] are inside; the last argument is its number."""


def dimpled(x: FloatArray, y: FloatArray, _: int) -> BoolArray:
    """A radius of 0.68 mm with four dents: it varies by 0.08 mm both ways."""
    return np.asarray(np.hypot(x, y) < 0.68 + 0.08 * np.cos(4.0 * np.arctan2(y, x)))


def notched(x: FloatArray, y: FloatArray, _: int) -> BoolArray:
    """Two slits, 0.16 mm wide and 0.15 mm deep."""
    return np.asarray((np.hypot(x, y) < 0.6) | ((np.abs(x) < 0.08) & (np.abs(y) < 0.75)))


SHAPES: dict[str, Hole] = {
    "round": lambda x, y, _: np.asarray(np.hypot(x, y) < 0.7),
    "elliptical": lambda x, y, k: np.asarray(
        np.hypot(x / (0.55, 0.75)[k % 2], y / (0.75, 0.55)[k % 2]) < 1.0
    ),
    "dimpled": dimpled,
    "notched": notched,
    "three sizes": lambda x, y, k: np.asarray(np.hypot(x, y) < (0.35, 0.55, 0.75)[k % 3]),
}


def plate(hole: Hole) -> Mesh:
    """Mesh of a plate with 3 x 3 holes."""
    count = round(2.0 * (HALF + 0.3) / FINE)
    grid = PixelGrid.centred(count, count, FINE)
    x, y = np.meshgrid(grid.x, grid.y)
    material = (np.abs(x) < HALF) & (np.abs(y) < HALF)
    for k in range(9):
        material &= ~hole(x - PITCH * (k % 3 - 1), y - PITCH * (k // 3 - 1), k)
    return mesh_of_mask(material, grid, 16.0, 6.0).mesh


def pressed(
    mesh: Mesh, strain: float, material: Material | None = None, slides: float = 0.0, steps: int = 4
) -> FloatArray:
    """(n, 2) displacement [mm] of a plate whose left and right edges approach each other.

    The edges widen by ``slides`` [-] of what they would without friction.
    """
    law = Imbalance(mesh, material or Ogden(), np.zeros(len(mesh.nodes), dtype=np.bool_))
    x, y = mesh.nodes.T
    clamped = (x < x.min() + 2.0 * FINE) | (x > x.max() - 2.0 * FINE)
    fixed = np.column_stack([clamped, clamped])
    u = np.column_stack([-strain / steps * x, 0.0 * x])
    if slides:
        fixed[:, 1] = clamped & (np.abs(y) == np.abs(y[clamped]).min())
        wide = equilibrium(law, u, ~fixed.ravel(), steps)[:, 1]
        fixed[:, 1] = clamped
        u[:, 1] = slides / steps * wide
    return equilibrium(law, u, ~fixed.ravel(), steps)


def equilibrium(law: Imbalance, u: FloatArray, free: BoolArray, steps: int) -> FloatArray:
    """(n, 2) displacement [mm] after so many steps; ``u`` is the first, exact if not ``free``."""
    for step in range(1, steps + 1):
        new = u * step / max(1, step - 1)  # extrapolated; exact at clamped edges
        for _ in range(12):
            f, K = law.forces(new.ravel())
            if np.abs(f[free]).max() < 1e-9:
                break
            new.ravel()[free] -= factorise(csr_array(K[free][:, free])).solve(f[free])
        u = new
    return u


class Measured(NamedTuple):
    """Displacement of a plate, measured and true [px]."""

    off: FloatArray
    sd: FloatArray
    """(p, 2) errors and standard deviations."""
    found: NodalResult
    holes: int


def measured(mesh: Mesh, u: FloatArray, pixel_size: float, strain: float, seed: int) -> Measured:
    """Photograph a plate before and after its displacement (n, 2) [mm], and measure that."""
    solution = Solution(mesh, (Snapshot(strain, u),))
    spec = ImagingSpec(
        pixel_size, 40, background=0.15, speckle=SpeckleSpec(dark=0.7, bright=0.7),
        sensor=Sensor(fill_factor=1.0, psf_px=0.6, read_noise=0.01, read_seed=seed), bits=8,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        (pair,) = make_images(solution, spec, folder)
        names = ("reference", f"deformed_{round(1e4 * strain):04d}")
        f, g = (read_image(Path(folder) / f"{n}_8bit.tif") for n in names)
        assert pair.truth
        true = pair.truth.displacement
    surface = plain_surface(f)
    assert surface
    body = FiniteElementOptions().body(surface.mask, pair.grid)
    found, matched = displacement_of_plain(surface, g, pair.grid, body)
    off, sd, px = found.displacement_on() - true, found.standard_deviation_on(), pixel_size
    there = np.isfinite(off[..., 0])
    return Measured(off[there] / px, sd[there] / px, found, len(matched.holes))


def row(name: str, pixel_size: float, strain: float) -> str:
    """Measure photographs of a plate; a line of the table."""
    mesh = plate(SHAPES[name])
    off, sd, found, holes = measured(mesh, pressed(mesh, strain), pixel_size, strain, 0)
    line = [
        np.sqrt(np.mean(off**2)), np.linalg.norm(off, axis=1).max(),
        100.0 * np.mean(np.abs(off) < 1.96 * sd), found.residual_rms,
    ]  # fmt: skip
    cells = " | ".join(f"{value:.3g}" for value in line)
    return f"| {name} | {cells} | {holes} | {' '.join(found.warnings) or 'none'} |"


def statistics(name: str, pixel_size: float, strain: float, seeds: int) -> str:
    """Intervals of plates of which all is drawn that intervals count; a line of the table."""
    mesh, shares, ratios = plate(SHAPES[name]), [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        nu, slides = rng.triangular(0.35, 0.45, 0.49), rng.uniform()
        u = pressed(mesh, strain, Ogden((2.0,), (2.0,), 2.0 * nu / (1.0 - 2.0 * nu)), slides)
        off, sd, *_ = measured(mesh, u, pixel_size * (1.0 + 0.1 * seed / seeds), strain, seed)
        shares.append(100.0 * float(np.mean(np.abs(off) < 1.96 * sd)))
        ratios.append(float(np.mean((off / sd) ** 2)))
        print(f"seed {seed}: Poisson's ratio {nu:.3f}, sliding {slides:.2f}, {shares[-1]:.1f} %, "
              f"error over its sd {np.sqrt(ratios[-1]):.2f}", file=sys.stderr)  # fmt: skip
    return f"| {name} | {np.mean(shares):.1f} | {np.sqrt(np.mean(ratios)):.2f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm]")
    parser.add_argument("--strain", type=float, default=0.06)
    parser.add_argument("--only", nargs="*", default=[*SHAPES], choices=[*SHAPES])
    parser.add_argument("--seeds", type=int, default=0, help="statistics instead, of so many seeds")
    given = parser.parse_args()
    if given.seeds:
        print("| holes | in 95 % intervals [%] | error over its sd, rms |\n" + "|---" * 3 + "|")
        for name in given.only:
            print(statistics(name, given.pixel_size, given.strain, given.seeds), flush=True)
        return
    print("| holes | u off, rms [px] | longest [px] | in 95 % intervals [%] | "
          "off the contours, rms [px] | holes found | warnings |\n" + "|---" * 7 + "|")  # fmt: skip
    for name in given.only:
        print(row(name, given.pixel_size, given.strain), flush=True)


if __name__ == "__main__":
    main()
